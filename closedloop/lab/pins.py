"""Runs that are kept beside the one that changes: up to four, and a table of their values side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from closedloop.lab.controls import toml_text
from closedloop.lab.history import Changes
from closedloop.record.report.control_verdict import told
from closedloop.record.report.measures import MEASURES
from closedloop.record.report.verdict import names_of
from closedloop.record.run import Run
from closedloop.scenario.units import with_unit

MOST_PINS = 4
# Reddish purple, sky blue and orange of Okabe and Ito's palette, which the run itself does not have, and violet.
COLOURS = ("#CC79A7", "#56B4E9", "#E69F00", "#7B61C4")
ROUNDING = 1e-9  # values that differ by no more than this share are equal
# What the table compares: values of `Run.summary`.
VALUES = (
    "rms_force_error", "peak_contact_force", "min_contact_force", "force_settled_at", "rms_path_error",
    "max_abs_closure_error", "max_tip_speed", "energy_lost_to_friction", "time_in_contact",
)  # fmt: skip


@dataclass(frozen=True)
class Pin:
    """A run that is kept: its name, its colour, the changes that made it, and the run."""

    name: str
    colour: str
    changes: Changes
    run: Run


@dataclass
class Pins:
    """The runs that are kept, in the order in which they were."""

    held: list[Pin] = field(default_factory=list)
    _count: int = 0

    def add(self, run: Run, changes: Changes) -> Pin | None:
        """Keep a run; return it, or None if as many are kept as can be."""
        if len(self.held) >= MOST_PINS:
            return None
        self._count += 1
        taken = {pin.colour for pin in self.held}
        colour = next(colour for colour in COLOURS if colour not in taken)
        pin = Pin(f"pin {self._count}", colour, dict(changes), run)
        self.held.append(pin)
        return pin

    def remove_last(self) -> None:
        """Keep the latest no longer."""
        if self.held:
            self.held.pop()


def compared(pins: Sequence[Pin], run: Run, changes: Changes) -> list[tuple[str, list[str]]]:
    """Return the rows of the table: a key that differs or a value, and what it is in each pin and now.

    A value that is a number has its difference from the present run beside it.
    """
    every = [*((pin.run, pin.changes) for pin in pins), (run, changes)]
    keys = dict.fromkeys(key for _, made in every for key in made)
    rows = [(key, [toml_text(_value_of(each.scenario, key)) for each, _ in every]) for key in keys]
    summaries = [each.summary() for each, _ in every]
    for name in VALUES:
        numbers = [summary.get(name) for summary in summaries]
        cells = [_with_difference(number, numbers[-1], k < len(pins)) for k, number in enumerate(numbers)]
        rows.append((with_unit(name, MEASURES[name].units), cells))
    rows.append(("verdict", [names_of(summary["verdict"]["problems"]) for summary in summaries]))
    return [*rows, ("control_verdict", [told(summary) for summary in summaries])]


def _value_of(scenario: Any, key: str) -> Any:
    section, _, name = key.partition(".")
    return getattr(getattr(scenario, section), name, None)


def _with_difference(number: float | None, now: float | None, differs: bool) -> str:
    if number is None:
        return "-"
    text = f"{number + 0.0:.4g}"  # no "-0"
    if not differs or now is None or abs(number - now) <= ROUNDING * max(abs(number), abs(now)):
        return text
    return f"{text} ({number - now:+.2g})"
