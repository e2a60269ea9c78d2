"""A canonical MJCF as Pinocchio can read it."""

import xml.etree.ElementTree as ET

from robot_models.mjcf import STILL
from robot_models.mjcf_mechanism import TURNS, Units, pose


def for_pinocchio(text: str) -> str:
    """Put all bodies of a canonical MJCF under one still body at the origin, and drop keyframes and idle geoms.

    Pinocchio reads one body of the world and loses its pose if it has no joint: a still one at the origin has
    none to lose. It loses the sites of the world, too, so these are left out. Its name cannot clash: `read` refuses it.
    """
    root = ET.fromstring(text)
    world = root.find("worldbody")
    still = ET.Element("body", name=STILL)
    if world is not None:
        still.extend(world.findall("body"))
        world[:] = [still]
        _drop_idle_geoms(still, False)
        _write_plainly(still, Units(root))
    for compiler in root.findall("compiler"):
        compiler.set("angle", "radian")
    for section in (*root.findall("keyframe"), *root.findall("equality")):
        root.remove(section)
    return ET.tostring(root, encoding="unicode")


def _write_plainly(body: ET.Element, units: Units) -> None:
    """Write every turn as a unit quaternion and every range in rad (m), in place."""
    import pinocchio as pin

    for floating in body.findall("body"):  # a free joint's position is where the body is
        if any(joint.get("type") == "free" for joint in floating.findall("joint")):
            for key in ("pos", *TURNS):
                floating.attrib.pop(key, None)
    for joint in body.iter("joint"):
        for key in ("range", "actuatorfrcrange"):
            if key in joint.attrib and not any(map(float, joint.attrib[key].split())):
                del joint.attrib[key]  # two zeros are no range
        if "range" in joint.attrib and joint.get("type") != "slide":
            low, high = (units.angle(float(word)) for word in joint.attrib["range"].split())
            joint.set("range", f"{low!r} {high!r}")
    for element in body.iter():
        if any(key in element.attrib for key in TURNS):
            turn = pose(element.attrib, units)[:3, :3]
            for key in TURNS:
                element.attrib.pop(key, None)
            x, y, z, w = pin.Quaternion(turn).coeffs().tolist()
            element.set("quat", f"{w!r} {x!r} {y!r} {z!r}")


def _drop_idle_geoms(body: ET.Element, moves: bool) -> None:
    """Drop the geoms that no inertia is taken from: of bodies that never move, and of those with an <inertial>."""
    if not moves or body.find("inertial") is not None:
        for geom in body.findall("geom"):
            body.remove(geom)
    for child in body.findall("body"):
        _drop_idle_geoms(child, moves or child.find("joint") is not None)
