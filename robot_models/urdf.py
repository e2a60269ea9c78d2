"""URDF: inspected before Pinocchio sees it, and made to mean one thing to every reader.

urdfdom, under Pinocchio, drops an `<inertial>` that it cannot parse (the link becomes massless) with no
more than a line on standard error, and gives a joint with a zero axis no motion. So the inspection names such things
and refuses them. A mimicking joint, which both treat as a free one, is bound by a gear.

`<dynamics damping friction>` stays in the file and is not simulated: Pinocchio stores it on the model and
leaves it out of its bias and of its forward dynamics, and here friction belongs to the scenario.
"""

import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection
from math import hypot, inf
from pathlib import Path
from typing import TYPE_CHECKING

from robot_models.errors import ModelError
from robot_models.loop_joint import LoopJoint
from robot_models.mechanism import check_size
from robot_models.physics import check_tensor
from robot_models.xml_text import angles, numbers, parse, tidy

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
    check_size(len(root.findall("link")), moving, where)
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
            axis.set("xyz", " ".join(repr(x / length) for x in xyz))
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
