"""Control laws of an arm that presses on a surface and moves along it.

    paper               Eq. 33                                             the paper
    hybrid              position and force each along its own directions   Raibert and Craig 1981
    operational_space   the tip's own dynamics made linear                 Khatib 1987
    dynamic_hybrid      the same through joint accelerations               Yoshikawa 1987
    impedance           a wished spring and damper at the tip              Hogan 1985
    admittance          a set point that yields to the force               Whitney 1977

Names are loaded when they are first used, so that reading a scenario's sections does not load the compiler.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from closedloop.control.paper import Law as Law
    from closedloop.control.paper import paper_law as paper_law

_HOME = {
    "Law": "paper",
    "paper_law": "paper",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'closedloop.control' has no attribute '{name}'")
    value = getattr(import_module(f"closedloop.control.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
