"""What a robot's text says and a run does not act on: one line each, for its report."""

import xml.etree.ElementTree as ET
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray


def notes(
    text: str,
    format: str,
    joints: Collection[str],
    velocity_limit: NDArray[np.float64],
    effort_limit: NDArray[np.float64],
) -> tuple[str, ...]:
    """Return what a reader of a run should know about its robot.

    text, format: the canonical text, and "urdf" or "mjcf"
    joints: those that move
    velocity_limit, effort_limit: (n,), rad/s and N m; infinite where there is none
    """
    root = ET.fromstring(text)
    found = _rough_urdf(root) if format == "urdf" else _rough_mjcf(root)
    tendons = [each.get("name", "") for each in root.iter("fixed")]
    rough = [name for name in (*joints, *tendons) if name in found]
    lines = []
    if rough:
        element = "<dynamics>" if format == "urdf" else "damping and frictionloss"
        lines.append(
            f"what the robot's file says of friction ({element}; {_some(rough)}) does not act: "
            "friction is what the scenario says"
        )
    limits = [w for w, b in (("effort", effort_limit), ("velocity", velocity_limit)) if np.isfinite(b).any()]
    if limits:
        named = " and ".join(limits)
        lines.append(
            f"{named} limits of the robot's file do not act on the motion; the verdict names joints that exceed them"
        )
    return tuple(lines)


def _rough_urdf(root: ET.Element) -> set[str]:
    rough = set()
    for joint in root.findall("joint"):
        dynamics = joint.find("dynamics")
        values = [dynamics.get(key, "0") for key in ("damping", "friction")] if dynamics is not None else []
        if any(float(value) for value in values):
            rough.add(joint.get("name", ""))
    return rough


def _rough_mjcf(root: ET.Element) -> set[str]:
    named = (*root.iter("joint"), *root.iter("fixed"))
    return {each.get("name", "") for each in named if each.get("damping") or each.get("frictionloss")}


def _some(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
