"""The drives: how much torque they give, and how fast it may change.

The torque Q that the law asks for is cut, joint by joint, before it acts in Eq. 24: by a rate limit to what is within
Q̇_max T of the torque of the sample before, T seconds earlier, then by a torque limit to what is within ±Q_max. A torque
that is cut to its limit is the limit to the last bit.

A rate limit acts between two samples of the law, so the law must be sampled (`law.sample_period`): within a step of
Runge and Kutta there is no torque of before. The first sample is not limited in rate: the drives stand at what it asks
for.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import TORQUE, Gain, Section, Size, gain_of
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import per_joint
from robot_models import RobotModel

# Whether the torque of a joint is what was asked for: the column `torque_limited`.
AS_ASKED, AT_TORQUE_LIMIT, AT_RATE_LIMIT = range(3)
OF_THE_ROBOT = "urdf"
TORQUE_RATE = Size(1e12, "N m/s", "no drive is so fast", 1e-9)


def _limit(value: Any) -> Any:
    limit = gain_of(value)
    for index, entry in enumerate(limit if isinstance(limit, tuple) else (limit,)):
        if not entry > 0.0:
            which = f"entry {index} is {entry:g}: " if isinstance(limit, tuple) else ""
            raise ValueError(f"{which}must be greater than 0")
    return limit


def _torque_limit(value: Any) -> Any:
    if isinstance(value, str):
        if value != OF_THE_ROBOT:
            raise ValueError(f'must be N m, one number or one per joint, or "{OF_THE_ROBOT}"')
        return value
    return _limit(value)


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

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint, or the robot's file has no effort limit.
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

    Parameters
    ----------
    section, model
        The limits and the robot.
    period : float or None
        Time between two samples of the law, s; None: it is not sampled.

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint, or the law is not sampled.
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

    Parameters
    ----------
    torque, before : (n,) arrays
        The torque asked for, overwritten, and that of the sample before.
    change, limit : (n,) arrays
        Largest change between the two, and largest torque.
    first : bool
        Whether there is no sample before.
    limited : (n,) array
        Written.
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
