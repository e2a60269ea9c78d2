"""The desired motion and force of a scenario, and the table of them that the loop reads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.follow import follow
from closedloop.control.reference.force import ConstantForceSection, ForceProfile, force_at
from closedloop.control.reference.joint_path import JointPath
from closedloop.control.reference.on_surface import refuse_beyond_edge, refuse_without_normal
from closedloop.control.reference.orientation import orientation_of, refuse_tool_too_large
from closedloop.control.reference.path import Path, path_on
from closedloop.control.reference.table import Reference
from closedloop.control.reference.tip_path import TipPath

if TYPE_CHECKING:
    from closedloop.mechanics.robot.pinocchio import Robot
    from closedloop.mechanics.surface.placed import PlacedSurface


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
        for name, x in zip(("position", "velocity", "acceleration"), self.tip.sample(instants), strict=True):
            table[:, Reference.place(name, n)] = x
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
    if robot.moved and scenario.reference.kind != "hold":
        raise ScenarioError(
            f"reference.kind = {scenario.reference.kind!r}: inverse kinematics follows no path with a robot that a "
            "[[mocap]] moves: leave [reference] out"
        )
    tip = path_on(scenario.reference, robot.known_tip(robot.pinocchios(q))[0], surface, duration)
    if scenario.reference.on_surface != "no":
        refuse_without_normal(surface, tip)
        refuse_beyond_edge(surface, tip)
        refuse_tool_too_large(surface, tip, radius)
    profile = ConstantForceSection() if profile is None else profile
    force_at(profile, scenario.law.force, np.zeros(1))  # a profile at fault is refused before any inverse kinematics
    held = orientation_of(scenario.reference.orientation, axis, robot, q, surface)
    return Desired(tip, follow(robot, q, tip, held), profile, scenario.law.force)
