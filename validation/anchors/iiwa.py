"""Drake's KUKA iiwa benchmark against MotionGenesis, which derived the equations symbolically.

The torques and accelerations in motion are what the C++ that MotionGenesis generated gives at the states of Drake's own
tests; Drake compares itself with that code at run time and prints no values.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from validation.anchors.problem import Case, ReferenceProblem, Robot, joint, link, read, robot, with_triad
from validation.oracle.spatial import Array

N = 7
TIP = "link7"

KINEMATICS = 1e-14
KINEMATICS_WHY = (
    "a rounding of 45 ε: seven rotations with angles printed to 16 digits, in a chain 1.3 m long (Drake, link by link: "
    "10 ε of the norm)"
)
TORQUE_EPS = 400 * float(np.finfo(float).eps)
TORQUE_WHY = "400 ε of the largest torque that the arm bears under its weight, Drake's own bound for these torques"
WEIGHT_TORQUE = 33.9
"""|Q| at the bent pose at rest [N m]; also what the terms of the torques in motion are summed from."""


def problems() -> tuple[ReferenceProblem, ...]:
    """Return the arm under each gravity that the benchmark uses."""
    data = read("iiwa_motion_genesis")
    return tuple(
        ReferenceProblem(
            f"KUKA iiwa, MotionGenesis, g = {g}",
            data["source"],
            build(data, float(g)),
            TIP,
            (*(_kinematics(data) if g == "0" else ()), *_torques(data, g)),
        )
        for g in data["torques"]
    )


def build(data: Mapping[str, Any], g: float) -> Robot:
    """Write the arm as URDF; data is that of iiwa_motion_genesis.json, g along −z [m/s²]."""
    parts, before = [link("base")], "base"
    for i in range(N):
        name, place = f"link{i + 1}", data["joint_origin"][i]
        parts += [
            link(name, data["mass"][i], data["com"][i], data["I_com"][i]),
            joint(f"joint{i + 1}", "revolute", before, name, xyz=place["xyz"], rpy=place["rpy"]),
        ]
        before = name
    names = [f"joint{i + 1}" for i in range(N)]
    return robot("iiwa_motion_genesis", [*parts, *with_triad(TIP)], names, TIP, gravity=(0.0, 0.0, -g))


def _kinematics(data: Mapping[str, Any]) -> tuple[Case, ...]:
    """Return place and motion of the last link, straight up and bent."""
    straight, bent = np.zeros(N), _bent()

    def case(name: str, quantity: str, expected: Any, **inputs: Array) -> Case:
        return Case(name, quantity, inputs, np.array(expected, dtype=float), np.array(KINEMATICS), KINEMATICS_WHY)

    known, moving = data["kinematics"], data["motion"]
    v = np.array(moving["v"])
    cases = [
        case("position, straight up", "position", known["straight"]["position"], q=straight),
        case("rotation, straight up", "rotation", known["straight"]["rotation"], q=straight),
        case("position, bent", "position", known["bent"]["position"], q=bent),
        case("rotation, bent", "rotation", known["bent"]["rotation"], q=bent),
        case("velocity", "tip_velocity", moving["velocity"], q=bent, v=v),
        case("angular velocity", "angular_velocity", moving["angular_velocity"], q=bent, v=v),
        case("drift", "drift", moving["coasting"]["acceleration"], q=bent, v=v),
    ]
    for state in ("coasting", "accelerating"):
        a = np.array(moving[state]["a"])
        for quantity, key in (("tip_acceleration", "acceleration"), ("angular_acceleration", "angular_acceleration")):
            name = f"{key.replace('_', ' ')}, {state}"
            cases.append(case(name, quantity, moving[state][key], q=bent, v=v, a=a))
    return tuple(cases)


def _torques(data: Mapping[str, Any], g: str) -> tuple[Case, ...]:
    """Return the joint torques that the benchmark knows under gravity `g`, a key of the file."""
    return tuple(
        Case(
            f"torque, {entry['state']}",
            "inverse_dynamics",
            {"q": _bent() if entry["pose"] == "bent" else np.zeros(N), "v": entry["v"], "a": entry["a"]},
            np.array(entry["torque"], dtype=float),
            np.array(TORQUE_EPS * WEIGHT_TORQUE),
            TORQUE_WHY,
        )
        for entry in data["torques"][g]
    )


def _bent() -> Array:
    """Return the pose of 60° and 30° in turn."""
    return np.array([np.pi / 3 if i % 2 == 0 else np.pi / 6 for i in range(N)])
