"""Fixed tendons: a length that is a linear combination of joint positions, with what acts along it.

    L = Σ cᵢ qᵢ            rad, or m: as its coefficients have it

Along L acts a spring, with k and k' and k'' for the coefficients of its force, between two rest lengths, a damper, dry
friction, and hard stops at its range. Each force f of them is the torque c f on the joints.

    spring     f = −(k x + k' x² + k'' x³)         x what L is beyond the nearer rest length; none between them
    damper     f = −(b + b' |L̇| + b'' L̇²) L̇
    friction   |f| ≤ f_c, against L̇

The spring of a joint is a tendon of that joint alone, with c = 1, and so is what b' and b'' of its damper add to the
viscous friction that every joint may have. All of it is as MuJoCo 3.17 has it.

Below: friction in the joints as a robot's file has it, `<dynamics damping="" friction="">`, an MJCF's `frictionloss`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError
from robot_models.physics import check_size

if TYPE_CHECKING:
    from robot_models.model import RobotModel

Pair = tuple[float, float]
Three = tuple[float, float, float]

NONE = (-inf, inf)
#: What the rows of `springs` begin with: k, k', k'' and the two rest lengths; the coefficients follow.
SPRING = 5
#: What the rows of `rough_tendons` begin with: b, b', b'', f_c and the two stops; the coefficients follow.
DAMPING, FRICTION, STOPS, ROUGH = 0, 3, 4, 6


@dataclass(frozen=True)
class Tendon:
    """One tendon; see the module. Units follow from those of its length, rad or m.

    name: its own, or that of a joint
    coefficients: c by the name of each joint that moves
    stiffness, damping: (3,), k, k', k'' and b, b', b''; zeros if there is none
    rest: (2,), the shorter and the longer rest length, less what joints that are held add to L
    friction: f_c
    limits: (2,), the hard stops of L, likewise less what is held; infinite where there is none
    """

    name: str
    coefficients: Mapping[str, float]
    stiffness: Three = (0.0, 0.0, 0.0)
    rest: Pair = (0.0, 0.0)
    damping: Three = (0.0, 0.0, 0.0)
    friction: float = 0.0
    limits: Pair = NONE


def tendons(text: str, joints: Sequence[str], locked: Mapping[str, float]) -> tuple[Tendon, ...]:
    """Return the tendons, springs of joints among them, that the plain text of an MJCF has.

    text: from `robot_models.mjcf.read`
    joints: names of the joints that move
    locked: those that are held, and where, rad (m)
    """
    root, found = ET.fromstring(text), []
    for joint in root.iterfind("worldbody//joint"):
        name = joint.attrib["name"]
        stiffness, (_, *more) = _three(joint, "stiffness"), _three(joint, "damping")
        if name in joints and (any(stiffness) or any(more)):
            rest = float(joint.get("springref", "0"))
            found.append(Tendon(name, {name: 1.0}, stiffness, (rest, rest), (0.0, more[0], more[1])))
    for element in root.iterfind("tendon/fixed"):
        parts = {part.attrib["joint"]: float(part.attrib["coef"]) for part in element.iterfind("joint")}
        held = sum(coefficient * locked[joint] for joint, coefficient in parts.items() if joint in locked)
        free = {joint: coefficient for joint, coefficient in parts.items() if joint in joints and coefficient}
        if free and len(element.attrib) > 1:  # one that is only pulled has nothing but a name
            spring = _three(element, "stiffness"), _pair(element, "springlength", (0.0, 0.0), held)
            rough = _three(element, "damping"), float(element.get("frictionloss", "0"))
            found.append(Tendon(element.attrib["name"], free, *spring, *rough, _pair(element, "range", NONE, held)))
    return tuple(found)


def pulls(text: str, joints: Sequence[str]) -> tuple[dict[str, float], ...]:
    """Return what each drive in the plain text of an MJCF pulls: the torque of each of the `joints` for a force of one.

    The text has them where one of them pulls several joints.
    """
    root, found = ET.fromstring(text), []
    parts = {
        element.attrib["name"]: [
            (part.attrib["joint"], float(part.attrib["coef"])) for part in element.iterfind("joint")
        ]
        for element in root.iterfind("tendon/fixed")
    }
    for motor in root.iterfind("actuator/motor"):
        pull: dict[str, float] = {}
        for joint, coefficient in (
            parts[motor.attrib["tendon"]] if "tendon" in motor.attrib else [(motor.attrib["joint"], 1.0)]
        ):
            pull[joint] = pull.get(joint, 0.0) + float(motor.attrib["gear"].split()[0]) * coefficient
        found.append({joint: ratio for joint, ratio in pull.items() if ratio and joint in joints})
    return tuple(pull for pull in found if pull)


def _three(element: ET.Element, key: str) -> Three:
    first, second, third = [float(word) for word in element.get(key, "0 0 0").split()]
    return first, second, third


def _pair(element: ET.Element, key: str, default: Pair, held: float) -> Pair:
    low, high = [float(word) for word in element.get(key, "").split()] or default
    return low - held, high - held


def springs(found: Sequence[Tendon], joints: Sequence[str]) -> NDArray[np.float64]:
    """Return a row for each tendon with a spring, (m, SPRING + n): k, k', k'', both rest lengths, coefficients."""
    rows = [
        [*each.stiffness, *each.rest, *(each.coefficients.get(joint, 0.0) for joint in joints)]
        for each in found
        if any(each.stiffness)
    ]
    return np.array(rows).reshape(len(rows), SPRING + len(joints))


def spring_torque(rows: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gradient of the energy of `springs` at joint positions q (n,): (n,), N m (N), as it stands in C."""
    k, k1, k2, short, long = rows[:, :SPRING].T
    length = rows[:, SPRING:] @ q
    x = length - np.minimum(np.maximum(length, short), long)
    torque: NDArray[np.float64] = (x * (k + x * (k1 + x * k2))) @ rows[:, SPRING:]
    return torque


def rough_tendons(found: Sequence[Tendon], joints: Sequence[str], friction: bool, stops: bool) -> NDArray[np.float64]:
    """Return a row for each tendon that rubs or has stops, (m, ROUGH + n): b, b', b'', f_c, both stops, coefficients.

    Without `friction` dampers and friction are zero, without `stops` the stops infinite, and so are all of those that
    have none.
    """
    rows = []
    for each in found:
        damping, level = (each.damping, each.friction) if friction else ((0.0, 0.0, 0.0), 0.0)
        limits = each.limits if stops else NONE
        if any(damping) or level or np.isfinite(limits).any():
            rows.append([*damping, level, *limits, *(each.coefficients.get(joint, 0.0) for joint in joints)])
    return np.array(rows).reshape(len(rows), ROUGH + len(joints))


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
