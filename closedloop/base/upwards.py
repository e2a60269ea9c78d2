"""Methods that call what stands above them, as `Run.plot` does: the one table of what is imported by its name.

A user looks for these functions at the object that he has; the imports of the package point downwards only.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

ABOVE = {
    "replace": "closedloop.scenario.overrides:replaced",
    "unchanged": "closedloop.scenario.messages:unchanged",
    "run": "closedloop.simulation.simulate:simulate_prepared",
    "plot": "closedloop.figures.overview:plot",
    "html": "closedloop.figures.files:html",
    "show": "closedloop.lab.share:show_run",
    "animate": "closedloop.lab.animate:animate",
    "save": "closedloop.figures.export.tables:save",
    "step_error": "closedloop.simulation.halve:step_error_of",
}


def called(name: str, *arguments: Any, **options: Any) -> Any:
    """Return what the function of that name returns, see `ABOVE`."""
    module, _, function = ABOVE[name].partition(":")
    return getattr(import_module(module), function)(*arguments, **options)
