"""Kernels of dual numbers: a kernel's Python function, compiled for `closedloop.jit.dual8` in place of floats.

Such a twin is the same code with other globals, as in `closedloop.jit.interpreted`: what makes arrays of an address
makes arrays of dual numbers, and every kernel is replaced by its twin. So memory that the plain loop has at an address
as n floats has n dual numbers in this form, and no formula is written twice.
"""

import math
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np

from closedloop.jit.calls import fortran_at, matrix_at, vector_at
from closedloop.jit.interpreted import Twins
from closedloop.jit.kernel import Kernel


class NotDualError(Exception):
    """There is no run of dual numbers, and why."""


class NotCompiledError(NotDualError):
    """Nor will there be one with the same kernels: numba cannot compile one of them."""


@contextmanager
def refused_as_one_line() -> Iterator[None]:
    """Turn numba's error about a function that it cannot compile into one line."""
    import numba

    try:
        yield
    except numba.errors.NumbaError as error:
        raise NotCompiledError(str(error).splitlines()[0]) from error


F = TypeVar("F", bound=Callable[..., Any])

# The digest of compiled code tells the forms of one function apart by this.
FORM = "dual8"


# `numpy` as twins have it: of its functions of numbers those that dual numbers have.
_NUMPY = types.ModuleType("numpy", "The functions of numbers of numpy that dual numbers have.")
_NUMPY.__dict__.update({name: vars(math)[name] for name in (
    "hypot", "sqrt", "sin", "cos", "tan", "tanh", "exp", "expm1", "log", "isfinite", "isnan", "pi", "inf", "nan",
)})  # fmt: skip
_NUMPY.__dict__.update(
    abs=abs, arctan2=math.atan2, arcsin=math.asin, arccos=math.acos, minimum=min, maximum=max, ceil=math.ceil
)


def dual(function: F) -> F:
    """Return the twin of a kernel that takes dual numbers; what is no kernel is returned as it is."""
    if not isinstance(function, Kernel):
        return function

    def finish(twin: Any) -> Kernel:
        twin.__name__, twin.__qualname__ = f"{twin.__name__}_{FORM}", f"{twin.__qualname__}_{FORM}"
        twin.__dict__["form"] = FORM
        made = Kernel(twin, function.make)
        made.unguarded = None if function.unguarded is None else dual(function.unguarded)
        return made

    return cast(F, _twins.of(function, finish))


def _twin_value(value: Any) -> Any:
    return dual(value) if isinstance(value, Kernel) else _in_place_of().get(id(value), value)


_twins = Twins(_twin_value)


@cache
def _in_place_of() -> dict[int, Any]:
    from closedloop.jit.inside.dual8 import dual_fortran_at, dual_matrix_at, dual_vector_at

    pairs = ((np, _NUMPY), (vector_at, dual_vector_at), (matrix_at, dual_matrix_at), (fortran_at, dual_fortran_at))
    return {id(value): other for value, other in pairs}
