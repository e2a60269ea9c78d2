"""The loop's entry: `closedloop.loop.events.proceed`, compiled once, with all that it needs at one address.

The Pinocchio engine calls it from Python with the results of Pinocchio's two passes, the compiled engine
(`closedloop.simulation.engines.compiled`) by its address with terms of our own.
"""

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.calls import address_of, fortran_at, integers_at, known_matrix_at, matrix_at, vector_at
from closedloop.jit.kernel import brief_entry, kernel_inlined
from closedloop.loop.events.proceed import proceed
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.loop.step.memory import Loop, loop_at
from closedloop.mechanics.robot.tip import tip_kinematics

# Where Jᵣ, r and J̇ᵣq̇ come from: they are in the loop's memory, or follow from Pinocchio's data.
IN_MEMORY, FROM_PINOCCHIO = range(2)


class Addresses(Block):
    """Addresses and sizes of the arrays of a run: what `proceed_at` takes the address of."""

    H: int
    C: int
    jacobian: int
    rotation: int
    origin: int
    velocity: int
    acceleration: int
    loop: int
    table: int
    tableau: int
    rows: int
    events: int
    n: int
    instants: int
    table_width: int
    row_count: int
    row_width: int
    event_room: int


ADDRESSES = Addresses.count()
VIEWS = 7  # of Pinocchio's data, H and C first


def addresses_of(
    terms: tuple[Array, ...], loop: Loop, table: Array, tableau: Array, rows: Array, events: Array
) -> Addresses:
    """Return the addresses of the arrays of a run, which it keeps.

    `terms`: H (n, n), column after column, and C (n,); for `FROM_PINOCCHIO` the 7 views of
        `closedloop.mechanics.robot.pinocchio.Robot.views`.
    `loop`, `table`, `tableau`, `rows`, `events`: see `proceed`. When `events` is replaced, so must be its address and
        its length; see `set_events`.
    """
    H, _, *more = terms
    for array in (*terms, table, tableau, rows, events):
        columns_first = array is H or any(array is other for other in more[:2])  # Eigen's storage order
        assert array.flags.f_contiguous if columns_first else array.flags.c_contiguous
    sizes = H.shape[0], 0, 0, 0, 0, 0
    missing = (0,) * (VIEWS - len(terms))
    at = (*map(address_of, terms), *missing, loop.address, 0, address_of(tableau), 0, 0)
    addresses = Addresses(np.array([*at, *sizes], dtype=np.int64))
    addresses.keep_alive(terms=terms, loop=loop, tableau=tableau)
    set_rows(addresses, table, rows)
    set_events(addresses, events)
    return addresses


def set_rows(addresses: Addresses, table: Array, rows: Array) -> None:
    """Store the addresses and the sizes of the table of what is desired, and of the rows."""
    addresses.table, addresses.rows = address_of(table), address_of(rows)
    (addresses.instants, addresses.table_width), (addresses.row_count, addresses.row_width) = table.shape, rows.shape
    addresses.keep_alive(table=table, rows=rows)


def set_events(addresses: Addresses, events: Array) -> None:
    """Store the address and the length of the table of events (M, EVENT_WIDTH)."""
    addresses.events, addresses.event_room = address_of(events), events.shape[0]
    addresses.keep_alive(events=events)


@kernel_inlined
def tip_from_pinocchio(a: Addresses) -> None:
    """Write Jᵣ, r and J̇ᵣq̇ from the results of `pinocchio.crba` and `pinocchio.nonLinearEffects` in Pinocchio's data."""
    _, constants, w = loop_at(a.loop)
    link = fortran_at(a.rotation, 3, 3), vector_at(a.origin, 3), vector_at(a.velocity, 6), vector_at(a.acceleration, 6)
    tip_kinematics(
        fortran_at(a.jacobian, 6, a.n), link, constants.tip, constants.gravity, constants.support, w.J, w.r, w.drift
    )


@brief_entry
def proceed_at(address: int, source: int) -> int:
    """Do `proceed` with the arrays of a run, and return its request.

    `address`: of the memory of what `addresses_of` returned.
    `source`: IN_MEMORY or FROM_PINOCCHIO.
    """
    a = Addresses(integers_at(address, ADDRESSES))
    if source == FROM_PINOCCHIO:
        tip_from_pinocchio(a)
    n = a.n
    state, constants, w = loop_at(a.loop)
    stages = state.settings.stages
    return proceed(
        fortran_at(a.H, n, n), vector_at(a.C, n), w, constants, state, matrix_at(a.table, a.instants, a.table_width),
        known_matrix_at(a.tableau, stages + 1, stages), matrix_at(a.rows, a.row_count, a.row_width),
        matrix_at(a.events, a.event_room, EVENT_WIDTH),
    )  # fmt: skip
