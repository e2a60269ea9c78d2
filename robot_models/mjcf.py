"""MJCF, reduced to the mechanism that it describes and written so that Pinocchio reads it as MuJoCo does.

Read against Pinocchio 4.1 and MuJoCo 3.17, Pinocchio's own reader

- loses the pose of a base body without joints, and every body of the world but the first;
- takes no notice of `<option gravity>`, of `<frame>`, springs, equality constraints, tendons, gravity
  compensation;
- mixes a joint's class with the `childclass` around it, where MuJoCo takes the class alone;
- counts no geom without contact in an inertia that is inferred from geoms, and, under
  `inertiafromgeom="true"`, leaves a body without geoms massless, where MuJoCo does neither;
- turns a negative mass into 0;
- looks for mesh files even where no inertia depends on them;
- wants `<compiler>` to stand before the bodies, and counts several joints of one body as one.

So `read` inlines the includes, resolves the default classes into plain attributes, keeps what the mechanism
needs (bodies, joints, inertias, sites, shapes that are not meshes, keyframes) and refuses what would change
the motion and cannot be honoured. Damping, friction loss, contacts, actuators and sensors do not belong to
the mechanism and are left out.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robot_models.errors import ModelError
from robot_models.mjcf_defaults import Defaults
from robot_models.physics import check_tensor
from robot_models.xml_text import numbers, parse, read_text

#: Sections that describe the mechanism, and those that may stand in a file and have no part in it.
_KEPT = ("compiler", "option", "default", "worldbody", "keyframe")
_LEFT_OUT = ("actuator", "asset", "contact", "custom", "sensor", "size", "statistic", "visual")
_IN_BODY = ("body", "joint", "inertial", "geom", "site")
_IGNORED_IN_BODY = ("camera", "light")

#: Attributes that survive: everything that places, moves or weighs something, and what a viewer draws.
_POSE = ("pos", "quat", "axisangle", "euler", "xyaxes", "zaxis")
_ATTRIBUTES = {
    "body": ("name", *_POSE),
    "inertial": ("mass", "diaginertia", "fullinertia", *_POSE),
    "joint": ("name", "type", "axis", "pos", "range", "armature", "actuatorfrcrange"),
    "site": ("name", *_POSE),
    "geom": ("name", "type", "size", "fromto", "mass", "density", "rgba", "contype", "conaffinity", *_POSE),
}

# How many numbers an attribute holds; None leaves it open. Others are words.
_COUNTS: dict[str, int | None] = {
    **dict.fromkeys(("mass", "armature", "density", "contype", "conaffinity"), 1),
    **dict.fromkeys(("range", "actuatorfrcrange"), 2),
    **dict.fromkeys(("pos", "euler", "zaxis", "axis", "diaginertia"), 3),
    **dict.fromkeys(("quat", "axisangle", "rgba"), 4),
    **dict.fromkeys(("xyaxes", "fullinertia", "fromto"), 6),
    "size": None,
}

#: The body that `for_pinocchio` adds; no body of a file may be named so.
STILL = "robot_models/world"

# What would change the motion if it were dropped: element, attribute, the values that change nothing.
_NEUTRAL = (
    ("joint", "stiffness", ("0",), "a spring is not simulated"),
    ("joint", "ref", ("0",), "a joint's zero is where the model is drawn"),
    ("joint", "limited", ("auto", "true"), "drop the range instead"),
    ("joint", "springdamper", ("0 0",), "a spring is not simulated"),
    ("body", "gravcomp", ("0",), "gravity compensation is not simulated"),
    ("body", "mocap", ("false",), "a mocap body is not simulated"),
    ("option", "density", ("0",), "a medium is not simulated"),
    ("option", "viscosity", ("0",), "a medium is not simulated"),
    ("flag", "gravity", ("enable",), 'write gravity="0 0 0"'),
    ("compiler", "angle", ("degree", "radian"), "use degree or radian"),
    ("compiler", "inertiafromgeom", ("auto", "false"), "give every body its <inertial>"),
    ("compiler", "inertiagrouprange", (), "give every body its <inertial>"),
    ("compiler", "autolimits", ("true",), "let a range mean a limit"),
    ("compiler", "coordinate", ("local",), "use local coordinates"),
    ("compiler", "balanceinertia", ("false",), "give the inertia that is meant"),
    ("compiler", "settotalmass", ("-1",), "give the masses that are meant"),
    ("compiler", "boundmass", ("0",), "give the masses that are meant"),
    ("compiler", "boundinertia", ("0",), "give the inertias that are meant"),
    ("compiler", "alignfree", ("auto", "false"), "it concerns free joints"),
)


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
    for section in root:
        if section.tag not in (*_KEPT, *_LEFT_OUT):
            raise ModelError(f"{where}: <{section.tag}> is not simulated: the model must do without it")
    out = ET.Element("mujoco", model=root.get("model") or "model")
    compiler = ET.SubElement(out, "compiler")
    for element in root.findall("compiler"):
        _check_neutral(element, dict(element.attrib), f"{where}: <compiler>")
        sequence = element.get("eulerseq", "xyz")
        if len(sequence) != 3 or not set(sequence) <= set("xyz"):
            raise ModelError(
                f"{where}: eulerseq is {sequence!r}: it must be three of x, y, z; capitals, for fixed "
                "axes, are not honoured"
            )
        compiler.attrib.update({k: v for k, v in element.attrib.items() if k in ("angle", "eulerseq")})
    for element in root.findall("option"):
        for part in element.iter():
            _check_neutral(part, dict(part.attrib), f"{where}: <{part.tag}>")
        if "gravity" in element.attrib:
            numbers(element.attrib["gravity"], 3, f"{where}: option gravity")
            ET.SubElement(out, "option", gravity=element.attrib["gravity"])
    world = ET.SubElement(out, "worldbody")
    defaults = Defaults(root, where)
    names: set[tuple[str, str]] = set()
    for element in root.findall("worldbody"):
        _copy_body(element, world, defaults, None, False, f"{where}: the world", names)
    keys = ET.SubElement(out, "keyframe")
    for key in root.iterfind("keyframe/key[@qpos]"):
        numbers(key.attrib["qpos"], None, f"{where}: keyframe qpos")
        ET.SubElement(keys, "key", name=key.get("name", "home"), qpos=key.attrib["qpos"])
    return ET.tostring(out, encoding="unicode")


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


def for_pinocchio(text: str) -> str:
    """Put all bodies of a canonical MJCF under one still body at the origin, and drop the keyframes.

    Pinocchio reads one body of the world and loses its pose if it has no joint: a still one at the origin has
    none to lose. Its name cannot clash: `read` refuses it.
    """
    root = ET.fromstring(text)
    world = root.find("worldbody")
    still = ET.Element("body", name=STILL)
    if world is not None:
        still.extend([element for element in world if element.tag in ("body", "site")])
        world[:] = [still]
    for keyframe in root.findall("keyframe"):
        root.remove(keyframe)
    return ET.tostring(root, encoding="unicode")


def _include(element: ET.Element, where: str, folder: Path | None, seen: set[Path]) -> None:
    """Replace every <include> by its file's content: each file once, relative to the model's folder."""
    position = 0
    while position < len(element):
        child = element[position]
        if child.tag != "include":
            _include(child, where, folder, seen)
            position += 1
            continue
        name = child.get("file")
        if not name or folder is None:
            raise ModelError(f"{where}: cannot include {name!r}: the text must stand by itself")
        path = (folder / name).resolve()
        if path in seen:
            raise ModelError(f"{where}: {name!r} is included twice: a file may be included once")
        seen.add(path)
        try:
            element[position : position + 1] = list(parse(read_text(path), name))
        except ModelError as error:
            raise ModelError(f"{where}: included {name}: {error}") from None


def _copy_body(
    source: ET.Element,
    target: ET.Element,
    defaults: Defaults,
    childclass: str | None,
    moves: bool,
    at: str,
    names: set[tuple[str, str]],
) -> None:
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
            raise ModelError(f"{at} floats on a free joint, which is not simulated: the base must be fixed")
        if child.tag not in _IN_BODY:
            raise ModelError(f"{at}: <{child.tag}> is not simulated: the model must do without it")
        given = defaults.resolve(child, childclass)
        name = f"{child.tag} {given['name']!r}" if "name" in given else f"a {child.tag} without a name"
        here = f"{where}: {name}"
        _check_neutral(child, given, here)
        _check_numbers(child.tag, given, here)
        if child.tag == "geom" and weighs:
            _check_weighing_geom(given, at)
        elif child.tag == "geom" and _is_mesh(given):
            continue
        if child.tag in ("body", "joint"):
            _check_name(child.tag, given, at, here, names)
        copy = ET.SubElement(target, child.tag, {k: given[k] for k in _ATTRIBUTES[child.tag] if k in given})
        if child.tag == "body":
            _copy_body(child, copy, defaults, childclass, moves, here, names)
        elif child.tag == "joint":
            _check_joint(given, here)
        elif child.tag == "inertial":
            _check_inertial(given, at)


def _check_name(tag: str, given: dict[str, str], at: str, here: str, names: set[tuple[str, str]]) -> None:
    name = given.get("name", "")
    if not name or name == STILL:
        raise ModelError(f"{at}: a {tag} has no name: every body and joint needs one")
    if (tag, name) in names:
        raise ModelError(f"{here}: the name is taken: names must differ")
    names.add((tag, name))


def _check_neutral(element: ET.Element, given: dict[str, str], at: str) -> None:
    for tag, key, neutral, cure in _NEUTRAL:
        if tag == element.tag and key in given and given[key] not in neutral:
            try:
                if float(given[key]) in {float(value) for value in neutral}:
                    continue
            except ValueError:
                pass
            raise ModelError(f"{at}: {key} is {given[key]!r}, which is not honoured: {cure}")


def _check_numbers(tag: str, given: dict[str, str], at: str) -> None:
    for key in _ATTRIBUTES[tag]:
        if key in given and key in _COUNTS:
            numbers(given[key], _COUNTS[key], f"{at}: {key}")
    turns = [key for key in _POSE[1:] if key in given]
    if len(turns) > 1:
        raise ModelError(f"{at} is turned by {' and '.join(turns)}: one of them is allowed")
    if tag == "site" and "fromto" in given:
        raise ModelError(f"{at}: fromto is not honoured on a site: give its pos")


def _check_joint(given: dict[str, str], at: str) -> None:
    kind = given.get("type", "hinge")
    if kind not in ("hinge", "slide"):
        raise ModelError(f"{at} is of type {kind!r}, a joint type that is not simulated: it must be hinge or slide")
    if np.linalg.norm(numbers(given.get("axis", "0 0 1"), 3, f"{at}: axis")) < 1e-9:
        raise ModelError(f"{at}: axis is {given['axis']!r}: a moving joint needs a direction")
    low, high = numbers(given.get("range", "0 0"), 2, f"{at}: range")
    if low > high:
        raise ModelError(f"{at}: lower limit {low:g} is above its upper limit {high:g}")
    if numbers(given.get("armature", "0"), 1, f"{at}: armature")[0] < 0.0:
        raise ModelError(f"{at}: armature is {given['armature']}: it must not be negative")


def _check_inertial(given: dict[str, str], at: str) -> None:
    for key, alternatives in (("mass", ("mass",)), ("diaginertia", ("diaginertia", "fullinertia"))):
        if not any(name in given for name in alternatives):
            raise ModelError(f"{at}: <inertial> lacks {key!r}")
    (mass,) = numbers(given["mass"], 1, f"{at}: mass")
    if mass < 0.0:
        raise ModelError(f"{at} has a mass of {mass:g} kg: it must be positive")
    check_tensor(_tensor(given, at), mass, f"{at}: its inertia tensor")


def _tensor(given: dict[str, str], at: str) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    if "fullinertia" in given:
        xx, yy, zz, xy, xz, yz = numbers(given["fullinertia"], 6, f"{at}: fullinertia")
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.array(np.diag(numbers(given["diaginertia"], 3, f"{at}: diaginertia")))


def _is_mesh(given: dict[str, str]) -> bool:
    return "mesh" in given or given.get("type", "sphere") in ("mesh", "hfield", "sdf", "plane")


def _check_weighing_geom(given: dict[str, str], at: str) -> None:
    """A body without <inertial> has the inertia of its geoms: refuse those that engines weigh differently."""
    if _is_mesh(given):
        raise ModelError(f"{at} takes its inertia from a mesh, which is not read: give it an <inertial>")
    if given.get("contype") == "0" and given.get("conaffinity") == "0":
        raise ModelError(f"{at} takes its inertia from a geom without contact: give it an <inertial>")


def iter_names(text: str, tag: str) -> Iterator[str]:
    """Yield the names of a canonical MJCF's bodies, joints or sites, in the order of the text."""
    for element in ET.fromstring(text).iter(tag):
        if "name" in element.attrib:
            yield element.attrib["name"]
