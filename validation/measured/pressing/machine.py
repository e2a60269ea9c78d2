"""The UR10e of the tests as a scenario: the maker's arm, a tool, elastic joints, a position servo and a force mode.

What is public is taken: kinematics and inertia of the maker (data/ur10e.urdf), mass, centre and tip of the tool and the
poses of the tests from the scripts and settings of the measurements' repository, the servo's cycle of 2 ms. What is not
public, is fitted: `PARAMETERS`. The tool's own tensor is a guess, that of a body of its size.

MuJoCo: the same machine, with its soft contact in place of Hunt and Crossley's.

The arm is MuJoCo's, from the same URDF. Motors, servo and force mode are written out here, as `scenario` of `machine`
has them. All their numbers are fitted to MuJoCo's own forces, beside those of its contact.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.optimize import least_squares

import closedloop as cl
import robot_models
from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError
from closedloop.scenario.scenario import Scenario
from validation.measured.judged import DATA
from validation.measured.pressing.touchdowns import Touchdown

URDF, FLANGE = DATA / "ur10e.urdf", "tool0"
# Tool centre point and centre of mass in the flange's axes, m, and its turn about the flange's axis; mass, kg.
TIP, CENTRE, TURN, MASS = (0.07188, -0.0415, 0.2594), (0.001, -0.002, 0.15), np.radians(-30.0), 6.86
TENSOR = (0.05, 0.05, 0.02, 0.0, 0.0, 0.0)
# Where the tip is in contact, m, in the arm's base frame. The tool points down, turned half about its axis in one.
PLACES = {"direct": (-0.734, 0.0, 0.0438), "straight": (-0.727, 0.265, 0.082), "ramp": (-0.708, 0.25, 0.183)}
HALF_TURNED = ("direct",)
NEAR = (-0.4, -1.4, 2.0, -2.1, -np.pi / 2.0, 0.0)  # rad: elbow up
CYCLE, STEP, GAP = 0.002, 4e-4, 5e-4  # s, s, and the height from which a run starts, m
# The sizes of the joints, largest first: stiffness, inertia and gains of a wrist are this share of those of the others.
WRIST = 0.2
SIZES = np.array([1.0, 1.0, 1.0, WRIST, WRIST, WRIST])


class Parameter(NamedTuple):
    """A number that is fitted: name, unit, first value, and bounds."""

    name: str
    unit: str
    first: float
    low: float
    high: float


MACHINE = (
    Parameter("joint_stiffness", "N m/rad", 1.9e4, 5e3, 5e5),  # of the three large joints
    Parameter("joint_damping", "N m s/rad", 100.0, 5.0, 600.0),
    Parameter("motor_inertia", "kg m²", 7.5, 0.5, 60.0),
    Parameter("servo_stiffness", "N m/rad", 1.4e4, 2e3, 2e5),
    Parameter("servo_damping", "N m s/rad", 53.0, 30.0, 6e3),
    Parameter("mode_inertia", "kg", 39.0, 15.0, 150.0),
    Parameter("mode_damping", "N s/m", 250.0, 5.0, 4e3),
    Parameter("delay", "s", 0.011, 0.002, 0.03),  # of the reading: the time constant of its low-pass
)
# The stiffness is the mean one at this depth, m: f = k d (depth/d)^exponent.
DEPTH = 1e-3
FIRST = {"direct": (2.0e6, 1.0), "straight": (1.6e4, 4.6), "ramp": (1.9e5, 1.1)}  # N/m, and the exponent
# μ of steel on steel, as of handbooks. A tip that sticks is held along the surface, which makes the arm stiffer along
# the normal for as long as μf holds it: the frequency of the swing rises with the force.
FRICTION = 0.15
CONTACT = (
    *(Parameter(f"stiffness_{place}", "N/m", k, 1e4, 1e8) for place, (k, _) in FIRST.items()),
    *(Parameter(f"exponent_{place}", "1", n, 1.0, 6.0) for place, (_, n) in FIRST.items()),
    Parameter("dissipation", "s/m", 0.87, 1e-2, 30.0),
)


@cache
def pose(place: str) -> tuple[Array, Array]:
    """Return q (6,), rad, with the tip at a place, and q̇ (6,), rad/s, at which it comes down upright at 1 m/s."""
    arm = cl.Robot(robot_models.load(str(URDF)), FLANGE)
    turn = TURN + (0.0 if place in HALF_TURNED else np.pi)
    down = np.array([[np.cos(turn), np.sin(turn), 0.0], [np.sin(turn), -np.cos(turn), 0.0], [0.0, 0.0, -1.0]])

    def tip(q: Array) -> Array:
        (axes,), (at,) = arm.frame_poses(FLANGE, q[None])
        return np.concatenate([at + axes @ TIP - PLACES[place], (axes - down).ravel()])

    found = least_squares(tip, NEAR, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    rates = np.linalg.lstsq(found.jac, -np.eye(12)[2], rcond=None)[0]
    return found.x, rates


def scenario(values: Mapping[str, float], test: Touchdown) -> Scenario:
    """Return the scenario of a test, from `GAP` above the surface on."""
    q, rates = pose(test.place)
    exponent = values[f"exponent_{test.place}"]
    return cl.load_scenario("soft_table", {
        "description": test.name,
        "robot": {"model": str(URDF), "tip": FLANGE, "drive_inertia": False},
        "tool": {"offset": TIP, "mass": MASS, "centre": CENTRE, "inertia": TENSOR},
        "surface": {"kind": "plane", "normal": [0, 0, 1], "offset": "start", "gap": GAP, "contact": "unilateral"},
        "compliance": {
            "kind": "hunt_crossley", "exponent": exponent, "dissipation": values["dissipation"],
            "stiffness": values[f"stiffness_{test.place}"] * DEPTH ** (1.0 - exponent),
        },
        "friction": {"kind": "coulomb", "coefficient": FRICTION},
        "transmission": {
            "stiffness": list(values["joint_stiffness"] * SIZES), "damping": list(values["joint_damping"] * SIZES),
            "motor_inertia": list(values["motor_inertia"] * SIZES), "measured": "motor",
        },
        "sensor": {"filter_time_constant": values["delay"]},
        "reference": {"kind": "hold"},
        "law": {
            "kind": "servo_admittance", "force": test.force, "gain_scaling": test.gain, "speed_limit": test.limit,
            "kp": list(values["servo_stiffness"] * SIZES), "kd": list(values["servo_damping"] * SIZES),
            "admittance_inertia": values["mode_inertia"], "admittance_damping": 0.0,
            "contact_damping": values["mode_damping"], "sample_period": CYCLE,
        },
        "start": {"q": list(q), "v": list(test.speed * rates)},
        "stabiliser": {"kind": "none"},
        "time": {"duration": test.rest + 0.01, "step": STEP, "integrator": "rk4"},
    })  # fmt: skip


def contact_time(time: Array, force: Array) -> float:
    """Return the instant of the first force, s."""
    return float(time[np.argmax(force > 0.0)])


class ClosedLoopArm:
    """The scenario in this package's compiled engine."""

    name: ClassVar = "closedloop"
    parameters: ClassVar[Sequence[Parameter]] = (*MACHINE, *CONTACT)

    def simulate(self, values: Mapping[str, float], test: Touchdown) -> tuple[Array, Array]:
        """Return time (N,), s, 0 at the first contact, and force (N,), N; none of a run that could not go on."""
        try:
            run = cl.simulate(scenario(values, test), progress=False, engine="compiled")
        except ClosedLoopError:
            return np.zeros(1), np.zeros(1)
        return run.time - contact_time(run.time, run.contact_force), run.contact_force


RADIUS = 0.01  # m
START = {"direct": 1.7e5, "straight": 6e4, "ramp": 1.7e4}  # 1/s²


class MuJoCoArm:
    """Fitted: the machine, and the contact: stiffness, 1/s², at each place and one damping ratio (solref)."""

    name: ClassVar = "mujoco"
    parameters: ClassVar[Sequence[Parameter]] = (
        *MACHINE,
        *(Parameter(f"stiffness_{place}", "1/s²", k, 1e2, 5e6) for place, k in START.items()),
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
