"""The Pinocchio engine's compiled step: `closedloop.events.proceed` with the results of Pinocchio's two passes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.events.proceed import proceed
from closedloop.events.table import EVENT_WIDTH
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import brief_entry, inlined_kernel
from closedloop.jit.pointers import address_of, fortran_at, integers_at, matrix_at, vector_at
from closedloop.robot.tip import tip_kinematics
from closedloop.step.memory import Loop, loop_at

Array = NDArray[np.float64]


class Addresses(Block):
    """Addresses and sizes of the arrays of a run: the argument of `proceed_on_pinocchio`."""

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


def addresses_of(
    views: tuple[Array, ...], loop: Loop, table: Array, tableau: Array, rows: Array, events: Array
) -> Addresses:
    """Return the addresses of the arrays of a run, which it keeps.

    Parameters
    ----------
    views : tuple of 7 arrays
        See `closedloop.robot.pinocchio.Robot.views` and `closedloop.robot.tip.tip_kinematics`.
    loop, table, tableau, rows, events
        See `proceed`. When `events` is replaced, so must be its address and its length; see `set_events`.
    """
    H, _, jacobian, rotation, *_ = views
    for array in (*views, table, tableau, rows, events):
        columns_first = array is H or array is jacobian or array is rotation  # Eigen's storage order
        assert array.flags.f_contiguous if columns_first else array.flags.c_contiguous
    sizes = (H.shape[0], *table.shape, *rows.shape, 0)
    at = (*map(address_of, views), loop.address, *map(address_of, (table, tableau, rows)), 0)
    addresses = Addresses(np.array([*at, *sizes], dtype=np.int64))
    addresses.keep_alive(views=views, loop=loop, table=table, tableau=tableau, rows=rows)
    set_events(addresses, events)
    return addresses


def set_events(addresses: Addresses, events: Array) -> None:
    """Store the address and the length of the table of events (M, EVENT_WIDTH)."""
    addresses.events, addresses.event_room = address_of(events), events.shape[0]
    addresses.keep_alive(events=events)


@inlined_kernel
def on_pinocchio(address: int, general: int | None) -> int:
    """Do `proceed_on_pinocchio` in one of its two forms."""
    a = Addresses(integers_at(address, ADDRESSES))
    n = a.n
    state, constants, w = loop_at(a.loop)
    tip_kinematics(
        fortran_at(a.jacobian, 6, n), fortran_at(a.rotation, 3, 3), vector_at(a.origin, 3), vector_at(a.velocity, 6),
        vector_at(a.acceleration, 6), constants.tip, constants.gravity, constants.support, w.J, w.r, w.drift,
    )  # fmt: skip
    return proceed(
        fortran_at(a.H, n, n), vector_at(a.C, n), w, constants, state, matrix_at(a.table, a.instants, a.table_width),
        matrix_at(a.tableau, state.stages + 1, state.stages), matrix_at(a.rows, a.row_count, a.row_width),
        matrix_at(a.events, a.event_room, EVENT_WIDTH), general,
    )  # fmt: skip


@brief_entry
def proceed_on_pinocchio(address: int) -> int:
    """Do `proceed` with the results of `pinocchio.crba` and `pinocchio.nonLinearEffects` in Pinocchio's data.

    Parameters
    ----------
    address : int
        Address of the memory of what `addresses_of` returned.
    """
    return on_pinocchio(address, None)


@brief_entry
def proceed_general_on_pinocchio(address: int) -> int:
    """Do the same in the general form: other laws, friction, a force sensor."""
    return on_pinocchio(address, 1)
