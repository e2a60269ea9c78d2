"""What is drawn of a run in space, as data: shapes and where they are, arrows, paths, the surface, the events.

Nothing here knows how it is drawn. The lab, the page of `Run.show` and the tests read the same scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.link_contacts import Drawn, contacts_drawn
from closedloop.figures.scene.ground import Ground, world_mesh
from closedloop.figures.scene.solids import Ghost, Joined, Shape, reactions_in, robot_in, robot_shapes
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.moved import MovedFrame
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.columns.record import Event
from closedloop.record.columns.touching import Touching, contacts_of, external_wrenches
from closedloop.record.run import Run
from closedloop.scenario.arm import without_tools
from robot_models import RobotModel
from robot_models.cached import cached_property
from robot_models.coordinates import in_pinocchios_order

# Kinds and colours of the arrows, red, green, blue from 0 to 1: of Okabe and Ito's palette.
LOOP, TOUCH, OUTSIDE = "loop force", "force between links", "external force"
# What the marks of loop joints are called where they are hidden.
JOINTS = "loop joints"
ARROWS: dict[str, tuple[float, float, float]] = {
    "contact force": (0.0, 0.447, 0.698),
    "friction": (0.835, 0.369, 0.0),
    "commanded force": (0.0, 0.62, 0.451),
    LOOP: (0.90, 0.62, 0.0),
    TOUCH: (0.337, 0.706, 0.914),
    OUTSIDE: (0.48, 0.38, 0.77),
}
PATH, WANTED = (0.80, 0.47, 0.65), (0.50, 0.31, 0.13)
# The largest force of a run is drawn as long as this share of the arm's reach.
LONGEST = 0.3


class Arrow(NamedTuple):
    """A force: where it acts (3,), m, the force (3,), N, both in the base frame, its name and its kind, of `ARROWS`."""

    tail: Array
    force: Array
    name: str
    kind: str


class Mark(NamedTuple):
    """An event in space: its instant, s, its kind, and the tip's position (3,), m."""

    time: float
    kind: str
    position: Array


@dataclass(frozen=True)
class Scene:
    """A run in space."""

    run: Run
    tip: str  # the frame that touches the surface
    ghosts: tuple[Ghost, ...] = ()  # bodies that are not of the run and are shown beside it

    @cached_property
    def robot(self) -> Robot:
        """The robot, with the tool that the scenario puts on its tip."""
        return robot_in(self.run)

    @property
    def model(self) -> RobotModel:
        """The model of the robot, with the tool."""
        return self.robot.model

    @cached_property
    def joined(self) -> Joined:
        """The loop joints of the robot."""
        return Joined(self.robot, self.size if self.model.loops else 0.0)

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The robot's shapes, each in the frame of a joint, or of a [[mocap]]."""
        shapes, first = robot_shapes(self.run.model, self.tip), mechanism_of(self.model).njoints
        moved = {name: (first + k, each) for k, each in enumerate(self.robot.moved) for name in each.names}
        if not moved:
            return shapes
        return tuple(_in_frame(s, *moved[s.frame]) if s.frame in moved else s for s in shapes)

    @cached_property
    def ground(self) -> Ground:
        """The surface that the tip touches."""
        return Ground(self.run)

    @cached_property
    def surface(self) -> tuple[Array, NDArray[np.uint32]]:
        """The surface at t = 0: vertices (k, 3), m, base frame, and triangles (l, 3); none if it is out of the way.

        Where the tip has none, it is the plane, or the bodies with flat faces, of the world that links touch.
        """
        if self.ground.there:
            return self.ground.mesh
        rows = np.unique(np.linspace(0, len(self.run) - 1, 20).round().astype(int))
        there = [self.joint_places(int(row)) for row in rows]
        touched = [a.tail for row, at in zip(rows, there, strict=True) for a in self.between_links(int(row), *at)]
        return world_mesh(self.run.scenario, np.vstack([origins for _, origins in there]), touched)

    @cached_property
    def marks(self) -> list[Mark]:
        """The events of the contact."""
        return [Mark(event.time, event.kind, self._where(event)) for event in self.run.events]

    def _where(self, event: Event) -> Array:
        """Return where an event is (3,), m: at the tip, or at the contact of links that it was of."""
        if not 0 < event.contact <= len(self.touching):  # at the tip, or a stop
            return event.position
        row = min(int(np.searchsorted(self.run.time, event.time)), len(self.run) - 1)
        place, _ = self.touching[event.contact - 1].force(0.0, np.zeros(2), *self.joint_places(row))
        return place

    def joint_places(self, row: int) -> tuple[Array, Array]:
        """Return axes (k, 3, 3) and origins (k, 3), m, of the base, the joints' frames and each [[mocap]] in a row."""
        axes, origins = joint_frames(self.model, self.run.q[row])
        for frame in self.robot.moved:
            (turn,), (shift,) = frame.displacements(self.run.time[row : row + 1])
            axes = np.concatenate([axes, (turn @ frame.axes)[None]])
            origins = np.concatenate([origins, (turn @ frame.origin + shift)[None]])
        return axes, origins

    def tip_place(self, row: int) -> Array:
        """Return the tip (3,), m, base frame, from the joints' frames as they are drawn, not from the record."""
        frame, (axes, origins) = self._tip_frame, self.joint_places(row)
        return origins[frame.parentJoint] + axes[frame.parentJoint] @ frame.placement.translation

    def tip_axes(self, axes: Array) -> Array:
        """Return the axes of the tip's frame, as columns (3, 3), base frame, where those of the joints' are `axes`."""
        return axes[self._tip_frame.parentJoint] @ self._tip_frame.placement.rotation

    @cached_property
    def _tip_frame(self) -> Any:
        model = mechanism_of(self.model)
        return model.frames[model.getFrameId(self.tip)]

    def arrows(self, rows: Sequence[int] | NDArray[np.int64]) -> list[list[Arrow]]:
        """Return the forces in each of some rows: the same ones, in the same order, in all.

        First those at the tip, of the surface on the tip and the commanded one on the surface; then that of each loop
        joint on its second side; then that of each contact of links on the link that has the point, where they are many
        that of all points of a patch at their centre of pressure; then each force from outside.
        """
        reactions = reactions_in(self.run, np.asarray(rows, dtype=np.int64))
        found = [self._at_tip(row) for row in rows]
        if self.joined.loops or self.touching or self.run.scenario.external_force:
            for arrows, row, each in zip(found, rows, reactions, strict=True):
                there = self.joint_places(row)
                arrows += [*self._in_loops(each, *there), *self._of_patches(self.between_links(row, *there), row)]
                arrows += self._from_outside(row, *there)
        return found

    def _at_tip(self, row: int) -> list[Arrow]:
        run, normal = self.run, self.run.surface_normal[row]
        wanted = 0.0 if run.mode[row] == FREE else float(run.reference_force[row])  # it acts on nothing there
        forces = run.contact_force[row] * normal, np.array(run.friction_force[row]), -wanted * normal
        return [Arrow(run.position[row], force, kind, kind) for kind, force in zip(ARROWS, forces, strict=False)]

    def _in_loops(self, reactions: Array, axes: Array, origins: Array) -> list[Arrow]:
        forces, (_, places) = self.joined.forces(reactions, axes, origins), self.joined.places(axes, origins)
        each = zip(places, forces, self.joined.loops, strict=True)
        return [Arrow(place, force, f"{LOOP} {loop.name}", LOOP) for place, force, loop in each]

    def between_links(self, row: int, axes: Array, origins: Array) -> list[Arrow]:
        """Return the force of each contact of links in a row, where the joints' frames are as `joint_places` has them.

        They are in the order of `touching`, each on the link that has its point.
        """
        if not self.touching:
            return []
        frictions, t = self.run.link_frictions[row].reshape(-1, 2), float(self.run.time[row])
        each = zip(self.touching, self.run.link_forces[row], frictions, strict=True)
        return [
            Arrow(*c.force(float(normal), friction, axes, origins, t), f"{TOUCH} {c.name}", TOUCH)
            for c, normal, friction in each
        ]

    @cached_property
    def patches(self) -> list[Drawn]:
        """The contacts of links that have an arrow: where they are many those of a patch have one."""
        return contacts_drawn(self.run)[0]

    def _of_patches(self, each: list[Arrow], row: int) -> list[Arrow]:
        if not each or len(self.patches) == len(each):
            return each
        found = []
        for patch in self.patches:
            own, pressed = [each[k] for k in patch.numbers], self.run.link_forces[row, patch.numbers]
            weights = pressed / pressed.sum() if pressed.sum() > 0.0 else np.full(len(own), 1.0 / len(own))
            tails, forces = (np.array([arrow[part] for arrow in own]) for part in (0, 1))
            found.append(Arrow(weights @ tails, forces.sum(axis=0), f"{TOUCH} {patch.name}", TOUCH))
        return found

    def _from_outside(self, row: int, axes: Array, origins: Array) -> list[Arrow]:
        here = axes[None], origins[None], slice(row, row + 1)
        each = external_wrenches(self.run, self._bare, self.tip, *here)
        return [Arrow(p[0], wrench[0, :3], f"{OUTSIDE} {k}", OUTSIDE) for k, (_, p, wrench) in enumerate(each)]

    @cached_property
    def _bare(self) -> Any:
        return mechanism_of(without_tools(self.model))  # whose frames no tool moves

    @cached_property
    def touching(self) -> tuple[Touching, ...]:
        """The contacts of the links."""
        return contacts_of(self.run.scenario, self._bare)

    @property
    def kinds(self) -> list[str]:
        """The kinds of arrows that this run has."""
        there = self.ground.there
        some = {LOOP: self.joined.loops, TOUCH: self.touching, "contact force": there}
        some[OUTSIDE] = self.run.scenario.external_force
        some["friction"] = there and self.run.scenario.friction.kind != "none"
        some["commanded force"] = there and bool(np.any(self.run.reference_force))
        return [kind for kind in ARROWS if some.get(kind, True)]

    @cached_property
    def arm_hides_force(self) -> bool:
        """Whether links stand where forces on them are drawn: one that touches another does, and the last link if it is
        above the surface at the start.
        """
        if self.touching:
            return True
        above = self.joint_places(0)[1][self.last_joint] - self.tip_place(0)
        return float(self.ground.frame[0] @ above) > 0.0

    @cached_property
    def hiding(self) -> frozenset[int]:
        """The numbers of the joints whose links may hide forces on them: of the last link, and of those that touch."""
        touching = {frame for each in self.touching for frame in (each.point_frame, each.plane_frame)}
        return frozenset(touching | {self.last_joint}) - {0}

    @cached_property
    def last_joint(self) -> int:
        """The number of the joint that moves the tip."""
        return int(self._tip_frame.parentJoint)

    @cached_property
    def size(self) -> float:
        """How far the furthest joint is along those before it, m, or the extent of the robot or the path if larger."""
        mechanism, far = mechanism_of(self.model), [0.0]
        for parent, place in zip(list(mechanism.parents)[1:], list(mechanism.jointPlacements)[1:], strict=True):
            far.append(far[parent] + float(np.linalg.norm(place.translation)))
        spread = np.ptp(np.vstack([self.joint_places(0)[1], self.tip_place(0)]), axis=0)
        return float(max(*far, *spread, *np.ptp(self.run.position, axis=0), 0.1))

    @cached_property
    def ball(self) -> tuple[Array, float]:
        """The middle (3,) and the radius, m, of a ball that holds all that is drawn at the start."""
        axes, origins = self.joint_places(0)
        parts = [shape.vertices @ axes[shape.joint].T + origins[shape.joint] for shape in self.shapes]
        points = np.vstack([*parts, self.surface[0], origins])
        low, high = points.min(axis=0), points.max(axis=0)
        middle: Array = 0.5 * (low + high)
        return middle, float(np.linalg.norm(points - middle, axis=1).max())

    @cached_property
    def usual_force(self) -> float:
        """The largest usual force of this run, N: 99 % of its forces are not above it."""
        others = LOOP, TOUCH, OUTSIDE
        rows = np.linspace(0, len(self.run) - 1, 20 if set(others) & set(self.kinds) else 0).astype(int)
        of_others = [np.linalg.norm(a.force) for each in self.arrows(rows) for a in each if a.kind in others]
        of_tip = [self.run.contact_force, self.run.reference_force] if self.ground.there else []
        forces = np.abs(np.concatenate([*of_tip, np.asarray(of_others)]))
        return float(np.percentile(forces[np.isfinite(forces)], 99)) if np.isfinite(forces).any() else 0.0

    @cached_property
    def metres_per_newton(self) -> float:
        """A round scale for arrows at which the largest usual force of this run is as long as `LONGEST` says."""
        return round_down(LONGEST * self.size / self.usual_force) if self.usual_force > 0.0 else 0.01


def _in_frame(shape: Shape, number: int, frame: MovedFrame) -> Shape:
    """Return a shape in the base frame as one in a frame that moves, which has that number among the places."""
    vertices = (shape.vertices - frame.origin) @ frame.axes
    return replace(shape, joint=number, vertices=vertices.astype(np.float32))


def scene_of(run: Run, ghosts: Sequence[Ghost] = ()) -> Scene:
    """Return a run of at least one row in space, with bodies beside it."""
    tip = run.scenario.robot.tip or run.model.tip
    assert tip is not None  # a robot without one is refused before anything is simulated
    return Scene(run, tip, tuple(ghosts))


def round_down(x: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above x > 0."""
    power = 10.0 ** math.floor(math.log10(x))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= x * (1.0 + 1e-12))


def quaternions(axes: Array) -> Array:
    """Return the unit quaternions (k, 4), the real part first, of rotation matrices (k, 3, 3)."""
    found = np.array([pin.Quaternion(np.ascontiguousarray(each)).coeffs() for each in axes]).reshape(-1, 4)
    return found[:, [3, 0, 1, 2]]


@lru_cache(maxsize=8)
def mechanism_of(model: RobotModel) -> Any:
    """Return Pinocchio's model of a robot, made once."""
    return model.pinocchio_model()


def joint_frames(model: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return the axes (n + 1, 3, 3) and origins (n + 1, 3), m, of the base and of each joint's frame at q (nq,)."""
    mechanism = mechanism_of(model)
    data = mechanism.createData()  # of its own: several threads draw
    pin.forwardKinematics(mechanism, data, np.ascontiguousarray(in_pinocchios_order(q, model.joint_types)))
    return np.array([p.rotation for p in data.oMi]), np.array([p.translation for p in data.oMi])
