"""MJCF, reduced to the mechanism that it describes and written so that Pinocchio reads it as MuJoCo does.

Read against Pinocchio 4.1 and MuJoCo 3.17, Pinocchio's own reader

- loses the pose of a base body without joints, and every body of the world but the first;
- takes no notice of `<option gravity>`, of `<frame>`, springs, equality constraints, tendons, gravity
  compensation;
- mixes a joint's class with the `childclass` around it, where MuJoCo takes the class alone;
- counts no geom without contact in an inertia that is inferred from geoms, and, under
  `inertiafromgeom="true"`, leaves a body without geoms massless, where MuJoCo does neither;
- turns a negative mass into 0, and takes the axis of an axisangle for a unit vector and the
  range of a slide joint for degrees;
- looks for mesh files even where no inertia depends on them;
- wants `<compiler>` to stand before the bodies, and counts several joints of one body as one.

So `read` inlines the includes, resolves the default classes into plain attributes, keeps what the mechanism
needs (bodies, joints, inertias, sites, shapes that are not meshes, loops, keyframes) and refuses what would change
the motion and cannot be honoured. Damping, friction loss, contacts and sensors do not belong to the mechanism and
are left out; of actuators the torques that they can give are kept (`robot_models.mjcf_actuators`).
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import NamedTuple

from robot_models import mjcf_equality
from robot_models.coordinates import PARTS, PLACES
from robot_models.errors import ModelError
from robot_models.mechanism import check_size
from robot_models.mjcf_actuators import limit_joint, torque_ranges
from robot_models.mjcf_defaults import Defaults
from robot_models.mjcf_mechanism import TURNS, Units, mechanism
from robot_models.mjcf_schema import check_schema
from robot_models.mjcf_values import (
    check_inertial,
    check_joint,
    check_neutral,
    check_shape,
    check_turns,
    check_weighing_bodies,
    check_weighing_geom,
    is_mesh,
)
from robot_models.notes import LEFT_OUT
from robot_models.xml_text import MAX_DEPTH, MAX_ELEMENTS, numbers, parse, read_text, tidy

#: Sections that would change the motion.
_REFUSED = ("deformable", "extension", "tendon")
_IN_BODY = ("body", "joint", "inertial", "geom", "site")
_IGNORED_IN_BODY = ("camera", "light")

#: Attributes that survive: everything that places, moves or weighs something, and what a viewer draws.
_POSE = ("pos", *TURNS)
_ATTRIBUTES = {
    "body": ("name", *_POSE),
    "inertial": ("mass", "diaginertia", "fullinertia", *_POSE),
    "joint": ("name", "type", "axis", "pos", "range", "armature", "actuatorfrcrange"),
    "site": ("name", *_POSE),
    "geom": ("name", "type", "size", "fromto", "mass", "density", "rgba", "contype", "conaffinity", *_POSE),
}

#: Files that one model may include.
MAX_INCLUDES = 100

#: Velocities of a joint that has more than one, by its type; and its positions.
ONE_BY_ONE, POSITIONS = {"ball": 3, "free": 6}, {"ball": 4, "free": 7}

# What a joint says of friction; it does not act.
_FRICTION = ("damping", "frictionloss")

#: The body that `mjcf_pinocchio` adds; no body of a file may be named so.
STILL = "robot_models/world"


def read(text: str, where: str, folder: Path | None) -> str:
    """Return an MJCF text that holds the mechanism and nothing that another file must complete.

    Parameters
    ----------
    text
        The document.
    where
        How to name it in a message.
    folder
        Where the files of `<include>` are looked up; None allows no include.

    Raises
    ------
    ModelError
        The XML is malformed, is no MJCF, or says something that cannot be honoured.
    """
    root = parse(text, where)
    if root.tag != "mujoco":
        raise ModelError(f"{where} is no MJCF: its root is <{root.tag}>, not <mujoco>")
    _include(root, where, folder, set())
    if sum(1 for _ in root.iter()) > MAX_ELEMENTS:
        raise ModelError(f"{where} has more than {MAX_ELEMENTS} elements with what it includes")
    floating = root.findall("worldbody//freejoint")
    moving = sum(ONE_BY_ONE.get(joint.get("type", ""), 1) for joint in root.iterfind("worldbody//joint"))
    moving += ONE_BY_ONE["free"] * len(floating)
    check_size(len(root.findall("worldbody//body")) + len(root.findall("worldbody//site")), moving, where)
    tidy(root)
    for section in root:
        if section.tag in _REFUSED:
            raise ModelError(f"{where}: <{section.tag}> is not simulated: the model must do without it")
    check_schema(root, where)
    out = ET.Element("mujoco", model=root.get("model") or "model")
    _copy_settings(root, out, where)
    world = ET.SubElement(out, "worldbody")
    defaults = Defaults(root, where)
    defaults.check_references(root)
    names: set[tuple[str, str]] = set()
    # Joints with friction, from the file itself or from a canonical text that was written before.
    rough = [e.get("data", "") for e in root.iterfind("custom/text") if e.get("name") == LEFT_OUT]
    shared = _Copied(defaults, Units(out), names, rough, torque_ranges(root, defaults, where))
    for element in root.findall("worldbody"):
        _copy_body(element, world, shared, None, False, f"{where}: the world")
    for joint in world.iterfind("body//body/joint"):
        if joint.get("type") == "free":
            raise ModelError(f"{where}: joint {joint.get('name')!r}: a free joint must be that of a body of the world")
    check_weighing_bodies(mechanism(ET.tostring(out, encoding="unicode"), STILL), where)
    if rough:
        custom = ET.SubElement(out, "custom")
        ET.SubElement(custom, "text", name=LEFT_OUT, data="\n".join(rough))
    mjcf_equality.copy(root, out, where)
    keys = ET.SubElement(out, "keyframe")
    for key in root.iterfind("keyframe/key[@qpos]"):
        numbers(key.attrib["qpos"], None, f"{where}: keyframe qpos")
        ET.SubElement(keys, "key", name=key.get("name", "home"), qpos=key.attrib["qpos"])
    return ET.tostring(out, encoding="unicode")


def _copy_settings(root: ET.Element, out: ET.Element, where: str) -> None:
    """Copy what <compiler> says of angles, and gravity; what would change anything else must be neutral."""
    compiler = ET.SubElement(out, "compiler")
    for element in root.findall("compiler"):
        check_neutral(element, dict(element.attrib), f"{where}: <compiler>")
        sequence = element.get("eulerseq", "xyz")
        if len(sequence) != 3 or not set(sequence) <= set("xyz"):
            raise ModelError(
                f"{where}: eulerseq is {sequence!r}: it must be three of x, y, z; capitals, for fixed "
                "axes, are not honoured"
            )
        compiler.attrib.update({k: v for k, v in element.attrib.items() if k in ("angle", "eulerseq")})
    for element in root.findall("option"):
        for part in element.iter():
            check_neutral(part, dict(part.attrib), f"{where}: <{part.tag}>")
        if "gravity" in element.attrib:
            numbers(element.attrib["gravity"], 3, f"{where}: option gravity")
            ET.SubElement(out, "option", gravity=element.attrib["gravity"])


def gravity(text: str) -> tuple[float, float, float]:
    """Return the gravity of a canonical MJCF, m/s² in the world frame; MuJoCo's default where it has none."""
    found = [option.attrib["gravity"].split() for option in ET.fromstring(text).findall("option")]
    x, y, z = (float(word) for word in (found[-1] if found else ("0", "0", "-9.81")))
    return x, y, z


def home(text: str) -> list[float] | None:
    """Return the posture of the keyframe "home", or of the first one, or None."""
    keys = ET.fromstring(text).findall("keyframe/key")
    keys.sort(key=lambda key: key.get("name") != "home")
    return [float(word) for word in keys[0].attrib["qpos"].split()] if keys else None


def _include(element: ET.Element, where: str, folder: Path | None, seen: set[Path], depth: int = 0) -> None:
    """Replace every <include> by its file's content: each file once, relative to the model's folder."""
    if depth > MAX_DEPTH:
        raise ModelError(f"{where}: elements are nested deeper than {MAX_DEPTH} levels with what it includes")
    position = 0
    while position < len(element):
        child = element[position]
        if child.tag != "include":
            _include(child, where, folder, seen, depth + 1)
            position += 1
            continue
        name = child.get("file")
        if not name or folder is None:
            raise ModelError(f"{where}: cannot include {name!r}: the text must stand by itself")
        path = (folder / name).resolve()
        if path in seen:
            raise ModelError(f"{where}: {name!r} is included twice: a file may be included once")
        seen.add(path)
        if len(seen) > MAX_INCLUDES:
            raise ModelError(f"{where} includes more than {MAX_INCLUDES} files: merge some")
        try:
            element[position : position + 1] = list(parse(read_text(path), name))
        except ModelError as error:
            raise ModelError(f"{where}: included {name}: {error}") from None


class _Copied(NamedTuple):
    """What all bodies of a file have in common while they are copied.

    Attributes
    ----------
    defaults, units
        How the file's attributes are to be read.
    names
        Tag and name of every body and joint so far.
    rough
        Joints with friction so far.
    most
        The largest torque of the actuators of each joint that has some, N m (N).
    """

    defaults: Defaults
    units: Units
    names: set[tuple[str, str]]
    rough: list[str]
    most: dict[str, float]


def _copy_body(
    source: ET.Element, target: ET.Element, shared: _Copied, childclass: str | None, moves: bool, at: str
) -> None:
    """Copy what a body holds that the mechanism is made of: `moves` if a joint carries it, `at` in messages."""
    childclass = source.get("childclass", childclass)
    where = at.split(": ")[0]
    joints = [child for child in source if child.tag in ("joint", "freejoint")]
    if len(joints) > 1:
        raise ModelError(f"{at} has {len(joints)} joints: give each a body of its own")
    moves = moves or bool(joints)
    weighs = moves and source.find("inertial") is None
    for child in source:
        if child.tag in _IGNORED_IN_BODY:
            continue
        if child.tag == "freejoint":
            check_neutral(child, dict(child.attrib), f"{at}: freejoint")
            given = {"type": "free", "name": child.get("name", source.get("name", ""))}
            child = ET.Element("joint", given)
        elif child.tag in _IN_BODY:
            given = shared.defaults.resolve(child, childclass)
        else:
            raise ModelError(f"{at}: <{child.tag}> is not simulated: the model must do without it")
        name = f"{child.tag} {given['name']!r}" if "name" in given else f"a {child.tag} without a name"
        here = f"{where}: {name}"
        check_neutral(child, given, here)
        check_turns(child.tag, given, shared.units, here)
        if child.tag in ("geom", "site"):
            check_shape(child.tag, given, here)
        if child.tag == "geom" and weighs:
            check_weighing_geom(given, at)
        elif child.tag == "geom" and is_mesh(given):
            continue
        if child.tag in ("body", "joint"):
            _check_name(child.tag, given, at, here, shared.names)
        if child.tag == "site" and source.tag == "worldbody":
            continue
        copy = ET.SubElement(target, child.tag, {k: given[k] for k in _ATTRIBUTES[child.tag] if k in given})
        if child.tag == "body":
            _copy_body(child, copy, shared, childclass, moves, here)
        elif child.tag == "joint":
            check_joint(given, here)
            limit_joint(copy, given, shared.most.get(given["name"], inf), here)
            if any(word.strip("0.") for key in _FRICTION for word in given.get(key, "").split()):
                shared.rough.append(given["name"])
        elif child.tag == "inertial":
            check_inertial(given, at)


def _check_name(tag: str, given: dict[str, str], at: str, here: str, names: set[tuple[str, str]]) -> None:
    name = given.get("name", "")
    if not name or name == STILL:
        raise ModelError(f"{at}: a {tag} has no name: every body and joint needs one")
    if (tag, name) in names:
        raise ModelError(f"{here}: the name is taken: names must differ")
    names.add((tag, name))


def joint_types(text: str) -> Iterator[tuple[str, str]]:
    """Yield name and type of the joints of a canonical MJCF, in the order of the text."""
    for element in ET.fromstring(text).iterfind("worldbody//joint"):
        yield element.attrib["name"], element.get("type", "hinge")


def position_names(text: str) -> list[str]:
    """Return the names of the positions of a canonical MJCF in the order of its keyframes, see `coordinates`."""
    found = []
    for name, kind in joint_types(text):
        ends = {"free": (*PLACES, *PARTS), "ball": PARTS}.get(kind, ("",))
        found += [name + end for end in ends]
    return found
