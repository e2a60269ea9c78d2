"""The arm of a scenario: a robot with its tip, gravity, the tool on it and the payload in it, and where it starts.

And contacts of whole links: `at = "collision"` of a [[contact]] as the contacts of the link's collision shapes.

    box                 its eight corners
    mesh                the corners of its convex hull
    sphere              a ball
    capsule             a ball at either end
    ellipsoid           itself
    cylinder            the edge of either end, and three points of it, on which it stands

With a plane that is all that can touch. With a curved or moving surface balls and points are what can touch it.
Two links touch by `pair_of`: balls, corners and edges of the one with the other; with time stepping two boxes touch in
eight points at most, wherever these are.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, ScenarioError
from closedloop.jit.parameters import lists_per_joint
from closedloop.mechanics.contacts.sections import COLLISION, BoxSection, ContactSection, EdgeSection
from closedloop.mechanics.friction.law import JointFriction
from closedloop.mechanics.friction.laws.coulomb_viscous import JointCoulombViscous
from closedloop.mechanics.integrators import steps_impulses
from closedloop.mechanics.loops.boxes import MOST_POINTS
from closedloop.mechanics.loops.moved import MovedFrame
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.kinds.box import Box
from closedloop.mechanics.surface.kinds.capsule import Capsule
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.placed import unit
from closedloop.mechanics.surface.surface import Surface
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of
from robot_models import RobotModel, Tool
from robot_models.bodies import FreeBody, with_bodies
from robot_models.collision import MOST_CORNERS, CollisionShape, collision_shapes
from robot_models.coordinates import PARTS, PLACES, RATES, in_pinocchios_order, normalised, with_rotation_vectors
from robot_models.loop_coordinate import coordinate_rates, place_coordinates
from robot_models.loop_joint import WORLD
from robot_models.tendon import joint_dynamics, loop_dynamics, rough_tendons


def start_posture(scenario: Scenario, model: RobotModel) -> Array:
    """Return q (n,) at the start as the loop has it: a joint that turns freely by its rotation vector, rad."""
    q = start_positions(scenario, model)
    if not model.balls:
        return q
    try:
        return with_rotation_vectors(normalised(q, model.joint_types, "start.q"), model.joint_types)
    except ModelError as error:
        raise ScenarioError(str(error)) from None


def start_positions(scenario: Scenario, model: RobotModel) -> Array:
    """Return q (nq,) at the start: that of `start.q`, or the home posture with each [[body]] where it is placed.

    A `start.q` may leave out what moves freely, which is then where the model, or its [[body]], has it.
    """
    given, names = scenario.start.q, model.coordinate_names
    if given is not None and len(given) == len(names):
        return np.array(given)
    placed = dict(zip(names, model.home.tolist(), strict=True))
    for body in scenario.body or ():
        pose = zip((*PLACES, *PARTS), (*body.position, *body.quaternion), strict=True)
        placed |= {body.name + end: value for end, value in pose}
    return _whole("start.q", given, np.array([placed[name] for name in names]), names, model)


def start_velocities(scenario: Scenario, model: RobotModel) -> Array:
    """Return q̇ (n,) at the start, with each [[body]] as it moves; of `start.v` see `start_positions`."""
    names, given = model.joint_names, scenario.start.v
    if given is not None and len(given) == len(names):
        return np.array(given)
    moving = dict.fromkeys(names, 0.0)
    for body in scenario.body or ():
        rates = zip((*PLACES, *RATES), (*body.velocity, *body.spin), strict=True)
        moving |= {body.name + end: value for end, value in rates}
    return _whole("start.v", given, np.array([moving[name] for name in names]), names, model)


def _whole(
    key: str, given: tuple[float, ...] | None, values: Array, names: tuple[str, ...], model: RobotModel
) -> Array:
    """Return `values` with the entries of a list that lacks some: it has those of what is not free."""
    if given is None:
        return values
    held = np.isin(names, np.array(model.joint_names)[~model.free])
    if len(given) == held.sum():
        values[held] = given
        return values
    what = f"{model.name} has {len(names)} joints" if not model.balls else f"for {model.name} it has {len(names)}"
    less = f", or {held.sum()} without those that move freely" if 0 < held.sum() < len(names) else ""
    raise ScenarioError(f"{key} has {len(given)} entries: {what}{less}, in the order {', '.join(names)}")


def is_of_model(key: str) -> bool:
    """Whether an overridden key says which robot it is, or which bodies are beside it."""
    return key.startswith(("robot.", "body", "mocap")) and key != "robot.tip"


def beside_bodies(scenario: Scenario, model: RobotModel) -> RobotModel:
    """Return a robot with each [[body]] of a scenario beside it; itself if it has bodies of these names."""
    own = {model.joint_names[j].removesuffix(PLACES[0]) for j in model.bodies}
    return with_bodies(model, [body for body in free_bodies(scenario) if body.name not in own])


def free_bodies(scenario: Scenario) -> list[FreeBody]:
    """Return each [[body]] of a scenario."""
    return [
        FreeBody(each.name, each.shape, each.size, each.mass, each.position, each.quaternion, each.inertia)
        for each in scenario.body or ()
    ]


def robot_of(scenario: Scenario, model: RobotModel) -> Robot:
    """Return the robot of a scenario, with gravity, tool, payload and elastic joints, from the model without them."""
    model = beside_bodies(scenario, model)
    tool, payload = scenario.tool, scenario.model_error.payload
    tip = model.tip if scenario.robot.tip is None else scenario.robot.tip
    tools = []
    unit(tool.axis, "tool.axis")
    if tool.mass == 0.0 and (any(tool.centre) or any(tool.inertia)):
        raise ScenarioError("tool.mass = 0: a tool with a centre of mass or a tensor has a mass; give it, in kg")
    if tip is not None and any((*tool.offset, tool.mass, *tool.centre, *tool.inertia)):
        model.require_frame(tip)
        tools.append(Tool(tip, tool.offset, tool.mass, tool.centre, tool.inertia))
        tools[0].tensor()
    if tip is not None and payload:
        model.require_frame(tip)
        tools.append(Tool(tip, mass=payload))  # at the tip as the tool has it
    changes: dict[str, Any] = {"tools": tuple(tools)} if tools else {}
    if scenario.robot.gravity is not None:
        changes["gravity"] = np.array(scenario.robot.gravity)
    if scenario.transmission.elastic:
        changes["elastic"] = True
    robot = Robot(model.changed(**changes) if changes else model, scenario.robot.tip)
    return Robot(robot.model, robot.tip, moved_frames(scenario, robot)) if scenario.mocap else robot


def moved_frames(scenario: Scenario, robot: Robot) -> tuple[MovedFrame, ...]:
    """Return each [[mocap]] of a scenario where the robot has it.

    Raises ScenarioError if it is no frame that is fixed to the world, two are one, or no loop joint holds onto one.
    """
    found: list[MovedFrame] = []
    for k, section in enumerate(scenario.mocap or ()):
        where = f"mocap.{k}.frame = {section.frame!r}"
        fixed = robot.frames_at_rest() - {name for frame in found for name in frame.names}
        if section.frame not in fixed:
            known = ", ".join(sorted(fixed)) or "it has none"
            raise ScenarioError(f"{where}: must be a frame of the robot that is fixed to the world: {known}")
        names = robot.fixed_to(section.frame)
        if not any(name in names for loop in robot.model.loops for name in loop.frames):
            raise ScenarioError(
                f"{where}: no loop joint holds onto it: an MJCF has a <weld> or <connect> to this mocap body, and the "
                "sidecar of a URDF a [[closed_loop]] of this frame"
            )
        _, axes, origin = robot.frame_at(section.frame, robot.model.home)
        found.append(MovedFrame(names, section.motion, axes, origin))
    return tuple(found)


def joint_friction_of(scenario: Scenario, model: RobotModel) -> JointFriction:
    """Return the law of friction in the joints: the scenario's, or that of the robot's file.

    What a loop joint of the file says of friction acts; what a joint says, on request.
    """
    if not scenario.robot.friction:
        damping, friction = loop_dynamics(model)
        if not (np.any(damping) or np.any(friction)):
            return scenario.joint_friction
        if scenario.joint_friction.kind != "none":
            raise ScenarioError(
                f"joint_friction.kind = {scenario.joint_friction.kind!r}: loop joints of {model.name} have friction in "
                "the robot's sidecar: leave out that, or joint_friction"
            )
        return JointCoulombViscous(kinetic=tuple(friction.tolist()), viscous=tuple(damping.tolist()))
    if scenario.joint_friction.kind != "none":
        raise ScenarioError(
            f"robot.friction = true with joint_friction.kind = {scenario.joint_friction.kind!r}: joint friction "
            "comes from the robot's file or from the scenario; leave out one of them"
        )
    damping, friction = joint_dynamics(model)
    return JointCoulombViscous(kinetic=tuple(friction.tolist()), viscous=tuple(damping.tolist()))


def stop_limits(scenario: Scenario, model: RobotModel) -> tuple[Array, Array]:
    """Return where the joints have hard stops, lower and upper, (n,), rad (m), infinite where there is none.

    The limits of a loop joint always are stops; those of the robot's joints if the scenario says so.
    """
    there = np.array([scenario.robot.stops or name in model.loop_coordinates for name in model.joint_names])
    return np.where(there, model.position_lower, -np.inf), np.where(there, model.position_upper, np.inf)


def acting_tendons(scenario: Scenario, model: RobotModel) -> Array:
    """Return what of the robot's tendons rubs and stops, see `robot_models.tendon.rough_tendons`.

    Like the friction and the stops of joints both are on request.
    """
    return rough_tendons(model.tendons, model.joint_names, scenario.robot.friction, scenario.robot.stops)


def has_stops(scenario: Scenario, model: RobotModel) -> bool:
    """Whether a joint has a hard stop."""
    if scenario.robot.stops or not model.loop_coordinates:
        return scenario.robot.stops
    return bool(np.isfinite(stop_limits(scenario, model)).any())


@lru_cache(maxsize=8)
def without_tools(model: RobotModel) -> RobotModel:
    """Return the model without tool, payload and elastic joints, which the scenario says."""
    return replace(model, tools=(), elastic=False) if model.tools or model.elastic else model


def with_all_entries(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario whose start, law and friction have an entry for each joint, if only those without one lack it.

    Of friction these are the free bodies alone, which have none. Lists of any other length are left as they are.
    """
    names, driven = model.loop_coordinates, model.joint_names if model.drives is None else model.drives
    given = np.array([name not in names or name in driven for name in model.joint_names], dtype=bool) & ~model.free
    count = int(given.sum())
    if count == model.n:
        return scenario

    start = _started(scenario, model, given) if names else {}
    lists = {
        name: tuple(_filled(values, given).tolist())
        for name, values in lists_per_joint(scenario.law).items()
        if len(values) == count
    }
    held = ~model.of_bodies
    in_joints = {
        name: tuple(_filled(values, held).tolist())
        for name, values in lists_per_joint(scenario.joint_friction).items()
        if len(values) == held.sum() < model.n
    }
    if not start and not lists and not in_joints:
        return scenario
    sections = ("start", start), ("law", lists), ("joint_friction", in_joints)
    return scenario.model_copy(
        update={name: getattr(scenario, name).model_copy(update=values) for name, values in sections if values}
    )


def _filled(values: Any, given: NDArray[np.bool_]) -> Array:
    """Return values with a zero for each joint that is not given."""
    whole = np.zeros(len(given))
    whole[given] = values
    return whole


def _started(scenario: Scenario, model: RobotModel, given: NDArray[np.bool_]) -> dict[str, Any]:
    """Return start.q and start.v with the coordinates of loop joints that they leave out, where they do."""
    q, v, count, start = scenario.start.q, scenario.start.v, int(given.sum()), {}
    types, built, posture = model.joint_types, model.pinocchio_model(), model.home
    held, own = (np.isin(model.coordinate_names, np.array(model.joint_names)[these]) for these in (~model.free, given))
    if q is not None:
        if len(q) not in (count, held.sum(), len(held)):
            return {}
        posture = posture.copy()
        everything = np.ones(len(held), dtype=bool)
        posture[{count: own, len(held): everything}.get(len(q), held)] = q
        if len(q) == count:
            placed = place_coordinates(built, model.loops, in_pinocchios_order(posture, types))
            posture = np.where(held & ~own, placed, posture)
            start["q"] = tuple(posture[held].tolist())
    if v is not None and len(v) == count:
        found = _filled(v, given)
        rates = coordinate_rates(built, model.loops, in_pinocchios_order(posture, types), found)
        start["v"] = tuple(np.where(given, found, rates)[~model.free].tolist())
    return start


# Points of each edge of a cylinder on which it stands.
FEET = 3
# Shapes of two links that may touch each other.
PAIRED = ("box", "sphere", "capsule")
# A mesh whose surface is inside its convex hull by more than this share of its size is not convex.
INSIDE = 1e-6


def with_collision_shapes(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario in which each contact of a link's collision shapes is a contact for each part of them."""
    sections = scenario.contact or ()
    if not any(section.at == COLLISION for section in sections):
        return scenario
    found: list[ContactSection] = []
    for name, section in zip(names_of(sections), sections, strict=True):
        if section.at != COLLISION:
            found.append(section if section.name else section.model_copy(update={"name": name}))
            continue
        if section.onto == COLLISION:
            parts = _pairs(section, model, name, steps_impulses(scenario.time.integrator))
        else:
            parts = [part for shape in _shapes(section, model, name) for part in parts_of(shape, f"contact {name!r}")]
        names = [name] if len(parts) == 1 else [f"{name} {k}" for k in range(1, len(parts) + 1)]
        found += [section.model_copy(update={"name": own} | part) for own, part in zip(names, parts, strict=True)]
    return scenario.model_copy(update={"contact": tuple(found)})


def _pairs(section: ContactSection, model: RobotModel, name: str, stepping: bool) -> list[dict[str, Any]]:
    """Return the contacts of the collision shapes of two links."""
    if section.against == WORLD:
        raise ScenarioError(f"contact {name!r}: onto = {COLLISION!r}: the world has no collision shapes: name a link")
    if section.surface is not None or section.motion is not None:
        raise ScenarioError(f"contact {name!r}: onto = {COLLISION!r} takes the shapes of the link: leave surface out")
    others = _shapes(section.model_copy(update={"link": section.against}), model, name)
    parts: list[dict[str, Any]] = []
    for shape in _shapes(section, model, name):
        for other in others:
            for kind in (shape.kind, other.kind):
                if kind not in PAIRED:
                    raise ScenarioError(
                        f"contact {name!r}: onto = {COLLISION!r}: a {kind} touches planes and other surfaces only: "
                        "shapes of two links may be boxes, spheres and capsules"
                    )
            boxes = stepping and shape.kind == other.kind == "box" and not section.resists
            parts += (points_of_boxes if boxes else pair_of)(shape, other, section.link, section.against)
    return [{"onto": "surface"} | part for part in parts]


def hulls_taken(scenario: Scenario, model: RobotModel) -> list[str]:
    """Return a line for each contact that takes the convex hull of a mesh that is not convex."""
    lines = []
    sections = scenario.contact or ()
    for name, section in zip(names_of(sections), sections, strict=True):
        for shape in _shapes(section, model, name) if section.at == COLLISION else ():
            if shape.kind == "mesh" and _is_hollow(shape):
                lines.append(f"contact {name!r}: the mesh {shape.file!r} is not convex: its convex hull touches")
    return lines


def _shapes(section: ContactSection, model: RobotModel, name: str) -> list[CollisionShape]:
    try:
        model.require_frame(section.link)
    except ModelError as error:
        raise ScenarioError(f"contact {name!r}: link: {error}") from None
    shapes = collision_shapes(model, section.link)
    if not shapes:
        raise ScenarioError(
            f"contact {name!r}: at = {COLLISION!r}: link {section.link!r} of {model.name} has no collision shape: give "
            "at as a point or a list of points"
        )
    return shapes


def parts_of(shape: CollisionShape, where: str) -> list[dict[str, Any]]:
    """Return what of a shape can touch, as the keys of a contact each: at, radius, half_axes."""
    turn, origin, (a, b, c) = shape.place[:3, :3], shape.place[:3, 3], shape.size

    def at(point: Any) -> tuple[float, ...]:
        return tuple((origin + turn @ np.asarray(point, dtype=float)).tolist())

    def half_axes(lengths: Any) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple((length * turn[:, i]).tolist()) for i, length in enumerate(lengths))

    if shape.kind == "box":
        return [{"at": at((x, y, z))} for z in (-c, c) for y in (-b, b) for x in (-a, a)]
    if shape.kind == "sphere":
        return [{"at": at(np.zeros(3)), "radius": float(a)}]
    if shape.kind == "capsule":
        return [{"at": at((0, 0, end * b)), "radius": float(a)} for end in (-1, 1)]
    if shape.kind == "ellipsoid":
        return [{"at": at(np.zeros(3)), "half_axes": half_axes(shape.size)}]
    if shape.kind == "cylinder":
        angles = 2.0 * np.pi * np.arange(FEET) / FEET
        feet = [(a * np.cos(x), a * np.sin(x)) for x in angles]
        edges = [{"at": at((0, 0, end * b)), "half_axes": half_axes((a, a))} for end in (-1, 1)]
        return edges + [{"at": at((x, y, end * b))} for end in (-1, 1) for x, y in feet]
    hull = hull_of(shape.vertices)
    if hull is None:
        raise ScenarioError(
            f"{where}: the mesh {shape.file!r} is flat: give the mesh of a solid, or at as a list of points"
        )
    corners = shape.vertices[np.sort(hull.vertices)]
    if len(corners) > MOST_CORNERS:
        raise ScenarioError(
            f"{where}: the convex hull of the mesh {shape.file!r} has {len(corners)} corners; at most {MOST_CORNERS}: "
            "give a simpler mesh, or at as a list of points"
        )
    return [{"at": at(corner)} for corner in corners]


def hull_of(vertices: Array) -> Any:
    """Return the convex hull of points (V, 3) about their mean, `scipy.spatial.ConvexHull`; None if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(vertices - np.mean(vertices, axis=0))
    except QhullError:
        return None


def _is_hollow(shape: CollisionShape) -> bool:
    """Whether a mesh's surface, at its corners and triangles' centroids, is inside its convex hull anywhere.

    The centroids tell a flat part with a notch, whose corners are all on its two faces.
    """
    hull = hull_of(shape.vertices)
    if hull is None:
        return False
    points = np.concatenate([shape.vertices, shape.centroids]) - np.mean(shape.vertices, axis=0)
    inside = np.min(-(points @ hull.equations[:, :3].T + hull.equations[:, 3]), axis=1)
    return bool(np.max(inside) > INSIDE * np.max(np.ptp(shape.vertices, axis=0)))


Parts = list[dict[str, Any]]


def points_of_boxes(one: CollisionShape, other: CollisionShape, link: str, against: str) -> Parts:
    """Return the contacts of the points in which two boxes touch, as keys of their sections."""
    links: dict[str, Any] = {"link": link, "against": against}
    places = {"at": _numbers(one.place[:3, 3]), "through": _numbers(other.place[:3, 3])}
    axes = {"half": _axes(one), "onto": _axes(other)}
    return [links | places | {"box": BoxSection.model_validate(axes | {"point": m})} for m in range(MOST_POINTS)]


def pair_of(one: CollisionShape, other: CollisionShape, link: str, against: str) -> Parts:
    """Return the contacts of two shapes, a box, a sphere or a capsule each, as keys of their sections.

    Balls and corners of either touch the other, but of a sphere, which is a ball itself. The edges of a box, or the rod
    of a capsule, cross those of the other.
    """
    parts: Parts = []
    if other.kind != "sphere" or one.kind == "sphere":
        parts += [part | surface_of_shape(other) | {"link": link, "against": against} for part in parts_of(one, "")]
    if one.kind != "sphere":
        parts += [part | surface_of_shape(one) | {"link": against, "against": link} for part in parts_of(other, "")]
    if "sphere" in (one.kind, other.kind):
        return parts
    if one.kind == "box" and other.kind == "capsule":
        one, other, link, against = other, one, against, link
    crossings = ("first", "last") if other.kind == "box" else ("first",)
    for edge in _edges(one):
        onto = {"onto": _axes(other), "onto_radius": float(other.size[0]) if other.kind == "capsule" else 0.0}
        for crossing in crossings:
            section = EdgeSection(**edge["edge"], **onto, crossing=crossing)
            place = {"at": edge["at"], "radius": edge["radius"], "edge": section, "link": link, "against": against}
            parts.append(place | {"through": _numbers(other.place[:3, 3])})
    return parts


def surface_of_shape(shape: CollisionShape) -> dict[str, Any]:
    """Return a shape as a surface that balls and points touch: the keys surface, through and normal of a contact."""
    turn, origin, (a, b, c) = shape.place[:3, :3], shape.place[:3, 3], shape.size
    surface: Surface
    if shape.kind == "sphere":
        normal, depth, surface = turn[:, 2], a, Sphere(radius=float(a))
    else:
        normal, along, depth = (turn[:, 2], turn[:, 0], c) if shape.kind == "box" else (turn[:, 0], turn[:, 2], a)
        x, y, z = _numbers(along)
        if shape.kind == "box":
            surface = Box(edges=(2.0 * float(a), 2.0 * float(b), 2.0 * float(c)), axis=(x, y, z))
        else:
            surface = Capsule(radius=float(a), length=float(2.0 * b), axis=(x, y, z))
    return {"surface": surface, "normal": _numbers(normal), "through": _numbers(origin + depth * normal)}


def _axes(shape: CollisionShape) -> tuple[tuple[float, ...], ...]:
    """Return the half axes of a box, or of the rod of a capsule."""
    turn = shape.place[:3, :3]
    if shape.kind == "capsule":
        return (_numbers(shape.size[1] * turn[:, 2]),)
    return tuple(_numbers(shape.size[k] * turn[:, k]) for k in range(3))


def _edges(shape: CollisionShape) -> Parts:
    """Return the twelve edges of a box, with the normals of their faces, or the rod of a capsule."""
    turn, origin = shape.place[:3, :3], shape.place[:3, 3]
    if shape.kind == "capsule":
        return [{"at": _numbers(origin), "radius": float(shape.size[0]), "edge": {"half": _axes(shape)[0]}}]
    found: Parts = []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for x in (-1.0, 1.0):
            for y in (-1.0, 1.0):
                middle = origin + x * shape.size[i] * turn[:, i] + y * shape.size[j] * turn[:, j]
                sides = _numbers(x * turn[:, i]), _numbers(y * turn[:, j])
                edge = {"half": _numbers(shape.size[k] * turn[:, k]), "sides": sides}
                found.append({"at": _numbers(middle), "radius": 0.0, "edge": edge})
    return found


def _numbers(vector: Array) -> tuple[float, ...]:
    return tuple(np.asarray(vector, dtype=float).tolist())
