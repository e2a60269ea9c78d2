"""Where the forces of several contacts are not unique and decide over an event: derivatives beyond it are less exact.

Four feet of a box that slides have one normal force more than a rigid body determines, and two points that stick bear
any force along the line between them. Forces of least norm are smooth functions of the scenario while contacts last as
they are. Where a slip ends, or a time step finds the modes of the contacts, the solver's way decides which they are.
"""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.loop.events.table import KINDS, STICK, TIME_STEP
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.record.run import Run
from closedloop.scenario.contact_names import names_of
from closedloop.studies.gradient.guard import AGREE
from closedloop.studies.gradient.outputs import EVENTS, Output

# Of two rigid bodies the normal forces of so many sliding points are unique, and of so many that stick all forces.
SLIDING, STICKING = 3, 1
# Events that such forces decide over.
DECIDED = (KINDS[STICK], KINDS[TIME_STEP])


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
    for event in run.events:
        if event.contact > 0 and event.kind in DECIDED:
            row = int(np.searchsorted(run.time, event.time, side="right")) - 1
            slides: Counter[Any] = Counter()
            sticks: Counter[Any] = Counter()
            for section, mode in zip(sections, run.link_modes[row], strict=True):
                if mode != FREE and _rubs(section):
                    (sticks if mode == STUCK else slides)[section.link, section.against] += 1
            pairs = slides.keys() | sticks.keys()
            if any(slides[pair] > SLIDING or sticks[pair] > STICKING for pair in pairs):
                return NotUnique(event.time, f"{event.kind} of {names_of(sections)[event.contact - 1]}")
    return None


def _rubs(section: Any) -> bool:
    """Whether a contact is rigid and has friction."""
    return section.compliance is None and (section.friction > 0.0 or section.friction_law is not None)
