"""The scene of a run as MJCF, for MuJoCo and what reads its files.

A point is a `connect`, a hinge two on its axis, a weld a `weld`, a gear a `joint`, a distance a tendon of that length.
The point of a contact is a small ball, and its plane lies lower by its radius: they are as far apart as the point
is from the plane, in every posture. Nothing but these pairs touches.

The bodies are those of the dynamics: a link with a joint each, what is fixed to it included, in the frames in which the
run computes, with the drives' inertia as `armature`. The shapes carry no mass and touch nothing; the surface can be
touched, and the links where the scenario has contacts of them; loops are closed by equalities. There are a motor for
each joint with a drive, a site `tip`, and keyframes of the run's first and last row.

The law, the closure and friction are no part of it: contact in MuJoCo is soft, and its force differs.
"""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, printable
from closedloop.base.files import write_whole
from closedloop.figures.scene.scene import Scene, quaternions, scene_of
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.mechanics.surface.kinds.cylinder import Cylinder
from closedloop.mechanics.surface.kinds.ellipsoid import Ellipsoid
from closedloop.mechanics.surface.kinds.height_field import HeightField
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.placed import PlacedSurface, unit
from closedloop.record.columns.touching import placed_frame
from closedloop.record.run import Run
from robot_models.loop_joint import LoopJoint


def element(into: ElementTree.Element, tag: str, **attributes: Any) -> ElementTree.Element:
    """Add an element; numbers have as many digits as tell them apart from all others, and None is left out."""
    said = {name: value for name, value in attributes.items() if value is not None}
    text = {name: value if isinstance(value, str) else numbers(value) for name, value in said.items()}
    return ElementTree.SubElement(into, tag, text)


def child_of(root: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Return the part of a file with this tag, made if there is none."""
    return element(root, tag) if (found := root.find(tag)) is None else found


def numbers(values: ArrayLike, digits: int = 17) -> str:
    """Return a number, or those of an array in their order, as text with so many digits."""
    exact, found = digits > 16, np.ravel(values).tolist()
    return " ".join(repr(x) if exact or isinstance(x, int) else f"{x:.{digits}g}" for x in found)


def quaternion(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion (4,), the real part first, of a rotation matrix (3, 3)."""
    return quaternions(np.asarray(axes)[None])[0]


COLOUR = (0.77, 0.80, 0.84, 0.75)
GRID = 129  # heights along a side at most, of what is no shape of MuJoCo's
BASE = 0.05  # thickness of a grid of heights below its lowest, m
LEAST_RANGE = 1e-6  # of heights, m: MuJoCo takes none that is flat


def add_surface(assets: ElementTree.Element, world: ElementTree.Element, scene: Scene) -> None:
    """Add the surface where it is at t = 0, below a body that can be moved (`mocap`) if the surface moves."""
    placed = scene.ground.placed
    if placed is None:
        raise ScenarioError(
            f"surface.kind = {scene.run.scenario.surface.kind}: this class has not been imported here, so that its "
            "shape is not known; import its module first, or use --to csv or --to mcap"
        )
    turned = placed.frame[[1, 2, 0]].T  # columns: the tangents t1, t2 and the normal
    section, origin, n = placed.section, placed.origin, placed.normal
    look: dict[str, Any] = {"name": "surface", "rgba": COLOUR, "mass": 0.0}
    body = element(world, "body", name="surface", mocap="true") if placed.moves else world
    size: tuple[float, ...]
    if isinstance(section, PlaneSurface):
        origin = origin + (placed.offset - n @ origin) * n  # a point that its `offset` says
        half = 0.5 * np.ptp(_tangential(scene, placed), axis=0).max()
        element(body, "geom", type="plane", pos=origin, quat=quaternion(turned), size=(half, half, 0.01), **look)
    elif isinstance(section, Sphere) and not section.inside:
        element(body, "geom", type="sphere", pos=origin - section.radius * n, size=(section.radius,), **look)
    elif isinstance(section, Ellipsoid):
        size = section.a, section.b, section.c
        element(body, "geom", type="ellipsoid", pos=origin - section.c * n, quat=quaternion(turned), size=size, **look)
    elif isinstance(section, Cylinder) and not section.inside:
        axis = unit(section.axis, "surface.axis")
        half = float(np.ptp((scene.ground.mesh[0] - origin) @ axis)) + section.radius
        along = quaternion(np.column_stack([np.cross(n, axis), n, axis]))
        size = (section.radius, half)
        element(body, "geom", type="cylinder", pos=origin - section.radius * n, quat=along, size=size, **look)
    else:
        _add_heights(assets, body, scene, placed, look)


def _tangential(scene: Scene, placed: PlacedSurface) -> Array:
    """Return where the drawn patch of the surface lies along its tangents (k, 2), m, from its origin."""
    return (scene.ground.mesh[0] - placed.origin) @ placed.frame[1:].T


def _add_heights(
    assets: ElementTree.Element, body: ElementTree.Element, scene: Scene, placed: PlacedSurface, look: dict[str, Any]
) -> None:
    """Add a grid of heights: all of a height field, of another surface the patch around the paths."""
    section = placed.section
    if isinstance(section, HeightField):
        rows, columns = len(section.heights), len(section.heights[0])
        high = 0.5 * section.spacing * (np.array([columns, rows]) - 1.0)
        low, finer = -high, max(1, (GRID - 1) // (max(rows, columns) - 1))
        counts = finer * (columns - 1) + 1, finer * (rows - 1) + 1
    else:
        along = _tangential(scene, placed)
        low, high, counts = along.min(axis=0), along.max(axis=0), (GRID, GRID)
    x, y = (np.linspace(a, b, count) for a, b, count in zip(low, high, counts, strict=True))
    tangential = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)  # a row for each y
    inner = tangential * (1.0 - 1e-9) + 1e-9 * tangential.mean(axis=0)  # not beyond the edge by rounding
    points = placed.origin + inner @ placed.frame[1:]
    none = np.zeros_like(points)
    on_it = placed.follow(0.0, np.zeros(len(points)), (points, none, none))[0]
    heights = ((on_it - placed.origin) @ placed.normal).reshape(len(y), len(x))
    span = max(float(np.ptp(heights)), LEAST_RANGE)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    place = placed.origin + middle @ placed.frame[1:] + heights.min() * placed.normal
    # MuJoCo reads the rows from the top, as one sees them from above.
    element(
        assets, "hfield", name="surface", nrow=len(y), ncol=len(x), size=(*half, span, BASE),
        elevation=numbers(heights[::-1] - heights.min(), 9),
    )  # fmt: skip
    quat = quaternion(placed.frame[[1, 2, 0]].T)
    element(body, "geom", type="hfield", hfield="surface", pos=place, quat=quat, **look)


BALL = 0.002  # radius of the ball that stands for a contact's point, m
APART = 0.1  # of the arm's reach: between the two points that hold a hinge
GROUP = 3  # of the geoms that touch; MuJoCo's viewer does not show it at first
# Of a geom that touches nothing but what it is paired with.
UNTOUCHED: dict[str, Any] = {"mass": 0.0, "contype": 0, "conaffinity": 0}
HELD = ("point", "hinge", "weld", "gear", "distance")  # types of loop joints that MuJoCo has an equality for


def check_joined(scene: Scene) -> None:
    """Refuse loop joints that MuJoCo has no equality for, and contacts of links but of points and balls with planes."""
    if scene.run.scenario.mocap:
        raise ScenarioError("--to mjcf: the motion of a [[mocap]] is not written; use --to csv or --to mcap")
    for loop in scene.run.model.loops:
        if loop.type not in HELD:
            raise ScenarioError(
                f"--to mjcf: MuJoCo has no equality for a {loop.type}, as {loop.name!r} of {scene.run.model.name} is; "
                "use --to csv or --to mcap"
            )
    for section, touching in zip(scene.run.scenario.contact or (), scene.touching, strict=True):
        faults = {
            "is of an ellipsoid or a disc's edge, and only points and balls are written": section.half_axes is not None,
            "has a law of friction that MuJoCo does not have": has_other_law(section),
            "has a surface that is curved or moves, and only planes at rest are written": touching.surface is not None,
        }
        for what, wrong in faults.items():
            if wrong:
                raise ScenarioError(f"--to mjcf: contact {touching.name!r} {what}; use --to csv or --to mcap")


def add_joined_parts(body: ElementTree.Element, joint: int, scene: Scene, mechanism: Any) -> None:
    """Add the sites of loop joints, and the geoms of contacts, that a body carries; `joint` 0: the world's."""
    for loop in scene.run.model.loops:
        for side, name in enumerate(loop.frames):
            frame, rotation, origin = placed_frame(mechanism, name)
            if frame == joint:
                turned = rotation if side == 0 else rotation @ np.array(loop.turn)
                for end, point in enumerate(_points(loop, side, APART * scene.size)):
                    place = origin + rotation @ point
                    element(body, "site", name=_site(loop, side, end), pos=place, quat=quaternion(turned), group=GROUP)
    for section, touching in zip(scene.run.scenario.contact or (), scene.touching, strict=True):
        if touching.point_frame == joint:
            _add_geom(body, f"{touching.name} point", "sphere", touching.point, (section.radius or BALL,))
        if touching.plane_frame == joint:
            _, rotation, origin = placed_frame(mechanism, section.against)
            normal, half = touching.axes[0], scene.size
            place = origin + rotation @ np.array(section.through) - (0.0 if section.radius else BALL) * normal
            turned = quaternion(touching.axes[[1, 2, 0]].T)
            if joint:  # MuJoCo has planes in the world only
                place = place - half * normal
            size = (half, half, half if joint else 0.01)
            _add_geom(body, f"{touching.name} plane", "box" if joint else "plane", place, size, turned)


def add_equalities(root: ElementTree.Element, scene: Scene, mechanism: Any) -> None:
    """Add the sections that hold the loop joints closed."""
    import pinocchio as pin

    if not scene.run.model.loops:
        return
    held = element(root, "equality")
    for loop in scene.run.model.loops:
        if loop.coefficients:
            sides = [(f"{loop.name} {side}", each) for side, each in enumerate(loop.sums, 1) if each]
            for name, each in sides:
                length = element(child_of(root, "tendon"), "fixed", name=name)
                for bound, coefficient in each.items():
                    element(length, "joint", joint=bound, coef=coefficient)
            names = {f"tendon{side}": name for side, (name, _) in enumerate(sides, 1)}
            element(held, "tendon", name=loop.name, polycoef=loop.polynomial, **names)
        elif loop.type == "gear":
            names = dict(zip(("joint1", "joint2"), loop.joints, strict=False))
            element(held, "joint", name=loop.name, polycoef=loop.polynomial, **names)
        elif loop.type == "distance":
            rod = element(child_of(root, "tendon"), "spatial", name=loop.name)
            ends, data = [], mechanism.createData()
            pin.forwardKinematics(mechanism, data, np.zeros(mechanism.nq))  # MuJoCo's tendons have their length here
            for side, name in enumerate(loop.frames):
                element(rod, "site", site=_site(loop, side, 0))
                joint, rotation, origin = placed_frame(mechanism, name)
                ends.append(data.oMi[joint].act(origin + rotation @ np.array(loop.points[side])))
            longer = loop.length - float(np.linalg.norm(ends[1] - ends[0]))
            element(held, "tendon", name=loop.name, tendon1=loop.name, polycoef=(longer, 0.0, 0.0, 0.0, 0.0))
        else:
            for end, _ in enumerate(_points(loop, 0, 1.0)):
                sites = {"site1": _site(loop, 0, end), "site2": _site(loop, 1, end)}
                element(held, "weld" if loop.type == "weld" else "connect", name=_numbered(loop.name, end), **sites)


def add_pairs(root: ElementTree.Element, scene: Scene) -> None:
    """Add the pairs of geoms that touch, each with its friction."""
    if not scene.touching:
        return
    pairs = element(root, "contact")
    for section, touching in zip(scene.run.scenario.contact or (), scene.touching, strict=True):
        mu = coulomb_of(section)
        coefficients = {"condim": 3, "friction": (mu, mu, 0.0, 0.0, 0.0)}
        geoms = {"geom1": f"{touching.name} point", "geom2": f"{touching.name} plane"}
        element(pairs, "pair", name=touching.name, **geoms, **(coefficients if mu > 0.0 else {"condim": 1}))


def _add_geom(
    body: ElementTree.Element, name: str, kind: str, place: Array, size: tuple[float, ...], quat: Array | None = None
) -> None:
    """Add a geom of a contact of links."""
    look = UNTOUCHED | {"group": GROUP, "rgba": (0.34, 0.71, 0.91, 0.2)}
    element(body, "geom", name=name, type=kind, pos=place, quat=quat, size=size, **look)


def _points(loop: LoopJoint, side: int, apart: float) -> list[Array]:
    """Return the points (3,), m, in the frame of a side at which a loop joint is held: of a hinge two on its axis."""
    point = np.array(loop.points[side])
    return [point, point + apart * np.array(loop.axes[side])] if loop.type == "hinge" else [point]


def _site(loop: LoopJoint, side: int, end: int) -> str:
    return _numbered(f"{loop.name} {'ab'[side]}", end)


def _numbered(name: str, end: int) -> str:
    return f"{name} {end + 1}" if end else name


ARM_GROUP = 1  # of the arm's geoms; the surface is in group 0
TIP_RADIUS = 0.006  # m
# The least mass and moment that MuJoCo takes for a moving body: a link without any gets it, kg and kg m².
LEAST = 1e-12
SHORT = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}
EXPLAINED = (
    " A scene of closedloop: {}. Angles in rad, lengths in m, masses in kg, axes of the base frame.\n"
    "     Without the control law and the closure: contact in MuJoCo is soft, and its force differs. "
)


def write_mjcf(run: Run, path: str | Path) -> list[Path]:
    """Write the scene of a run as MJCF, and return its path in a list.

    Raises ScenarioError if the run has no rows, MuJoCo has no equality for a loop joint of the robot, or the surface is
        a user's class not named in this process.
    Raises OutputError if the file cannot be written.
    """
    if not len(run):
        raise ScenarioError(f"{run.scenario.name}: the run has no rows: there is no scene")
    check_joined(scene_of(run))
    root = mjcf_of(run)
    ElementTree.indent(root)
    text = '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    return [write_whole(path, text.encode())]


def explained(name: str) -> str:
    """Return the comment of the file, which no name ends: two hyphens would."""
    return EXPLAINED.format(re.sub("-(?=-)", "- ", printable(name)))


def mjcf_of(run: Run) -> ElementTree.Element:
    """Return the scene of a run of at least one row as the element <mujoco>."""
    scene, mechanism = scene_of(run), scene_of(run).model.pinocchio_model()
    root = ElementTree.Element("mujoco", model=run.scenario.name)
    root.append(ElementTree.Comment(explained(run.scenario.name)))
    element(root, "compiler", angle="radian", autolimits="true", boundmass=LEAST, boundinertia=LEAST)
    element(root, "option", gravity=mechanism.gravity.linear, timestep=run.scenario.time.step)
    assets, world = element(root, "asset"), element(root, "worldbody")
    element(world, "light", pos=(1.0, -1.0, 2.5), dir=(-0.4, 0.4, -1.0))
    order = _add_links(assets, world, scene, mechanism)
    if scene.ground.there:
        add_surface(assets, world, scene)
    add_pairs(root, scene)
    add_equalities(root, scene, mechanism)
    motors, keys = element(root, "actuator"), element(root, "keyframe")
    driven = [joint for joint in order if run.model.driven[mechanism.joints[joint].idx_v]]
    for joint in driven:
        name, most = str(mechanism.names[joint]), float(run.model.effort_limit[mechanism.joints[joint].idx_v])
        element(motors, "motor", name=name, joint=name, ctrlrange=(-most, most) if np.isfinite(most) else None)
    joints = [mechanism.joints[joint] for joint in order]
    places = [at for joint in joints for at in range(joint.idx_q, joint.idx_q + joint.nq)]
    columns = [at for joint in joints for at in range(joint.idx_v, joint.idx_v + joint.nv)]
    powered = [mechanism.joints[joint].idx_v for joint in driven]
    for name, row in (("start", 0), ("end", len(run) - 1)):
        states = {"qpos": run.q[row, places], "qvel": run.v[row, columns], "ctrl": run.torque[row, powered]}
        element(keys, "key", name=name, time=run.time[row], **states)
    return root


def _add_links(assets: ElementTree.Element, world: ElementTree.Element, scene: Scene, mechanism: Any) -> list[int]:
    """Add a body for each joint, with its shapes, and return the joints in MuJoCo's order: depth first."""
    order: list[int] = []
    sliders = {at + k for at in scene.run.model.bodies for k in range(3)}

    def add(joint: int, into: ElementTree.Element) -> None:
        chain = [joint]
        while mechanism.joints[chain[-1]].idx_v in sliders:  # a free joint, taken apart: one body
            chain.append(chain[-1] + 1)
        body = _add_body(into, chain, scene, mechanism) if joint else into
        if joint:
            order.extend(chain)
        joint = chain[-1]
        for at, shape in enumerate(scene.shapes):
            if shape.joint == joint:
                name, vertices = f"shape{at}", numbers(shape.vertices, 6)
                element(assets, "mesh", name=name, inertia="shell", vertex=vertices, face=numbers(shape.faces))
                look = {"rgba": (*shape.colour, 1.0), **UNTOUCHED, "group": ARM_GROUP}
                element(body, "geom", name=name, type="mesh", mesh=name, **look)
        _add_tip(body, joint, scene, mechanism)
        add_joined_parts(body, joint, scene, mechanism)
        for child in range(1, mechanism.njoints):
            if int(mechanism.parents[child]) == joint:
                add(child, body)

    add(0, world)
    return order


def _add_body(into: ElementTree.Element, chain: list[int], scene: Scene, mechanism: Any) -> ElementTree.Element:
    """Add the body that a joint moves, or those of a free joint taken apart, with its inertia, and return it."""
    joint = chain[-1]
    place, inertia = mechanism.jointPlacements[chain[0]], mechanism.inertias[joint]
    name = str(mechanism.names[joint])
    body = element(into, "body", name=name, pos=place.translation, quat=quaternion(place.rotation))
    moments, axes = np.linalg.eigh(inertia.inertia)
    axes[:, 2] *= np.linalg.det(axes)  # right-handed
    element(
        body, "inertial", pos=inertia.lever, mass=inertia.mass, quat=quaternion(axes),
        diaginertia=np.maximum(moments, 0.0),
    )  # fmt: skip
    if len(chain) > 1 and into.tag == "worldbody" and place.isIdentity(0.0):
        element(body, "joint", name=name, type="free", armature=mechanism.armature[mechanism.joints[joint].idx_v])
        return body
    for each in chain:
        _add_joint(body, each, scene, mechanism)
    return body


def _add_joint(body: ElementTree.Element, joint: int, scene: Scene, mechanism: Any) -> None:
    kind, model, name = mechanism.joints[joint], scene.run.model, str(mechanism.names[joint])
    column = kind.idx_v
    if kind.nv > 1:
        element(body, "joint", name=name, type="ball", armature=mechanism.armature[column])
        return
    data = kind.createData()
    kind.calc(data, np.zeros(1))
    moved = np.asarray(data.S).ravel()  # what a unit of speed moves: linear, angular
    hinge = model.joint_types[column] != "prismatic"
    low, high = float(model.position_lower[column]), float(model.position_upper[column])
    element(
        body, "joint", name=name, type=SHORT[model.joint_types[column]], axis=moved[3:] if hinge else moved[:3],
        range=(low, high) if np.isfinite(low) and np.isfinite(high) else None, armature=mechanism.armature[column],
    )  # fmt: skip


def _add_tip(body: ElementTree.Element, joint: int, scene: Scene, mechanism: Any) -> None:
    """Add the site that touches the surface, and the tool as a rod, to the body that carries them."""
    frame = mechanism.frames[mechanism.getFrameId(scene.tip)]
    if int(frame.parentJoint) != joint:
        return
    place = frame.placement
    element(body, "site", name="tip", pos=place.translation, quat=quaternion(place.rotation), size=(TIP_RADIUS,))
    flange = place.translation - place.rotation @ np.array(scene.run.scenario.tool.offset)
    if np.linalg.norm(place.translation - flange) > TIP_RADIUS:
        size: dict[str, Any] = {"fromto": (*flange, *place.translation), "size": (TIP_RADIUS,)}
        element(body, "geom", name="tool", type="capsule", **size, **UNTOUCHED, group=ARM_GROUP)
