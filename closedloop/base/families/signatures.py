"""The functions of a user's class against those of the class that it is derived from: their arguments."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_HOW = {staticmethod: "@staticmethod ", classmethod: "@classmethod "}


def signature_faults(member: type[Any], base: type[Any]) -> list[str]:
    """Return what is wrong with the functions of a class that have the name of one of its base: a line for each.

    A function must be static, of the class or of the instance as the base's is, and take as many arguments by place.

    Parameters
    ----------
    member, base : type
        A user's class, and the family's base class.
    """
    return [fault for name in _functions(base) if (fault := _fault(name, member, base))]


def _functions(base: type[Any]) -> Iterator[str]:
    """Return the names of the functions that a class of the package defines, itself or in a base of the package."""
    for name in dict.fromkeys(name for each in base.__mro__ if _is_ours(each) for name in vars(each)):
        made = inspect.getattr_static(base, name)
        if not name.startswith("_") and (isinstance(made, (staticmethod, classmethod)) or inspect.isfunction(made)):
            yield name


def _is_ours(each: type[Any]) -> bool:
    return each.__module__.partition(".")[0] == __name__.partition(".")[0]


def _fault(name: str, member: type[Any], base: type[Any]) -> str:
    """Return what is wrong with one function, "" if nothing is."""
    owner = next((each for each in member.__mro__ if name in vars(each)), base)
    if _is_ours(owner):
        return ""
    given, wanted = inspect.getattr_static(member, name), inspect.getattr_static(base, name)
    right = f"{_HOW.get(type(wanted), '')}def {name}({', '.join(_names(wanted))})"
    if not isinstance(given, (staticmethod, classmethod)) and not callable(given):
        return f"{name} is not a function: must be {right}"
    here = _place(given)
    try:
        inspect.signature(_plain(given)).bind(*_names(wanted))
    except TypeError:
        return f"{here}{name}({', '.join(_names(given))}): must be {right}"
    except ValueError:  # a function of C, which does not say
        return ""
    static = isinstance(wanted, staticmethod)
    if static and not isinstance(given, staticmethod) and inspect.isfunction(given):
        return f"{here}{name}: must be {right}"
    return ""


def _plain(function: Any) -> Any:
    """Return the Python function of a method, or of what numba has made of one."""
    function = getattr(function, "__func__", function)
    return getattr(function, "py_func", function)


def _names(function: Any) -> list[str]:
    """Return the names of the arguments that are given by place."""
    parameters = inspect.signature(_plain(function)).parameters.values()
    return [each.name for each in parameters if each.kind in _POSITIONAL and each.default is each.empty]


def _place(function: Any) -> str:
    """Return "file:line: " of a function, "" if it has no file."""
    code = getattr(_plain(function), "__code__", None)
    return "" if code is None else f"{Path(code.co_filename).name}:{code.co_firstlineno}: "
