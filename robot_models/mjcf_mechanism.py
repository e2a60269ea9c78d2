"""A canonical MJCF as numbers: bodies, sites, joints, and what bodies weigh, as MuJoCo's documentation defines it."""

import xml.etree.ElementTree as ET
from math import pi, radians

import numpy as np

from robot_models.errors import ModelError
from robot_models.mechanism import Array, Bounds, Link, Weight, lumped, transform, turned

#: A direction or a turn shorter than this is none, as for MuJoCo.
LEAST_LENGTH = 1e-10

#: The attributes that turn an element; one of them at most.
TURNS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")

#: kg/m³ of a geom that does not say.
_DENSITY = 1000.0


class Units:
    """The units of angles in a canonical MJCF, and the axes of its Euler angles."""

    def __init__(self, root: ET.Element):
        compiler = root.find("compiler")
        given = compiler.attrib if compiler is not None else {}
        self.degrees = given.get("angle", "degree") == "degree"
        self.sequence = given.get("eulerseq", "xyz")

    def angle(self, value: float) -> float:
        """Return an angle of the text in rad."""
        return radians(value) if self.degrees else value


def mechanism(text: str, still: str) -> list[Link]:
    """Return the bodies and sites of a canonical MJCF, parents before their children.

    Parameters
    ----------
    text
        What `mjcf.read` returned.
    still
        The name of the root, which stands for the world.
    """
    root = ET.fromstring(text)
    units = Units(root)
    links = [Link(still, -1)]
    for world in root.findall("worldbody"):
        _add(world, 0, False, units, links)
    return links


def _add(element: ET.Element, at: int, moves: bool, units: Units, links: list[Link]) -> None:
    for site in element.findall("site"):
        if "name" in site.attrib:
            links.append(Link(site.attrib["name"], at, offset=pose(site.attrib, units), site=True))
    for body in element.findall("body"):
        joint = body.find("joint")
        free = moves or joint is not None
        links.append(_body(body, joint, at, free, units))
        _add(body, len(links) - 1, free, units, links)


def _body(body: ET.Element, joint: ET.Element | None, parent: int, moves: bool, units: Units) -> Link:
    name, place, weight = body.attrib["name"], pose(body.attrib, units), _weight(body, moves, units)
    if joint is None:
        return Link(name, parent, placement=place, weight=weight)
    armature = float(joint.get("armature", "0"))
    if joint.get("type") == "free":  # its position is where the body is, not a step from there
        return Link(name, parent, joint.attrib["name"], "free", weight=weight, armature=armature)
    axis = _numbers(joint.get("axis", "0 0 1"))
    centre = transform(np.eye(3), _numbers(joint.get("pos", "0 0 0")))
    kind = {"slide": "prismatic", "ball": "ball"}.get(joint.get("type", "hinge"), "revolute")
    return Link(
        name,
        parent,
        joint.attrib["name"],
        kind,
        place @ centre,
        axis / np.linalg.norm(axis),
        transform(np.eye(3), -centre[:3, 3]),
        weight,
        _bounds(joint, kind, units),
        armature,
    )


def _bounds(joint: ET.Element, kind: str, units: Units) -> Bounds:
    low, high = _numbers(joint.get("range", "0 0"))
    if low < high:
        lower, upper = (low, high) if kind == "prismatic" else (units.angle(low), units.angle(high))
    else:
        lower, upper = -np.inf, np.inf
    least, most = _numbers(joint.get("actuatorfrcrange", "0 0"))
    return Bounds(float(lower), float(upper), effort=float(most) if least < most else np.inf)


def start_poses(text: str) -> dict[str, Array]:
    """Return where the bodies on free joints of a canonical MJCF stand as they are written, (4, 4), by their joints."""
    root = ET.fromstring(text)
    units = Units(root)
    bodies = ((body, body.find("joint")) for body in root.iterfind("worldbody/body"))
    return {
        joint.attrib["name"]: pose(body.attrib, units)
        for body, joint in bodies
        if joint is not None and joint.get("type") == "free"
    }


def pose(given: dict[str, str], units: Units) -> Array:
    """Return the pose (4, 4) that attributes of an element describe.

    Raises
    ------
    ModelError
        A turn that is none: a direction of length zero, or two that are parallel. The text has no name in it.
    """
    return transform(_turn(given, units), _numbers(given.get("pos", "0 0 0")))


def _turn(given: dict[str, str], units: Units) -> Array:
    if "quat" in given:
        w, x, y, z = _unit(given, "quat", _numbers(given["quat"]))
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
    if "axisangle" in given:
        *axis, angle = _numbers(given["axisangle"])
        return turned(_unit(given, "axisangle", np.array(axis)), units.angle(angle))
    if "euler" in given:
        rotation: Array = np.eye(3)
        for letter, angle in zip(units.sequence, _numbers(given["euler"]), strict=True):
            rotation = rotation @ turned(np.eye(3)["xyz".index(letter)], units.angle(angle))
        return rotation
    if "xyaxes" in given:
        both = _numbers(given["xyaxes"])
        x = _unit(given, "xyaxes", both[:3])
        y = _unit(given, "xyaxes", both[3:] - x * (x @ both[3:]))
        return np.column_stack([x, y, np.cross(x, y)])
    if "zaxis" in given:
        return _towards(_unit(given, "zaxis", _numbers(given["zaxis"])))
    return np.eye(3)


def _towards(z: Array) -> Array:
    """Return the smallest rotation that takes the z axis to a unit vector; about x where that is −z."""
    axis = np.array([-z[1], z[0], 0.0])
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > LEAST_LENGTH else np.array([1.0, 0.0, 0.0])
    return turned(axis, float(np.arctan2(sine, z[2])))


def _unit(given: dict[str, str], key: str, vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    if not LEAST_LENGTH < length < np.inf:
        raise ModelError(f"{key} is {given[key]!r}: must have a length above {LEAST_LENGTH:g}")
    return vector / length


def _weight(body: ET.Element, moves: bool, units: Units) -> Weight:
    inertial = body.find("inertial")
    if inertial is not None:
        place = pose(inertial.attrib, units)
        own = Weight(float(inertial.attrib["mass"]), tensor=tensor_of(inertial.attrib))
        return lumped([own], [place])
    if not moves:  # what never moves need not weigh
        return Weight()
    geoms = [_geom(geom.attrib, units) for geom in body.findall("geom")]
    return lumped([weight for weight, _ in geoms], [place for _, place in geoms])


def tensor_of(given: dict[str, str]) -> Array:
    """Return the tensor (3, 3) of an <inertial> in the axes that it names, kg m²."""
    if "fullinertia" in given:
        xx, yy, zz, xy, xz, yz = _numbers(given["fullinertia"])
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.diag(_numbers(given["diaginertia"]))


def sizes(given: dict[str, str]) -> list[float]:
    """Return the size of a geom as its type counts it: radii and half lengths, m."""
    size = [float(word) for word in given.get("size", "").split()]
    kind = given.get("type", "sphere")
    if "fromto" in given:
        ends = _numbers(given["fromto"])
        half = 0.5 * float(np.linalg.norm(ends[:3] - ends[3:]))
        return [*size[:1], half] if kind in ("capsule", "cylinder") else [*size[:1], *size[:1], half]
    return size[: {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)]


def geom_pose(given: dict[str, str], units: Units) -> Array:
    """Return the pose (4, 4) of a geom in its body."""
    if "fromto" not in given:
        return pose(given, units)
    ends = _numbers(given["fromto"])
    return transform(_towards(_unit(given, "fromto", ends[:3] - ends[3:])), 0.5 * (ends[:3] + ends[3:]))


def _geom(given: dict[str, str], units: Units) -> tuple[Weight, Array]:
    """Return what a solid geom weighs about its own centre, and its pose."""
    place = geom_pose(given, units)
    volume, moments = _solid(given.get("type", "sphere"), sizes(given))
    mass = float(given["mass"]) if "mass" in given else volume * float(given.get("density", _DENSITY))
    return Weight(mass, tensor=np.diag(mass * moments)), place


def _solid(kind: str, size: list[float]) -> tuple[float, Array]:
    """Return the volume, m³, and the principal moments for 1 kg, m², of a homogeneous solid."""
    if kind in ("capsule", "cylinder"):
        r, h = size  # half length of the cylindrical part
        tube, caps = 2.0 * pi * r**2 * h, 4.0 / 3.0 * pi * r**3 * (kind == "capsule")
        share, rest = tube / (tube + caps), caps / (tube + caps)
        across = share * (r**2 / 4.0 + h**2 / 3.0) + rest * (0.4 * r**2 + h**2 + 0.75 * r * h)
        along = share * r**2 / 2.0 + rest * 0.4 * r**2
        return tube + caps, np.array([across, across, along])
    a, b, c = np.array(size * 3 if kind == "sphere" else size)
    part, volume = (1.0 / 3.0, 8.0 * a * b * c) if kind == "box" else (0.2, 4.0 / 3.0 * pi * a * b * c)
    return float(volume), part * np.array([b * b + c * c, a * a + c * c, a * a + b * b])


def _numbers(text: str) -> Array:
    return np.array([float(word) for word in text.split()])
