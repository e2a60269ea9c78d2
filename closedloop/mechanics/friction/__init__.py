"""Friction of the tip on a surface and in joints.

law          what every law of friction is
laws         those that ship, a file each
quantities   the types of their parameters
packing      their parameters by name, from a section
contact      a law at one contact, for use from Python
block        a block that is pulled over a surface with one
presliding   small motions before slip

    section = SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0)
    contact = surface_contact(section)
    draw(section, "lugre.png")

Names are loaded when they are first used, so that reading a scenario's sections does not load the compiler.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from closedloop.mechanics.friction.block import pull_block as pull_block
    from closedloop.mechanics.friction.contact import Contact as Contact
    from closedloop.mechanics.friction.contact import joint_contacts as joint_contacts
    from closedloop.mechanics.friction.contact import surface_contact as surface_contact
    from closedloop.mechanics.friction.law import JOINT_LAWS as JOINT_LAWS
    from closedloop.mechanics.friction.law import SURFACE_LAWS as SURFACE_LAWS
    from closedloop.mechanics.friction.law import JointFriction as JointFriction
    from closedloop.mechanics.friction.law import SurfaceFriction as SurfaceFriction
    from closedloop.mechanics.friction.presliding import largest_step as largest_step
    from closedloop.mechanics.friction.presliding import presliding_motion as presliding_motion

_HOME = {
    "JOINT_LAWS": "law",
    "SURFACE_LAWS": "law",
    "Contact": "contact",
    "JointFriction": "law",
    "SurfaceFriction": "law",
    "joint_contacts": "contact",
    "largest_step": "presliding",
    "presliding_motion": "presliding",
    "pull_block": "block",
    "surface_contact": "contact",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'closedloop.mechanics.friction' has no attribute '{name}'")
    value = getattr(import_module(f"closedloop.mechanics.friction.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
