"""A URDF as numbers, and as the plain text that Pinocchio gets."""

import xml.etree.ElementTree as ET

import numpy as np

from robot_models.mechanism import Array, Bounds, Link, Weight, transform

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
    floating one, whose sliding joints `robot_models.separate` leaves out.
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
