"""Where the forces of several contacts are not unique and decide over an event: derivatives beyond it are less exact.

Four feet of a box that slides have one normal force more than a rigid body determines, and two points that stick bear
any force along the line between them. Forces of least norm are smooth functions of the scenario while contacts last as
they are. Where a slip ends, or a time step finds the modes of the contacts, the solver's way decides which they are.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.loop.events.table import KINDS, STICK, TANGENTIAL_IMPACT, TIME_STEP
from closedloop.record.report.run_values import shares_at
from closedloop.record.run import Run
from closedloop.scenario.tables import names_of
from closedloop.studies.gradient.guard import AGREE
from closedloop.studies.gradient.outputs import EVENTS, Output

# Events that such forces decide over.
DECIDED = (KINDS[STICK], KINDS[TIME_STEP], KINDS[TANGENTIAL_IMPACT])


# What follows is as exact as the runs beside a run tell, and they scatter by as much.
SHARE_OFF = 2.0 * AGREE


class NotUnique(NamedTuple):
    """The first event over which forces that are not unique decide: its instant, s, and what it is, in words."""

    instant: float
    event: str

    @property
    def problem(self) -> str:
        """What is to be said of derivatives."""
        return (
            f"not smooth at {self.instant:.6g} s ({self.event}): forces of contacts are not unique there; derivatives "
            f"of what follows may be off by {SHARE_OFF:g} of their size"
        )

    def follows(self, output: Output, run: Run) -> NDArray[np.bool_]:
        """Return which entries of an output, flat, are of what a run comes to at the event or later."""
        if not output.column:
            return np.ones(output.of(run).size, dtype=bool)
        column = np.asarray(getattr(run, output.column))
        times = run.event_time if output.column.startswith(EVENTS) else run.time
        late = np.broadcast_to((times >= self.instant).reshape(-1, *(1,) * (column.ndim - 1)), column.shape)
        as_it_is: Any = SimpleNamespace(**{output.column: late})
        return np.ravel(output.read(as_it_is))


def not_unique(run: Run) -> NotUnique | None:
    """Return the first event of a run that forces which are not unique decide over; None if there is none."""
    sections = run.scenario.contact
    if not sections:
        return None
    rubs = np.array([c.compliance is None and (c.friction > 0.0 or c.friction_law is not None) for c in sections])
    seen = set[bytes]()
    for event in run.events:
        if event.contact > 0 and event.kind in DECIDED:
            row = int(np.searchsorted(run.time, event.time, side="right")) - 1
            modes = run.link_modes[row].tobytes()
            if modes not in seen and np.any(shares_at(run, row)[0] & rubs):
                return NotUnique(event.time, f"{event.kind} of {names_of(sections)[event.contact - 1]}")
            seen.add(modes)
    return None
