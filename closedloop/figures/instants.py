"""The instants marked in figures: changes of the law or the reference, and of the contact mode."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.families import Absent
from closedloop.control.reference.force import StepForceSection
from closedloop.control.reference.path import path_normal, tip_path
from closedloop.loop.events.table import IMPACT, REVERSAL
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario

# The text of the one mark that is not of the motion.
FORCE_STEPS = "force steps"
# Parts of the time shown in which one of the marks of a kind is drawn.
CELLS = 250


class Mark(NamedTuple):
    """An instant, s, and what happens there."""

    time: float
    text: str


class Interval(NamedTuple):
    """A time, from `begin` to `end`, s, in which the tip does one thing: a value of the column `mode`."""

    mode: int
    begin: float
    end: float


def motion(scenario: Scenario) -> tuple[float, float] | None:
    """Return the instants, s, at which the reference starts and stops to move.

    None if it never moves, or is a user's path in a run file, not named in this process.
    """
    if isinstance(scenario.reference, Absent):
        return None
    segments = tip_path(scenario.reference, np.zeros(3), path_normal(scenario.reference, scenario.surface)).segments
    return (segments[0].start, segments[-1].stop) if segments else None


def marks(run: Run) -> list[Mark]:
    """Return the instants at which the scenario's law or reference changes, in order; none under a user's law."""
    if run.law != "scenario":
        return []
    scenario = run.scenario
    found = []
    moves = motion(scenario)
    if moves is not None:
        found += [Mark(moves[0], "motion starts"), Mark(moves[1], "motion stops")]
    if scenario.law.kind == "paper":
        begins = getattr(scenario.law, "pd_start", None)
        if moves is not None and begins in (None, moves[0]):
            found[0] = Mark(moves[0], "PD and motion start")
        elif begins is not None:
            found.append(Mark(begins, "PD starts"))
    if isinstance(scenario.force_profile, StepForceSection):
        found.append(Mark(scenario.force_profile.at, FORCE_STEPS))
    return sorted(found)


def intervals(run: Run) -> list[Interval]:
    """Return the intervals of each contact mode; their bounds are the events' instants, between two rows."""
    changes = np.flatnonzero(np.diff(run.mode)) + 1
    bounds = [float(run.time[0]), *(_instant(run, int(k)) for k in changes), float(run.time[-1])]
    modes = run.mode[[0, *changes]].tolist()
    return [Interval(*each) for each in zip(modes, bounds, bounds[1:], strict=False)]


def _instant(run: Run, row: int) -> float:
    """Return when the mode of this row began: the last event since the row before that changes modes, if there is."""
    events = run.event_time[(run.event_kind != IMPACT) & (run.event_kind != REVERSAL)]
    latest = int(np.searchsorted(events, run.time[row], side="right")) - 1
    if latest >= 0 and events[latest] > run.time[row - 1]:
        return float(events[latest])
    return float(run.time[row])


def thinned(times: NDArray[np.float64], begin: float, end: float) -> NDArray[np.float64]:
    """Return the times from `begin` to `end`, one for each of `CELLS` parts of that span: more could not be seen."""
    inside = times[(times >= begin) & (times <= end)]
    cell = np.floor(CELLS * (inside - begin) / max(end - begin, np.finfo(float).tiny))
    return inside[np.unique(cell, return_index=True)[1]]
