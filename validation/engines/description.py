"""A description without everything that engines read differently and that is no part of the mechanism."""

from xml.etree import ElementTree

import numpy as np

from validation.engines.interface import CannotBuild
from validation.oracle.spatial import Array

_LEFT_OUT = {
    "link": ("visual", "collision"),  # meshes may be absent; MuJoCo and Drake would look for them
    "joint": ("dynamics", "mimic", "safety_controller", "calibration"),  # damping, friction, ties: not in Eq. 8
}
_KEPT = ("link", "joint")


def bare_urdf(text: str) -> str:
    """Return the links with their inertias and the joints with their placements, and nothing else.

    ``mimic`` goes because a joint that has a column moves on its own, ``dynamics`` because drive friction is
    no part of H and C: MuJoCo and Drake would both put it into q̈.
    """
    root = ElementTree.fromstring(text.encode())
    if root.tag != "robot":
        raise CannotBuild(f"the description is a <{root.tag}>, not a URDF <robot>")
    for element in list(root):
        if element.tag not in _KEPT:
            root.remove(element)
            continue
        for child in list(element):
            if child.tag in _LEFT_OUT[element.tag]:
                element.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


def bare_mjcf(text: str) -> tuple[str, dict[str, tuple[str, Array]]]:
    """Return the bodies and what their inertias follow from, and each site's body and place in it (3,) [m]."""
    root, sites = ElementTree.fromstring(text.encode()), {}
    for element in list(root):
        if element.tag not in ("compiler", "default", "asset", "worldbody"):
            root.remove(element)
    for compiler in root.iter("compiler"):  # Drake asks for an inertia of each body; MuJoCo and we know frames
        compiler.attrib.pop("inertiafromgeom", None)
    for joint in root.iter("joint"):
        for key in ("damping", "frictionloss", "stiffness"):  # no part of H and C
            joint.attrib.pop(key, None)
    for body in root.iter("body"):
        for site in body.findall("site"):
            place = np.array([float(value) for value in site.get("pos", "0 0 0").split()])
            sites[site.get("name", "")] = (body.get("name", ""), place)
            body.remove(site)
        for geom in body.findall("geom") if body.find("inertial") is not None else []:
            body.remove(geom)
    root.set("model", root.get("model", "robot"))  # Drake asks for a name
    return ElementTree.tostring(root, encoding="unicode"), sites


def root_link(text: str) -> str:
    """Return the link that is no joint's child."""
    root = ElementTree.fromstring(text.encode())
    children = {child.get("link") for child in root.iterfind("joint/child")}
    (name,) = [link.get("name", "") for link in root.iterfind("link") if link.get("name") not in children]
    return name


def masses(text: str) -> dict[str, float]:
    """Return the mass of each link as the text gives it [kg]."""
    root = ElementTree.fromstring(text.encode())
    out = {}
    for link in root.iterfind("link"):
        mass = link.find("inertial/mass")
        out[link.get("name", "")] = 0.0 if mass is None else float(mass.get("value", "nan"))
    return out
