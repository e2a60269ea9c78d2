"""Friction in the joints as a robot's file has it: `<dynamics damping="" friction="">`, an MJCF's `frictionloss`."""

import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError
from robot_models.model import RobotModel
from robot_models.physics import check_size

# Where a file has damping and friction of a joint.
KEYS = {"urdf": ("damping", "friction"), "mjcf": ("damping", "frictionloss")}
_WHERE = {"urdf": "<dynamics>", "mjcf": "damping and frictionloss"}


def joint_dynamics(model: RobotModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return damping, N m s/rad (N s/m), and friction, N m (N), of each joint, (n,) each; zero if left out.

    Raises `ModelError` if no joint and no tendon has any, or if a number is negative.
    """
    found = _dynamics(model)
    if not (np.any(found) or any(any(each.damping) or each.friction for each in model.tendons)):
        raise ModelError(f"{model.name}: no joint of the robot's file has damping or friction ({_WHERE[model.format]})")
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
    root, keys = ET.fromstring(model.text), KEYS[model.format]
    for joint in root.findall("joint") if model.format == "urdf" else root.iter("joint"):
        dynamics, name = joint.find("dynamics") if model.format == "urdf" else joint, joint.get("name", "")
        if dynamics is None or name not in model.joint_names:
            continue
        j, where = model.joint_names.index(name), f"{model.name}: joint {name}: {_WHERE[model.format]}"
        found[:, j] = [float(dynamics.get(key, "0").split()[0]) for key in keys]
        if not (np.all(np.isfinite(found[:, j])) and np.all(found[:, j] >= 0.0)):
            raise ModelError(f"{where}: damping and friction must be zero or more")
        for key, number in zip(KEYS["urdf"], found[:, j], strict=True):
            check_size(key, number, where)
    return found
