"""A package that can be called, since its name is that of a function as well, as ``closedloop.lab`` is."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, found: Callable[[], Callable[..., Any]]) -> None:
    """Let a package that is being imported be called as a function, which `found` imports when it is."""

    class CallablePackage(ModuleType):
        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return found()(*arguments, **options)

        @property
        def __signature__(self) -> inspect.Signature:
            return inspect.signature(found())

    sys.modules[package].__class__ = CallablePackage
