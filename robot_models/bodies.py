"""Free bodies beside a robot: a box, a ball or a cylinder that nothing holds, as a link of the robot's own text.

A robot with them is one mechanism: its text, which a run file keeps, has them.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robot_models.coordinates import PARTS, PLACES
from robot_models.errors import ModelError
from robot_models.load import from_text
from robot_models.mechanism import symmetric
from robot_models.model import RobotModel
from robot_models.physics import check_tensor
from robot_models.urdf import add_inertial, add_joint
from robot_models.xml_text import words

Vector = NDArray[np.float64]

# The colour of a body where it is drawn.
_RGBA = "0.16 0.38 0.68 1"


@dataclass(frozen=True)
class FreeBody:
    """A rigid body on a free joint; its origin is the middle of its shape, and its centre of mass.

    name: of its link and its joint
    shape: "box", "ball" or "cylinder"
    size: m; of a box the lengths of its edges along x, y, z, of a ball its radius, of a cylinder its radius and its
        length along z
    mass: kg
    position: (3,), of the origin in the base frame, m
    quaternion: (4,), w, x, y, z; of any length but zero
    inertia: (6,), tensor about the origin in the body's axes, kg m²: xx, yy, zz, xy, xz, yz; of uniform density if left
        out
    """

    name: str
    shape: Literal["box", "ball", "cylinder"]
    size: tuple[float, ...]
    mass: float
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] | None = None

    def tensor(self) -> Vector:
        """Return the tensor about the origin (3, 3), kg m²."""
        if self.inertia is not None:
            return symmetric(*self.inertia)
        if self.shape == "box":
            squares = np.square(self.size)
            return self.mass / 12.0 * np.diag(squares.sum() - squares)
        if self.shape == "ball":
            return 0.4 * self.mass * self.size[0] ** 2 * np.eye(3)
        radius, length = self.size
        across = (3.0 * radius**2 + length**2) / 12.0
        return self.mass * np.diag([across, across, 0.5 * radius**2])


def only_bodies(bodies: Sequence[FreeBody]) -> RobotModel:
    """Return free bodies and nothing else, as a robot whose tip is the last of them.

    Raises `ModelError` if there are none, or see `with_bodies`.
    """
    if not bodies:
        raise ModelError("there is no body, and no robot: one of them is needed")
    nothing = RobotModel(
        name="bodies", format="urdf", text='<robot name="bodies"><link name="base"/></robot>', joint_names=(),
        armature=np.zeros(0), position_lower=np.zeros(0), position_upper=np.zeros(0), velocity_limit=np.zeros(0),
        effort_limit=np.zeros(0), joint_types=(), tip=bodies[-1].name, frames=("base",), home=np.zeros(0),
    )  # fmt: skip
    return with_bodies(nothing, bodies)


def with_bodies(model: RobotModel, bodies: Sequence[FreeBody]) -> RobotModel:
    """Return a robot beside which there are free bodies; in its home posture they are where they are said to be.

    Raises `ModelError` if a name is that of a link or joint of the robot, or of another body, or if it cannot be
    simulated with them, see `robot_models.load`.
    """
    if not bodies:
        return model
    taken = {*model.frames, *model.joint_names, "world"}
    for body in bodies:
        if body.name in taken:
            raise ModelError(f"body {body.name!r}: {model.name} has a link or a joint of that name: give it another")
        taken.add(body.name)
        if odd := check_tensor(body.tensor(), body.mass, f"body {body.name!r}: its inertia"):
            raise ModelError(f"body {body.name!r}: its inertia {odd}")
    root = ET.fromstring(model.text)
    for body in bodies:
        (_add_to_urdf if model.format == "urdf" else _add_to_mjcf)(root, body)
    n = model.n + 6 * len(bodies)
    found = from_text(
        ET.tostring(root, encoding="unicode"), model.format, name=model.name, armature=np.zeros(n), tip=model.tip,
        home=np.ones(len(model.home) + 7 * len(bodies)), locked=model.locked, gravity=model.gravity,
        description=model.description, source=model.source, drives=model.drives or (),
        undriven=model.drives == (),
        loops=[loop.as_table() for loop in model.loops],
    )  # fmt: skip
    home = dict(zip(model.coordinate_names, model.home.tolist(), strict=True))
    for body in bodies:
        w = np.array(body.quaternion) / np.linalg.norm(body.quaternion)
        pose = zip((*PLACES, *PARTS), (*body.position, *w.tolist()), strict=True)
        home |= {body.name + end: value for end, value in pose}
    armature = dict(zip(model.joint_names, model.armature.tolist(), strict=True))
    return replace(
        found,
        home=np.array([home[name] for name in found.coordinate_names]),
        armature=np.array([armature.get(name, 0.0) for name in found.joint_names]),
    )


def _add_to_urdf(root: ET.Element, body: FreeBody) -> None:
    children = {joint.find("child").get("link") for joint in root.findall("joint")}  # type: ignore[union-attr]
    base = next(link.get("name", "") for link in root.findall("link") if link.get("name") not in children)
    link = ET.SubElement(root, "link", name=body.name)
    add_inertial(link, body.mass, body.tensor())
    for tag in ("visual", "collision"):
        shown = ET.SubElement(link, tag)
        geometry = ET.SubElement(shown, "geometry")
        if body.shape == "box":
            ET.SubElement(geometry, "box", size=words(body.size))
        elif body.shape == "ball":
            ET.SubElement(geometry, "sphere", radius=repr(body.size[0]))
        else:
            ET.SubElement(geometry, "cylinder", radius=repr(body.size[0]), length=repr(body.size[1]))
        if tag == "visual":
            ET.SubElement(ET.SubElement(shown, "material", name=f"{body.name} colour"), "color", rgba=_RGBA)
    add_joint(root, body.name, "floating", base, body.name)


def _add_to_mjcf(root: ET.Element, body: FreeBody) -> None:
    world = root.find("worldbody")
    assert world is not None  # a text that has been read has one
    own = ET.SubElement(world, "body", name=body.name)
    ET.SubElement(own, "joint", name=body.name, type="free")
    T = body.tensor()
    full = (T[0, 0], T[1, 1], T[2, 2], T[0, 1], T[0, 2], T[1, 2])
    ET.SubElement(own, "inertial", pos="0 0 0", mass=repr(body.mass), fullinertia=words(full))
    kind = "sphere" if body.shape == "ball" else body.shape
    halved = {"box": (0.5, 0.5, 0.5), "ball": (1.0,), "cylinder": (1.0, 0.5)}[body.shape]
    ET.SubElement(own, "geom", type=kind, size=words(np.array(body.size) * halved), rgba=_RGBA)
