"""The parameters of a section of friction, by name: of the surface, or of each joint."""

from __future__ import annotations

from typing import Any

from closedloop.jit.parameters import one_joint_block, pack, pack_each_joint, parameter_block
from closedloop.mechanics.friction.law import FrictionLaw


def surface_parameters(section: FrictionLaw) -> Any:
    """Return what the functions of a law of the surface's friction read."""
    return parameter_block(type(section))(pack(section, 1, "friction"), 1)


def joint_parameters(section: FrictionLaw, n: int | None = None) -> list[Any]:
    """Return what the functions of a law of the joints' friction read, for each joint.

    Parameters
    ----------
    section : FrictionLaw
        A section of friction.
    n : int, optional
        The number of joints; left out, it is that of the longest list in the section.
    """
    kind = type(section)
    if n is None:
        given = (getattr(section, name) for name in kind.model_fields)
        n = max((len(value) for value in given if isinstance(value, tuple)), default=1)
    return [one_joint_block(kind)(row, n) for row in pack_each_joint(section, n, "joint_friction")]
