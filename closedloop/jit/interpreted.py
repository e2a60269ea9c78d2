"""Kernels interpreted: a kernel's Python function, with the functions that it calls interpreted too.

The globals of a kernel's Python function are compiled functions. Its twin is the same code with other globals, in which
every compiled function is replaced by its twin. Both do IEEE arithmetic in the same order, so the results are the same
to the last bit; `math.hypot`, which Python implements itself, is the C library's in the twin, as in compiled code.
"""

import math
import threading
import types
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from closedloop.jit.calls import Entry, address_of_function
from closedloop.jit.simd8 import LANEWISE

F = TypeVar("F", bound=Callable[..., Any])

_MATH = types.ModuleType("math", "The module `math` as compiled code has it.")
_MATH.__dict__.update({name: value for name, value in vars(math).items() if not name.startswith("_")})
_MATH.__dict__["hypot"] = np.hypot


class Twins:
    """Twins of functions: the same code with other globals, in which what these say is replaced, twins among it.

    `replaced`: returns what stands in place of a value.
    """

    def __init__(self, replaced: Callable[[Any], Any]) -> None:
        self._replaced = replaced
        # By the identity of what they are of, which is kept with them.
        self._made: dict[int, tuple[Any, Any]] = {}
        self._globals: dict[int, tuple[dict[str, Any], dict[str, Any]]] = {}
        self._making = threading.RLock()

    def of(self, function: Any, finish: Callable[[Any], Any] = lambda twin: twin, **others: Any) -> Any:
        """Return what `finish` makes of the twin of a function's Python function, made once; `others` are names too."""
        with self._making:
            if id(function) not in self._made:
                source = function.py_func
                cells = tuple(types.CellType(self._replaced(cell.cell_contents)) for cell in source.__closure__ or ())
                names = self._names(source.__globals__)
                names = names | others if others else names
                twin = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__, cells)
                twin.__kwdefaults__, twin.__doc__ = source.__kwdefaults__, source.__doc__
                twin.__qualname__, twin.__module__ = source.__qualname__, source.__module__
                self._made.setdefault(id(function), (function, finish(twin)))
            return self._made[id(function)][1]

    def _names(self, names: dict[str, Any]) -> dict[str, Any]:
        if id(names) not in self._globals:
            # Entered before it is filled: two modules may have functions of each other.
            self._globals[id(names)] = names, dict(names)
            self._globals[id(names)][1].update({name: self._replaced(value) for name, value in names.items()})
        return self._globals[id(names)][1]


def interpreted(function: F) -> F:
    """Return the twin of a function that numba has been given: the same source, interpreted.

    It gives what the compiled form gives, to the last bit, with one exception: where Python's arithmetic raises an
    ArithmeticError or a ValueError (1.0 / 0.0, math.sqrt(-1.0)), compiled code goes on with what IEEE 754 says. What
    numpy warns of in the twin, compiled code does in silence.

    `function`: a function with the attribute `py_func`; another is returned as it is, as with ``NUMBA_DISABLE_JIT=1``.
    """
    if not hasattr(function, "py_func"):
        return function
    if getattr(function, "unguarded", None) is not None:
        return cast(F, interpreted(cast(Any, function).unguarded))
    others = LANEWISE if hasattr(cast(Any, function).py_func, "lanewise") else {}
    return cast(F, _twins.of(function, **others))


def twin_address(entry: Entry) -> int:
    """Return the number by which interpreted code calls an entry, interpreted too; see `closedloop.jit.calls`."""
    return address_of_function(interpreted(entry))


def _twin_value(value: Any) -> Any:
    if value is math:
        return _MATH
    return interpreted(value) if callable(value) else value


_twins = Twins(_twin_value)
