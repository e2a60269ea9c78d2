"""The events of a run, one by one, from the columns that have them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.loop.events.table import EVENT_COLUMNS, KINDS


class Event(NamedTuple):
    """One event of the contact: an impact, the beginning or the end of contact, of sticking or of slip.

    Attributes
    ----------
    time : float
        Instant, s.
    kind : str
        "impact", "touchdown", "liftoff", "stick", "slip", "reversal", "edge", "stop", "release", "time_step" or
        "tangential_impact".
    rate_before, rate_after : float
        Rate of the closure error just before and just after it, m/s.
    rate_cut : float
        Rate of a bounce that `impact.rest_speed` turned into contact, m/s.
    compression, decompression : float
        Impulses of both phases on the tip along the normal, N s.
    tangential : (3,) array
        Impulse on the tip along the surface, N s, base frame.
    energy_lost : float
        Kinetic energy lost, J; at an edge the energy of the spring of a soft surface.
    energy_rested : float
        Part of `energy_lost` that was removed so that a contact which separates too slowly comes to rest, J.
    position : (3,) array
        Where the tip is, m, base frame.
    slip_before, slip_after : float
        Speed of the tip along the surface, m/s.
    restitution : float
        Coefficient of restitution of an impact: `impact.restitution`, or less where Newton's law would have created
        energy. It is 0 for all other events.
    contact : int
        Number of the contact: 0 is the tip; the scenario's sections [[contact]] follow in their order, and then the
        joints that have stops.
    """

    time: float
    kind: str
    rate_before: float
    rate_after: float
    rate_cut: float
    compression: float
    decompression: float
    tangential: Array
    energy_lost: float
    energy_rested: float
    position: Array
    slip_before: float
    slip_after: float
    restitution: float
    contact: int = 0


def events_of(columns: Mapping[str, NDArray[Any]]) -> tuple[Event, ...]:
    """Return the events of columns that have those of `EVENT_COLUMNS`, in order of time."""
    parts = [columns[name] for name in EVENT_COLUMNS]
    rows = zip(*(part if part.ndim == 2 else part.tolist() for part in parts), strict=True)
    return tuple(Event(row[0], KINDS[row[1]], *row[2:]) for row in rows)
