"""What the tabs "keep" and "map" need of the lab."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from closedloop.lab.answers import Answer, Answers
from closedloop.lab.history import History
from closedloop.lab.view_plots import Plots
from closedloop.lab.view_space import Space


class LabForTabs(Protocol):
    """A lab, as far as a tab of it is concerned; see `closedloop.lab.app.Lab`."""

    server: Any
    steps: Any
    history: History
    answers: Answers
    answer: Answer | None
    plots: Plots
    after_show: list[Callable[[Answer], None]]

    @property
    def space(self) -> Space:
        """What is drawn in space."""

    def refresh(self) -> None:
        """Let all controls show the scenario as it is now."""

    def ask(self, key: str = "") -> None:
        """Run the scenario as it is now."""

    def command(self, answer: Answer) -> str:
        """Return the command line that repeats a run."""
