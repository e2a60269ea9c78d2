"""The drives and gears: how much torque they give, how fast it may change, and what arrives at the joints.

The torque Q that the law asks for is cut, joint by joint, before it acts in Eq. 24: by a rate limit to what is within
Q̇_max T of the torque of the sample before, T seconds earlier, then by a torque limit to what is within ±Q_max. A
torque that is cut to its limit is the limit to the last bit.

A rate limit acts between two samples of the law, so the law must be sampled (`law.sample_period`): within a step of
Runge and Kutta there is no torque of before. The first sample is not limited in rate: the drives stand at what it asks
for.

Gears have friction that grows with the load, and may be elastic, with play or without. Elastic joints: between motor
and link a spring and a damper, the motor with its inertia as a state of its own.

    τ = k (θ − q) + d (θ̇ − q̇)            what the transmission passes on to the link, in place of Q in Eq. 24
    B θ̈ = Q − τ                            the motor, with its inertia reflected to the joint

The motor's inertia is that of the drive, which a rigid joint adds to the mass matrix; here it is taken out of it. So
the motion goes to that of rigid joints as 1/k. A controller takes the joints for rigid: the H that it sees has the
motors in it. Friction in the joints acts on the links.

Backlash, the play of 2 b between motor and link, is a dead zone of this spring: with δ = θ − q

    τ = k (δ − b sign δ) + d δ̇      where |δ| > b and this pushes, else 0

so that teeth push on the side where they touch, and never pull. Friction of a gear that grows with its load adds a
share μ of the torque that the gear passes on, τ, or Q of a rigid joint, to the dry friction of the joint:

    |τ_f| = c + μ |τ|               what is driven gets τ (1 − μ) − c, and drives back against τ (1 + μ) + c

Sources: the dead zone in M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash - a survey,
Automatica 38(10), 2002; friction that depends on the load is that of P. Hamon, M. Gautier and P. Garrec, who identified
it on robots about 2010. Elastic joints: M. Spong, Modeling and control of elastic joint robots, ASME J. Dynamic
Systems, Measurement, and Control 109(4), 1987, with the usual assumption that the motors' gyroscopic torques are small.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from closedloop.base import sections
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import ANGLE, COEFFICIENT, TORQUE, Gain, Section, Size, stiffness_in, viscous_in
from closedloop.control.sensor import EachJoint
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import per_joint
from robot_models import RobotModel

# Whether the torque of a joint is what was asked for: the column `torque_limited`.
AS_ASKED, AT_TORQUE_LIMIT, AT_RATE_LIMIT = range(3)
OF_THE_ROBOT = "urdf"
TORQUE_RATE = Size(1e12, "N m/s", "no drive is so fast", 1e-9)


def _limit(value: Any) -> Any:
    return sections.gains_not_negative(sections.gain_of(value), zero=False)


def _torque_limit(value: Any) -> Any:
    if isinstance(value, str) and value != OF_THE_ROBOT:
        raise ValueError(f'must be N m, one number or one per joint, or "{OF_THE_ROBOT}"')
    return value if isinstance(value, str) else _limit(value)


Limit = Annotated[Gain, BeforeValidator(_limit)]
TorqueLimit = Annotated[float | tuple[float, ...] | str, BeforeValidator(_torque_limit)]


class DrivesSection(Section):
    """[drives]: what the joints' drives can do; by default any torque at once, as in the paper."""

    torque_limit: Annotated[TorqueLimit, TORQUE] | None = Field(
        None,
        description='largest torque, N m, one number for all joints or one per joint, or "urdf": the effort limits of '
        "the robot's file; none if left out",
    )
    rate_limit: Annotated[Limit, TORQUE_RATE] | None = Field(
        None,
        description="fastest change of a torque from sample to sample of the law, N m/s, one number or one per joint; "
        "none if left out. It needs law.sample_period",
    )


def torque_limits(section: DrivesSection, model: RobotModel) -> Array:
    """Return the largest torque of each joint (n,), N m; ∞ where there is none.

    Raises ScenarioError if a list has not one entry a joint, or the robot's file has no effort limit.
    """
    limit = section.torque_limit
    if limit is None:
        return np.full(model.n, math.inf)
    if isinstance(limit, str):
        if not np.any(np.isfinite(model.effort_limit)):
            raise ScenarioError(
                f'drives.torque_limit = "{OF_THE_ROBOT}": the file of {model.name} has no effort limits; give them in '
                f"N m, one number or {model.n}"
            )
        return model.effort_limit.copy()
    return per_joint("drives.torque_limit", limit, model.n, model.joint_names)


def torque_steps(section: DrivesSection, model: RobotModel, period: float | None) -> Array:
    """Return by how much each torque may change from sample to sample (n,), N m; ∞ where there is no rate limit.

    `section`, `model`: the limits and the robot.
    `period`: time between two samples of the law, s; None: it is not sampled.
    Raises ScenarioError if a list has not one entry a joint, or the law is not sampled.
    """
    if section.rate_limit is None:
        return np.full(model.n, math.inf)
    if not period:
        raise ScenarioError(
            "drives.rate_limit: acts from sample to sample of the law, and this law is continuous; give "
            "law.sample_period, such as one step of time.step"
        )
    return period * per_joint("drives.rate_limit", section.rate_limit, model.n, model.joint_names)


@kernel
def cut_torque(torque: Array, before: Array, change: Array, limit: Array, first: bool, limited: Array) -> None:
    """Cut the torque (n,), N m, to what the drives can give, and write `limited` (n,), see `AS_ASKED`.

    `torque`, `before`, (n,) arrays: the torque asked for, overwritten, and that of the sample before.
    `change`, `limit`, (n,) arrays: largest change between the two, and largest torque.
    `first`: whether there is no sample before.
    `limited` (n,): written.
    """
    for j in range(torque.shape[0]):
        asked = torque[j]
        limited[j] = AS_ASKED
        if not first and abs(asked - before[j]) > change[j]:
            torque[j] = before[j] + (change[j] if asked > before[j] else -change[j])
            limited[j] = AT_RATE_LIMIT
        if limit[j] < abs(torque[j]) < math.inf:  # what is no number stays none: the run ends by it
            torque[j] = limit[j] if torque[j] > 0.0 else -limit[j]
            limited[j] = AT_TORQUE_LIMIT


MOTOR_INERTIA = Size(1e9, "kg m²", "no motor is so heavy", 1e-12)


class TransmissionSection(Section):
    """[transmission]: between motors and links; by default rigid."""

    stiffness: Annotated[Limit, stiffness_in("N m/rad")] | None = Field(
        None, description="stiffness of the joints, N m/rad, one number for all or one per joint; rigid if left out"
    )
    damping: Annotated[EachJoint, viscous_in("N m s/rad")] = Field(
        0.0, description="damping between motor and link, N m s/rad, one number for all or one per joint"
    )
    motor_inertia: Annotated[Limit, MOTOR_INERTIA] | None = Field(
        None,
        description="inertia of the motors, reflected to the joints, kg m², one number for all or one per joint; the "
        "robot's own drive inertia if left out",
    )
    backlash: Annotated[EachJoint, ANGLE] = Field(
        0.0, description="play between motor and link, from side to side, rad (m), one number for all or one per joint"
    )
    load_friction: Annotated[EachJoint, COEFFICIENT] = Field(
        0.0,
        description="friction of the gear, as a share of the torque that it passes on, one number for all or one per "
        "joint; beside the dry friction of [joint_friction], of rigid joints too",
    )
    measured: Literal["link", "motor"] = Field(
        "link", description="the side on which the controller measures positions and velocities"
    )

    @property
    def elastic(self) -> bool:
        """Whether the joints are elastic."""
        return self.stiffness is not None

    @property
    def on_motors(self) -> bool:
        """Whether the controller measures the motors."""
        return self.elastic and self.measured == "motor"


def transmission_constants(section: TransmissionSection, model: RobotModel) -> Array:
    """Return, of each joint, (5, n): what the next lines say.

    Stiffness, N m/rad, damping, N m s/rad, motor inertia, kg m², half the backlash, rad (m), and the share of the load
    that rubs. A stiffness of zero is that of a rigid joint. Joints without a drive, which loops may have, have no
    motor, and are zero.

    Raises ScenarioError if a list has not one entry a joint, the inertia of a motor is not known, or there is no spring
        to it all.
    """
    if section.stiffness is None:
        usual = TransmissionSection()
        for key in ("damping", "motor_inertia", "backlash", "measured"):
            value = getattr(section, key)
            if value != getattr(usual, key):
                raise ScenarioError(
                    f"transmission.{key} = {value!r}: goes with transmission.stiffness, which is left out: rigid joints"
                )
        none = np.zeros((5, model.n))
        none[4] = per_joint("transmission.load_friction", section.load_friction, model.n, model.joint_names)
        return none

    for drive in model.shared_drives:
        raise ScenarioError(
            f"transmission.stiffness: one drive pulls {', '.join(drive)}: the springs here are in joints with a drive "
            "of their own; leave transmission out"
        )

    def each(key: str) -> Array:
        given = per_joint(f"transmission.{key}", getattr(section, key), model.n, model.joint_names)
        return np.where(model.driven, given, 0.0)

    inertia = np.where(model.driven, model.armature, 0.0) if section.motor_inertia is None else each("motor_inertia")
    if lacking := [
        name for name, own, has in zip(model.joint_names, inertia, model.driven, strict=True) if has and not own > 0.0
    ]:
        raise ScenarioError(
            f"transmission.motor_inertia is left out, and {model.name} has no drive inertia in {', '.join(lacking)}: "
            "give it in kg m², one number or one per joint"
        )
    play = 0.5 * each("backlash")
    return np.stack([each("stiffness"), each("damping"), inertia, play, each("load_friction")])
