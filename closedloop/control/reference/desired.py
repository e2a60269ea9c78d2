"""The desired motion and force, and the table of them that the loop reads.

The rows of the table that the loop reads: what is desired, and what sensors draw, at each of its instants.

`table[:, Reference.place("force", n)]` is a column of it.

Checks of several fields together, shared by several kinds of reference.

The desired motion and force of a scenario, and the table of them that the loop reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Protocol

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Size
from closedloop.control.reference.follow import follow
from closedloop.control.reference.force import ConstantForceSection, ForceProfile, force_at
from closedloop.control.reference.joint_path import JointPath
from closedloop.control.reference.on_surface import refuse_beyond_edge, refuse_without_normal
from closedloop.control.reference.orientation import orientation_of, refuse_tool_too_large
from closedloop.control.reference.path import Path, path_on
from closedloop.control.reference.tip_path import TipPath
from closedloop.jit.blocks import Block, Count
from closedloop.mechanics.surface.placed import unit

if TYPE_CHECKING:
    from closedloop.mechanics.robot.pinocchio import Robot
    from closedloop.mechanics.surface.placed import PlacedSurface


N = Count.of("n")


class Reference(Block, sizes=("n",)):
    """What is desired of n joints, and of the tip in base axes; see `closedloop.loop.step.locate.in_contact_frame`."""

    q: Annotated[Array, N]  # rad (m)
    v: Annotated[Array, N]  # rad/s (m/s)
    position: Annotated[Array, 3]  # m
    velocity: Annotated[Array, 3]  # m/s
    acceleration: Annotated[Array, 3]  # m/s²
    force: float  # N


class TableRow(Block, sizes=("n",)):
    """A row of the table."""

    reference: Reference
    noise: float  # of the force sensor, N


class DrawnRow(TableRow, sizes=("n",)):
    """A row of the table of an arm whose encoders are noisy."""

    draws: Annotated[Array, 2 * N]  # see `closedloop.control.encoder.encoder_draws`


TURNS = Size(1e6, "", "no path goes round so often", 1e-9)

# Sine of the angle by which a direction may point out of the surface: 1e-9 of the way, a nanometre in a metre.
OUT_OF_SURFACE = 1e-9


class Between(Protocol):
    """A section that has a start and a stop, s."""

    @property
    def start(self) -> float: ...  # noqa: D102
    @property
    def stop(self) -> float: ...  # noqa: D102


def direction_along(direction: Sequence[float], normal: Array) -> Array:
    """Return the unit vector (3,) of reference.direction, which must be along the surface with this unit normal (3,).

    Raises
    ------
    ScenarioError
        If it has no direction, or points out of the surface; names the nearest that does not.
    """
    along = unit(direction, "reference.direction")
    out = float(normal @ along)
    if abs(out) > OUT_OF_SURFACE:
        inside = along - out * normal
        size = float(np.linalg.norm(inside))
        near = (inside / size).round(12) + 0.0 if size > 1e-9 else None
        hint = "" if near is None else f"; the nearest direction along it is {near.tolist()}"
        raise ScenarioError(f"reference.direction = {list(direction)}: must lie in the surface{hint}")
    return along


def interval(section: Between) -> tuple[float, float]:
    """Return reference.start and reference.stop, s."""
    if not section.stop > section.start:
        raise ScenarioError(
            f"reference.stop = {section.stop:g}: must be later than reference.start = {section.start:g}"
        )
    return section.start, section.stop


def not_zero(value: float, key: str) -> float:
    """Return the value; refuse zero."""
    if value == 0.0:
        raise ScenarioError(f"{key} = 0: must not be zero")
    return value


OUTWARDS = np.array([0.0, 0.0, 1.0])


class PressingLaw(Protocol):
    """A law that presses: `force`, N."""

    @property
    def force(self) -> float:
        """law.force, N."""


class MotionAndLaw(Protocol):
    """The parts of a scenario that determine the desired motion and force."""

    @property
    def reference(self) -> Path:
        """The motion."""

    @property
    def law(self) -> PressingLaw:
        """The law."""


@dataclass(frozen=True)
class Desired:
    """The desired motion and force as functions of time."""

    tip: TipPath  # the tip's path, base frame
    joints: JointPath  # the joints' path along it
    profile: ForceProfile  # the desired force over time
    force: float  # law.force, N, which the profile starts from

    def table(self, instants: Array, spare: int = 0) -> Array:
        """Return the table at `instants` (P,), s, rows of `Reference`; at a discontinuity with the right limit.

        `spare` columns of zeros are appended.
        """
        n = self.joints.q.shape[1]
        table = np.zeros((instants.size, Reference.count(n) + spare))
        self.joints.write(instants, table, 2)
        to = Reference(table.T, n)
        for part, x in zip((to.position, to.velocity, to.acceleration), self.tip.sample(instants), strict=True):
            part[:] = x.T
        table[:, Reference.place("force", n)] = force_at(self.profile, self.force, instants)
        return table


def desired(
    scenario: MotionAndLaw, robot: Robot, surface: PlacedSurface, q: Array, profile: ForceProfile | None = None,
    duration: float = 0.0, axis: Array = OUTWARDS, radius: float = 0.0,
) -> Desired:  # fmt: skip
    """Return the desired motion and force of a robot that starts at joint positions q (n,).

    On a surface that moves, the tip is carried along by it for `duration`, s. `axis` (3,) is the axis of the tool, a
    unit vector in the tip's frame, which reference.orientation may hold against the normal, and `radius` that of the
    tool's round end, m.

    Raises
    ------
    ScenarioError
        If [reference] or the force profile is at fault, the path leaves the surface, or is not one for the tool, or
        leaves the workspace or the joint limits.
    """
    tip = path_on(scenario.reference, robot.position(q), surface, duration)
    if scenario.reference.on_surface != "no":
        refuse_without_normal(surface, tip)
        refuse_beyond_edge(surface, tip)
        refuse_tool_too_large(surface, tip, radius)
    profile = ConstantForceSection() if profile is None else profile
    force_at(profile, scenario.law.force, np.zeros(1))  # a profile at fault is refused before any inverse kinematics
    held = orientation_of(scenario.reference.orientation, axis, robot, q, surface)
    return Desired(tip, follow(robot, q, tip, held), profile, scenario.law.force)
