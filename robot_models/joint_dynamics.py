"""Friction in the joints as a URDF has it: `<dynamics damping="" friction="">`."""

import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError
from robot_models.model import RobotModel
from robot_models.physics import check_size

KEYS = ("damping", "friction")


def joint_dynamics(model: RobotModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return damping, N m s/rad (N s/m), and friction, N m (N), of each joint of a URDF, (n,) each; zero if left out.

    Raises
    ------
    ModelError
        If the robot is no URDF, if no joint has any, or if a number is negative.
    """
    if model.format != "urdf":
        raise ModelError(f"{model.name}: friction of the robot's file acts from a URDF's <dynamics> only; this is MJCF")
    found = _dynamics(model)
    if not np.any(found):
        raise ModelError(f"{model.name}: no joint of the robot's file has damping or friction (<dynamics>)")
    return found[0], found[1]


def loop_dynamics(model: RobotModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the same of the coordinates of loop joints alone, zero of all other joints."""
    if not model.loop_coordinates:
        return np.zeros(model.n), np.zeros(model.n)
    found = _dynamics(model) * [name in model.loop_coordinates for name in model.joint_names]
    return found[0], found[1]


def _dynamics(model: RobotModel) -> NDArray[np.float64]:
    """Return damping and friction of each joint, (2, n)."""
    found = np.zeros((2, model.n))
    for joint in ET.fromstring(model.text).findall("joint"):
        dynamics, name = joint.find("dynamics"), joint.get("name", "")
        if dynamics is None or name not in model.joint_names:
            continue
        j = model.joint_names.index(name)
        found[:, j] = [float(dynamics.get(key, "0")) for key in KEYS]
        if not (np.all(np.isfinite(found[:, j])) and np.all(found[:, j] >= 0.0)):
            raise ModelError(f"{model.name}: joint {name}: <dynamics>: damping and friction must be zero or more")
        for key, number in zip(KEYS, found[:, j], strict=True):
            check_size(key, number, f"{model.name}: joint {name}: <dynamics>")
    return found
