"""The contacts of the links in space: where each is, and the force that it carries."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.contacts.names import names_of
from closedloop.scenario.scenario import Scenario
from closedloop.surface.plane import contact_frame, unit
from robot_models.loop_joint import WORLD

Array = NDArray[np.float64]


class Touching(NamedTuple):
    """A contact of links: its name; the number of the frame that has the point, 0 the base, and the point (3,), m,
    in it; the number of the frame that has the plane, and there its normal and tangents, the rows of a (3, 3) array.
    """

    name: str
    point_frame: int
    point: Array
    plane_frame: int
    axes: Array

    def force(self, normal: float, friction: Array, axes: Array, origins: Array) -> tuple[Array, Array]:
        """Return where the point is (3,), m, and the force (3,), N, on the link that has it, base frame.

        Parameters
        ----------
        normal : float
            Along the normal, N.
        friction : (2,) array
            Along the tangents, N.
        axes, origins : (n + 1, 3, 3) and (n + 1, 3) arrays
            The frames of the base and the joints.
        """
        place = origins[self.point_frame] + axes[self.point_frame] @ self.point
        force = axes[self.plane_frame] @ (np.array([normal, *friction]) @ self.axes)
        return place, force


def placed_frame(mechanism: Any, name: str) -> tuple[int, Array, Array]:
    """Return the joint that carries a frame of a Pinocchio model, 0 the base, and there the frame's axes, as columns
    (3, 3), and its origin (3,), m.
    """
    if name == WORLD:
        return 0, np.eye(3), np.zeros(3)
    frame = mechanism.frames[mechanism.getFrameId(name)]
    return int(frame.parentJoint), frame.placement.rotation, frame.placement.translation


def contacts_of(scenario: Scenario, mechanism: Any) -> tuple[Touching, ...]:
    """Return the contacts of a scenario's links, those of its sections [[contact]], in a Pinocchio model."""
    sections = scenario.contact or ()
    found = []
    for section, name in zip(sections, names_of(sections), strict=True):
        joint, rotation, origin = placed_frame(mechanism, section.link)
        other, turned, _ = placed_frame(mechanism, section.against)
        normal_and_tangents = contact_frame(unit(section.normal, "normal")) @ turned.T
        found.append(Touching(name, joint, origin + rotation @ np.array(section.at), other, normal_and_tangents))
    return tuple(found)
