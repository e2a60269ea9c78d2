"""Properties of objects, and answers of functions, that are worked out once, without a lock."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Generic, ParamSpec, TypeVar, overload

T = TypeVar("T")
P = ParamSpec("P")


def cached(function: Callable[P, T]) -> Callable[P, T]:
    """As `functools.cache`; of threads that ask at once all get the answer that was there first, the same object."""
    known: dict[Any, T] = {}

    @wraps(function)
    def answer(*arguments: P.args, **named: P.kwargs) -> T:
        key = (*arguments, *named.items())
        if key not in known:
            known.setdefault(key, function(*arguments, **named))
        return known[key]

    return answer


class cached_property(Generic[T]):
    """As `functools.cached_property` is from Python 3.12 on: two threads at once may both work the value out.

    The one of Python 3.11 holds a lock of the whole class meanwhile. A process forked in that time keeps the lock
    taken, and waits for ever for the same property of any object. All threads get the value that was there first.
    """

    def __init__(self, function: Callable[[Any], T]) -> None:
        self._function, self.__doc__ = function, function.__doc__

    def __set_name__(self, owner: type[Any], name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type[Any]) -> cached_property[T]: ...

    @overload
    def __get__(self, instance: object, owner: type[Any]) -> T: ...

    def __get__(self, instance: object | None, owner: type[Any]) -> cached_property[T] | T:
        """Work the value out, and leave it where Python finds it before it asks here again."""
        if instance is None:
            return self
        found: T = vars(instance).setdefault(self._name, self._function(instance))
        return found
