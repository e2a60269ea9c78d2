"""URDF: inspected before Pinocchio sees it, made to mean one thing to every reader, and as numbers.

urdfdom, under Pinocchio, drops an `<inertial>` that it cannot parse (the link becomes massless) with no
more than a line on standard error, and gives a joint with a zero axis no motion. So the inspection names such things
and refuses them. A mimicking joint, which both treat as a free one, is bound by a gear.

`<dynamics damping friction>` stays in the file and is not simulated: Pinocchio stores it on the model and
leaves it out of its bias and of its forward dynamics, and here friction belongs to the scenario.

Loops of a URDF are in a YAML of the same name beside it, the convention of Gepetto's example-parallel-robots.

    closed_loop: [[frame_a, frame_b], ...]     links, or fixed joints, whose frames coincide where it is closed
    type: ['6d', '3d', ...]                    in all six directions, or their origins alone; '6d' if left out
    name_mot: [joint, ...]                     joints with a drive; all if left out
    joint_name: [joint, ...]                   joints that are other than the URDF has them,
    joint_type: ['SPHERICAL', 'UJOINT_XY', 'FIXED', ...]     and what they are

A ball joint and a universal joint become hinges one after the other, about x, y, z of the joint's frame, with massless
links between: the same mechanism, until a hinge in the middle is at a quarter turn.
"""

import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from math import hypot, inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from robot_models.errors import ModelError, shown
from robot_models.loop_joint import LoopJoint, loop_joint
from robot_models.mechanism import Array, Bounds, Link, Weight, check_count, symmetric, transform
from robot_models.physics import check_tensor
from robot_models.xml_text import angles, numbers, parse, read_text, tidy, words

if TYPE_CHECKING:
    import yourdfpy

#: "spherical" is not in the URDF's own standard; it is written as urdfdom's "floating" is.
MANY = ("floating", "spherical")
MOVING = ("revolute", "continuous", "prismatic", *MANY)

_OWN = {
    *(
        "robot",
        "link",
        "joint",
        "inertial",
        "origin",
        "mass",
        "inertia",
        "parent",
        "child",
        "axis",
        "limit",
        "dynamics",
    ),
    *("mimic", "visual", "collision", "geometry", "box", "cylinder", "sphere", "mesh", "material", "color", "texture"),
}

_VERSIONS = ("1", "1.0", "1.1", "1.2")
_DECLARATION = re.compile(r"\A\ufeff?\s*<\?xml[^>]*\?>")

_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")

# An axis printed with six digits is off its unit length by up to 1e-6. Every reader rescales that; what is
# further off is rescaled here too, in the text, because not every reader does.
_UNIT = 1e-6


def read(text: str, where: str) -> str:
    """Parse a URDF and return its text with unit joint axes and without stray blanks in its attributes.

    Pinocchio scales a joint's axis to unit length; yourdfpy does so for revolute joints and not for prismatic
    ones. Where an axis is not of unit length, or an attribute has blanks that readers take differently, the text is
    written anew; otherwise it is returned as it came.

    Raises `ModelError` if the XML is malformed or no URDF, a name, a joint's type or link is missing, or a number is
    none.
    """
    root = parse(text, where)
    if root.tag != "robot":
        raise ModelError(f"{where} is no URDF: its root is <{root.tag}>, not <robot>")
    if not root.get("name"):
        raise ModelError(f"{where}: <robot> has no name")
    if any("xacro" in key for element in root.iter() for key in (element.tag, *element.attrib)):
        raise ModelError(f"{where} is a xacro template: load its file, or expand it to a URDF first")
    for element in root.iter():
        if element.tag.startswith("{") and element.tag.split("}")[1] in _OWN:
            raise ModelError(f"{where}: <{element.tag.split('}')[1]}> stands in an XML namespace: drop its xmlns")
    kinds = [joint.get("type", "").strip() for joint in root.findall("joint")]
    moving = sum({"floating": 6, "spherical": 3}.get(kind, 1) for kind in kinds if kind in MOVING)
    check_count(len(root.findall("link")), moving, where)
    changed = tidy(root)
    version = root.get("version", "1.0")
    if version not in _VERSIONS:
        raise ModelError(f"{where}: <robot> has version {version!r}: it must be one of {', '.join(_VERSIONS)}")
    _check_links(root, where)
    _check_joints(root, where)
    for joint in root.findall("joint"):
        axis = joint.find("axis")
        if axis is None or joint.get("type") not in MOVING or joint.get("type") in MANY:
            continue
        at = f"{where}: joint {joint.get('name')!r}"
        # Without xyz urdfdom takes no direction at all, yourdfpy takes x.
        xyz = numbers(axis.get("xyz", ""), 3, f"{at}: axis xyz")
        length = hypot(*xyz)
        if not 1e-9 <= length <= 1e9:
            raise ModelError(f"{at}: axis is {axis.get('xyz')!r}: a moving joint needs a direction")
        if abs(length - 1.0) > _UNIT:
            axis.set("xyz", words(x / length for x in xyz))
            changed = True
    return ET.tostring(root, encoding="unicode") if changed else text


def expanded(path: Path, where: str) -> str:
    """Return the URDF of a xacro template. Raises `ModelError` if xacrodoc is not installed, or cannot expand it."""
    try:
        from xacrodoc import XacroDoc
    except ModuleNotFoundError:
        raise ModelError(
            f'{where} is a xacro template, which xacrodoc expands: pip install "closedloop[xacro]"'
        ) from None
    try:
        return str(XacroDoc.from_file(str(path)).to_urdf_string())
    except Exception as error:  # whatever a template and its expressions raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ModelError(f"{where}: xacrodoc cannot expand it: {reason}") from None


def joint_types(text: str) -> dict[str, str]:
    """Return the type of every joint of a URDF that `read` returned, by name."""
    return {joint.get("name", ""): joint.get("type", "") for joint in ET.fromstring(text).findall("joint")}


def _names(root: ET.Element, tag: str, where: str) -> list[str]:
    names = [element.get("name", "") for element in root.findall(tag)]
    times = Counter(names)
    for name in names:
        if not name:
            raise ModelError(f"{where}: a <{tag}> has no name")
        if times[name] > 1:
            raise ModelError(f"{where}: two {tag}s are named {name!r}: names must differ")
    return names


def _check_links(root: ET.Element, where: str) -> None:
    for name, link in zip(_names(root, "link", where), root.findall("link"), strict=True):
        at = f"{where}: link {name!r}"
        _check_single(link, at, "inertial")
        for inertial in link.findall("inertial"):
            _check_single(inertial, f"{at}: <inertial>", "origin", "mass", "inertia")
            _check_origin(inertial, f"{at}: inertial")
            for tag, keys in (("mass", ("value",)), ("inertia", _TENSOR)):
                element = inertial.find(tag)
                for key in keys:
                    if element is None or key not in element.attrib:
                        raise ModelError(f"{at}: <inertial> lacks <{tag} {key}=…>")
                    (value,) = numbers(element.attrib[key], 1, f"{at}: {tag} {key}")
                    if tag == "mass" and value < 0.0:  # before Pinocchio divides by sums of masses
                        raise ModelError(f"{at} has a mass of {value:g} kg: it must be positive")


def _check_joints(root: ET.Element, where: str) -> None:
    links = _names(root, "link", where)
    known = set(links)
    parents: dict[str, str] = {}
    for name, joint in zip(_names(root, "joint", where), root.findall("joint"), strict=True):
        at = f"{where}: joint {name!r}"
        kind = joint.get("type")
        if kind not in (*MOVING, "fixed"):
            raise ModelError(
                f"{at} is of type {kind!r}, a joint type that is not simulated: "
                f"it must be one of {', '.join((*MOVING, 'fixed'))}"
            )
        _check_single(joint, at, "origin", "parent", "child", "axis", "limit", "dynamics", "mimic")
        ends = []
        for tag in ("parent", "child"):
            element = joint.find(tag)
            link = element.get("link") if element is not None else None
            if link not in known:
                raise ModelError(f"{at}: its {tag} link {link!r} is not in the file")
            ends.append(link)
        if ends[1] in parents:
            raise ModelError(f"{at}: link {ends[1]!r} already has a parent: a loop cannot be written in a URDF")
        parents[ends[1]] = ends[0]
        _check_origin(joint, at)
        for dynamics in joint.findall("dynamics"):
            for key, value in dynamics.attrib.items():
                numbers(value, 1, f"{at}: dynamics {key}")
        if kind in MANY and joint.find("mimic") is not None:
            raise ModelError(f"{at} is {kind} and mimics another, which is not simulated: drop its <mimic>")
        if kind in MOVING and kind not in MANY:
            _check_limit(joint, kind, at)
    _check_tree(links, parents, where)


def _check_single(element: ET.Element, at: str, *tags: str) -> None:
    for tag in tags:
        if (count := len(element.findall(tag))) > 1:
            raise ModelError(f"{at} has {count} <{tag}> elements: one is allowed")


def _check_origin(element: ET.Element, at: str) -> None:
    origin = element.find("origin")
    for key, value in (origin.attrib if origin is not None else {}).items():
        if key == "quat_xyzw":
            raise ModelError(f"{at}: origin quat_xyzw is not read by every reader: give rpy")
        if key in ("xyz", "rpy"):
            (angles if key == "rpy" else numbers)(value, 3, f"{at}: origin {key}")


def _check_limit(joint: ET.Element, kind: str, at: str) -> None:
    limit = joint.find("limit")
    # A continuous joint has no bounds: what its <limit> says of them is ignored, as every reader does.
    known = ("effort", "velocity") if kind == "continuous" else ("lower", "upper", "effort", "velocity")
    given = [key for key in known if limit is not None and key in limit.attrib]
    values = {"lower": -inf, "upper": inf}  # what is missing is no limit
    for key in given:
        (values[key],) = numbers(limit.attrib[key], 1, f"{at}: limit {key}")  # type: ignore[union-attr]
        if key in ("effort", "velocity") and values[key] < 0.0:
            raise ModelError(f"{at}: limit {key} is {values[key]:g}: it must not be negative")
    if values["lower"] > values["upper"]:
        raise ModelError(f"{at}: lower limit {values['lower']:g} is above its upper limit {values['upper']:g}")


def _check_tree(links: list[str], parents: dict[str, str], where: str) -> None:
    roots = [link for link in links if link not in parents]
    if len(roots) > 1:
        raise ModelError(f"{where}: {len(roots)} links have no parent ({_some(roots)}): one root is allowed")
    grounded: set[str] = set(roots)
    for link in links:
        walked: dict[str, None] = {}
        while link not in grounded:
            if link in walked:
                raise ModelError(f"{where}: link {link!r} is its own ancestor: the links must form a tree")
            walked[link] = None
            link = parents[link]
        grounded.update(walked)
    if not links:
        raise ModelError(f"{where} has no links")


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", …" if len(names) > 5 else "")


def mimics(text: str, where: str) -> tuple[tuple[LoopJoint, ...], list[str]]:
    """Return the gears of a URDF that `read` returned, each joint that mimics another, and warnings.

    Of one that mimics a joint which does not move the gear is the value at which it is held. One that mimics a joint
    which is not in the file moves as it is.

    Raises `ModelError` if it mimics itself, or a joint that turns freely, or a number is none.
    """
    found, warnings, joints = [], [], ET.fromstring(text).findall("joint")
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in joints}
    for joint in joints:
        mimic, name = joint.find("mimic"), joint.get("name", "")
        if mimic is None or kinds[name] not in MOVING:
            continue
        at, other = f"{where}: joint {name!r}", mimic.get("joint", "")
        factor, offset = (
            numbers(mimic.get(key, default), 1, f"{at}: mimic {key}")[0]
            for key, default in (("multiplier", "1"), ("offset", "0"))
        )
        if other not in kinds:
            warnings.append(f"joint {name!r} mimics {other!r}, which is not in the file: it is bound to nothing")
            continue
        if kinds[other] in MANY or other == name:
            raise ModelError(f"{at} mimics {other!r}, which is no other joint with one coordinate")
        bound = (name,) if kinds[other] == "fixed" else (name, other)
        polynomial = (offset, factor * (len(bound) == 2), 0.0, 0.0, 0.0)
        found.append(LoopJoint(f"{name} mimics {other}", "gear", joints=bound, polynomial=polynomial))
    return tuple(found), warnings


def inspect(text: str, where: str, locked: Collection[str]) -> list[str]:
    """Refuse a URDF whose moving links cannot exist, and return what of them should be otherwise, a line each.

    Links that stay with the base never move, so their inertia has no effect and only its numbers are checked.
    A link without mass that moves, or with an inertia that no body has, is named: where the mass matrix is positive
    definite all the same it moves. `check_mechanism` refuses what is left over.

    text: the URDF, as `read` returned it
    locked: joints that will be held rigid, and so are as good as fixed
    Raises `ModelError` if a tensor is not positive definite, or yourdfpy cannot read the file.
    """
    robot = _typed(text, where)
    children: dict[str, list[yourdfpy.Joint]] = {joint.parent: [] for joint in robot.joints}
    for joint in robot.joints:
        children[joint.parent].append(joint)
    moved = {j.child for j in robot.joints if j.type in MOVING and j.name not in locked}
    beyond = list(moved)  # everything carried by a moving joint
    for link in beyond:
        beyond += [joint.child for joint in children.get(link, []) if joint.child not in moved]
    warnings = []
    for link in robot.links:
        if link.inertial is None:
            continue
        mass, tensor = link.inertial.mass, link.inertial.inertia
        at = f"{where}: link {link.name!r}"
        if mass == 0.0 and link.name in moved:
            warnings.append(f"link {link.name!r} moves and has a mass of 0 kg")
        if link.name in beyond:
            if mass == 0.0 and tensor.any():
                warnings.append(f"link {link.name!r} has a rotational inertia and a mass of 0 kg")
            if odd := check_tensor(tensor, mass, f"{at}: its inertia tensor"):
                warnings.append(f"link {link.name!r}: its inertia tensor {odd}")
    return warnings


def _typed(text: str, where: str) -> "yourdfpy.Robot":
    # Imported here: it pulls trimesh, half a second that no shipped model need pay.
    import io

    from yourdfpy import URDF

    # Without its declaration, which names another encoding or, damaged, makes yourdfpy print and read in another way.
    stream = io.BytesIO(_DECLARATION.sub("", text).encode())
    try:
        return URDF.load(stream, build_scene_graph=False, load_meshes=False).robot
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ModelError(f"{where}: yourdfpy cannot read it: {reason}") from None


#: urdfdom reads no "inf": no bound is written as this, and read back as infinity once the model stands.
NO_BOUND = 1e300

# What Pinocchio needs of a file that `urdf.read` has passed. Shapes, colours, transmissions and what else stands beside
# them are not the mechanism, and where urdfdom stumbles over one of them it drops the whole joint or file.
_INERTIAL = {"origin": ("xyz", "rpy"), "mass": ("value",), "inertia": _TENSOR}
_JOINT = {
    "parent": ("link",), "child": ("link",), "origin": ("xyz", "rpy"), "axis": ("xyz",),
    "dynamics": ("damping", "friction"),
}  # fmt: skip


def for_pinocchio(text: str) -> str:
    """Return the links, joints and weights of a canonical URDF and nothing else.

    Pinocchio gives a continuous joint the pair (cos q, sin q), which would make nq ≠ nv. Here it is written as a
    revolute joint without bounds: the same mechanism, one angle. urdfdom knows no spherical joint: it is written as a
    floating one, whose sliding joints `robot_models.coordinates` leaves out.
    """
    root = ET.fromstring(text)
    out = ET.Element("robot", name=root.get("name", ""))
    for link in root.findall("link"):
        copy = ET.SubElement(out, "link", name=link.get("name", ""))
        inertial = link.find("inertial")
        if inertial is not None:
            _copy(inertial, ET.SubElement(copy, "inertial"), _INERTIAL)
    for joint in root.findall("joint"):
        kind = joint.get("type", "")
        plain = {"continuous": "revolute", "spherical": "floating"}.get(kind, kind)
        copy = ET.SubElement(out, "joint", name=joint.get("name", ""), type=plain)
        _copy(joint, copy, _JOINT)
        if kind not in ("fixed", "floating", "spherical"):
            bounds = vars(_bounds(joint))
            limit = {key: repr(float(np.clip(value, -NO_BOUND, NO_BOUND))) for key, value in bounds.items()}
            ET.SubElement(copy, "limit", limit)
    return ET.tostring(out, encoding="unicode")


def _copy(source: ET.Element, target: ET.Element, kept: dict[str, tuple[str, ...]]) -> None:
    for tag, keys in kept.items():
        element = source.find(tag)
        if element is not None:
            given = {key: element.attrib[key] for key in keys if key in element.attrib}
            # A link's name may have blanks in it; between numbers one is enough.
            ET.SubElement(target, tag, {k: v if k == "link" else " ".join(v.split()) for k, v in given.items()})


def add_inertial(link: ET.Element, mass: float, tensor: Array, centre: Array | None = None) -> None:
    """Add the inertia of a link: kg, (3, 3) about the centre of mass, kg m², and (3,), m, the origin if left out."""
    inertial = ET.SubElement(link, "inertial")
    if centre is not None:
        ET.SubElement(inertial, "origin", xyz=words(centre))
    ET.SubElement(inertial, "mass", value=repr(float(mass)))
    entries = {key: repr(float(tensor["xyz".index(key[1]), "xyz".index(key[2])])) for key in _TENSOR}
    ET.SubElement(inertial, "inertia", entries)


def add_joint(root: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    """Add a joint between two links, and return it."""
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def mechanism(text: str) -> list[Link]:
    """Return the links of a canonical URDF, parents before their children."""
    root = ET.fromstring(text)
    weights = {link.get("name", ""): _weight(link.find("inertial")) for link in root.findall("link")}
    hanging: dict[str, list[tuple[str, ET.Element]]] = {name: [] for name in weights}
    children = set()
    for joint in root.findall("joint"):
        parent, child = (_get(joint, tag, "link") for tag in ("parent", "child"))
        hanging[parent].append((child, joint))
        children.add(child)
    links = [Link(name, -1, weight=weight) for name, weight in weights.items() if name not in children]
    for at, link in enumerate(links):  # grows while it is walked
        links += [_link(child, at, joint, weights[child]) for child, joint in hanging[link.name]]
    return links


def _link(name: str, parent: int, joint: ET.Element, weight: Weight) -> Link:
    given = joint.get("type", "")
    kind = {"continuous": "revolute", "floating": "free", "spherical": "ball"}.get(given, given)
    if kind in ("free", "ball"):
        return Link(name, parent, joint.get("name", ""), kind, origin_of(joint), weight=weight)
    axis = np.array(_numbers(_get(joint, "axis", "xyz", "1 0 0")))
    moving = kind != "fixed"
    return Link(
        name, parent, joint.get("name", ""), kind, origin_of(joint), axis / np.linalg.norm(axis) if moving else axis,
        weight=weight, bounds=_bounds(joint) if moving else Bounds(),
    )  # fmt: skip


def _bounds(joint: ET.Element) -> Bounds:
    limit = joint.find("limit")
    given = {key: float(limit.attrib[key]) for key in vars(Bounds()) if limit is not None and key in limit.attrib}
    if joint.get("type") == "continuous":  # what a continuous joint says of bounds is ignored, as every reader does
        given = {key: value for key, value in given.items() if key not in ("lower", "upper")}
    given = {key: value for key, value in given.items() if abs(value) < NO_BOUND}
    # Both numbers have to be given, and who knows neither writes 0: a joint that can neither move nor be driven is
    # not what is meant.
    return Bounds(**{k: v for k, v in given.items() if v != 0.0 or k not in ("velocity", "effort")})


def _weight(inertial: ET.Element | None) -> Weight:
    if inertial is None:
        return Weight()
    pose = origin_of(inertial)
    xx, xy, xz, yy, yz, zz = (float(_get(inertial, "inertia", key)) for key in _INERTIAL["inertia"])
    tensor = symmetric(xx, yy, zz, xy, xz, yz)
    turn = pose[:3, :3]
    return Weight(float(_get(inertial, "mass", "value")), pose[:3, 3], turn @ tensor @ turn.T)


def origin_of(element: ET.Element) -> Array:
    """Return the pose (4, 4) of an <origin>: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch, yaw = _numbers(_get(element, "origin", "rpy", "0 0 0"))
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return transform(rotation, np.array(_numbers(_get(element, "origin", "xyz", "0 0 0"))))


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _get(element: ET.Element, tag: str, key: str, default: str = "") -> str:
    child = element.find(tag)
    return default if child is None else child.get(key, default)


_KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
_AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}


class Beside(NamedTuple):
    """What a YAML says: the URDF as it then is, its loop joints, the joints with a drive, a line each of warnings."""

    text: str
    loops: tuple[LoopJoint, ...] = ()
    drives: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def read_beside(path: Path, text: str) -> Beside:
    """Return what the YAML at `path` says of a URDF, whose text is given, or that alone where there is no such YAML.

    Raises `ModelError` if it is no YAML, or a key is not what it should be.
    """
    table = _table(path)
    if not table:
        return Beside(text)
    for key in table:
        if key not in _KEYS:
            raise ModelError(f"{path}: unknown key {shown(key)}: known are {', '.join(_KEYS)}")
    changed, kinds = _texts(table, "joint_name", path), _texts(table, "joint_type", path)
    if len(changed) != len(kinds):
        raise ModelError(f"{path}: joint_name has {len(changed)} names and joint_type {len(kinds)}: give one for each")
    root, warnings = ET.fromstring(text), []
    for name, kind in zip(changed, kinds, strict=True):
        if not _change(root, name, kind.upper(), path):
            warnings.append(f"{path.name}: joint_name {name!r} is no joint of the URDF, and is ignored")
        elif kind.upper() == "SPHERICAL":
            warnings.append(f"joint {name!r} is three hinges, about x, y and z: it must not turn by 90 degrees about y")
    pairs, types = table["closed_loop"], _texts(table, "type", path)
    if not isinstance(pairs, list) or len(types) > len(pairs):
        raise ModelError(f"{path}: closed_loop is {shown(pairs)}: it must be pairs of links, one for each type")
    links, loops = _frames(root), []
    for k, (frames, kind) in enumerate(zip(pairs, types + ["6d"] * (len(pairs) - len(types)), strict=True), 1):
        loop = loop_joint({"name": f"loop {k}", "type": kind.lower(), "frames": frames}, str(path))
        if unknown := [name for name in loop.frames if name not in links]:
            warnings.append(f"{path.name}: closed_loop {k} names {unknown[0]!r}, no frame of the URDF, and is left out")
            continue
        loops.append(replace(loop, frames=tuple(links[name] for name in loop.frames)))
    if not loops:
        raise ModelError(f"{path}: closed_loop names no frame of the URDF: name its links, or its fixed joints")
    moving = {joint.get("name") for joint in root.findall("joint") if joint.get("type") != "fixed"}
    drives = tuple(name for name in _texts(table, "name_mot", path) if name in moving)
    return Beside(ET.tostring(root, encoding="unicode") if changed else text, tuple(loops), drives, tuple(warnings))


def _frames(root: ET.Element) -> dict[str, str]:
    """Return the link whose frame each name of a joint, or of a link, is."""
    joints = {
        joint.get("name", ""): child.get("link", "")
        for joint in root.findall("joint")
        if (child := joint.find("child")) is not None
    }
    return joints | {name: name for link in root.findall("link") if (name := link.get("name", ""))}


def _table(path: Path) -> dict[str, Any]:
    """Return the keys of a YAML that has loops; none where there is no such file."""
    if not path.exists():
        return {}
    import yaml

    try:
        table = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise ModelError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    return table if isinstance(table, dict) and "closed_loop" in table else {}


def _texts(table: dict[str, Any], key: str, path: Path) -> list[str]:
    value = table.get(key) or []
    if not (isinstance(value, list) and all(isinstance(x, str) for x in value)):
        raise ModelError(f"{path}: {key} is {shown(value)}: it must be a list of texts")
    return value


def _change(root: ET.Element, name: str, kind: str, path: Path) -> bool:
    """Make a joint of a URDF fixed, or a row of hinges; return whether there is such a joint."""
    axes = "XYZ" if kind == "SPHERICAL" else kind.removeprefix("UJOINT_")
    if kind != "FIXED" and not (kind[:1] in "SU" and axes and set(axes) <= set(_AXES)):
        raise ModelError(f"{path}: joint_type is {kind!r}: it must be SPHERICAL, FIXED or UJOINT_ and two axes, as XY")
    joint = next((each for each in root.findall("joint") if each.get("name") == name), None)
    child, parent = (None, None) if joint is None else (joint.find("child"), joint.find("parent"))
    if joint is None or child is None or parent is None:
        return False
    for tag in ("axis", "limit", "mimic", "dynamics"):
        for element in joint.findall(tag):
            joint.remove(element)
    if kind == "FIXED":
        joint.set("type", "fixed")
        return True
    last = child.get("link", "")
    for k, axis in enumerate(axes):
        own = joint if k == 0 else ET.SubElement(root, "joint")
        own.set("name", f"{name}_{axis}")
        own.set("type", "continuous")
        ET.SubElement(own, "axis", xyz=_AXES[axis])
        link = last if k == len(axes) - 1 else f"{name}_{axis} link"
        if k == 0:
            child.set("link", link)
        else:
            ET.SubElement(own, "parent", link=f"{name}_{axes[k - 1]} link")
            ET.SubElement(own, "child", link=link)
        if link != last:
            ET.SubElement(root, "link", name=link)
    return True
