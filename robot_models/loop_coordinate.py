"""Coordinates of loop joints: one that has friction, limits or a drive becomes a joint of the tree.

A hinge between links A and B that has any of them is cut elsewhere. A new link hangs on A by a joint of the tree, which
is the hinge, and is welded to B, which closes the loop. The motion is the same: the new link takes a share of B's mass
and moves as one body with the rest of it, so that the mass matrix of the tree is not singular. What acts on a joint of
the tree then acts on the loop joint as well: friction, stops, drives, and all that a scenario knows of joints.

Where B cannot share (it is the base, or has no inertia about the axis), A does, and the new link hangs on B.
"""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from robot_models.errors import ModelError
from robot_models.loop_joint import FREE, WORLD, LoopJoint
from robot_models.mechanism import Array, Link, Weight, lumped, turned
from robot_models.physics import LEAST_INERTIA
from robot_models.urdf import NO_BOUND, add_inertial, add_joint, mechanism
from robot_models.xml_text import words

if TYPE_CHECKING:
    import pinocchio as pin


def links_of(loop: LoopJoint) -> tuple[str, str]:
    """Return the names of the new links of a loop joint: of that between two coordinates, and of the one welded."""
    return f"{loop.name} turned", f"{loop.name} side"


def new_side(loop: LoopJoint) -> int:
    """Return on which side of a loop joint with coordinates the welded one of its new links is, 0 or 1."""
    return int(loop.frames[1] == links_of(loop)[-1])


def place_coordinates(model: "pin.Model", loops: Sequence[LoopJoint], q: Array) -> Array:
    """Return joint positions (n,), rad (m), with the coordinates of loop joints as the rest of the posture has them.

    loops: those without coordinates are passed over
    q: (n,), what it says of the coordinates is not read
    """
    import pinocchio as pin

    placed, data = np.array(q, dtype=np.float64), model.createData()
    for loop in loops:
        joints = [model.idx_qs[model.getJointId(name)] for name in loop.coordinates if model.existJointName(name)]
        if not joints:
            continue
        placed[joints] = 0.0
        k = new_side(loop)
        new, other = loop.frames[k], loop.frames[1 - k]
        pin.framesForwardKinematics(model, data, placed)
        there = data.oMf[model.getFrameId(other)] * pin.SE3(np.eye(3), np.array(loop.points[1 - k]))
        moved = data.oMf[model.getFrameId(new)].actInv(there)
        for j, name in zip(joints, loop.coordinates, strict=False):
            joint = model.joints[model.getJointId(name)]
            motion = np.array(joint.createData().S).ravel()
            if motion[:3].any():
                placed[j] = motion[:3] @ moved.translation
            else:
                placed[j] = _angle(moved.rotation, motion[3:], model.lowerPositionLimit[j], model.upperPositionLimit[j])
    return placed


def coordinate_rates(model: "pin.Model", loops: Sequence[LoopJoint], q: Array, v: Array) -> Array:
    """Return joint velocities (n,), rad/s (m/s), with the rates of loop joints' coordinates as the rest has them.

    model, loops: as in `place_coordinates`
    q, v: (n,), a posture in which they are placed, and velocities; what those say of the coordinates is not read
    """
    import pinocchio as pin

    rates, data = np.array(v, dtype=np.float64), model.createData()
    joints = {name: model.joints[model.getJointId(name)] for loop in loops for name in loop.coordinates}
    rates[[joint.idx_v for joint in joints.values()]] = 0.0
    pin.forwardKinematics(model, data, q, rates)
    pin.updateFramePlacements(model, data)
    for loop in loops:
        if not loop.coordinates:
            continue
        k = new_side(loop)
        new, other = (model.getFrameId(loop.frames[i]) for i in (k, 1 - k))
        moving = [data.oMf[i].act(pin.getFrameVelocity(model, data, i, pin.LOCAL)) for i in (other, new)]
        apart = data.oMf[new].actInv(moving[0] - moving[1]).vector
        for name in loop.coordinates:
            rates[joints[name].idx_v] = np.array(joints[name].createData().S).ravel() @ apart
    return rates


def give_back(model: "pin.Model", loops: Sequence[LoopJoint]) -> None:
    """Give the mass that the links of coordinates share back to the links that they are welded to.

    The mass matrix is then singular. It is for the forces between the links: those of a weld are then those of the
    loop joint that it stands for.
    """
    import pinocchio as pin

    for loop in loops:
        if not loop.coordinates:
            continue
        k = new_side(loop)
        new = model.frames[model.getFrameId(loop.frames[k])]
        old = model.frames[model.getFrameId(loop.frames[1 - k])]
        place = old.placement * pin.SE3(np.eye(3), np.array(loop.points[1 - k])) * new.placement.inverse()
        model.inertias[old.parentJoint] += place.act(model.inertias[new.parentJoint])
        model.inertias[new.parentJoint] = pin.Inertia.Zero()


def stands_for(loops: Sequence[LoopJoint]) -> set[str]:
    """Return the names of the joints and links of a tree that stand for loop joints."""
    return {name for loop in loops if loop.coordinates for name in (*loop.coordinates, *links_of(loop))}


def _angle(rotation: Array, axis: Array, low: float, high: float) -> float:
    """Return the angle of a rotation (3, 3) about an axis, rad, within limits if a turn more or less is."""
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    angle = float(np.arctan2(np.cross(axis, x) @ rotation @ x, x @ rotation @ x))
    return next((a for a in (angle, angle + 2.0 * np.pi, angle - 2.0 * np.pi) if low <= a <= high), angle)


_KINDS = " and ".join(FREE)


class _Side(NamedTuple):
    """The side k of a loop joint that shares its mass, and the body that it belongs to: links held together."""

    k: int
    body: int


def _acting(loops: Sequence[LoopJoint], drives: Sequence[str], where: str) -> tuple[LoopJoint, ...]:
    """Return the loop joints whose coordinates become joints of the tree.

    Raises `ModelError` if a drive is named at a loop joint that has no coordinate of that name.
    """
    for loop in loops:
        if loop.name in drives and loop.name not in loop.free and not loop.coordinates:
            cure = f"name {' or '.join(map(repr, loop.free))}" if loop.free else f"loop joints with one are {_KINDS}"
            raise ModelError(f"{where}: drives names the loop joint {loop.name!r}, a {loop.type}: {cure}")
    return tuple(loop for loop in loops if loop.friction or loop.damping or loop.limits or set(loop.free) & set(drives))


def with_coordinates(
    text: str, format: str, loops: Sequence[LoopJoint], drives: Sequence[str], where: str
) -> tuple[str, tuple[LoopJoint, ...]]:
    """Return a text with the coordinates of loop joints that act as joints of its tree, and its loop joints then.

    text, format: a canonical text, and "urdf" or "mjcf"
    drives: joints with a drive
    Raises `ModelError` if the text is MJCF, a coordinate has the name of a joint, or no side of a loop joint has
    inertia to share.
    """
    wanted = _acting(loops, drives, where)
    if not wanted:
        return text, tuple(loops)
    if format != "urdf":
        raise ModelError(
            f"{where}: closed_loop {wanted[0].name!r}: friction, limits and drives of loop joints are for a URDF, and "
            "this is MJCF: leave them out"
        )
    links = mechanism(text)
    number = {link.name: i for i, link in enumerate(links)}
    if any(name not in (*number, WORLD) for loop in wanted for name in loop.frames):
        return text, tuple(loops)  # what is not there is named by `check_loops`
    bodies, poses = _bodies(links)
    sides = {loop.name: _sharing(loop, links, number, bodies, poses, where) for loop in wanted}
    shares = Counter(side.body for side in sides.values())
    root = ET.fromstring(text)
    taken = {element.get("name", "") for element in root if element.tag in ("link", "joint")}
    for loop in wanted:
        if clash := [name for name in (*loop.free, *links_of(loop)) if name in taken]:
            raise ModelError(
                f"{where}: closed_loop {loop.name!r} needs the name {clash[0]!r}, which a link or a joint has"
            )
    for link in root.findall("link"):
        body = bodies[number[link.get("name", "")]]
        for tag in ("mass", "inertia") if body in shares else ():
            for element in link.findall(f"inertial/{tag}"):
                for key, value in element.attrib.items():
                    element.set(key, repr(float(value) / (1 + shares[body])))
    made = []
    for loop in loops:
        if loop not in wanted:
            made.append(loop)
            continue
        side = sides[loop.name]
        weight = _weight_at(loop, side, links, number, bodies, poses)
        parent = loop.frames[1 - side.k]
        _hang(root, loop, side.k, links[0].name if parent == WORLD else parent, weight, 1 + shares[side.body])
        made.append(_weld(loop, side.k))
    return ET.tostring(root, encoding="unicode"), tuple(made)


def _bodies(links: list[Link]) -> tuple[list[int], list[Array]]:
    """Return of each link the first of those that it is fixed to, and where it is there, (4, 4)."""
    bodies, poses = list(range(len(links))), [np.eye(4) for _ in links]
    for i, link in enumerate(links):
        if link.parent >= 0 and link.kind == "fixed":
            bodies[i] = bodies[link.parent]
            poses[i] = poses[link.parent] @ link.placement @ link.offset
    return bodies, poses


def _weight_at(
    loop: LoopJoint, side: _Side, links: list[Link], number: dict[str, int], bodies: list[int], poses: list[Array]
) -> Weight:
    """Return the weight of a side's body, in the frame of the loop joint there."""
    here = poses[number[loop.frames[side.k]]].copy()
    here[:3, 3] += here[:3, :3] @ np.array(loop.points[side.k])
    back = np.linalg.inv(here)
    held = [i for i in range(len(links)) if bodies[i] == side.body]
    return lumped([links[i].weight for i in held], [back @ poses[i] for i in held])


def _sharing(
    loop: LoopJoint, links: list[Link], number: dict[str, int], bodies: list[int], poses: list[Array], where: str
) -> _Side:
    """Return the side that shares its mass with the new link: the second if it can."""
    for k in (1, 0):
        if loop.frames[k] == WORLD or bodies[number[loop.frames[k]]] == 0:
            continue
        side = _Side(k, bodies[number[loop.frames[k]]])
        weight, axis = _weight_at(loop, side, links, number, bodies, poses), np.array(_axis(loop, k))
        arm = np.cross(axis, weight.centre)
        about = float(axis @ weight.tensor @ axis + weight.mass * arm @ arm)
        kinds = [kind for kind, _ in FREE[loop.type]]
        if weight.mass > 0.0 and ("revolute" not in kinds or about > LEAST_INERTIA):
            return side
    raise ModelError(
        f"{where}: closed_loop {loop.name!r}: friction, limits and drives need a link with inertia about the axis on "
        "one side: give one its <inertial>"
    )


def _axis(loop: LoopJoint, k: int) -> Array:
    """Return the direction of the axis on a side: of a slider its frames' directions agree."""
    if loop.type == "slider" and k == 1:
        axis: Array = np.array(loop.turn) @ np.array(loop.axes[0])
        return axis
    return np.array(loop.axes[k])


def _onto(b: Array, a: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes one direction to another."""
    across, along = np.cross(b, a), float(b @ a)
    size = float(np.linalg.norm(across))
    if size < 1e-12:
        if along > 0.0:
            return np.eye(3)
        across = np.cross(b, np.eye(3)[np.argmin(np.abs(b))])
        return turned(across / np.linalg.norm(across), np.pi)
    return turned(across / size, float(np.arctan2(size, along)))


def _weld(loop: LoopJoint, k: int) -> LoopJoint:
    """Return the weld between the new link and the side k that shares its mass."""
    points: list[tuple[float, ...]] = [(0.0, 0.0, 0.0)] * 2
    frames, axis = list(loop.frames), tuple(float(x) for x in _axis(loop, k))
    frames[1 - k], points[k] = links_of(loop)[-1], loop.points[k]
    return replace(LoopJoint(loop.name, "weld", tuple(frames), tuple(points)), axes=(axis, axis), coordinates=loop.free)


def _hang(root: ET.Element, loop: LoopJoint, k: int, parent: str, weight: Weight, parts: int) -> None:
    """Add the joints of a loop joint's coordinates and their links, of which the last has its part of a weight.

    The last link's frame is that of the side k at its point. A coordinate is that of the second side to the first.
    """
    import pinocchio as pin

    # the axes of the second side in those of the first
    first = np.array(loop.turn).T if loop.type == "slider" else _onto(_axis(loop, 1), _axis(loop, 0))
    rotation, axis = (first, _axis(loop, 1)) if k == 1 else (first.T, -_axis(loop, 0))
    between, last = links_of(loop)
    names = [last] if len(loop.free) == 1 else [between, last]
    for i, (child, (kind, _), joint_name) in enumerate(zip(names, FREE[loop.type], loop.free, strict=True)):
        low, high = loop.limits[i] if loop.limits else (-np.inf, np.inf)
        free = kind == "revolute" and low == -np.inf and high == np.inf
        joint = add_joint(root, joint_name, "continuous" if free else kind, parent, child)
        if i == 0:
            rpy = pin.rpy.matrixToRpy(rotation)
            ET.SubElement(joint, "origin", xyz=words(loop.points[1 - k]), rpy=words(rpy))
        ET.SubElement(joint, "axis", xyz=words(axis))
        if not free:
            bounds = {"lower": float(max(low, -NO_BOUND)), "upper": float(min(high, NO_BOUND))}
            ET.SubElement(joint, "limit", {key: repr(x) for key, x in bounds.items()}, effort="0", velocity="0")
        acts = {"friction": loop.friction, "damping": loop.damping}
        if loop.friction or loop.damping:  # urdfdom takes no empty one
            ET.SubElement(joint, "dynamics", {key: repr(float(x[i])) for key, x in acts.items() if x})
        link = ET.SubElement(root, "link", name=child)
        parent = child
    add_inertial(link, weight.mass / parts, weight.tensor / parts, weight.centre)
