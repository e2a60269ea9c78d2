"""Kernels interpreted: a kernel's Python function, with the functions that it calls interpreted too.

The globals of a kernel's Python function are compiled functions. Its twin is the same code with other globals, in which
every compiled function is replaced by its twin. Both do IEEE arithmetic in the same order, so the results are the same
to the last bit; `math.hypot`, which Python implements itself, is the C library's in the twin, as in compiled code.
"""

from __future__ import annotations

import math
import threading
import types
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from closedloop.jit.buffers import with_buffers
from closedloop.jit.calls import (
    Entry,
    address_of_function,
    give_with_buffers,
)
from closedloop.jit.lanewise import LANEWISE, on_arrays

F = TypeVar("F", bound=Callable[..., Any])

_MATH = types.ModuleType("math", "The module `math` as compiled code has it.")
_MATH.__dict__.update({name: value for name, value in vars(math).items() if not name.startswith("_")})
_MATH.__dict__["hypot"] = np.hypot

# Twins, and the globals of twins, by the identity of what they are of, which is kept with them; with arrays, or with
# buffers (`closedloop.jit.buffers`).
_twins: dict[tuple[int, bool], tuple[Any, Any]] = {}
_globals: dict[tuple[int, bool], tuple[dict[str, Any], dict[str, Any]]] = {}
_making = threading.RLock()


def interpreted(function: F, buffers: bool = False) -> F:
    """Return the twin of a function that numba has been given: the same source, interpreted.

    It gives what the compiled form gives, to the last bit, with one exception: where Python's arithmetic raises an
    ArithmeticError or a ValueError (1.0 / 0.0, math.sqrt(-1.0)), compiled code goes on with what IEEE 754 says. What
    numpy warns of in the twin, compiled code does in silence.

    Parameters
    ----------
    function : callable
        A function with the attribute `py_func`; another is returned as it is, as with ``NUMBA_DISABLE_JIT=1``.
    buffers : bool
        Whether what it takes by address are buffers: twice as fast, and refused by some kernels with an exception.
    """
    if not hasattr(function, "py_func"):
        return function
    if getattr(function, "unguarded", None) is not None:
        return cast(F, interpreted(cast(Any, function).unguarded, buffers))
    key = id(function), buffers
    with _making:
        if key not in _twins:
            source = function.py_func
            if buffers and hasattr(source, "takes_arrays"):
                _twins[key] = function, on_arrays(interpreted(function))
                return cast(F, _twins[key][1])
            cells = tuple(types.CellType(_twin_value(cell.cell_contents, buffers)) for cell in source.__closure__ or ())
            names = _twin_globals(source.__globals__, buffers)
            if hasattr(source, "lanewise"):
                names = names | LANEWISE
            twin = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__, cells)
            twin.__kwdefaults__, twin.__doc__ = source.__kwdefaults__, source.__doc__
            twin.__qualname__ = source.__qualname__
            _twins.setdefault(key, (function, twin))
        return cast(F, _twins[key][1])


def twin_address(entry: Entry) -> int:
    """Return the number by which interpreted code calls an entry, interpreted too; see `closedloop.jit.calls`."""
    address = address_of_function(interpreted(entry))
    if getattr(entry, "unguarded", None) is None:  # a user's is written for arrays
        give_with_buffers(address, interpreted(entry, buffers=True))
    return address


def _twin_globals(names: dict[str, Any], buffers: bool) -> dict[str, Any]:
    key = id(names), buffers
    if key not in _globals:
        # Entered before it is filled: two modules may have functions of each other.
        _globals[key] = names, dict(names)
        _globals[key][1].update({name: _twin_value(value, buffers) for name, value in names.items()})
    return _globals[key][1]


def _twin_value(value: Any, buffers: bool) -> Any:
    if value is math:
        return _MATH
    if buffers and (other := with_buffers(value)) is not value:
        return other
    return interpreted(value, buffers) if callable(value) else value
