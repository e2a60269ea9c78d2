"""The desired motion and force of a scenario, and the table of them that the loop reads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.follow import follow
from closedloop.control.reference.force import ForceProfile, force_at
from closedloop.control.reference.inverse_kinematics import JointPath
from closedloop.control.reference.on_surface import refuse_beyond_edge, refuse_without_normal
from closedloop.control.reference.orientation import orientation_of, refuse_tool_too_large
from closedloop.control.reference.path import Path, path_on
from closedloop.control.reference.table import Reference
from closedloop.control.reference.tip_path import TipPath

if TYPE_CHECKING:
    from closedloop.mechanics.robot.pinocchio import Robot
    from closedloop.mechanics.surface.placed import PlacedSurface


OUTWARDS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Motion:
    """The desired motion as a function of time."""

    tip: TipPath  # the tip's path, base frame
    joints: JointPath  # the joints' path along it

    def table(self, instants: Array, spare: int = 0) -> Array:
        """Return the table at `instants` (P,), s, rows of `Reference` without a force; at a discontinuity with the
        right limit.

        `spare` columns of zeros are appended.
        """
        n = self.joints.q.shape[1]
        table = np.zeros((instants.size, Reference.count(n) + spare))
        self.joints.write(instants, table, 2)
        if type(self.tip) is TipPath and not self.tip.segments:  # it stays, and the other columns are zero
            table[:, Reference.place("position", n)] = self.tip.origin
            return table
        for name, x in zip(("position", "velocity", "acceleration"), self.tip.sample(instants), strict=True):
            table[:, Reference.place(name, n)] = x
        return table


@dataclass(frozen=True)
class Desired(Motion):
    """The desired motion and force as functions of time."""

    profile: ForceProfile  # the desired force over time
    force: float  # law.force, N, which the profile starts from

    def table(self, instants: Array, spare: int = 0) -> Array:
        """Return the table of `Motion`, with the force."""
        table = super().table(instants, spare)
        table[:, Reference.place("force", self.joints.q.shape[1])] = force_at(self.profile, self.force, instants)
        return table


def desired(
    reference: Path, robot: Robot, surface: PlacedSurface, q: Array, duration: float = 0.0, axis: Array = OUTWARDS,
    radius: float = 0.0,
) -> Motion:  # fmt: skip
    """Return the desired motion of a robot that starts at joint positions q (n,).

    On a surface that moves, the tip is carried along by it for `duration`, s. `axis` (3,) is the axis of the tool, a
    unit vector in the tip's frame, which reference.orientation may hold against the normal, and `radius` that of the
    tool's round end, m.

    Raises
    ------
    ScenarioError
        If [reference] is at fault, the path leaves the surface, or is not one for the tool, or leaves the workspace or
        the joint limits.
    """
    if robot.moved and reference.kind != "hold":
        raise ScenarioError(
            f"reference.kind = {reference.kind!r}: inverse kinematics follows no path with a robot that a "
            "[[mocap]] moves: leave [reference] out"
        )
    tip = path_on(reference, robot.known_tip(robot.pinocchios(q))[0], surface, duration)
    if reference.on_surface != "no":
        refuse_without_normal(surface, tip)
        refuse_beyond_edge(surface, tip)
        refuse_tool_too_large(surface, tip, radius)
    held = orientation_of(reference.orientation, axis, robot, q, surface)
    return Motion(tip, follow(robot, q, tip, held))
