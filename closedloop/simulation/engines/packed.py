"""Laws as numbers: what the loop and the entries of plug-ins read of their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from closedloop.base.arrays import Array
from closedloop.control.law import Compensation, ControlLaw
from closedloop.jit.parameters import pack, pack_each_joint, state_block
from closedloop.loop.step.memory import ELASTIC_STICK, RIGID_STICK, SMOOTH, SPRING_STICK
from closedloop.mechanics.friction.law import FrictionLaw
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.surface.compliance import Compliance

STICKING = {"rigid": RIGID_STICK, "elastic": ELASTIC_STICK, "spring": SPRING_STICK}


class PackedLaw(NamedTuple):
    """A law as the loop reads it: of control, of compensation, of friction, or of a soft surface."""

    member: Any  # its class
    # its parameters, see `closedloop.jit.parameters.parameter_block`; of friction in joints a row for each, (n, ...),
    # see `closedloop.jit.parameters.one_joint_block`
    numbers: Array
    states: int  # how many states it has; of friction in joints, each of them


def pack_law(section: ControlLaw | Compensation, n: int, joint_names: Sequence[str] = ()) -> PackedLaw:
    """Turn a law or a compensation into numbers for n joints."""
    where = "law" if isinstance(section, ControlLaw) else "compensation"
    type(section).check_functions(f"{where}.kind")
    return PackedLaw(type(section), pack(section, n, where, joint_names), state_block(type(section)).count(n))


def pack_friction(section: FrictionLaw, n: int, joints: bool = False) -> PackedLaw:
    """Turn a law of the surface's friction, or of the joints', into numbers for n joints."""
    member, where = type(section), "joint_friction" if joints else "friction"
    if member is not NoFriction:
        member.check_functions(f"{where}.kind")
    numbers = pack_each_joint(section, n, where) if joints else pack(section, n, where)
    return PackedLaw(member, numbers, state_block(member).count(1 if joints else 2))


def pack_compliance(section: Compliance, n: int) -> PackedLaw:
    """Turn a soft surface into numbers for n joints."""
    return PackedLaw(type(section), pack(section, n, "compliance"), 0)


def sticking(friction: PackedLaw) -> int:
    """Return how a law of friction holds what it has stopped, see `closedloop.loop.step.memory`."""
    return SMOOTH if friction.member is NoFriction else STICKING[friction.member.sticks]
