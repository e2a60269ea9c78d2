"""The table of events: changes of contact, each at its own instant between two rows of the record.

Impulses are events and never part of the contact force.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]

# Kinds, as they are stored.
IMPACT, TOUCHDOWN, LIFTOFF, STICK, SLIP_AGAIN, REVERSAL = 1, 2, 3, 4, 5, 6
KINDS = {
    IMPACT: "impact",
    TOUCHDOWN: "touchdown",
    LIFTOFF: "liftoff",
    STICK: "stick",
    SLIP_AGAIN: "slip",
    REVERSAL: "reversal",
}


class EventColumn(NamedTuple):
    """Dimensions, unit, meaning, and where the column begins in a row of the table."""

    dims: tuple[str, ...]
    units: str
    meaning: str
    at: int


EVENT_COLUMNS: dict[str, EventColumn] = {
    "event_time": EventColumn(("event",), "s", "instant of the event", 0),
    "event_kind": EventColumn(
        ("event",),
        "1",
        "1 impact (the tip bounces), 2 touchdown (contact begins), 3 liftoff, 4 stick, 5 slip, 6 reversal of slip",
        1,
    ),
    "event_rate_before": EventColumn(("event",), "m s-1", "closure rate just before the event", 2),
    "event_rate_after": EventColumn(("event",), "m s-1", "closure rate just after the event", 3),
    "event_rate_cut": EventColumn(
        ("event",),
        "m s-1",
        "closure rate that restitution would have given and impact.rest_speed cut to zero",
        4,
    ),
    "event_compression": EventColumn(("event",), "N s", "normal impulse of compression on the tip", 5),
    "event_decompression": EventColumn(("event",), "N s", "normal impulse of decompression on the tip", 6),
    "event_tangential": EventColumn(("event", "axis"), "N s", "tangential impulse on the tip, base frame", 7),
    "event_energy_lost": EventColumn(("event",), "J", "kinetic energy lost", 10),
    "event_position": EventColumn(("event", "axis"), "m", "tip position r, base frame", 11),
    "event_slip_before": EventColumn(("event",), "m s-1", "speed of slip just before the event", 14),
    "event_slip_after": EventColumn(("event",), "m s-1", "speed of slip just after the event", 15),
    "event_restitution": EventColumn(
        ("event",),
        "1",
        "restitution that an impact gave; less than impact.restitution where newton's law would have created energy",
        16,
    ),
}
EVENT_WIDTH = 17


@kernel
def write_event(
    row: Array, t: float, kind: int, cut: float, restitution: float, frame: Array, r: Array, before: Array,
    after: Array, compression: Array, decompression: Array, energy_lost: float,
) -> None:  # fmt: skip
    """Write one row of the table; velocities and impulses are in the contact frame, r in the base frame."""
    row[0], row[1], row[2], row[3], row[4] = t, kind, before[0], after[0], cut
    row[5], row[6], row[10] = compression[0], decompression[0], energy_lost
    t1, t2 = compression[1] + decompression[1], compression[2] + decompression[2]
    for k in range(3):
        row[7 + k] = frame[1, k] * t1 + frame[2, k] * t2
        row[11 + k] = r[k]
    row[14] = np.hypot(before[1], before[2])
    row[15] = np.hypot(after[1], after[2])
    row[16] = restitution


def event_columns(table: Array) -> dict[str, NDArray[Any]]:
    """Return the table (N, EVENT_WIDTH) as named columns."""
    columns: dict[str, NDArray[Any]] = {}
    for name, spec in EVENT_COLUMNS.items():
        wide = len(spec.dims) == 2
        part = table[:, spec.at : spec.at + 3] if wide else table[:, spec.at]
        columns[name] = part.astype(np.int8) if name == "event_kind" else np.ascontiguousarray(part)
    return columns
