"""What is drawn of a run in space, as data: shapes and where they are, arrows, paths, the surface, the events.

Nothing here knows how it is drawn. The lab, the page of `Run.show` and the tests read the same scene. Of the surface
that the tip touches it has a patch around the paths, or the whole of one that has an edge.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from closedloop.base.arrays import Array, evenly
from closedloop.base.errors import ScenarioError
from closedloop.figures.force import Drawn, contacts_drawn
from closedloop.figures.motion import frame_of
from closedloop.figures.scene.solids import Ghost, Joined, Shape, reactions_in, robot_in, robot_shapes, solids_mesh
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.mechanics.surface.surface import Surface
from closedloop.record.columns.record import Event
from closedloop.record.columns.touching import Touching, contacts_of, external_wrenches
from closedloop.record.run import Run
from closedloop.scenario.arm import without_tools
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel
from robot_models.cached import cached_property
from robot_models.coordinates import in_pinocchios_order
from robot_models.loop_joint import WORLD

# The patch of the surface reaches this far beyond the path, m, or a share of the path's size.
MARGIN, SHARE = 0.06, 0.3
# And a floor that links touch this share of the size of what is on it.
FLOOR = 0.5
# A surface that the tip never comes so near, m, is out of the way: the arms hold each other or a thing.
FAR = 1.0
# Vertices along a side of a curved surface.
CELLS = 32


@dataclass(frozen=True)
class Ground:
    """The surface of a run in space."""

    run: Run

    @cached_property
    def frame(self) -> Array:
        """The contact frame at the surface's origin (3, 3): rows n, t1, t2, base axes."""
        return frame_of(self.run)

    @cached_property
    def placed(self) -> PlacedSurface | None:
        """The surface in its place; None if it is a user's class in a run file, not named in this process."""
        scenario, start = self.run.scenario, self.run.position[0]
        if not (isinstance(scenario.surface, Surface) and isinstance(scenario.surface_motion, SurfaceMotion)):
            return None
        radius, depth = scenario.tool.radius, 0.0
        found = PlacedSurface.of(scenario.surface, scenario.surface_motion, start, depth, radius)
        for _ in range(20 if found.below_start else 0):  # a tip that starts in a soft surface, which may slope there
            off = found.touching(start).gap - float(self.run.closure_error[0])
            if abs(off) < 1e-12:
                break
            depth += off
            found = PlacedSurface.of(scenario.surface, scenario.surface_motion, start, depth, radius)
        return replace(found, radius=0.0)

    @cached_property
    def mesh(self) -> tuple[Array, NDArray[np.uint32]]:
        """The surface around both paths at t = 0: vertices (k, 3), m, base frame, and triangles (l, 3)."""
        flat = self.placed is None or isinstance(self.placed.section, PlaneSurface)
        if self.placed is not None and self.placed.ends:
            return _whole(self.placed, 2 if flat else CELLS)
        along = np.vstack([thin_out(path) for path in (self.run.position, self.run.reference_tip)]) @ self.frame[1:].T
        low, high = along.min(axis=0), along.max(axis=0)
        offset = float(self.frame[0] @ self.run.position[0] - self.run.closure_error[0])
        offset -= self.run.scenario.tool.radius
        for share in (1.0, 0.5, 0.2, 0.0):  # a ball may be smaller than what is around the path
            margin = share * max(MARGIN, SHARE * float(np.max(high - low)))
            a, b = (np.linspace(x - margin, y + margin, 2 if flat else CELLS) for x, y in zip(low, high, strict=True))
            grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
            vertices = grid @ self.frame[1:] + offset * self.frame[0]
            if flat or self.placed is None:
                break
            none = np.zeros_like(vertices)
            try:
                vertices = self.placed.follow(0.0, np.zeros(len(vertices)), (vertices, none, none))[0]
                break
            except ScenarioError:
                continue
        return vertices, grid_triangles(a.size, b.size)

    @property
    def there(self) -> bool:
        """Whether it is part of what is seen: the tip touches it, or comes near it."""
        if not self.run.scenario.has_surface:
            return False
        return bool(np.any(self.run.mode != FREE)) or float(np.min(self.run.closure_error)) < FAR

    def place(self, row: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and the shift (3,), m, by which the surface is displaced in a row."""
        if self.placed is None:
            return np.eye(3), np.zeros(3)
        return self.placed.displacement(float(self.run.time[row]))


def floor_mesh(scenario: Scenario, points: Array) -> tuple[Array, NDArray[np.uint32]]:
    """Return the plane of the world that links touch, below and around points (k, 3), m, as two triangles.

    Empty where no contact is with such a plane.
    """
    for section in scenario.contact or ():
        if section.against == WORLD and (section.surface is None or section.surface.kind == "plane"):
            frame, through = contact_frame(unit(section.normal, "normal")), np.array(section.through)
            along = (points - through) @ frame[1:].T
            low, high = along.min(axis=0), along.max(axis=0)
            margin = max(MARGIN, FLOOR * float(np.max(high - low)))
            corners = [(x, y) for x in (low[0] - margin, high[0] + margin) for y in (low[1] - margin, high[1] + margin)]
            return through + np.array(corners) @ frame[1:], grid_triangles(2, 2)
    return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint32)


def _whole(placed: PlacedSurface, cells: int) -> tuple[Array, NDArray[np.uint32]]:
    """Return a surface that has an edge, as far as it goes: a rectangle, or a disc, of so many cells a side."""
    a, b = placed.section.bounds()
    if b > 0.0:
        x, y = np.linspace(-a, a, cells), np.linspace(-b, b, cells)
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        sides = cells, cells
    else:
        far, round_it = np.meshgrid(np.linspace(0.0, a, cells), np.linspace(0.0, 2.0 * np.pi, CELLS), indexing="ij")
        grid = np.stack([far * np.cos(round_it), far * np.sin(round_it)], axis=-1).reshape(-1, 2)
        sides = cells, CELLS
    vertices = placed.origin + grid @ placed.frame[1:]
    none = np.zeros_like(vertices)
    return placed.follow(0.0, np.zeros(len(vertices)), (vertices, none, none))[0], grid_triangles(*sides)


def grid_triangles(rows: int, columns: int) -> NDArray[np.uint32]:
    """Return the triangles (2 (rows − 1)(columns − 1), 3) of a grid of vertices, row after row."""
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corner = first[:, None]
    halves = np.hstack([corner, corner + columns, corner + 1, corner + 1, corner + columns, corner + columns + 1])
    return halves.reshape(-1, 3).astype(np.uint32)


def thin_out(points: Array, most: int = 400) -> Array:
    """Return so many of the points (N, 3) at most, evenly spaced in their order, without those that are no numbers."""
    few: Array = points[evenly(len(points), most)]
    return few[np.all(np.isfinite(few), axis=1)]


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
            return shapes  # one and the same for all runs: a page has the robot already
        found = []
        for shape in shapes:
            if shape.frame in moved:  # given in the base frame
                number, frame = moved[shape.frame]
                vertices = (shape.vertices - frame.origin) @ frame.axes
                shape = replace(shape, joint=number, vertices=vertices.astype(np.float32))
            found.append(shape)
        return tuple(found)

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
        rows = evenly(len(self.run), 20)
        there = [self.joint_places(int(row)) for row in rows]
        touched = [a.tail for row, at in zip(rows, there, strict=True) for a in self.between_links(int(row), *at)]
        vertices, faces = floor_mesh(self.run.scenario, np.vstack([origins for _, origins in there]))
        if not touched:
            return vertices, faces
        walls, more = solids_mesh(self.run.scenario, np.array(touched))
        return np.vstack([vertices, walls]), np.vstack([faces, more + np.uint32(len(vertices))])

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
        mechanism = mechanism_of(self.model)
        data = mechanism.createData()  # of its own: several threads draw
        pin.forwardKinematics(
            mechanism, data, np.ascontiguousarray(in_pinocchios_order(self.run.q[row], self.model.joint_types))
        )
        axes, origins = np.array([p.rotation for p in data.oMi]), np.array([p.translation for p in data.oMi])
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
            for arrows, row, reaction in zip(found, rows, reactions, strict=True):
                there = self.joint_places(row)
                forces, (_, places) = self.joined.forces(reaction, *there), self.joined.places(*there)
                each = zip(places, forces, self.joined.loops, strict=True)
                arrows += [Arrow(place, force, f"{LOOP} {loop.name}", LOOP) for place, force, loop in each]
                arrows += self._of_patches(self.between_links(row, *there), row)
                axes, origins = there[0][None], there[1][None]
                outside = external_wrenches(self.run, self._bare, self.tip, axes, origins, slice(row, row + 1))
                for k, (_, p, wrench) in enumerate(outside):
                    arrows.append(Arrow(p[0], wrench[0, :3], f"{OUTSIDE} {k}", OUTSIDE))
        return found

    def _at_tip(self, row: int) -> list[Arrow]:
        run, normal = self.run, self.run.surface_normal[row]
        wanted = 0.0 if run.mode[row] == FREE else float(run.reference_force[row])  # it acts on nothing there
        forces = run.contact_force[row] * normal, np.array(run.friction_force[row]), -wanted * normal
        return [Arrow(run.position[row], force, kind, kind) for kind, force in zip(ARROWS, forces, strict=False)]

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
