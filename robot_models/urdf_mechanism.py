"""A URDF as numbers, and as the plain text that Pinocchio gets.

Its loops are in a YAML of the same name beside it, the convention of Gepetto's example-parallel-robots.

    closed_loop: [[frame_a, frame_b], ...]     links, or fixed joints, whose frames coincide where it is closed
    type: ['6d', '3d', ...]                    in all six directions, or their origins alone; '6d' if left out
    name_mot: [joint, ...]                     joints with a drive; all if left out
    joint_name: [joint, ...]                   joints that are other than the URDF has them,
    joint_type: ['SPHERICAL', 'UJOINT_XY', 'FIXED', ...]     and what they are

A ball joint and a universal joint become hinges one after the other, about x, y, z of the joint's frame, with massless
links between: the same mechanism, until a hinge in the middle is at a quarter turn.
"""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot_models.errors import ModelError, shown
from robot_models.loop_joint import LoopJoint, loop_joint
from robot_models.mechanism import Array, Bounds, Link, Weight, transform
from robot_models.xml_text import read_text

#: urdfdom reads no "inf": no bound is written as this, and read back as infinity once the model stands.
NO_BOUND = 1e300

# What Pinocchio needs of a file that `urdf.read` has passed. Shapes, colours, transmissions and what else stands beside
# them are not the mechanism, and where urdfdom stumbles over one of them it drops the whole joint or file.
_INERTIAL = {"origin": ("xyz", "rpy"), "mass": ("value",), "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
_JOINT = {
    "parent": ("link",),
    "child": ("link",),
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "dynamics": ("damping", "friction"),
}


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
        name,
        parent,
        joint.get("name", ""),
        kind,
        origin_of(joint),
        axis / np.linalg.norm(axis) if moving else axis,
        weight=weight,
        bounds=_bounds(joint) if moving else Bounds(),
    )


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
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
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
    changed, kinds = _names(table, "joint_name", path), _names(table, "joint_type", path)
    if len(changed) != len(kinds):
        raise ModelError(f"{path}: joint_name has {len(changed)} names and joint_type {len(kinds)}: give one for each")
    root, warnings = ET.fromstring(text), []
    for name, kind in zip(changed, kinds, strict=True):
        if not _change(root, name, kind.upper(), path):
            warnings.append(f"{path.name}: joint_name {name!r} is no joint of the URDF, and is ignored")
        elif kind.upper() == "SPHERICAL":
            warnings.append(f"joint {name!r} is three hinges, about x, y and z: it must not turn by 90 degrees about y")
    pairs, types = table["closed_loop"], _names(table, "type", path)
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
    drives = tuple(name for name in _names(table, "name_mot", path) if name in moving)
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


def _names(table: dict[str, Any], key: str, path: Path) -> list[str]:
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
