"""The loops of an MJCF: its section <equality>, as loop joints that hold exactly.

`connect` is a point, `weld` a weld, `joint` a gear. MuJoCo holds them by a soft force (solref, solimp); here they hold.
What closes at MuJoCo's reference configuration closes at zero joint angles, which is the same.
"""

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError
from robot_models.loop_joint import MOST_NUMBER, WORLD, LoopJoint
from robot_models.mjcf_mechanism import Units, pose
from robot_models.xml_text import numbers

if TYPE_CHECKING:
    import pinocchio as pin

Array = NDArray[np.float64]

#: What survives of each element that is simulated.
_KEPT = {
    "connect": ("name", "body1", "body2", "anchor", "site1", "site2"),
    "weld": ("name", "body1", "body2", "anchor", "relpose", "site1", "site2"),
    "joint": ("name", "joint1", "joint2", "polycoef"),
}


def copy(root: ET.Element, out: ET.Element, where: str) -> None:
    """Copy what is active in the sections <equality> of an MJCF.

    Raises
    ------
    ModelError
        An element is not simulated, or does not say what it holds.
    """
    target = ET.Element("equality")
    for element in root.iterfind("equality/*"):
        if element.get("active", "true") == "false":
            continue
        if element.tag not in _KEPT:
            raise ModelError(f"{where}: <equality>: <{element.tag}> is not simulated: the model must do without it")
        given = {key: element.attrib[key] for key in _KEPT[element.tag] if key in element.attrib}
        named = "joint1" in given or "body1" in given or {"site1", "site2"} <= set(given)
        if not named or (element.tag == "connect" and "body1" in given and "anchor" not in given):
            raise ModelError(f"{where}: <equality>: a <{element.tag}> does not say what it holds together")
        for key, count in (("anchor", 3), ("relpose", 7)):
            if key in given:
                _check(given[key], count, f"{where}: {element.tag} {key}")
        if "polycoef" in given:
            _check(given["polycoef"], None, f"{where}: joint polycoef")
        ET.SubElement(target, element.tag, given)
    if len(target):
        out.append(target)


def _check(value: str, count: int | None, what: str) -> None:
    """Refuse numbers larger than those of a loop joint, or none."""
    for number in numbers(value, count, what):
        if abs(number) > MOST_NUMBER:
            raise ModelError(f"{what} is {value!r}: it must be numbers, at most {MOST_NUMBER:g}")


def loops(text: str, model: "pin.Model") -> tuple[LoopJoint, ...]:
    """Return the loop joints of a canonical MJCF, of which `model` has been built."""
    import pinocchio as pin

    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(model.nq))

    def place(frame: str) -> tuple[Array, Array]:
        if frame == WORLD:
            return np.eye(3), np.zeros(3)
        found = data.oMf[model.getFrameId(frame)]
        return np.array(found.rotation), np.array(found.translation)

    made = []
    for k, element in enumerate(ET.fromstring(text).iterfind("equality/*")):
        given = element.attrib
        name = given.get("name", f"{element.tag} {k + 1}")
        if element.tag == "joint":
            coefficients = [float(word) for word in given.get("polycoef", "0 1 0 0 0").split()]
            joints = tuple(given[key] for key in ("joint1", "joint2") if key in given)
            polynomial = tuple((coefficients + 5 * [0.0])[:5])
            made.append(LoopJoint(name, "gear", joints=joints, polynomial=polynomial))
            continue
        if "site1" in given:
            made.append(
                LoopJoint(name, "point" if element.tag == "connect" else "weld", (given["site1"], given["site2"]))
            )
            continue
        frames = given["body1"], given.get("body2", WORLD)
        (turn_1, at_1), (turn_2, at_2) = map(place, frames)
        anchor = np.array([float(word) for word in given.get("anchor", "0 0 0").split()])
        if element.tag == "connect":
            other = turn_2.T @ (at_1 + turn_1 @ anchor - at_2)
            made.append(LoopJoint(name, "point", frames, _vectors(anchor, other)))
            continue
        relative = [float(word) for word in given.get("relpose", "0 0 0 0 0 0 0").split()]
        if any(relative[3:]):
            turned = pose({"quat": " ".join(map(repr, relative[3:]))}, Units(ET.Element("mujoco")))[:3, :3]
            moved = np.array(relative[:3])
        else:
            turned, moved = turn_1.T @ turn_2, turn_1.T @ (at_2 - at_1)
        points = _vectors(moved + turned @ anchor, anchor)
        made.append(LoopJoint(name, "weld", frames, points, turn=_vectors(*turned.T)))
    return tuple(made)


def _vectors(*rows: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(x) for x in row) for row in rows)
