"""The record of a run: its columns, what made them, and what was computed from them.

A report, and whatever follows from the columns, is written for this interface; `closedloop.record.run.Run` has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

from closedloop.mechanics.loops.reactions import LoopReactions
from closedloop.record.columns.events import Event
from closedloop.record.columns.recorded import Column
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel


class Record(Protocol):
    """The record of a simulation; every column of `columns`, and every derived one, is an attribute too."""

    @property
    def scenario(self) -> Scenario:
        """What was asked for."""

    @property
    def model(self) -> RobotModel:
        """The robot."""

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """The columns recorded."""

    @property
    def added(self) -> Mapping[str, Column]:
        """What those of the columns are that not every run has, see `closedloop.record.columns.added`."""

    @property
    def specs(self) -> Mapping[str, Column]:
        """What each column is."""

    @property
    def law(self) -> str:
        """The law's name: "scenario" for the scenario's own."""

    @property
    def law_digest(self) -> str:
        """The SHA-256 of the text of the user's law, "" if it is not known."""

    @property
    def member_digests(self) -> Mapping[str, str]:
        """The same of each user's class that the scenario picks, by its name."""

    @property
    def engine(self) -> str:
        """Who computed the terms."""

    @property
    def versions(self) -> Mapping[str, str]:
        """Packages that made the run."""

    @property
    def stopped(self) -> str | None:
        """Why the simulation could not go on; None if it ran to its end."""

    @property
    def wall_seconds(self) -> float:
        """Time the simulation took, s."""

    @property
    def halved(self) -> Mapping[str, Any] | None:
        """By how much it differs from the same run at half the step; None if that was not run."""

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened to the contact, in order of time."""

    @property
    def loops(self) -> LoopReactions | None:
        """What the loop joints of a mechanism carried; None of a tree."""

    def summary(self) -> dict[str, Any]:
        """Return the summary, see `closedloop.record.report.summary.summarise`."""

    def units(self, name: str) -> str:
        """Return the unit of a column."""

    def __len__(self) -> int: ...

    def __getattr__(self, name: str) -> NDArray[Any]: ...
