"""MuJoCo: the same machine, with its soft contact in place of Hunt and Crossley's.

The arm is MuJoCo's, from the same URDF. Motors, servo and force mode are written out here, as `scenario` of `machine`
has them. All their numbers are fitted to MuJoCo's own forces, beside those of its contact.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from closedloop.base.arrays import Array
from validation.measured.pressing.machine import (
    CENTRE,
    CYCLE,
    FLANGE,
    FRICTION,
    GAP,
    MACHINE,
    MASS,
    PLACES,
    SIZES,
    STEP,
    TENSOR,
    TIP,
    URDF,
    Parameter,
    contact_time,
    pose,
)
from validation.measured.pressing.touchdowns import Touchdown

RADIUS = 0.01  # m
FIRST = {"direct": 1.7e5, "straight": 6e4, "ramp": 1.7e4}  # 1/s²


class MuJoCoArm:
    """Fitted: the machine, and the contact: stiffness, 1/s², at each place and one damping ratio (solref)."""

    name: ClassVar = "mujoco"
    parameters: ClassVar[Sequence[Parameter]] = (
        *MACHINE,
        *(Parameter(f"stiffness_{place}", "1/s²", k, 1e2, 5e6) for place, k in FIRST.items()),
        Parameter("damping_ratio", "1", 0.5, 0.01, 5.0),
    )  # fmt: skip

    def simulate(self, values: Mapping[str, float], test: Touchdown) -> tuple[Array, Array]:
        """Return time (N,), s, 0 at the first contact, and force (N,), N."""
        import mujoco

        m, k = values, values[f"stiffness_{test.place}"]
        reference = (-k, -2.0 * values["damping_ratio"] * float(np.sqrt(k)))
        model = _model(mujoco, test.place, reference)
        data = mujoco.MjData(model)
        tip = model.site("tip").id
        q, rates = pose(test.place)
        data.qpos[:], data.qvel[:] = q, test.speed * rates
        mujoco.mj_forward(model, data)
        spring, damper, inertia = (m[name] * SIZES for name in ("joint_stiffness", "joint_damping", "motor_inertia"))
        kp, kd = m["servo_stiffness"] * SIZES, m["servo_damping"] * SIZES
        motor, turning = q + data.qfrc_bias / spring, test.speed * rates
        held, at, speed, reading, pressed = motor.copy(), GAP, -test.speed, 0.0, 0.0
        jacobian, force, wrench = np.zeros((3, 6)), 0.0, np.zeros(6)
        steps = round((test.rest + 0.01) / STEP)
        forces: Array = np.zeros(steps)
        torque = np.zeros(6)
        for i in range(steps):
            if i % round(CYCLE / STEP) == 0:
                mujoco.mj_jacSite(model, data, jacobian, None, tip)
                up = np.linalg.pinv(jacobian)[:, 2]
                torque = data.qfrc_bias + kp * (held + up * (at - GAP) - motor) + kd * (up * speed - turning)
            passed = spring * (motor - data.qpos) + damper * (turning - data.qvel)
            turning = turning + STEP * (torque - passed) / inertia
            motor = motor + STEP * turning
            data.qfrc_applied[:] = passed
            mujoco.mj_step(model, data)
            force = 0.0
            for j in range(data.ncon):
                mujoco.mj_contactForce(model, data, j, wrench)
                force += wrench[0]
            pressed = 1.0 if force > 0.0 else 0.0
            reading += STEP * (force - reading) / m["delay"]
            error = reading - test.force - pressed * m["mode_damping"] * speed
            speed += STEP * test.gain * error / m["mode_inertia"]
            speed = min(max(speed, -test.limit), test.limit)
            at += STEP * speed
            forces[i] = force
        time: Array = STEP * np.arange(steps, dtype=np.float64)
        return time - contact_time(time, forces), forces


def _model(mujoco: Any, place: str, reference: tuple[float, float]) -> Any:
    """Return the arm with its tool over a plane, with solref (−stiffness, −damping) of their contact."""
    spec = mujoco.MjSpec.from_string(URDF.read_text(encoding="utf-8"))
    spec.compiler.fusestatic = False
    spec.option.timestep, spec.option.cone = STEP, mujoco.mjtCone.mjCONE_ELLIPTIC
    flange = spec.body(FLANGE)
    tool = flange.add_body(name="tool")
    tool.mass, tool.ipos, tool.explicitinertial = MASS, CENTRE, True
    tool.inertia = TENSOR[:3]
    kept = {"solref": reference, "condim": 3, "friction": [FRICTION, 0.0, 0.0]}
    tool.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=[TIP[0], TIP[1], TIP[2] - RADIUS], **kept)
    tool.add_site(name="tip", pos=TIP)
    height = PLACES[place][2] - GAP
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 1], pos=[0, 0, height], **kept)
    return spec.compile()
