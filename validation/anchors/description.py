"""Robots written as URDF from published parameters, in the fields that an engine reads."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from validation.oracle.spatial import Array

LIMIT = 100.0
"""Wide enough that no case comes near it [rad] or [m]; URDF wants a number."""


@dataclass(frozen=True, eq=False)
class Robot:
    """What an engine reads of a robot; the same names as `robot_models.RobotModel`."""

    name: str
    text: str
    joint_names: tuple[str, ...]
    armature: Array
    tip: str
    gravity: Array
    format: str = "urdf"
    locked: Mapping[str, float] = field(default_factory=dict)


def read(name: str) -> dict[str, Any]:
    """Return the data of a reference, ``name``.json beside this file."""
    text = files("validation.anchors").joinpath(f"{name}.json").read_text(encoding="utf-8")
    return json.loads(text)


def robot(
    name: str,
    parts: Sequence[str],
    joint_names: Sequence[str],
    tip: str,
    *,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    armature: Sequence[float] | Array | None = None,
) -> Robot:
    """Join links and joints to a robot; `joint_names` are the moving ones in column order."""
    text = f'<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"
    drives = np.zeros(len(joint_names)) if armature is None else np.array(armature, dtype=float)
    return Robot(name, text, tuple(joint_names), drives, tip, np.array(gravity, dtype=float))


def link(name: str, mass: float = 0.0, centre: Sequence[float] | None = None, moments: Sequence[float] = ()) -> str:
    """Return a link; `centre` (3,) of mass [m]; `moments` (3,) Ixx, Iyy, Izz about it along the link's axes [kg m²]."""
    if not mass:
        return f'<link name="{name}"/>'
    ixx, iyy, izz = (repr(float(value)) for value in moments)
    return (
        f'<link name="{name}"><inertial><origin xyz="{_vector(centre or (0.0, 0.0, 0.0))}"/>'
        f'<mass value="{float(mass)!r}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    *,
    xyz: Sequence[float] = (0.0, 0.0, 0.0),
    rpy: Sequence[float] = (0.0, 0.0, 0.0),
    axis: Sequence[float] = (0.0, 0.0, 1.0),
) -> str:
    """Return a joint of `kind` "revolute", "prismatic" or "fixed"; the child's frame sits at `xyz` [m], `rpy` [rad]."""
    moving = "" if kind == "fixed" else f'<axis xyz="{_vector(axis)}"/>{_LIMITS}'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_vector(xyz)}" rpy="{_vector(rpy)}"/>{moving}</joint>'
    )


def with_triad(tip: str) -> list[str]:
    """Return the links one metre off along the axes of `tip` that `quantities.rotation` looks at, and their joints."""
    parts = []
    for axis, unit in zip("xyz", np.eye(3), strict=True):
        parts += [link(f"{tip}_{axis}"), joint(f"{tip}_to_{axis}", "fixed", tip, f"{tip}_{axis}", xyz=unit.tolist())]
    return parts


_LIMITS = f'<limit lower="{-LIMIT}" upper="{LIMIT}" velocity="{LIMIT}" effort="1000.0"/>'


def _vector(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
