"""The URDF that a client gets: the arm of the scenario, with the names that libfranka looks for.

libfranka builds its own model of it. It needs seven joints joint1 ... joint7, a link link8 (the flange), and an element
with limits of the speed that depend on the position, which a URDF of another source does not have: those here leave the
joint's own limit as it is.
"""

from __future__ import annotations

import math
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot

JOINTS = 7
# What stands for a limit that there is none of, and a deceleration, rad/s², that makes the limit of the speed that of
# the joint up to its end.
_NO_LIMIT, _AT_ONCE = 1e3, 1e9


def describe(robot: Robot, flange: str) -> str:
    """Return the URDF of an arm of seven joints; its masses are those of the links and of all that is fixed to them.

    Parameters
    ----------
    robot : Robot
        The arm.
    flange : str
        The frame that is link8.
    """
    model, limits = robot.model.pinocchio_model(), robot.model
    root = ET.Element("robot", name=f"closedloop_{limits.name}")
    ET.SubElement(root, "link", name="link0")
    axes = robot.frame_jacobian(np.zeros(JOINTS))[3:]
    turned = np.eye(3)
    for j in range(JOINTS):
        place, body = model.jointPlacements[j + 1], model.inertias[j + 1]
        turned = turned @ place.rotation
        link = ET.SubElement(root, "link", name=f"link{j + 1}")
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_text(body.lever), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(float(body.mass)))
        tensor = np.array(body.inertia)
        places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ET.SubElement(inertial, "inertia", {name: repr(float(tensor[at])) for name, at in places.items()})
        joint = _joint(root, j + 1, "revolute", place.rotation, place.translation)
        ET.SubElement(joint, "axis", xyz=_text(turned.T @ axes[:, j]))
        ET.SubElement(
            joint, "limit", lower=_limit(limits.position_lower[j]), upper=_limit(limits.position_upper[j]),
            velocity=_limit(limits.velocity_limit[j]), effort=_limit(limits.effort_limit[j]),
        )  # fmt: skip
        ET.SubElement(joint, "position_based_velocity_limits", velocity_offset="0", deceleration_limit=repr(_AT_ONCE))
    ET.SubElement(root, "link", name="link8")
    place = model.frames[model.getFrameId(flange)].placement
    _joint(root, JOINTS + 1, "fixed", place.rotation, place.translation)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode")


def _joint(root: ET.Element, number: int, kind: str, rotation: Array, translation: Array) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=f"joint{number}", type=kind)
    ET.SubElement(joint, "parent", link=f"link{number - 1}")
    ET.SubElement(joint, "child", link=f"link{number}")
    angles = Rotation.from_matrix(np.array(rotation)).as_euler("xyz")
    ET.SubElement(joint, "origin", xyz=_text(translation), rpy=_text(angles))
    return joint


def _text(numbers: Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _limit(value: float) -> str:
    return repr(float(value) if math.isfinite(value) else math.copysign(_NO_LIMIT, value))
