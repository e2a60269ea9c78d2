"""The contacts of the links, and forces from outside, in space: where each is, and the force that it carries."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, Mask
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.edges import E1, ROUND1, choose_crossing, edges_of
from closedloop.mechanics.contacts.rolling import SHAPE, lowest_point, make_shape_memory, shape_of
from closedloop.mechanics.contacts.surfaces import surface_of
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.mechanics.loops.boxes import BoxPair, touch_boxes
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.record.columns.record import Record
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of
from robot_models.loop_joint import WORLD


class Touching(NamedTuple):
    """A contact of links: its name; the number of the frame that has the point, 0 the base, and the point (3,), m,
    in it; the number of the frame that has the surface, and there the normal and tangents of a plane, the rows of a
    (3, 3) array. Of any other surface these are the axes that it is in, from an origin (3,), m, in that frame. Last the
    shape about the point, see `closedloop.mechanics.contacts.rolling`, in axes of the frame that has it.
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
    # half axes of two boxes (2, 3, 3) in axes of either frame, and which of the points in which they touch
    box: tuple[Array, int] | None = None

    @property
    def flat(self) -> bool:
        """Whether a point touches a plane, so that `force` takes any number of rows at once."""
        return self.surface is None and self.edge is None and self.box is None and not np.any(self.shape)

    def force(
        self, normal: Array | float, friction: Array, axes: Array, origins: Array, t: float = 0.0
    ) -> tuple[Array, Array]:
        """Return where the contact is (3,), m, and the force (3,), N, on the link that has the point, base frame.

        If it is `flat`, all of these may have the same further axes before theirs. What bears nothing is at its point.

        `normal`: along the normal, N.
        `friction` (2,): along the tangents, N.
        `axes`, `origins`, (n + 1, 3, 3) and (n + 1, 3) arrays: the frames of the base and the joints.
        `t`: the instant, s, of a surface that moves.
        """
        place = origins[..., self.point_frame, :] + axes[..., self.point_frame, :, :] @ self.point
        turn, frame = axes[..., self.plane_frame, :, :], self.axes
        if np.ndim(normal) == 0 and normal == 0.0 and not np.any(friction):
            return place, np.zeros(3)
        if self.edge is not None:
            return self._of_edges(place, float(normal), friction, axes, origins)
        if self.box is not None:
            return self._of_boxes(place, float(normal), friction, axes, origins)
        if self.surface is not None:
            within = self.axes @ (turn.T @ (place - origins[self.plane_frame]) - self.origin)
            frame = self.surface.frame_at_rest(within, t) @ self.axes
        along = np.concatenate([np.asarray(normal)[..., None], friction], axis=-1) @ frame
        force = (turn @ along[..., None])[..., 0]
        if np.any(self.shape):
            reach = np.zeros(3)
            interpreted(lowest_point)(self.shape, axes[self.point_frame], turn @ frame[0], reach)
            place = place + reach
        return place, force

    def forces(
        self, normals: Array, frictions: Array, axes: Array, origins: Array, times: Array
    ) -> tuple[Array, Array]:
        """Return what `force` does of N rows; of one that bears nothing both are zero if it is not `flat`."""
        if self.flat:
            return self.force(normals, frictions, axes, origins)
        places, forces = np.zeros((2, len(normals), 3))
        for k in np.flatnonzero((normals != 0.0) | np.any(frictions != 0.0, axis=1)):
            places[k], forces[k] = self.force(float(normals[k]), frictions[k], axes[k], origins[k], float(times[k]))
        return places, forces

    def _of_boxes(
        self, place: Array, normal: float, friction: Array, axes: Array, origins: Array
    ) -> tuple[Array, Array]:
        """Return what `force` does of two boxes, that of the link with its middle at `place` (3,), m."""
        assert self.box is not None
        pair, (halves, m), turn = BoxPair(np.zeros(BoxPair.count())), self.box, axes[self.plane_frame]
        middle = origins[self.plane_frame] + turn @ self.origin
        pair.half_a[:], pair.half_b[:] = np.linalg.norm(halves, axis=2)
        pair.axes_a[:] = halves[0] @ axes[self.point_frame].T / pair.half_a[:, None]
        pair.axes_b[:] = halves[1] @ turn.T / pair.half_b[:, None]
        pair.apart[:] = place - middle
        interpreted(touch_boxes)(pair)
        return middle + pair.points[m], np.array([normal, *friction]) @ pair.frames[m]

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
    scenario: Scenario, mechanism: Any, times: Array, q: Array, forces: Array, frictions: Array,
    rolling: Array | None = None, pivoting: Array | None = None,
) -> Array:  # fmt: skip
    """Return the torques of the k contacts of a scenario's links on the joints in N rows, (N, n), N m (N).

    `times` (N,): s.
    `q` (N, nq): rad (m), as Pinocchio has them.
    `forces`, `frictions`, (N, k) and (N, 2 k) arrays: along the normals and the tangents, N, on the links that have the
        points.
    `rolling`, `pivoting`, (N, 2 k) and (N, k) arrays: moments about the tangents and the normals, N m, on the same
        links.
    """
    contacts, torques = contacts_of(scenario, mechanism), np.zeros((len(q), mechanism.nv))
    axes, origins, jacobians = frames_in_rows(mechanism, np.ascontiguousarray(q), frames_of(contacts))
    carried = (forces, frictions, rolling, pivoting)
    for frame, wrench in wrenches_on_links(contacts, times, axes, origins, carried):
        if frame > 0:
            torques += np.einsum("kij,ki->kj", jacobians[frame], wrench)
    return torques


def contact_rows(scenario: Scenario, mechanism: Any, time: float, q: Array, some: Mask) -> Array:
    """Return what the joints move the points of some of the k contacts by, (k, 3, n); zeros of the others.

    The rows of a contact are along its normal and its tangents, whatever its surface and the shape that touches it.

    `time`: s.
    `q` (nq,): rad (m), as Pinocchio has them.
    `some` (k,): of which.
    """
    contacts, unit = contacts_of(scenario, mechanism), np.eye(3)[:, None] * some[:, None]
    rows = np.zeros((len(contacts), 3, mechanism.nv))
    axes, origins, jacobians = frames_in_rows(mechanism, np.tile(q, (3, 1)), frames_of(contacts))
    carried = unit[..., 0], unit[..., 1:].reshape(3, -1), None, None
    both = wrenches_on_links(contacts, np.full(3, time), axes, origins, carried)
    for number, (link, wrench) in enumerate(both):  # of each contact on the one link, then on the other
        if link > 0 and some[number // 2]:
            rows[number // 2] += np.einsum("kij,ki->kj", jacobians[link], wrench)
    return rows


def frames_of(contacts: tuple[Touching, ...]) -> list[int]:
    """Return the numbers of the joints' frames that contacts are between, without the base."""
    return sorted({frame for each in contacts for frame in (each.point_frame, each.plane_frame)} - {0})


def wrenches_on_links(
    contacts: tuple[Touching, ...], times: Array, axes: Array, origins: Array,
    carried: tuple[Array, Array, Array | None, Array | None],
) -> Iterator[tuple[int, Array]]:  # fmt: skip
    """Yield, of each contact on either of its links, the link and the wrench (N, 6), base axes, about its origin.

    `axes` and `origins` are those of the links, see `frames_in_rows`; `carried` are forces, frictions, rolling and
    pivoting moments, as `contact_torques` takes them.
    """
    forces, frictions, rolling, pivoting = carried
    for i, touching in enumerate(contacts):
        at, both = (axes, origins, times), slice(2 * i, 2 * i + 2)
        place, force = touching.forces(forces[:, i], frictions[:, both], *at)
        moment = np.zeros(3)
        if rolling is not None and pivoting is not None:
            moment = touching.forces(pivoting[:, i], rolling[:, both], *at)[1]
        for link, sign in ((touching.point_frame, 1.0), (touching.plane_frame, -1.0)):
            about = np.concatenate([force, np.broadcast_to(moment, force.shape)], axis=1)
            yield link, sign * moved_wrench(about, place - origins[:, link])


def moved_wrench(wrench: Array, off: Array) -> Array:
    """Return wrenches (N, 6) about the points from which theirs are off by (N, 3), m."""
    return np.concatenate([wrench[:, :3], wrench[:, 3:] + np.cross(off, wrench[:, :3])], axis=1)


def external_wrenches(
    run: Record, mechanism: Any, tip: str, axes: Array, origins: Array, rows: slice = slice(None)
) -> Iterator[tuple[int, Array, Array]]:
    """Yield, of each force from outside, the link, the point (N, 3), m, and the wrench (N, 6) about it, base axes.

    They are those of the step that begins at each of the rows, see `closedloop.loop.step.external`.
    """
    scenario = run.scenario
    for section in scenario.external_force or ():
        frame, at = section.place(tip, scenario.tool.offset)
        link, rotation, origin = placed_frame(mechanism, frame)
        other, turned, _ = placed_frame(mechanism, section.axes)
        # there it is all or nothing
        step = scenario.time.step * (1e-6 if scenario.time.integrator in ADAPTIVE else 1.0)
        share = section.shares(run.time[rows], step)
        wrench = np.concatenate([axes[:, other] @ turned @ part for part in (section.force, section.moment)], axis=1)
        yield link, origins[:, link] + axes[:, link] @ (origin + rotation @ np.array(at)), share[:, None] * wrench


def frames_in_rows(mechanism: Any, q: Array, some: list[int] | None = None) -> tuple[Array, Array, dict[int, Array]]:
    """Return the axes (N, n + 1, 3, 3) and origins (N, n + 1, 3), m, of some or all joints' frames in N rows, and their
    Jacobians (N, 6, n); the base has its own, the others zeros.
    """
    import pinocchio as pin

    frames, data = list(range(1, mechanism.njoints)) if some is None else some, mechanism.createData()
    axes, origins = np.zeros((len(q), mechanism.njoints, 3, 3)), np.zeros((len(q), mechanism.njoints, 3))
    axes[:, 0] = np.eye(3)
    jacobians = {frame: np.zeros((len(q), 6, mechanism.nv)) for frame in frames}
    for k, posture in enumerate(q if frames else ()):
        pin.computeJointJacobians(mechanism, data, posture)
        for frame in frames:
            axes[k, frame], origins[k, frame] = data.oMi[frame].rotation, data.oMi[frame].translation
            jacobians[frame][k] = pin.getJointJacobian(mechanism, data, frame, pin.LOCAL_WORLD_ALIGNED)
    return axes, origins, jacobians


def contacts_of(scenario: Scenario, mechanism: Any) -> tuple[Touching, ...]:
    """Return the contacts of a scenario's links, those of its sections [[contact]], in a Pinocchio model."""
    sections = scenario.contact or ()
    found = []
    for section, name in zip(sections, names_of(sections), strict=True):
        joint, rotation, origin = placed_frame(mechanism, section.link)
        other, turned, place = placed_frame(mechanism, section.against)
        surface = surface_of(section, name)
        plane = surface is None and section.edge is None and section.box is None
        axes = contact_frame(unit(section.normal, "normal")) if plane else np.eye(3)
        at, shape = origin + rotation @ np.array(section.point), shape_of(section, rotation)
        edge, box = None, None
        if section.box is not None:
            place = place + turned @ np.array(section.through)
            halves = np.array([np.array(section.box.half) @ rotation.T, np.array(section.box.onto) @ turned.T])
            box = halves, section.box.point
        if section.edge is not None:
            shape, edge = np.zeros(SHAPE), edges_of(section, rotation)
            place = place + turned @ np.array(section.through)
        found.append(Touching(name, joint, at, other, axes @ turned.T, place, surface, shape, edge, box))
    return tuple(found)
