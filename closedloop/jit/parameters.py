"""From the section of a plug-in to the parameters of its functions: each field by its own name.

class Spring(ControlLaw):
    stiffness: Annotated[NotNegative, gain_in("N/m")] = ...        par.stiffness       a number
    kd: Annotated[Gain, gain_in("N m s/rad")] = ...                par.kd[j]           one for each joint
"""

import math
from collections.abc import Sequence
from types import NoneType, new_class
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import Section
from closedloop.jit.blocks import Block, Count
from robot_models.cached import cached

_N = Count.of("n")
# Annotation of a key whose parameter is the list that `resolved` makes of it, such as the formula of a surface.
AS_RESOLVED = "as resolved"


class Named(NamedTuple):
    """Annotation of a key whose parameter has another name, under which a function has it of two sections."""

    name: str


@cached
def parameter_block(section: type[Section]) -> type[Block]:
    """Return the block of a section's fields: numbers, and arrays (n,) of those with one for each joint.

    Text, such as the kind, has no part in it, unless it is `AS_RESOLVED`.
    """
    shapes = {
        name: (_N,)
        if AS_RESOLVED in section.model_fields[key].metadata
        else _shape(section.model_fields[key].annotation)
        for name, key in _keys(section).items()
    }
    return _block(section, "Parameters", {name: shape for name, shape in shapes.items() if shape is not None})


@cached
def one_joint_block(section: type[Section]) -> type[Block]:
    """Return the block of what a section says of one joint: what has one entry for each joint is a number."""
    shapes = parameter_block(section).layout.shape
    own = {name: () if _is_per_joint(shape) else shape for name, shape in shapes.items()}
    return _block(section, "OneJoint", own)


@cached
def state_block(member: type) -> type[Block]:
    """Return the block of a member's states: `states` are numbers, `joint_states` and `slip_states` arrays (n,)."""
    arrays = (*getattr(member, "joint_states", ()), *getattr(member, "slip_states", ()))
    return _block(member, "States", dict.fromkeys(getattr(member, "states", ()), ()) | dict.fromkeys(arrays, (_N,)))


@cached
def _keys(section: type[Section]) -> dict[str, str]:
    """Return the key of each parameter, by its name."""
    names = {
        key: [x.name for x in field.metadata if isinstance(x, Named)] for key, field in section.model_fields.items()
    }
    return {name: key for key, given in names.items() for name in given or [key]}


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
        return (_N,) if Ellipsis in entries else (len(entries), *(_shape(entries[0]) or ()))
    shapes = [_shape(choice) for choice in get_args(annotation) if choice is not NoneType]
    if not shapes or any(shape is None for shape in shapes):
        return None
    return max(shapes, key=lambda shape: len(shape or ()))


def _is_per_joint(shape: tuple[Any, ...]) -> bool:
    return bool(shape) and shape[0].terms == _N.terms


def _values(section: Section) -> dict[str, Any]:
    """Return what a section says, by name: of what it leaves out, what `resolved` says, else NaN."""
    resolver = getattr(type(section), "resolved", None)  # on the class: a section looks every missing name up
    resolved: dict[str, Any] = resolver(section) if resolver is not None else {}
    known, keys, given = parameter_block(type(section)).layout.shape, _keys(type(section)), vars(section) | resolved
    return {name: math.nan if (value := given[keys[name]]) is None else value for name in known}


def pack(section: Section, n: int, where: str, joint_names: Sequence[str] = ()) -> Array:
    """Return the numbers of a section for n joints, as its `parameter_block` has them.

    `section`: what it leaves out (None) is what its method `resolved` says, if it has one, else NaN.
    `n`: number of joints.
    `where`: the section's name in messages.
    `joint_names`: for messages.
    Raises ScenarioError if a list has not one entry a joint.
    """
    block, numbers = parameter_block(type(section)), list[float]()
    for (name, value), (_, _, _, shape) in zip(_values(section).items(), block.layout.places(n).values(), strict=True):
        if not shape:
            numbers.append(value)
        elif not isinstance(value, tuple) or len(shape) > 1:
            numbers += np.broadcast_to(value, shape).ravel().tolist()
        elif len(value) == shape[0]:
            numbers += value
        else:
            raise wrong_length(f"{where}.{name}", value, n, joint_names)
    return np.array(numbers, dtype=np.float64)


def lists_per_joint(section: Section) -> dict[str, tuple[float, ...]]:
    """Return the keys of a section that it gives as a list with one number for each joint, and the lists."""
    shapes = parameter_block(type(section)).layout.shape
    given = {name: getattr(section, name) for name, shape in shapes.items() if _is_per_joint(shape)}
    return {name: value for name, value in given.items() if isinstance(value, tuple)}


def pack_each_joint(section: Section, n: int, where: str) -> Array:
    """Return the numbers of a section for n joints, a row for each, (n, ...), as its `one_joint_block` has them."""
    kind, shapes = one_joint_block(type(section)), parameter_block(type(section)).layout.shape
    rows = np.zeros((n, kind.count(n)))
    values = _values(section)
    for j in range(n):
        block = kind(rows[j], n)
        for name, value in values.items():
            if not _is_per_joint(shapes[name]) and shapes[name]:
                getattr(block, name)[:] = value
            elif not isinstance(value, tuple):
                setattr(block, name, value)
            elif len(value) == n:
                setattr(block, name, value[j])
            else:
                entries = f"has {len(value)} entries: must be one number or {n}, one per joint"
                raise ScenarioError(f"{where}.{name} {entries}")
    return rows


def per_joint(key: str, value: float | tuple[float, ...], n: int, joint_names: Sequence[str] = ()) -> Array:
    """Return one number a joint (n,); `key` names it in messages.

    Raises ScenarioError if a list has another length.
    """
    if not isinstance(value, tuple):
        return np.full(n, float(value))
    if len(value) != n:
        raise wrong_length(key, value, n, joint_names)
    return np.array(value)


def wrong_length(key: str, value: tuple[float, ...], n: int, joint_names: Sequence[str]) -> ScenarioError:
    """Return what is wrong with a list that has not one entry a joint."""
    names = f", {', '.join(joint_names)}" if joint_names else ""
    return ScenarioError(f"{key} has {len(value)} entries: the robot has {n} joints{names}")
