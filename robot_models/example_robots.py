"""The robots of example-robot-data, found through its own table and read as text: no mesh is opened.

Every robot stands on a fixed base here, also those that the table would let float.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robot_models.errors import ModelError
from robot_models.sidecar import Sidecar
from robot_models.xml_text import parse, read_text

# The table of version 5.0.0 gives "ur3" the loader of the UR5.
_RENAMED = {"ur3": "UR3Loader"}

# What these loaders do in Python is not in the file, so the file alone would be another robot.
_MADE_BY_CODE = {
    "human": "its loader turns the base by code: load its human.urdf by path if a lying base will do",
    "talos_legs": "its loader cuts it out of 'talos' by code: load 'talos' and lock the upper body",
}


@dataclass(frozen=True)
class _Known:
    """What the data package does not say about an arm that many people use."""

    tip: str
    home: Mapping[str, float] = field(default_factory=dict)
    lock: Mapping[str, float] = field(default_factory=dict)
    description: str = ""


# The fingers are shut, at the value of the group state "default" of the package's own SRDF rounded to zero: a
# mimicking joint is not simulated, so the second finger has to be locked in any case.
_PANDA = _Known(
    tip="panda_hand_tcp",
    lock={"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0},
    description="Franka Emika Panda with its hand, fingers locked shut: a 7-joint arm. "
    "lock={'panda_finger_joint2': 0.0} leaves the first finger free.",
)


def _ur(name: str) -> _Known:
    # Upper arm up, forearm level, flange facing down: a usual ready posture, away from the singular ones.
    joints = (
        *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"),
        *("wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
    )
    values = (0.0, -1.5707963267948966, 1.5707963267948966, -1.5707963267948966, -1.5707963267948966, 0.0)
    return _Known(tip="tool0", home=dict(zip(joints, values, strict=True)), description=f"Universal Robots {name}")


_UR = (*("ur3", "ur3_gripper", "ur3_limited", "ur5", "ur5_gripper", "ur5_limited"), *("ur10", "ur10_limited"))

_KNOWN = {
    "panda": _PANDA,
    "panda_collision": _PANDA,
    "kinova": _Known(tip="j2s6s200_end_effector", description="Kinova Jaco 2, six joints, fingers fixed"),
    **{name: _ur(name.split("_")[0].upper()) for name in _UR},
}


NEEDS = 'example-robot-data, which is not installed: pip install "closedloop[robots]"'


def _table() -> Any:
    """Return the table of example-robot-data, None if that is not installed."""
    try:
        from example_robot_data import robots_loader  # here: it imports Pinocchio
    except ModuleNotFoundError:
        return None
    return robots_loader


def installed() -> bool:
    """Whether example-robot-data is installed, which is optional."""
    return _table() is not None


def example_names() -> tuple[str, ...]:
    """Return the names in the table of example-robot-data, sorted; none if that is not installed."""
    table = _table()
    return () if table is None else tuple(sorted(table.ROBOTS))


@dataclass(frozen=True)
class Example:
    """A robot of the table: its URDF, and what would stand in a sidecar."""

    text: str
    sidecar: Sidecar
    #: Where rotor inertias and gear ratios stand, if the package says that its SRDF has them.
    rotors: Path | None


def find(name: str) -> Example:
    """Return a robot of the table.

    Raises `ModelError` if the robot has no URDF, is not what its file alone says, or its file is not installed.
    """
    table = _table()
    loader = getattr(table, _RENAMED[name]) if name in _RENAMED else table.ROBOTS[name]
    if name in _MADE_BY_CODE:
        raise ModelError(f"example-robot-data's {name!r} is not its file alone: {_MADE_BY_CODE[name]}")
    if not loader.urdf_filename:
        raise ModelError(
            f"example-robot-data's {name!r} is described in SDF ({loader.sdf_filename}), which is not read: "
            "a URDF or an MJCF is needed"
        )
    relative = Path(loader.path, loader.urdf_subpath, loader.urdf_filename)
    try:
        folder = Path(table.getModelPath(str(relative)))
    except OSError:
        raise ModelError(f"{relative} is not installed: install the package example-robot-data") from None
    text = read_text(folder / relative)
    known = _KNOWN.get(name)
    srdf = folder / loader.path / loader.srdf_subpath / loader.srdf_filename if loader.srdf_filename else None
    home = dict(known.home) if known else {}
    if srdf is not None and loader.ref_posture and not home:
        home = _group_state(srdf, loader.ref_posture)
    held = " (held by its base, which floats in reality)" if loader.free_flyer else ""
    sidecar = Sidecar(
        description=(known.description if known else "") or f"{name} of example-robot-data{held}",
        source=f"example-robot-data {_version()}, {relative.as_posix()}",
        tip=known.tip if known else None,
        home=home,
        lock=dict(known.lock) if known else {},
    )
    return Example(text, sidecar, srdf if loader.has_rotor_parameters else None)


def _group_state(srdf: Path, name: str) -> dict[str, float]:
    """Return the named posture of an SRDF: joint → rad (m); joints of several variables are left out."""
    root = parse(read_text(srdf), srdf.name)
    posture = {}
    for joint in root.iterfind(f"group_state[@name='{name}']/joint"):
        words = joint.get("value", "").split()
        if len(words) == 1:
            posture[joint.get("name", "")] = float(words[0])
    return posture


def _version() -> str:
    # Imported here: 20 ms that a shipped robot need not wait for.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("example-robot-data")
    except PackageNotFoundError:
        return "of unknown version"


def rotor_inertia(srdf: Path, joints: Sequence[str]) -> dict[str, float]:
    """Return rotor inertia × gear ratio² of the joints that an SRDF gives them for, kg m²."""
    root: ET.Element = parse(read_text(srdf), srdf.name)
    found = {}
    for joint in root.iterfind("rotor_params/joint"):
        name = joint.get("name", "")
        if name in joints:
            found[name] = float(joint.attrib["mass"]) * float(joint.attrib["gear_ratio"]) ** 2
    return found
