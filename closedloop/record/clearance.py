"""How near links came to each other and to planes: the least distance of a run, and where links pass through.

The shapes are the collision shapes of the robot's file, or those that are drawn where a URDF has none; of a mesh its
convex hull. Links joined by a joint, or that touch by a [[contact]], are not compared, nor those that overlap at the
start: their shapes are made so. The surface of the tip has no edge in the file: shapes that are through its plane at
the start are taken to be beside it, and the shape that holds the tip touches it. Distances of two links are those of
coal, negative where they overlap; those from a plane are exact. Looked at is a number of rows, and all rows about the
nearest of them.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import combinations, islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, evenly
from closedloop.base.errors import ModelError
from closedloop.mechanics.surface.placed import unit
from closedloop.record.columns.record import Record
from closedloop.record.columns.touching import placed_frame
from closedloop.scenario.arm import hull_of, parts_of
from robot_models import RobotModel
from robot_models.collision import CollisionShape, collision_shapes
from robot_models.coordinates import in_pinocchios_order
from robot_models.loop_joint import WORLD

# Rows that are looked at first, and pairs of shapes that are compared at most.
MOST_ROWS, MOST_PAIRS = 25, 400
# What overlaps by less than this, m, is taken to touch.
TOUCHING = 1e-6
SURFACE = "the surface"


class Clearance(NamedTuple):
    """The least distance of a run, m, negative where shapes overlap; its instant, s; and between which two it was."""

    distance: float
    time: float
    between: tuple[str, str]


class Solid(NamedTuple):
    """A shape of a link: the link's name, the joint that carries it, 0 the base, and its pose (4, 4) in that frame.

    Of a mesh the vertices are the corners of its convex hull. `made` is the shape as coal has it, and `reach` the
    radius of a ball about its origin that holds it, m.
    """

    link: str
    joint: int
    place: Array
    shape: CollisionShape
    made: Any
    reach: float


class Plane(NamedTuple):
    """A plane at rest: its name, unit normal (3,), offset, m, base frame, and the joint whose link has a contact with
    it, −1 if none: what touches by a contact is not compared."""

    name: str
    normal: Array
    offset: float
    joint: int


def clearance(run: Record) -> Clearance | None:
    """Return the least distance between links, and of links from planes; None where there are no shapes to compare.

    Meshes whose files are not there are left out.
    """
    known = np.flatnonzero(np.all(np.isfinite(run.q), axis=1)) if len(run) else np.zeros(0, dtype=int)
    solids = _solids(run.model) if len(known) else ()
    if not solids:
        return None
    mechanism = run.model.pinocchio_model()
    rows = known[evenly(len(known), MOST_ROWS)]
    planes = _planes(run, mechanism)
    found = [_from_plane(run, solids, plane, touching, mechanism, known) for plane, touching in planes]
    pairs = _pairs(run, mechanism, solids)
    poses = _poses(run, mechanism, rows if pairs else rows[:0])
    pairs = list(islice((pair for pair in pairs if _distance(*pair, poses[0]) > TOUCHING), MOST_PAIRS))
    nearest = (np.inf, 0, 0)
    bounds = _bounds(pairs, poses)
    for place in np.argsort(bounds, axis=None, kind="stable"):
        at, k = divmod(int(place), len(pairs))
        if bounds[at, k] >= nearest[0]:
            break
        nearest = min(nearest, (_distance(*pairs[k], poses[at]), at, k))
    if np.isfinite(nearest[0]):
        low, high = rows[max(nearest[1] - 1, 0)], rows[min(nearest[1] + 1, len(rows) - 1)]
        about = known[(known >= low) & (known <= high)]
        near = about[evenly(len(about), 4 * MOST_ROWS)]
        one, other = pairs[nearest[2]]
        distances = [_distance(one, other, pose) for pose in _poses(run, mechanism, near)]
        k = int(np.argmin(distances))
        found.append(Clearance(distances[k], float(run.time[near[k]]), (one.link, other.link)))
    return min((each for each in found if each is not None), key=lambda each: each.distance, default=None)


def passing_note(found: Mapping[str, Any] | None) -> str:
    """Return a line where something passes through, by the summary's `clearance`; "" where nothing does."""
    if found is None or found["distance"] >= -TOUCHING:
        return ""
    one, other = found["between"]
    deep = f"{1e3 * -found['distance']:.3g} mm deep at t = {found['time']:.4g} s"
    return f"{one} passes through {other}, up to {deep}: nothing in this run keeps their shapes apart"


@lru_cache(maxsize=8)
def _solids(model: RobotModel) -> tuple[Solid, ...]:
    mechanism = model.pinocchio_model()
    for visual in (False, True):
        found = []
        for link in model.frames:
            joint, turn, origin = placed_frame(mechanism, link)
            place = np.eye(4)
            place[:3, :3], place[:3, 3] = turn, origin
            try:
                shapes = collision_shapes(model, link, visual)
            except ModelError:
                continue
            for shape in shapes:
                if shape.kind == "mesh":
                    hull = hull_of(shape.vertices)
                    if hull is None:  # it is flat
                        continue
                    shape = replace(shape, vertices=shape.vertices[hull.vertices])
                found.append(Solid(link, joint, place @ shape.place, shape, *_geometry(shape)))
        if found:
            return tuple(found)
    return ()


def _poses(run: Record, mechanism: Any, rows: NDArray[Any]) -> Array:
    """Return the frames of the base and the joints (rows, n + 1, 4, 4) in each of these rows."""
    import pinocchio as pin

    data, q = mechanism.createData(), in_pinocchios_order(run.q[rows], run.model.joint_types)
    found = np.zeros((len(rows), mechanism.njoints, 4, 4))
    for at, row in enumerate(q):
        pin.forwardKinematics(mechanism, data, row)
        found[at] = [place.homogeneous for place in data.oMi]
    return found


def _pairs(run: Record, mechanism: Any, solids: tuple[Solid, ...]) -> list[tuple[Solid, Solid]]:
    """Return the shapes that are compared."""
    touching = {
        frozenset(placed_frame(mechanism, name)[0] for name in (section.link, section.against))
        for section in run.scenario.contact or ()
    }
    parents = [int(parent) for parent in mechanism.parents]
    found = []
    for a, b in combinations(solids, 2):
        joined = parents[a.joint] == b.joint or parents[b.joint] == a.joint
        free = mechanism.joints[max(a.joint, b.joint)].nv == 6  # that of a free body joins it to nothing
        joined = a.joint == b.joint or (joined and not free)
        if not joined and frozenset((a.joint, b.joint)) not in touching:
            found.append((a, b))
    return found


def _planes(run: Record, mechanism: Any) -> list[tuple[Plane, frozenset[int]]]:
    """Return the planes at rest, the surface and those of contacts against the world, each once; and who touches it."""
    scenario, found = run.scenario, []
    if scenario.surface.kind == "plane" and scenario.surface_motion.kind == "none" and scenario.surface.extent is None:
        n = np.array(run.surface_normal[0])
        offset = float(n @ run.position[0] - run.closure_error[0]) - scenario.tool.radius
        found.append(Plane(SURFACE, n, offset, -1))
    for section in scenario.contact or ():
        flat = section.surface is None and (section.motion is None or section.motion.kind == "none")
        if section.against == WORLD and flat:
            n = unit(section.normal, "normal")
            joint = placed_frame(mechanism, section.link)[0]
            found.append(Plane(f"the plane of {section.name!r}", n, float(n @ np.array(section.through)), joint))
    same: dict[tuple[float, ...], list[Plane]] = {}
    for plane in found:
        same.setdefault((*np.round(plane.normal, 9), round(plane.offset, 9)), []).append(plane)
    return [(planes[0], frozenset(plane.joint for plane in planes)) for planes in same.values()]


def _from_plane(
    run: Record, solids: tuple[Solid, ...], plane: Plane, touching: frozenset[int], mechanism: Any, known: NDArray[Any]
) -> Clearance | None:
    """Return the least distance from a plane of the shapes that move, but for those of joints that touch it."""
    moving = [solid for solid in solids if solid.joint != 0 and solid.joint not in touching]
    rows = known[evenly(len(known), 8 * MOST_ROWS if moving else 1)]
    poses, best = _poses(run, mechanism, rows), None
    for solid in moving:
        frames = poses[:, solid.joint] @ solid.place
        n = np.einsum("rji,j->ri", frames[:, :3, :3], plane.normal)  # in the shape's axes
        height = frames[:, :3, 3] @ plane.normal - plane.offset
        gaps = height + _lowest(solid.shape, n)
        if plane.name == SURFACE and (gaps[0] < -TOUCHING or _holds(solid, poses[0], run.position[rows[0]])):
            continue
        if np.max(gaps) < 0.0 and np.ptp(gaps) < TOUCHING:  # it stands through the plane, as a base does
            continue
        at = int(np.argmin(gaps))
        distance = float(gaps[at])
        if best is None or distance < best.distance:
            best = Clearance(distance, float(run.time[rows[at]]), (solid.link, plane.name))
    return best


def _holds(solid: Solid, pose: Array, point: Array) -> bool:
    """Whether a point (3,), m, base frame, is in a shape or on it."""
    import coal

    place = pose[solid.joint] @ solid.place
    there, at = coal.Transform3s(place[:3, :3], place[:3, 3]), coal.Transform3s(np.eye(3), point)
    ball, ask = coal.Sphere(TOUCHING), coal.DistanceRequest()
    return float(coal.distance(solid.made, there, ball, at, ask, coal.DistanceResult())) < TOUCHING


def _lowest(shape: CollisionShape, n: Array) -> Array:
    """Return how far along the normals n (N, 3), in its axes, the lowest point of a shape is from its origin, m."""
    if shape.kind == "mesh":
        return np.min(n @ shape.vertices.T, axis=1)
    found = []
    for part in parts_of(replace(shape, place=np.eye(4)), ""):
        H = np.array(part.get("half_axes") or np.zeros((1, 3)))
        found.append(n @ np.array(part["at"]) - np.linalg.norm(n @ H.T, axis=1) - part.get("radius", 0.0))
    return np.min(found, axis=0)


def _geometry(shape: CollisionShape) -> tuple[Any, float]:
    """Return a shape as coal has it, and the radius of a ball about its centre that holds it, m."""
    import coal

    kind, (a, b, c) = shape.kind, shape.size.tolist()
    if kind == "box":
        return coal.Box(2 * a, 2 * b, 2 * c), float(np.sqrt(a * a + b * b + c * c))
    if kind == "sphere":
        return coal.Sphere(a), a
    if kind == "capsule":
        return coal.Capsule(a, 2 * b), a + b
    if kind == "cylinder":
        return coal.Cylinder(a, 2 * b), float(np.hypot(a, b))
    if kind == "ellipsoid":
        return coal.Ellipsoid(a, b, c), max(a, b, c)
    points, listed = shape.vertices, coal.StdVec_Vec3s()
    listed.extend(list(points))
    return coal.Convex.convexHull(listed, False, None), float(np.max(np.linalg.norm(points, axis=1)))


def _bounds(pairs: list[tuple[Solid, Solid]], poses: Array) -> Array:
    """Return distances (rows, pairs) that shapes are not nearer than: those of balls about them, m."""
    if not pairs:
        return np.zeros((len(poses), 0))
    a, b = (
        np.einsum("rsij,sj->rsi", poses[:, [one.joint for one in side]], np.array([one.place[:, 3] for one in side]))
        for side in zip(*pairs, strict=True)
    )
    reach = np.array([one.reach + other.reach for one, other in pairs])
    return np.asarray(np.linalg.norm((a - b)[:, :, :3], axis=2) - reach)


def _distance(a: Solid, b: Solid, pose: Array) -> float:
    """Return the distance of two shapes, m, negative where they overlap."""
    import coal

    placed = []
    for solid in (a, b):
        place = pose[solid.joint] @ solid.place
        placed += [solid.made, coal.Transform3s(place[:3, :3], place[:3, 3])]
    return float(coal.distance(*placed, coal.DistanceRequest(), coal.DistanceResult()))
