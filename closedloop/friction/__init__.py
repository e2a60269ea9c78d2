"""Laws of friction, of the tip on a surface and in joints.

    none               no friction
    coulomb            of one size, against the slip
    coulomb_viscous    the same, and a part proportional to the slip
    stribeck           falls from static to kinetic as slip gets faster    Bo and Pavelescu 1982
    karnopp            slip within a band of speeds counts as none         Karnopp 1985
    dahl               an elastic bristle that yields                      Dahl 1968
    lugre              damped bristles that yield at the Stribeck curve    Canudas de Wit et al. 1995
    seven_parameter    rises with rest, lags the slip                      Armstrong-Hélouvry et al. 1994

A file for each has its equations, source, parameters with units and ranges. `sections` is what a scenario may
say, `packing` makes arrays of it, `laws` is the one interface of all laws for the code inside a step, `layout`
the numbers of laws, parameters and states. `block` pulls a block with one.

    section = SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0)
    kind, par = pack(section)
    draw(section, "lugre.png")

Names are loaded when they are first used, so that reading a scenario's sections does not load the compiler.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from closedloop.friction.block import pull_block as pull_block
    from closedloop.friction.layout import KINDS as KINDS
    from closedloop.friction.layout import STICKS as STICKS
    from closedloop.friction.layout import state_count as state_count
    from closedloop.friction.packing import energy_fault as energy_fault
    from closedloop.friction.packing import pack as pack
    from closedloop.friction.presliding import largest_step as largest_step
    from closedloop.friction.presliding import presliding_motion as presliding_motion
    from closedloop.friction.sections import JointFriction as JointFriction
    from closedloop.friction.sections import SurfaceFriction as SurfaceFriction

_HOME = {
    "KINDS": "layout",
    "STICKS": "layout",
    "JointFriction": "sections",
    "SurfaceFriction": "sections",
    "energy_fault": "packing",
    "largest_step": "presliding",
    "pack": "packing",
    "presliding_motion": "presliding",
    "pull_block": "block",
    "state_count": "layout",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'closedloop.friction' has no attribute '{name}'")
    value = getattr(import_module(f"closedloop.friction.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
