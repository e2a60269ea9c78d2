"""Arguments of the functions that users call from Python, compared with their annotations: the answer is one line.

    @arguments_checked()
    def simulate(scenario: Scenario, *, engine: str = "pinocchio") -> Run: ...

What is given is refused if it is of another type, and so is a number that is NaN. What a value must be besides, the
function itself says. A name of an annotation that its module has only for type checkers is compared by its text.
"""

import builtins
import collections.abc
import inspect
import math
import numbers
import os
import sys
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.errors import ScenarioError
from robot_models.errors import shown

F = TypeVar("F", bound=Callable[..., Any])
C = TypeVar("C", bound=type)

# What a class is called in a message, by its name.
WORDS = {
    "Scenario": "a Scenario, as load_scenario('wam_slide') returns",
    "RobotModel": "a robot, as robot_models.load('wam4') returns",
    "Run": "a Run, as simulate returns",
    "Log": "a Log",
    "Recording": "a Recording",
    "PathLike": "a path",
    "Path": "a path",
    "Table": "a table of pyarrow",
    "float": "a number",
    "int": "a whole number",
    "bool": "True or False",
    "str": "text",
    "NoneType": "None",
}


class _Only(type):
    """A class of which only the name is known."""

    def __getattr__(cls, name: str) -> "_Only":
        if name.startswith("__"):
            raise AttributeError(name)
        return _Only(name, (), {})

    def __getitem__(cls, _: Any) -> "_Only":
        return cls


class _Names(dict[str, Any]):
    """The names of a module, and an `_Only` for each that it has for type checkers alone."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name) if hasattr(builtins, name) else _Only(name, (), {})


def arguments_checked(**words: str) -> Callable[[F], F]:
    """Return what makes of a function one that compares its arguments with their annotations first.

    `words` say of an argument what it must be, in place of what its annotation says.

    Raises ScenarioError by the function that is made, if an argument has another type, or is NaN.
    """

    def made(function: F) -> F:
        @cache
        def known() -> tuple[inspect.Signature, list[str], dict[str, Any], dict[str, set[type]]]:
            signature, hints = inspect.signature(function), _hints(function, function.__globals__)
            return signature, list(signature.parameters), hints, {name: _exact(hint) for name, hint in hints.items()}

        @wraps(function)
        def called(*args: Any, **named: Any) -> Any:
            signature, names, hints, exact = known()
            given = {**dict(zip(names, args, strict=False)), **named}
            if any(name in exact and type(value) not in exact[name] for name, value in given.items()):
                _compare(signature.bind(*args, **named).arguments, hints, words)
            return function(*args, **named)

        return cast(F, called)

    return made


def fields_checked(owner: C) -> C:
    """Return a dataclass whose fields are compared with their annotations before what it does after its making.

    Raises ScenarioError by the making of one, as by `arguments_checked`.
    """
    after = getattr(owner, "__post_init__", None)

    @cache
    def hints() -> dict[str, Any]:
        space = vars(sys.modules[owner.__module__])
        return {k: v for k, v in _hints(owner, space).items() if k in inspect.signature(owner).parameters}

    def compared(self: Any) -> None:
        _compare(vars(self), hints(), {})
        if after is not None:
            after(self)

    owner.__post_init__ = compared  # type: ignore[attr-defined]
    return owner


def _hints(owner: Any, space: Mapping[str, Any]) -> dict[str, Any]:
    """Return the annotations of a function or a dataclass, by the names of its module."""
    return typing.get_type_hints(owner, localns=_Names(space))


def _compare(values: Mapping[str, Any], hints: Mapping[str, Any], words: Mapping[str, str]) -> None:
    for name, value in values.items():
        if name in hints and not fits(value, hints[name]):
            raise ScenarioError(f"{name} = {shown(value)}: must be {words.get(name) or in_words(hints[name])}")


def _exact(hint: Any) -> set[type]:
    """Return classes of which every instance is what an annotation says, without a look at it: a float may be NaN."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return set().union(*map(_exact, typing.get_args(hint)))
    return {hint} if isinstance(hint, type) and hint is not float else set()


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is what an annotation says."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or isinstance(hint, TypeVar) or hint == ArrayLike:
        return hint != ArrayLike or _are_numbers(value)
    if hint is None or hint is types.NoneType:
        return value is None
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if hint is bool:
        return isinstance(value, (bool, np.bool_))
    if hint in (int, float):
        kind = numbers.Integral if hint is int else numbers.Real
        return isinstance(value, kind) and not isinstance(value, (bool, np.bool_)) and not math.isnan(value)
    if isinstance(hint, _Only):
        same = any(each.__name__ == hint.__name__ for each in type(value).__mro__)
        return same or (hint.__name__ == "PathLike" and isinstance(value, os.PathLike))
    if origin is collections.abc.Callable or hint is collections.abc.Callable:
        return callable(value)
    if origin is tuple and parts[-1] is ...:
        return _is_list(value) and all(fits(each, parts[0]) for each in value)
    if origin is tuple:
        return _is_list(value) and len(value) == len(parts) and all(map(fits, value, parts))
    if origin is np.ndarray:
        return _are_numbers(value)
    if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
        return isinstance(value, collections.abc.Mapping) and all(
            fits(key, parts[0]) and fits(each, parts[1]) for key, each in value.items()
        )
    if isinstance(origin, type) and issubclass(origin, collections.abc.Iterable):
        if _is_list(value):
            return all(fits(each, parts[0]) for each in value)
        text = isinstance(value, (str, bytes, collections.abc.Mapping))
        return origin is collections.abc.Iterable and isinstance(value, origin) and not text
    return not isinstance(hint, type) or isinstance(value, hint)


def _is_list(value: Any) -> bool:
    """Whether a value is a list, or has entries by their number as an array or a column of a table has."""
    if isinstance(value, collections.abc.Sequence):
        return not isinstance(value, (str, bytes))
    return hasattr(value, "dtype") and np.ndim(value) == 1


def _are_numbers(value: Any) -> bool:
    """Whether a value is an array of numbers, or one that becomes it."""
    try:
        return np.asarray(value).dtype.kind in "iuf" or np.size(value) == 0
    except (TypeError, ValueError):
        return False


def in_words(hint: Any) -> str:
    """Return an annotation as a message has it."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(in_words, parts)))
    if hint == ArrayLike or origin is np.ndarray:
        return "an array of numbers"
    if origin is collections.abc.Callable:
        return "a function"
    if origin is tuple and parts[-1] is not ...:
        return "a pair" if len(parts) == 2 else f"{len(parts)} values"
    if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
        values = in_words(parts[1]) if parts[1] is not Any else "a value"
        return f"a dictionary from keys to {values}"
    if isinstance(origin, type) and issubclass(origin, collections.abc.Iterable):  # a tuple of any length too
        one = {str: "names", float: "numbers", Any: "values"}.get(parts[0])
        return f"a list of {one}" if one else f"a list, each entry {in_words(parts[0])}"
    name = "None" if hint is None else getattr(hint, "__name__", str(hint))
    return WORDS.get(name, f"a {name}")
