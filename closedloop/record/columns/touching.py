"""The contacts of the links in space: where each is, and the force that it carries."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.edges import E1, ROUND1, choose_crossing, edges_of
from closedloop.mechanics.contacts.shapes import SHAPE, lowest_point, make_shape_memory, shape_of
from closedloop.mechanics.contacts.surfaces import surface_of
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.plane import contact_frame, unit
from closedloop.scenario.contact_names import names_of
from closedloop.scenario.scenario import Scenario
from robot_models.loop_joint import WORLD

Array = NDArray[np.float64]


class Touching(NamedTuple):
    """A contact of links: its name; the number of the frame that has the point, 0 the base, and the point (3,), m,
    in it; the number of the frame that has the surface, and there the normal and tangents of a plane, the rows of a
    (3, 3) array. Of any other surface these are the axes that it is in, from an origin (3,), m, in that frame. Last the
    shape about the point, see `closedloop.mechanics.contacts.shapes`, in axes of the frame that has it.
    """

    name: str
    point_frame: int
    point: Array
    plane_frame: int
    axes: Array
    origin: Array
    surface: PlacedSurface | None
    shape: Array
    edge: Array | None = None  # see `closedloop.mechanics.contacts.edges`

    def force(self, normal: float, friction: Array, axes: Array, origins: Array, t: float = 0.0) -> tuple[Array, Array]:
        """Return where the contact is (3,), m, and the force (3,), N, on the link that has the point, base frame.

        Parameters
        ----------
        normal : float
            Along the normal, N.
        friction : (2,) array
            Along the tangents, N.
        axes, origins : (n + 1, 3, 3) and (n + 1, 3) arrays
            The frames of the base and the joints.
        t : float
            The instant, s, of a surface that moves.
        """
        place, turn = origins[self.point_frame] + axes[self.point_frame] @ self.point, axes[self.plane_frame]
        frame = self.axes
        if self.edge is not None:
            return self._of_edges(place, normal, friction, axes, origins)
        if self.surface is not None:
            within = self.axes @ (turn.T @ (place - origins[self.plane_frame]) - self.origin)
            frame = self.surface.touching(within, t=t).frame @ self.axes
        force = turn @ (np.array([normal, *friction]) @ frame)
        if np.any(self.shape):
            reach = np.zeros(3)
            interpreted(lowest_point)(self.shape, axes[self.point_frame], turn @ frame[0], reach)
            place = place + reach
        return place, force

    def _of_edges(
        self, place: Array, normal: float, friction: Array, axes: Array, origins: Array
    ) -> tuple[Array, Array]:
        """Return what `force` does of edges that cross, the middle of the edge of the link being at `place` (3,), m."""
        assert self.edge is not None
        turn = axes[self.plane_frame] @ self.axes.T
        shapes, link = make_shape_memory(1, np.zeros((1, SHAPE)), np.atleast_2d(self.edge)).shapes, self.point_frame
        shapes.axes[:] = turn.T @ axes[link]
        at = turn.T @ (place - origins[self.plane_frame] - axes[self.plane_frame] @ self.origin)
        interpreted(choose_crossing)(shapes, 0, at, True, -1)
        N, e1 = shapes.frame[0], shapes.axes @ shapes.edge[0, E1 : E1 + 3]
        reach = shapes.crossing[2] * e1 - shapes.edge[0, ROUND1] * N[0]
        return place + turn @ reach, turn @ (np.array([normal, *friction]) @ N)


def placed_frame(mechanism: Any, name: str) -> tuple[int, Array, Array]:
    """Return the joint that carries a frame of a Pinocchio model, 0 the base, and there the frame's axes, as columns
    (3, 3), and its origin (3,), m.
    """
    if name == WORLD:
        return 0, np.eye(3), np.zeros(3)
    frame = mechanism.frames[mechanism.getFrameId(name)]
    return int(frame.parentJoint), frame.placement.rotation, frame.placement.translation


def contact_torques(
    scenario: Scenario,
    mechanism: Any,
    times: Array,
    q: Array,
    forces: Array,
    frictions: Array,
    rolling: Array | None = None,
    pivoting: Array | None = None,
) -> Array:
    """Return the torques of the k contacts of a scenario's links on the joints in N rows, (N, n), N m (N).

    Parameters
    ----------
    scenario : Scenario
    mechanism : pinocchio.Model
    times : (N,) array
        s.
    q : (N, nq) array
        rad (m), as Pinocchio has them.
    forces, frictions : (N, k) and (N, 2 k) arrays
        Along the normals and the tangents, N, on the links that have the points.
    rolling, pivoting : (N, 2 k) and (N, k) arrays, optional
        Moments about the tangents and the normals, N m, on the same links.
    """
    import pinocchio as pin

    torques, contacts, data = np.zeros((len(q), mechanism.nv)), contacts_of(scenario, mechanism), mechanism.createData()
    for k, posture in enumerate(np.ascontiguousarray(q) if contacts else ()):
        pin.computeJointJacobians(mechanism, data, posture)
        axes = np.array([place.rotation for place in data.oMi])
        origins = np.array([place.translation for place in data.oMi])
        for i, touching in enumerate(contacts):
            rub, t = frictions[k, 2 * i : 2 * i + 2], float(times[k])
            place, force = touching.force(float(forces[k, i]), rub, axes, origins, t)
            moment = np.zeros(3)
            if rolling is not None and pivoting is not None:
                moment = touching.force(float(pivoting[k, i]), rolling[k, 2 * i : 2 * i + 2], axes, origins, t)[1]
            for joint, sign in ((touching.point_frame, 1.0), (touching.plane_frame, -1.0)):
                if joint > 0:
                    J = pin.getJointJacobian(mechanism, data, joint, pin.LOCAL_WORLD_ALIGNED)
                    torques[k] += sign * (
                        J[:3].T @ force + J[3:].T @ (np.cross(place - origins[joint], force) + moment)
                    )
    return torques


def contacts_of(scenario: Scenario, mechanism: Any) -> tuple[Touching, ...]:
    """Return the contacts of a scenario's links, those of its sections [[contact]], in a Pinocchio model."""
    sections = scenario.contact or ()
    found = []
    for section, name in zip(sections, names_of(sections), strict=True):
        joint, rotation, origin = placed_frame(mechanism, section.link)
        other, turned, place = placed_frame(mechanism, section.against)
        surface = surface_of(section, name)
        axes = (
            np.eye(3)
            if surface is not None or section.edge is not None
            else contact_frame(unit(section.normal, "normal"))
        )
        at, shape = origin + rotation @ np.array(section.point), shape_of(section, rotation)
        edge = None
        if section.edge is not None:
            shape, edge = np.zeros(SHAPE), edges_of(section, rotation)
            place = place + turned @ np.array(section.through)
        found.append(Touching(name, joint, at, other, axes @ turned.T, place, surface, shape, edge))
    return tuple(found)
