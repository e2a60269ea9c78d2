"""What is called by its name and imported when it is: methods of what stands below, as `Run.plot`, and packages.

A user looks for functions at the object that he has; the imports of the package point downwards only: `ABOVE` is the
one table of them. ``closedloop.lab`` is a package, and a function as well.
"""

import inspect
import sys
from functools import cache
from pkgutil import resolve_name
from types import ModuleType
from typing import Any

ABOVE = {
    "replace": "closedloop.scenario.load:replaced",
    "unchanged": "closedloop.scenario.messages:unchanged",
    "run": "closedloop.simulation.simulate:simulate_changed",
    "plot": "closedloop.figures.errors:plot",
    "html": "closedloop.figures.files:html",
    "show": "closedloop.lab.history:show_run",
    "animate": "closedloop.lab.animate:animate",
    "save": "closedloop.figures.export.files:save",
    "step_error": "closedloop.simulation.simulate:step_error_of",
}


_found = cache(resolve_name)  # a run of a prepared problem is called by its name, too


def called(name: str, *arguments: Any, **options: Any) -> Any:
    """Return what the function of that name returns, see `ABOVE`."""
    return _found(ABOVE[name])(*arguments, **options)


def make_callable(package: str, function: str) -> None:
    """Let a package that is being imported be called as MODULE:FUNCTION, which is imported when it is."""

    class CallablePackage(ModuleType):
        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return resolve_name(function)(*arguments, **options)

        @property
        def __signature__(self) -> inspect.Signature:
            return inspect.signature(resolve_name(function))

    sys.modules[package].__class__ = CallablePackage
