"""The Pinocchio engine's compiled step: `closedloop.events.proceed` on what Pinocchio's two passes left behind."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.events.phases import extra_states
from closedloop.events.proceed import proceed
from closedloop.events.table import EVENT_WIDTH
from closedloop.jit.kernel import brief_entry, inlined_kernel
from closedloop.jit.pointers import address_of, fortran_at, matrix_at, vector_at, whole_at
from closedloop.robot.tip import tip_kinematics
from closedloop.step.memory import Constants, State, Whole, Work

Array = NDArray[np.float64]

# What `proceed_on_pinocchio` is told, by place in one block of whole numbers: the addresses of all arrays, and sizes.
(
    AT_H, AT_C, AT_JACOBIAN, AT_ROTATION, AT_ORIGIN, AT_VELOCITY, AT_ACCELERATION,
    AT_CONSTANTS, AT_STATE, AT_WORK, AT_TABLE, AT_TABLEAU, AT_ROWS, AT_EVENTS,
    SIZE_N, SIZE_CONSTANTS, SIZE_STATE, SIZE_WORK, INSTANTS, WANTED_WIDTH, ROWS, ROW_WIDTH, EVENT_ROOM,
) = range(23)  # fmt: skip
PLACES = 23


def places_of(
    views: tuple[Array, ...], constants: Constants, state: State, w: Work, table: Array, tableau: Array, rows: Array,
    events: Array,
) -> Whole:  # fmt: skip
    """Write down where the arrays of a run are: for `proceed_on_pinocchio`, as long as they all are kept.

    Parameters
    ----------
    views : tuple of 7 arrays
        See `closedloop.robot.pinocchio.Robot.views` and `closedloop.robot.tip.tip_kinematics`.
    constants, state, w, table, tableau, rows, events
        See `proceed`. When `events` is replaced, so must be its address and its length, EVENT_ROOM.
    """
    H, jacobian, rotation = views[0], views[2], views[3]
    arrays = (*views, constants.memory, state.memory, w.memory, table, tableau, rows, events)
    for array in arrays:
        columns_first = array is H or array is jacobian or array is rotation  # as Eigen has them
        assert array.flags.f_contiguous if columns_first else array.flags.c_contiguous
    blocks = (constants.memory.size, state.memory.size, w.memory.size)
    sizes = (H.shape[0], *blocks, *table.shape, *rows.shape, events.shape[0])
    return np.array([*(address_of(x) for x in arrays), *sizes], dtype=np.int64)


@inlined_kernel
def on_pinocchio(n: int, places: int, more: int | None) -> int:
    """Do `proceed_on_pinocchio` for n joints."""
    a = whole_at(places, PLACES)
    constants = Constants(vector_at(a[AT_CONSTANTS], a[SIZE_CONSTANTS]), n)
    state = State(whole_at(a[AT_STATE], a[SIZE_STATE]))
    memory = vector_at(a[AT_WORK], a[SIZE_WORK])
    w = Work(memory, n, extra_states(state, n), state.stages, state.sensor_ring)
    tip_kinematics(
        fortran_at(a[AT_JACOBIAN], 6, n), fortran_at(a[AT_ROTATION], 3, 3), vector_at(a[AT_ORIGIN], 3),
        vector_at(a[AT_VELOCITY], 6), vector_at(a[AT_ACCELERATION], 6),
        constants.tip, constants.gravity, constants.support, w.J, w.r, w.drift,
    )  # fmt: skip
    return proceed(
        fortran_at(a[AT_H], n, n), vector_at(a[AT_C], n), w, constants, state,
        matrix_at(a[AT_TABLE], a[INSTANTS], a[WANTED_WIDTH]),
        matrix_at(a[AT_TABLEAU], state.stages + 1, state.stages),
        matrix_at(a[AT_ROWS], a[ROWS], a[ROW_WIDTH]), matrix_at(a[AT_EVENTS], a[EVENT_ROOM], EVENT_WIDTH), more,
    )  # fmt: skip


@brief_entry
def proceed_on_pinocchio(places: int) -> int:
    """Do `proceed` on what `pinocchio.crba` and `pinocchio.nonLinearEffects` left in their data.

    Parameters
    ----------
    places : int
        Address of what `places_of` returned.
    """
    return on_pinocchio(whole_at(places, PLACES)[SIZE_N], places, None)


@brief_entry
def proceed_with_more_on_pinocchio(places: int) -> int:
    """Do the same with everything that may come on top: other laws, friction, a force sensor."""
    return on_pinocchio(whole_at(places, PLACES)[SIZE_N], places, 1)
