"""The table of events: changes of contact, each at its own instant between two rows of the record.

Impulses are events and never part of the contact force.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel

# Kinds, as they are stored.
IMPACT, TOUCHDOWN, LIFTOFF, STICK, SLIP_AGAIN, REVERSAL, EDGE, STOP, RELEASE, TIME_STEP = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10
TANGENTIAL_IMPACT, TIME_STEPPING = 11, 12
KINDS = {
    IMPACT: "impact",
    TOUCHDOWN: "touchdown",
    LIFTOFF: "liftoff",
    STICK: "stick",
    SLIP_AGAIN: "slip",
    REVERSAL: "reversal",
    EDGE: "edge",
    STOP: "stop",
    RELEASE: "release",
    TIME_STEP: "time_step",
    TANGENTIAL_IMPACT: "tangential_impact",
    TIME_STEPPING: "time_stepping_start",
}


class EventRow(Block):
    """An event as a row of the table; its parts are the columns `EVENT_COLUMNS`, without their "event_"."""

    time: float
    kind: float
    rate_before: float
    rate_after: float
    rate_cut: float
    compression: float
    decompression: float
    tangential: Annotated[Array, 3]
    energy_lost: float
    energy_rested: float
    position: Annotated[Array, 3]
    slip_before: float
    slip_after: float
    restitution: float
    contact: float


EVENT_WIDTH = EventRow.count()


class EventColumn(NamedTuple):
    """Dimensions, unit and meaning of a column."""

    dims: tuple[str, ...]
    units: str
    meaning: str


EVENT_COLUMNS: dict[str, EventColumn] = {
    "event_time": EventColumn(("event",), "s", "instant of the event"),
    "event_kind": EventColumn(
        ("event",),
        "1",
        "1 impact (the tip bounces), 2 touchdown (contact begins), 3 liftoff, 4 stick, 5 slip, 6 reversal of slip, "
        "7 edge (the tip goes beyond the surface's edge: contact ends), 8 stop (a joint strikes its stop), 9 release, "
        "10 a time step at the level of impulses, where no modes of the contacts agree, 11 tangential impact (an "
        "impulse stops a slip that pulls the contact in), 12 start of time stepping, where modes change too often",
    ),
    "event_rate_before": EventColumn(("event",), "m s-1", "closure rate just before the event"),
    "event_rate_after": EventColumn(("event",), "m s-1", "closure rate just after the event"),
    "event_rate_cut": EventColumn(
        ("event",), "m s-1", "closure rate that restitution would have given and impact.rest_speed cut to zero"
    ),
    "event_compression": EventColumn(("event",), "N s", "normal impulse of compression on the tip"),
    "event_decompression": EventColumn(("event",), "N s", "normal impulse of decompression on the tip"),
    "event_tangential": EventColumn(("event", "axis"), "N s", "tangential impulse on the tip, base frame"),
    "event_energy_lost": EventColumn(
        ("event",), "J", "kinetic energy lost; at an edge that of the spring of a soft surface"
    ),
    "event_energy_rested": EventColumn(
        ("event",), "J", "part of the energy lost that the rule of rest removed (impact.rest_speed)"
    ),
    "event_position": EventColumn(("event", "axis"), "m", "tip position r, base frame"),
    "event_slip_before": EventColumn(("event",), "m s-1", "speed of slip just before the event"),
    "event_slip_after": EventColumn(("event",), "m s-1", "speed of slip just after the event"),
    "event_restitution": EventColumn(
        ("event",),
        "1",
        "restitution that an impact gave; less than impact.restitution where newton's law would have created energy",
    ),
    "event_contact": EventColumn(
        ("event",),
        "1",
        "which contact it was of: 0 the tip, then the sections [[contact]] in their order, then joints with stops",
    ),
}


@kernel
def write_event(
    row: Array, t: float, kind: int, cut: float, restitution: float, frame: Array, r: Array, before: Array,
    after: Array, compression: Array, decompression: Array, energy_lost: float, energy_rested: float,
) -> None:  # fmt: skip
    """Write one row of the table; velocities and impulses are in the contact frame, r in the base frame."""
    event = EventRow(row)
    event.time, event.kind = t, kind
    event.rate_before, event.rate_after, event.rate_cut = before[0], after[0], cut
    event.compression, event.decompression, event.energy_lost = compression[0], decompression[0], energy_lost
    event.energy_rested = energy_rested
    t1, t2 = compression[1] + decompression[1], compression[2] + decompression[2]
    for k in range(3):
        event.tangential[k] = frame[1, k] * t1 + frame[2, k] * t2
        event.position[k] = r[k]
    event.slip_before = np.hypot(before[1], before[2])
    event.slip_after = np.hypot(after[1], after[2])
    event.restitution, event.contact = restitution, 0.0


WHOLE = ("event_kind", "event_contact")


def event_column(table: Array, name: str) -> NDArray[Any]:
    """Return one of `EVENT_COLUMNS` of the table (N, EVENT_WIDTH)."""
    part = table[:, EventRow.place(name.removeprefix("event_"))]
    return part.astype(np.int8) if name in WHOLE else np.ascontiguousarray(part)


def event_columns(table: Array) -> dict[str, NDArray[Any]]:
    """Return the table (N, EVENT_WIDTH) as named columns."""
    return {name: event_column(table, name) for name in EVENT_COLUMNS}
