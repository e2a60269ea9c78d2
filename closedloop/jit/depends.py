"""What a compiled function depends on outside of the package: users' functions that it calls, and their constants."""

from __future__ import annotations

from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

# What the folder's name answers for: the text of the package's kernels, and versions.
KNOWN = ("closedloop", "robot_models", "numba", "numpy", "math", "builtins")


def users_text(function: Any) -> bytes:
    """Return what users' functions say that a function calls, itself among them, wherever they are defined.

    Their instructions, and the numbers, texts and arrays that they take from their modules: numba makes constants of
    them.
    """
    said: list[bytes] = []
    seen: set[int] = set()
    waiting = [function]
    while waiting:
        each = waiting.pop()
        each = getattr(each, "py_func", each)
        if not isinstance(each, FunctionType) or id(each) in seen:
            continue
        seen.add(id(each))
        values = [cell.cell_contents for cell in each.__closure__ or ()]
        if (each.__module__ or "").partition(".")[0] not in KNOWN:
            for code in _codes(each.__code__):
                said += [code.co_code, repr([x for x in code.co_consts if not isinstance(x, CodeType)]).encode()]
                values += _values(each, code)
        said += [_constant(value) for value in values]
        waiting += values
    return b"\0".join(said)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _codes(inner)


def _values(function: FunctionType, code: CodeType) -> list[Any]:
    """Return what the names in a function's text stand for, in its module or in a module that this has imported."""
    found = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
    modules = [value for value in found if isinstance(value, ModuleType) and value.__name__ not in KNOWN]
    return found + [vars(module)[name] for module in modules for name in code.co_names if name in vars(module)]


def _constant(value: Any) -> bytes:
    if isinstance(value, np.ndarray):
        return repr((value.dtype.str, value.shape)).encode() + value.tobytes()
    simple = isinstance(value, bool | int | float | complex | str | bytes | np.generic | type(None))
    simple = simple or (isinstance(value, tuple) and all(isinstance(x, bool | int | float | str) for x in value))
    return repr(value).encode(errors="surrogatepass") if simple else b""
