"""The torque limits of an MJCF's joints: what their actuators can give, within what the joint takes.

The torque of an actuator is its force times its gear (the first of six numbers). Its force is held in `forcerange`;
that of a motor is its control, held in `ctrlrange`. Actuators of one joint add up, and `actuatorfrcrange` of the joint
holds their sum. A range counts where its switch (`forcelimited`, …) is not "false". Actuators that act on a site, a
slider or a body limit no joint.
"""

import xml.etree.ElementTree as ET
from math import inf

from robot_models.errors import ModelError
from robot_models.mjcf_defaults import ACTUATORS, Defaults
from robot_models.xml_text import numbers


def torque_ranges(root: ET.Element, defaults: Defaults, where: str) -> dict[str, float]:
    """Return the largest torque of the actuators of each joint that has some, N m (N); infinite where one has no limit.

    Raises
    ------
    ModelError
        A range is not two numbers, the lower first.
    """
    most: dict[str, float] = {}
    for element in root.iterfind("actuator/*"):
        joint = element.get("joint", element.get("jointinparent"))
        if joint is None or element.tag not in ACTUATORS:
            continue
        given = defaults.resolve(element, None)
        at = f"{where}: <{element.tag}> {element.get('name', joint)!r}"
        force = limit_of(given, "forcerange", "forcelimited", at)
        if (given["gaintype"], given["biastype"]) == ("fixed", "none") and given["dyntype"] in _FOLLOWS:
            gain = numbers(given["gainprm"], None, f"{at}: gainprm")[0]
            force = min(force, abs(gain) * limit_of(given, "ctrlrange", "ctrllimited", at) if gain else 0.0)
        gear = abs(numbers(given.get("gear", "1"), None, f"{at}: gear")[0])
        most[joint] = most.get(joint, 0.0) + (gear * force if gear else 0.0)
    return most


# The activation goes to the control, and never beyond.
_FOLLOWS = ("none", "filter", "filterexact")


def limit_of(given: dict[str, str], key: str, switch: str, at: str) -> float:
    """Return the magnitude that a range allows in both directions, infinite where it is none.

    Of a range that allows one direction alone it is the larger bound.
    """
    low, high = numbers(given.get(key, "0 0"), 2, f"{at}: {key}")
    limited = given.get(switch, "auto")
    if limited == "false" or (low == high == 0.0 and limited == "auto"):
        return inf
    if not low < high:
        raise ModelError(f"{at}: {key} is {given.get(key, '0 0')!r}: its upper limit must be above its lower one")
    return min(-low, high) if low < 0.0 < high else max(abs(low), abs(high))


def limit_joint(joint: ET.Element, given: dict[str, str], most: float, at: str) -> None:
    """Write the torque limit of a joint into its `actuatorfrcrange`, the only place where a canonical text has it."""
    limit = min(limit_of(given, "actuatorfrcrange", "actuatorfrclimited", at), most)
    joint.attrib.pop("actuatorfrcrange", None)
    if 0.0 < limit < inf:
        joint.set("actuatorfrcrange", f"{-limit!r} {limit!r}")
