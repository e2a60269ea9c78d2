"""What an MJCF's attributes may hold: numbers that are numbers, words that are known, and nothing that is dropped."""

import xml.etree.ElementTree as ET

import numpy as np

from robot_models.errors import ModelError
from robot_models.mechanism import Link
from robot_models.mjcf_mechanism import LEAST_LENGTH, TURNS, Units, pose, sizes, tensor_of
from robot_models.physics import LEAST_INERTIA, check_tensor
from robot_models.xml_text import angles, numbers

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
    ("compiler", "alignfree", ("auto", "false"), "write the body's frame along its principal axes"),
    ("freejoint", "align", ("auto", "false"), "write the body's frame along its principal axes"),
)


def check_neutral(element: ET.Element, given: dict[str, str], at: str) -> None:
    """Refuse what would change the motion and is not honoured."""
    for tag, key, neutral, cure in _NEUTRAL:
        if tag == element.tag and key in given and given[key] not in neutral:
            try:
                if float(given[key]) in {float(value) for value in neutral}:
                    continue
            except ValueError:
                pass
            raise ModelError(f"{at}: {key} is {given[key]!r}, which is not honoured: {cure}")


def check_turns(tag: str, given: dict[str, str], units: Units, at: str) -> None:
    """Refuse a turn that turns nothing, or more than one."""
    turns = [key for key in TURNS if key in given]
    if len(turns) > 1:
        raise ModelError(f"{at} is turned by {' and '.join(turns)}: one of them is allowed")
    for key, words in (("euler", given.get("euler", "0")), ("axisangle", given.get("axisangle", "0").split()[-1])):
        angles(words, len(words.split()), f"{at}: {key}")
    try:
        pose(given, units)
    except ModelError as error:
        raise ModelError(f"{at}: {error}") from None
    if tag == "site" and "fromto" in given:
        raise ModelError(f"{at}: fromto is not honoured on a site: give its pos")


def check_joint(given: dict[str, str], at: str) -> None:
    """Refuse a joint that is not simulated, or says what no joint can be."""
    kind = given.get("type", "hinge")
    if kind not in ("hinge", "slide", "ball", "free"):
        raise ModelError(
            f"{at} is of type {kind!r}, a joint type that is not simulated: it must be hinge, slide, ball or free"
        )
    if kind in ("ball", "free"):
        for key in ("range", "actuatorfrcrange"):
            if any(numbers(given.get(key, "0 0"), 2, f"{at}: {key}")):
                raise ModelError(f"{at}: {key} is {given[key]!r}, which is not simulated on a {kind} joint: drop it")
    if not LEAST_LENGTH < np.linalg.norm(numbers(given.get("axis", "0 0 1"), 3, f"{at}: axis")) < np.inf:
        raise ModelError(f"{at}: axis is {given['axis']!r}: a moving joint needs a direction")
    for key in ("range", "actuatorfrcrange"):
        low, high = numbers(given.get(key, "0 0"), 2, f"{at}: {key}")
        if low > high:
            raise ModelError(f"{at}: {key}: lower limit {low:g} is above its upper limit {high:g}")
        switch = {"range": "limited", "actuatorfrcrange": "actuatorfrclimited"}[key]
        if low == high and (low != 0.0 or given.get(switch) == "true"):
            raise ModelError(f"{at}: {key} is {given.get(key, '0 0')!r}: its upper limit must be above its lower one")
    for key in ("armature", "frictionloss"):
        if numbers(given.get(key, "0"), 1, f"{at}: {key}")[0] < 0.0:
            raise ModelError(f"{at}: {key} is {given[key]}: it must not be negative")


def check_inertial(given: dict[str, str], at: str) -> None:
    """Refuse an inertial that lacks something, says something twice, or that no body can have."""
    for key, alternatives in (("pos", ("pos",)), ("mass", ("mass",)), ("diaginertia", ("diaginertia", "fullinertia"))):
        if not any(name in given for name in alternatives):
            raise ModelError(f"{at}: <inertial> lacks {key!r}")
    if "fullinertia" in given and (more := [key for key in ("diaginertia", *TURNS) if key in given]):
        raise ModelError(f"{at}: <inertial> has fullinertia and {more[0]}: one of them is allowed")
    (mass,) = numbers(given["mass"], 1, f"{at}: mass")
    if mass < 0.0:
        raise ModelError(f"{at} has a mass of {mass:g} kg: it must be positive")
    check_tensor(tensor_of(given), mass, f"{at}: its inertia tensor", rounding=0.0)


def is_mesh(given: dict[str, str]) -> bool:
    """Tell whether a geom's shape stands in another file, or has no end."""
    return "mesh" in given or given.get("type", "sphere") in ("mesh", "hfield", "sdf", "plane")


def check_weighing_geom(given: dict[str, str], at: str) -> None:
    """A body without <inertial> has the inertia of its geoms: refuse those that engines weigh differently."""
    if is_mesh(given):
        raise ModelError(f"{at} takes its inertia from a mesh, which is not read: give it an <inertial>")
    if given.get("contype") == "0" and given.get("conaffinity") == "0":
        raise ModelError(f"{at} takes its inertia from a geom without contact: give it an <inertial>")
    if given.get("shellinertia", "false") != "false":
        raise ModelError(f"{at} takes its inertia from the shell of a geom: give it an <inertial>")


def check_shape(tag: str, given: dict[str, str], here: str) -> None:
    """Refuse a geom or site without a size, and a negative mass."""
    for key in ("mass", "density"):
        if key in given and float(given[key]) < 0.0:
            raise ModelError(f"{here}: {key} is {given[key]}: it must not be negative")
    kind = given.get("type", "sphere")
    if "fromto" in given and kind not in ("capsule", "cylinder", "box", "ellipsoid"):
        raise ModelError(f"{here}: fromto is for capsule, cylinder, box and ellipsoid, not for {kind}")
    least = [float(word) for word in given.get("size", "").split()]
    if kind == "plane" and "mesh" not in given:  # two half lengths, 0 for no end, and the spacing of its grid
        if len(least) < 3 or min(least[:2]) < 0.0 or least[2] <= 0.0:
            raise ModelError(f"{here}: size is {given.get('size', '')!r}: a plane needs two numbers and a positive one")
    elif not is_mesh(given):
        wanted, size = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3), sizes(given)
        # A site has a size of its own where it gives none.
        if (len(size) < wanted and tag == "geom") or min(size, default=1.0) <= 0.0:
            raise ModelError(f"{here}: size is {given.get('size', '')!r}: a {kind} needs {wanted} positive numbers")


def check_weighing_bodies(links: list[Link], where: str) -> None:
    """Refuse a body with a joint that weighs nothing, neither by itself nor by what is welded to it."""
    weighs = [False] * len(links)
    for at in range(len(links) - 1, -1, -1):  # children before their parents
        weight = links[at].weight
        finite = np.isfinite(weight.tensor).all()
        heavy = weight.mass > LEAST_INERTIA and finite and np.linalg.eigvalsh(weight.tensor).min() > LEAST_INERTIA
        weighs[at] = weighs[at] or bool(heavy) or not finite  # what is not finite is refused for that
        if links[at].kind != "fixed" and not weighs[at]:
            raise ModelError(
                f"{where}: body {links[at].name!r} moves and has no mass or no inertia, nor has what is welded to it: "
                "give it an <inertial>"
            )
        if links[at].kind == "fixed" and links[at].parent >= 0:
            weighs[links[at].parent] = weighs[links[at].parent] or weighs[at]
