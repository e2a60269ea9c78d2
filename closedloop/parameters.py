"""From the section of a plug-in to the parameters of its functions: each field by its own name.

class Spring(ControlLaw):
    stiffness: Annotated[NotNegative, gain_in("N/m")] = ...        par.stiffness       a number
    kd: Annotated[Gain, gain_in("N m s/rad")] = ...                par.kd[j]           one for each joint
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from types import NoneType, new_class
from typing import Annotated, Any, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ScenarioError
from closedloop.jit.blocks import Block, Count
from closedloop.sections import Section

Array = NDArray[np.float64]

_N = Count.of("n")


@cache
def parameter_block(section: type[Section]) -> type[Block]:
    """Return the block of a section's fields: numbers, and arrays (n,) of those with one for each joint.

    Text, such as the kind, has no part in it.
    """
    shapes = {name: _shape(field.annotation) for name, field in section.model_fields.items()}
    return _block(section, "Parameters", {name: shape for name, shape in shapes.items() if shape is not None})


@cache
def state_block(member: type) -> type[Block]:
    """Return the block of a member's states: `states` are numbers, `joint_states` arrays (n,)."""
    states, joint_states = getattr(member, "states", ()), getattr(member, "joint_states", ())
    return _block(member, "States", dict.fromkeys(states, ()) | dict.fromkeys(joint_states, (_N,)))


def _block(member: type, suffix: str, shapes: dict[str, tuple[Any, ...]]) -> type[Block]:
    ordered = sorted(shapes.items(), key=lambda part: len(part[1]))  # single numbers come first
    annotations: dict[str, Any] = {name: Annotated[(Array, *shape)] if shape else float for name, shape in ordered}
    body: dict[str, Any] = {
        "__annotations__": annotations,
        "__module__": member.__module__,
        "__doc__": f"{suffix} of a member.",
    }
    body["__qualname__"] = f"{member.__qualname__}.{suffix}"
    return new_class(suffix, (Block,), {"sizes": ("n",)}, lambda space: space.update(body))


def _shape(annotation: Any) -> tuple[Any, ...] | None:
    """Return the shape of a field: () a number, (n,) one for each joint, (3,) a vector; None: it is not of numbers."""
    if get_origin(annotation) is Annotated:
        return _shape(get_args(annotation)[0])
    if annotation in (float, int, bool):
        return ()
    if get_origin(annotation) is tuple:
        entries = get_args(annotation)
        return (_N,) if Ellipsis in entries else (len(entries),)
    shapes = [_shape(choice) for choice in get_args(annotation) if choice is not NoneType]
    if not shapes or any(shape is None for shape in shapes):
        return None
    return max(shapes, key=lambda shape: len(shape or ()))


def pack(section: Section, n: int, where: str, joint_names: Sequence[str] = ()) -> Array:
    """Return the numbers of a section for n joints, as its `parameter_block` has them.

    Parameters
    ----------
    section : Section
        What it leaves out (None) is what its method `resolved` says, if it has one, else NaN.
    n : int
        Number of joints.
    where : str
        The section's name in messages.
    joint_names : sequence of str
        For messages.

    Raises
    ------
    ScenarioError
        If a list has not one entry a joint.
    """
    kind = parameter_block(type(section))
    block = kind(np.zeros(kind.count(n)), n)
    resolved: dict[str, Any] = getattr(section, "resolved", dict)()
    for name, shape in kind.layout.shape.items():
        value = resolved.get(name, getattr(section, name))
        if value is None:
            value = math.nan
        if shape and shape[0].terms != _N.terms:
            getattr(block, name)[:] = value
        elif shape:
            getattr(block, name)[:] = per_joint(f"{where}.{name}", value, n, joint_names)
        else:
            setattr(block, name, value)
    return block.memory


def per_joint(key: str, value: float | tuple[float, ...], n: int, joint_names: Sequence[str] = ()) -> Array:
    """Return one number a joint (n,); `key` names it in messages.

    Raises
    ------
    ScenarioError
        If a list has another length.
    """
    if not isinstance(value, tuple):
        return np.full(n, float(value))
    if len(value) != n:
        names = f", {', '.join(joint_names)}" if joint_names else ""
        raise ScenarioError(f"{key} has {len(value)} entries: the robot has {n} joints{names}")
    return np.array(value)
