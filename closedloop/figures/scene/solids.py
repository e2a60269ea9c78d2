"""The solids of a scene: a robot's shapes, bodies with flat faces, loop joints, and a second body beside them.

The visual shapes of a robot's URDF are used: boxes, cylinders, spheres, and meshes where their files are installed; or
the geoms of its MJCF. A robot without any is drawn as a rod from each joint to the next.

Of each loop joint a mark is drawn where it is, and the force that it carries. Its place follows from the rows of the
closure (`closedloop.mechanics.loops.bind`), its force from the joint's reaction
(`closedloop.mechanics.loops.reactions`), so that a later kind of loop joint is drawn as well: as a ball.
"""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.mechanics.contacts.surfaces import surface_of
from closedloop.mechanics.loops.bind import bound_by_loops, link_poses, loop_memory
from closedloop.mechanics.loops.memory import GEAR
from closedloop.mechanics.loops.reactions import loop_rows, named_side, parts_of, rows_along
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.kinds.polyhedron import Polyhedron
from closedloop.record.columns.derived import reactions_of
from closedloop.record.run import Run
from closedloop.scenario.arm import robot_of
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import robot_key
from robot_models import RobotModel
from robot_models.collision import collision_shapes, mesh_file, source_folder
from robot_models.loop_joint import WORLD

if TYPE_CHECKING:
    import trimesh


# Triangles of one visual shape at most, where the library that reduces meshes is installed.
MOST_TRIANGLES = 1500
GREY, ROD, MARK = (0.62, 0.65, 0.68), (0.30, 0.45, 0.60), (0.62, 0.48, 0.80)


@dataclass(frozen=True)
class Shape:
    """Triangles fixed in the frame of a joint."""

    joint: int  # 0 for what stands still; k for what moves with the k-th joint, counted from 1, or frame behind these
    vertices: NDArray[np.float32]  # (V, 3): m, in the joint's frame
    faces: NDArray[np.int32]  # (F, 3): numbers of vertices, counter-clockwise seen from outside
    colour: tuple[float, float, float]  # red, green, blue, 0 to 1
    frame: str = ""  # the link's, where it is one


@lru_cache(maxsize=8)
def robot_shapes(model: RobotModel, tip: str) -> tuple[Shape, ...]:
    """Return the shapes of a robot whose frame `tip` is the tip."""
    mechanism = model.pinocchio_model()
    shapes = _visuals(model, mechanism) if model.format == "urdf" else _geoms(model, mechanism)
    return tuple(shapes or _rods(mechanism, tip))


def _visuals(model: RobotModel, mechanism: Any) -> list[Shape]:
    """Return the shapes that a URDF gives; none if it gives none that can be read."""
    from yourdfpy import URDF

    options = {"build_scene_graph": False, "load_meshes": False}
    robot = URDF.load(io.BytesIO(model.text.encode()), **options).robot
    named = {m.name: m.color for m in robot.materials}
    shapes = []
    for link in robot.links:
        if not mechanism.existFrame(link.name, pin.FrameType.BODY):
            continue
        frame = mechanism.frames[mechanism.getFrameId(link.name, pin.FrameType.BODY)]
        for visual in link.visuals:
            origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin, dtype=float)
            place = frame.placement.homogeneous @ origin
            for mesh, colour in _meshes(visual, named, source_folder(model.source)):
                shapes.append(_shape(int(frame.parentJoint), mesh, place, colour or GREY, link.name))
    return shapes


def _geoms(model: RobotModel, mechanism: Any) -> list[Shape]:
    """Return the geoms that an MJCF gives, meshes that touch as their convex hulls, and no planes."""
    import trimesh

    shapes = []
    for link in model.frames:
        for geom in collision_shapes(model, link, visual=True):
            a, b, _ = geom.size
            if geom.kind == "box":
                mesh = trimesh.creation.box(2.0 * geom.size)
            elif geom.kind == "cylinder":
                mesh = trimesh.creation.cylinder(a, 2.0 * b, sections=32)
            elif geom.kind == "capsule":
                mesh = trimesh.creation.capsule(2.0 * b, a)
                mesh.apply_translation(-mesh.bounds.mean(axis=0))
            elif geom.kind == "mesh":
                mesh = trimesh.convex.convex_hull(geom.vertices)
            else:
                mesh = trimesh.creation.icosphere(3)
                mesh.apply_scale(geom.size if geom.kind == "ellipsoid" else a)
            frame = mechanism.frames[mechanism.getFrameId(link)]
            place = frame.placement.homogeneous @ geom.place
            shapes.append(_shape(int(frame.parentJoint), mesh, place, geom.colour or GREY, link))
    return shapes


def _shape(
    joint: int, mesh: trimesh.Trimesh, place: Array, colour: tuple[float, float, float], frame: str = ""
) -> Shape:
    vertices = np.asarray(mesh.vertices) @ place[:3, :3].T + place[:3, 3]
    return Shape(joint, vertices.astype(np.float32), np.asarray(mesh.faces, dtype=np.int32), colour, frame)


def _meshes(visual: Any, named: dict[str, Any], folder: Path | None) -> list[tuple[trimesh.Trimesh, Any]]:
    """Return the triangles of one visual shape, and their colour: the shape's own, else that of its file, or None.

    `named` are the colours of the robot's materials by name.
    """
    import trimesh

    shape, material = visual.geometry, visual.material
    given = None if material is None else material.color or named.get(material.name)
    colour = None if given is None else tuple(float(c) for c in given.rgba[:3])
    if shape.box is not None:
        return [(trimesh.creation.box(np.asarray(shape.box.size)), colour)]
    if shape.cylinder is not None:
        return [(trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length, sections=32), colour)]
    if shape.sphere is not None:
        return [(trimesh.creation.icosphere(3, shape.sphere.radius), colour)]
    if shape.mesh is None:
        return []
    file = mesh_file(shape.mesh.filename, folder)
    if file is None:
        return []
    scale = np.ones(3) if shape.mesh.scale is None else np.broadcast_to(np.asarray(shape.mesh.scale, dtype=float), 3)
    return [(mesh, colour or own) for mesh, own in _read(file, tuple(scale.tolist()))]


@lru_cache(maxsize=64)
def _read(file: Path, scale: tuple[float, float, float]) -> list[tuple[trimesh.Trimesh, Any]]:
    """Return the meshes of a file, scaled and reduced, each with its colour; none if the file cannot be read."""
    import trimesh

    try:
        scene = trimesh.load_scene(file)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception:  # whatever a reader of meshes makes of a file; a run does not depend on it
        return []
    total, found = sum(len(part.faces) for part in parts), []
    for part in parts:
        main = getattr(getattr(part.visual, "material", None), "main_color", None)
        colour = None if main is None else tuple(float(c) / 255.0 for c in main[:3])
        bare = trimesh.Trimesh(part.vertices * np.array(scale), part.faces, process=True)
        found.append((_reduced(bare, max(60, MOST_TRIANGLES * len(part.faces) // total)), colour))
    return found


def _reduced(mesh: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """Return a mesh of about so many triangles at most; as it is where the library for that is not installed."""
    if len(mesh.faces) <= most:
        return mesh
    try:
        return mesh.simplify_quadric_decimation(face_count=most)
    except ImportError:
        return mesh


def _rods(mechanism: Any, tip: str) -> list[Shape]:
    """Return a rod from each joint to those that follow it, and to the tip, and a ball at each joint."""
    import trimesh

    frame = mechanism.frames[mechanism.getFrameId(tip)]
    ends = [(int(mechanism.parents[j]), mechanism.jointPlacements[j].translation) for j in range(1, mechanism.njoints)]
    ends.append((int(frame.parentJoint), frame.placement.translation))
    reach = sum(float(np.linalg.norm(end)) for _, end in ends) or 1.0
    shapes = [
        _shape(joint, trimesh.creation.icosphere(2, 0.03 * reach), np.eye(4), GREY)
        for joint in range(mechanism.njoints)
    ]
    for joint, end in ends:
        if np.linalg.norm(end) > 1e-6 * reach:
            rod = trimesh.creation.cylinder(0.018 * reach, segment=[np.zeros(3), np.asarray(end)], sections=24)
            shapes.append(_shape(joint, rod, np.eye(4), ROD))
    return shapes


# Radius and height, in hundredths of the arm's reach, of the cylinder along its axis that a loop joint is drawn as.
_MARKS = {
    "hinge": (1.4, 7.0), "cylinder": (1.0, 14.0), "universal": (0.9, 7.0), "planar": (5.0, 0.4), "gear": (4.0, 1.2)
}  # fmt: skip


Mesh = tuple[Array, NDArray[np.uint32]]

# They are drawn this far beyond the contacts, m, if the ball that fits in what is drawn has at least this radius.
BEYOND, THINNEST = 0.03, 1e-9


def solids_mesh(scenario: Scenario, points: Array) -> Mesh:
    """Return the polyhedra of the world that links touch, in a box around points (k, 3), m, base frame.

    Vertices (m, 3), m, and triangles (l, 3); empty where no contact is with a polyhedron.
    """
    low, high = points.min(axis=0) - BEYOND, points.max(axis=0) + BEYOND
    box = np.vstack([np.column_stack([np.eye(3), high]), np.column_stack([-np.eye(3), -low])])
    vertices: list[Array] = [np.zeros((0, 3))]
    triangles: list[NDArray[np.int64]] = [np.zeros((0, 3), np.int64)]
    for section in scenario.contact or ():
        placed = surface_of(section) if section.against == WORLD else None
        if placed is None or placed.moves or not isinstance(placed.section, Polyhedron):
            continue
        faces = np.array(placed.section.resolved()["faces"]).reshape(-1, 4)
        faces[1:, 3] += placed.section.oversize
        normals = faces[:, :3] @ placed.frame[[1, 2, 0]]  # a face's axes are the two tangents and the normal
        solid = np.column_stack([normals, faces[:, 3] + normals @ placed.origin])
        corners, sides = _between(np.vstack([solid, box]))
        triangles.append(sides + sum(len(each) for each in vertices))
        vertices.append(corners)
    return np.vstack(vertices), np.vstack(triangles).astype(np.uint32)


def _between(planes: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the body n·p ≤ d, whose planes (m, 4) are unit n and d, as corners and triangles; none if it is empty.

    Within it is the centre of the largest ball that fits.
    """
    import trimesh
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection

    within, anywhere = np.insert(planes[:, :3], 3, 1.0, axis=1), (None, None)
    ball = linprog([0.0, 0.0, 0.0, -1.0], within, planes[:, 3], bounds=[anywhere, anywhere, anywhere, (0.0, None)])
    if not (ball.success and ball.x[3] > THINNEST):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    found = trimesh.convex.convex_hull(HalfspaceIntersection(planes * [1, 1, 1, -1], ball.x[:3]).intersections)
    return np.asarray(found.vertices), np.asarray(found.faces)


# The robots of the runs drawn last: what is computed of a robot's loops is kept with it, and takes as long as a run of
# few steps.
_robots = Cache(limit=4)
# A robot has one memory for Pinocchio's results, and several threads draw.
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class _Loop:
    """A loop joint: its name, what its mark looks like, its two sides, and its axes, in the first side's frame.

    Each side is the number of its joint's frame, 0 for the base, and there its point (3,), m.
    `named` are the joint's frame, 0 for the base, and there the axes, as columns, in which its reaction is; `force`
    says which parts of all reactions are its force: none of a gear.
    """

    name: str
    shape: Shape
    sides: tuple[tuple[int, Array], tuple[int, Array]]
    axes: Array
    named: tuple[int, Array]
    force: tuple[int, ...]
    rod: bool  # from one side to the other


@dataclass(frozen=True, eq=False)
class Joined:
    """The loop joints of a robot."""

    robot: Robot  # with loops or without
    size: float  # the reach of the robot, m, which decides how large the marks are

    @property
    def loops(self) -> tuple[_Loop, ...]:
        """The loop joints, in the order of the model."""
        return _loops_of(self.robot, self.size)

    def places(self, axes: Array, origins: Array) -> tuple[Array, Array]:
        """Return the axes (k, 3, 3), as columns, and the origins (k, 3), m, base frame, of the marks.

        `axes`, `origins`, (n + 1, 3, 3) and (n + 1, 3) arrays: the frames of the base and the joints.
        """
        turns, points = np.zeros((len(self.loops), 3, 3)), np.zeros((len(self.loops), 3))
        for k, loop in enumerate(self.loops):
            (first, points[k]), (_, other) = ((at, origins[at] + axes[at] @ point) for at, point in loop.sides)
            turns[k] = _upright(other - points[k]) if loop.rod else axes[first] @ loop.axes
        return turns, points

    def forces(self, reactions: Array, axes: Array, origins: Array) -> Array:
        """Return the force (k, 3) of each loop joint on its second side, N, base frame.

        Where a rod ends on a platform it is the second: the force on the rod would be drawn inside of it.

        `reactions` (c,): on the first side, see `closedloop.mechanics.loops.reactions.LoopReactions`.
        `axes`, `origins`, (n + 1, 3, 3) and (n + 1, 3) arrays: the frames of the base and the joints.
        """
        found = np.zeros((len(self.loops), 3))
        for k, loop in enumerate(self.loops):
            if loop.force:
                number, turn = loop.named
                found[k] = -axes[number] @ turn @ reactions[list(loop.force)]
        return found


@lru_cache(maxsize=8)
def _loops_of(robot: Robot, size: float) -> tuple[_Loop, ...]:
    """Return the loop joints of a robot, their marks as large as its reach `size`, m, asks for."""
    model = robot.model
    if not model.loops:
        return ()
    bound, mechanism = bound_by_loops(robot), model.pinocchio_model()
    poses = link_poses(robot.tree, model.loop_home)
    kinds, first, second, _ = bound.sides.reshape(4, -1)
    data = mechanism.createData()
    pin.forwardKinematics(mechanism, data, robot.pinocchios(model.home))
    frames = [(place.rotation, place.translation) for place in data.oMi]

    def side(link: int, point: Array) -> tuple[int, Array]:
        place = poses[link][1] + poses[link][0] @ point
        return link + 1, frames[link + 1][0].T @ (place - frames[link + 1][1])

    found, at, parts = [], 0, 0
    for loop in model.loops:
        a, b = int(first[at]), int(second[at])
        sides = side(a, bound.at_a[at]), side(a if kinds[at] == GEAR else b, bound.at_b[at])
        axis, named, force = np.array([0.0, 0.0, 1.0]), (0, np.eye(3)), range(0)
        if kinds[at] == GEAR:
            axis = frames[a + 1][0].T @ poses[a][0] @ axis
        elif loop.frames:
            number, turn, _ = robot.frame_at(named_side(robot, loop)[0], model.home)
            named, force = (number + 1, frames[number + 1][0].T @ turn), range(parts, parts + 3)
            axis = mechanism.frames[mechanism.getFrameId(loop.frames[0])].placement.rotation @ np.array(loop.axes[0])
        import trimesh

        part = 0.01 * size
        if loop.length > 0.0:
            mesh = trimesh.creation.cylinder(
                0.7 * part, segment=[np.zeros(3), np.array([0.0, 0.0, loop.length])], sections=24
            )
        elif loop.type in ("slider", "weld"):
            mesh = trimesh.creation.box(part * np.array([2.0, 2.0, 14.0 if loop.type == "slider" else 2.0]))
        elif loop.type in _MARKS:
            radius, height = _MARKS[loop.type]
            mesh = trimesh.creation.cylinder(part * radius, part * height, sections=24)
        else:
            mesh = trimesh.creation.icosphere(2, 1.8 * part)
        shape = _shape(0, mesh, np.eye(4), MARK)
        found.append(_Loop(loop.name, shape, sides, _upright(axis), named, tuple(force), bool(loop.length)))
        at, parts = at + loop.rows, parts + len(parts_of(model, loop))
    return tuple(found)


def reactions_in(run: Run, rows: NDArray[np.int64]) -> Array:
    """Return the reactions (k, c) of a mechanism's loops in some rows (k,) of its run, N or N m; (k, 0) of a tree."""
    if not run.model.loops:
        return np.zeros((len(rows), 0))
    few = {name: column[rows] for name, column in run.columns.items() if run.specs[name].dims[0] == "time"}
    robot = robot_in(run, whole=True)
    with _one_at_a_time:
        return reactions_of(replace(run, columns={**run.columns, **few}), robot).reactions


def robot_in(run: Run, whole: bool = False) -> Robot:
    """Return the robot of a run, with the tool that the scenario puts on its tip: one for all runs with the same.

    If asked for, links that stand for coordinates of loop joints share no mass, as for their reactions.
    """
    key = run.model, whole, robot_key(run.scenario, Cache())
    model = replace(run.model, whole=True) if whole else run.model
    return _robots.get_shared(key, lambda: robot_of(run.scenario, model), lambda robot: 1)


def errors_in(run: Run, rows: NDArray[np.int64]) -> Array:
    """Return the errors (k, m) of a mechanism's loops in some rows (k,) of its run, m or sines of angles."""
    robot = robot_in(run)
    compile_rows(robot)
    with _one_at_a_time:
        return loop_rows(robot, run.q[rows], run.v[rows], run.time[rows])[1]


def compile_rows(robot: Robot) -> None:
    """Have compiled what evaluates the rows of loops: interpreted it takes 1 ms for each row of a run."""
    memory, n, m = loop_memory(robot), robot.n, sum(loop.rows for loop in robot.model.loops)
    states = np.zeros((0, n))
    states.flags.writeable = False  # as a run's columns are: for another type it would be compiled again
    rows_along(memory.address, states, states, np.zeros((0, 0)), np.zeros((0, m, n)), np.zeros((0, m)))


def _upright(axis: Array) -> Array:
    """Return axes, as columns, of which the last is along `axis` (3,), however long."""
    z = axis / (np.linalg.norm(axis) or 1.0)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x) or 1.0
    return np.column_stack([x, np.cross(z, x), z])


#: Red, green, blue from 0 to 1: of Okabe and Ito's palette, and how much of what is behind a ghost it hides.
COLOUR, OPACITY = (0.90, 0.62, 0.0), 0.35


@dataclass(frozen=True)
class Ghost:
    """A body that moves by itself, and its motion.

    `name`: what it is called in a legend.
    `shapes`: in the body's frame. Their `joint` and colour count for nothing.
    `time` (K,): s, increasing.
    `quaternions` (K, 4): orientation of the body's frame, w x y z.
    `origins` (K, 3): origin of the body's frame, m, base frame.
    """

    name: str
    shapes: tuple[Shape, ...]
    time: Array
    quaternions: Array
    origins: Array

    def place(self, t: float) -> tuple[Array, Array]:
        """Return the axes (3, 3) and the origin (3,), m, at an instant: between two rows, along the shortest turn."""
        later = int(np.clip(np.searchsorted(self.time, t), 1, len(self.time) - 1))
        share = float(np.clip((t - self.time[later - 1]) / (self.time[later] - self.time[later - 1]), 0.0, 1.0))
        a, b = (pin.Quaternion(*map(float, self.quaternions[k])) for k in (later - 1, later))
        origin: Array = (1.0 - share) * self.origins[later - 1] + share * self.origins[later]
        return np.array(a.slerp(share, b).matrix()), origin
