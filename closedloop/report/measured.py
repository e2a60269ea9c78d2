"""The values of a run's summary in one compiled pass over its rows.

`closedloop.report.summary` has the same values from the columns of a `Run`, in numpy. A batch of ten thousand runs
makes no columns, and numpy would hold the interpreter's lock.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE, STUCK
from closedloop.events.table import EVENT_COLUMNS, KINDS
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.simd8 import select
from closedloop.report.assumptions import NAMES, NEAR_SINGULAR, RESIDUAL_TOLERANCE
from closedloop.report.joint_values import (
    ALTERNATING,
    JOINT_TALLY,
    JOINT_VALUES,
    SIGNAL_TALLY,
    SIZE,
    begin_joints,
    count_joint,
    count_signal,
    share_of,
    write_joints,
)
from closedloop.report.measures import MEASURES, SETTLED
from closedloop.robot.tree import Tree, tree_potential_energy
from closedloop.step.record_row import SCALARS

Array = NDArray[np.float64]

(
    FINAL_FORCE, PEAK_FORCE, LEAST_FORCE, STABILISER, ERROR, FINAL_ERROR, CLOSURE_SPEED, TIP_SPEED, RESIDUAL, CONDITION,
    MOBILITY, ENERGY, EXCHANGED, DEPTH, CONTACT_TIME, FRICTION, JOINT_FRICTION, RUBBED, STRUCK, RATE_CUT,
    FORCE_RMS, SETTLED_AT, PATH_RMS, MOST_KINETIC, START_ERROR, FORCE_CHATTER,
) = range(len(MEASURES))  # fmt: skip
# After them: how often each kind of event was, and when each assumption first failed, s, NaN if it held.
EVENTS_AT = len(MEASURES)
FAILED_AT = EVENTS_AT + len(KINDS)
WIDTH = FAILED_AT + len(NAMES)
# Then those of each joint, see `closedloop.report.joint_values`.

(
    CONTACT_FORCE, STABILISER_FORCE, CLOSURE_ERROR, CLOSURE_RATE, MODE, MOTION_RESIDUAL, CLOSURE_RESIDUAL,
    KKT_CONDITION, NORMAL_MOBILITY, KINETIC_ENERGY, ENERGY_SUPPLIED,
) = (
    SCALARS.index(name)
    for name in (
        "contact_force", "stabiliser_force", "closure_error", "closure_rate", "mode", "residual_motion",
        "residual_closure", "kkt_condition", "normal_mobility", "kinetic_energy", "energy_supplied",
    )
)  # fmt: skip
EVENT_KIND, EVENT_CUT, EVENT_LOSS = (EVENT_COLUMNS[f"event_{name}"].at for name in ("kind", "rate_cut", "energy_lost"))


# Accumulated over the rows so far.
(
    PEAK, LEAST, LEAST_MOBILITY, LARGEST_SHARE, LARGEST_RESIDUAL, LARGEST_CONDITION, DEEPEST, WORST, FASTEST, IN_JOINTS,
    UNACCOUNTED, WORK_SIZE, RUBBING, FORCE_SQUARES, PATH_SQUARES, TIP_SQUARES, FRICTION_SQUARES, START_ENERGY,
    START_SUPPLIED, DRIVE_BEFORE, FRICTION_BEFORE, TOUCHES, TOUCHED_BEFORE, STEPS_IN_CONTACT, UNSETTLED, KINETIC,
    ERROR_AT_START,
) = range(27)  # fmt: skip
FAILED = 27
SIGNAL = FAILED + len(NAMES)
TALLY = SIGNAL + SIGNAL_TALLY


@kernel
def value_count(n: int) -> int:
    """Return how many values the summary of a run with n joints has."""
    return WIDTH + JOINT_VALUES * n


@kernel
def tally_size(n: int) -> int:
    """Return how many numbers a tally of the rows of a robot of n joints takes."""
    return TALLY + JOINT_TALLY * n


@entry_kernel
def measure_rows(
    tree: Tree, scratch: Array, rows: Array, count: int, table: Array, nodes: int, h: float, frame: Array,
    limits: Array, events: Array, happened: int, tally: Array, out: Array,
) -> None:  # fmt: skip
    """Write the values of a run's summary; those that do not exist are NaN.

    Parameters
    ----------
    tree : Tree
        The robot, for its potential energy.
    scratch : array
        From `closedloop.engines.compiled.compiled_work`.
    rows : (>= count, width) array
        The record, in the order of `closedloop.step.record_row.Row`, of which `count` >= 1 rows are the run's, `h`
        seconds apart.
    table : (P, >= 2 n + 10) array
        What is desired, `nodes` rows to each of the record's, see `closedloop.step.evaluate.reference_row`.
    frame : (3, 3) array
        Contact frame: rows n, t1, t2 in base axes.
    limits : (4, n) array
        See `closedloop.report.joint_values.joint_limits`.
    events : (>= happened, EVENT_WIDTH) array
        See `closedloop.events.table`.
    tally : (>= tally_size(n),) array
        Scratch.
    out : (value_count(n),) array
        Written: `MEASURES` in their order, counts of `KINDS`, when the assumptions first failed, and each of
        `JOINT_MEASURES` for all joints.
    """
    n = tree.n
    largest = 0.0
    for i in range(count):
        largest = max(largest, abs(table[i * nodes, 2 * n + 9]))
    begin_tally(tally, n)
    sines = scratch[n * n + n :]  # what the terms leave there, and more
    for i in range(count):
        potential = tree_potential_energy(tree, rows[i, 0:n], sines)
        count_row(rows[i], potential, table[i * nodes], i, h, frame, limits, largest, tally)
        count_condition(rows[i], tally)
    write_values(rows[count - 1, 5 * n + 9 :], n, count, h, largest, tally, out)
    for i in range(happened):
        out[STRUCK] += events[i, EVENT_LOSS]
        out[RATE_CUT] = max(out[RATE_CUT], events[i, EVENT_CUT])
        out[EVENTS_AT + int(events[i, EVENT_KIND]) - 1] += 1.0


@kernel
def begin_tally(tally: Array, n: int) -> None:
    """Write the tally (>= tally_size(n),) of no row of a robot of n joints."""
    for i in range(TALLY):
        tally[i] = math.nan if FAILED <= i < SIGNAL else 0.0
    begin_joints(tally[TALLY:], n)
    tally[PEAK], tally[LEAST], tally[LEAST_MOBILITY] = -math.inf, math.inf, math.inf
    tally[UNSETTLED] = -1.0


@kernel_inlined
def count_row(
    row: Array, potential: float, wanted: Array, i: int, h: float, frame: Array, limits: Array, largest: float,
    tally: Array,
) -> None:  # fmt: skip
    """Count row i in, all but its condition number.

    Parameters
    ----------
    row, wanted : (width,), (>= 2 n + 10,) arrays
        The row, and what is desired at its instant.
    potential : float
        Potential energy, J.
    h, frame, limits
        See `measure_rows`.
    largest : float
        Largest |f_des| of the run, N.
    tally : (TALLY,) array
        Changed.
    """
    n, t = (row.shape[0] - len(SCALARS) - 9) // 5, tally
    tip, scalars = 4 * n, 5 * n + 9
    force, error, rate = row[scalars + CONTACT_FORCE], row[scalars + CLOSURE_ERROR], row[scalars + CLOSURE_RATE]
    mode, motion = row[scalars + MODE], row[scalars + MOTION_RESIDUAL]
    closed, mobility = row[scalars + CLOSURE_RESIDUAL], row[scalars + NORMAL_MOBILITY]
    t[PEAK], t[LEAST] = max(t[PEAK], force), min(t[LEAST], force)
    t[LEAST_MOBILITY] = min(t[LEAST_MOBILITY], mobility)
    t[LARGEST_SHARE] = max(t[LARGEST_SHARE], abs(row[scalars + STABILISER_FORCE]))
    t[LARGEST_RESIDUAL] = max(max(t[LARGEST_RESIDUAL], motion), closed)
    t[DEEPEST] = max(t[DEEPEST], -error)

    touching = mode != FREE
    miss = force - wanted[2 * n + 9]
    t[UNSETTLED] = select(abs(miss) > SETTLED * largest, 1.0 * i, t[UNSETTLED])
    t[STEPS_IN_CONTACT] += t[TOUCHED_BEFORE]
    t[TOUCHED_BEFORE] = select(touching, 1.0, 0.0)
    t[TOUCHES] += t[TOUCHED_BEFORE]
    t[FORCE_SQUARES] += select(touching, miss * miss, 0.0)
    t[WORST] = max(t[WORST], select(touching, abs(error), 0.0))
    t[FASTEST] = max(t[FASTEST], select(touching, abs(rate), 0.0))
    for axis in range(1, 3):
        off = -wanted[2 * n + axis]
        for k in range(3):
            off += frame[axis, k] * row[tip + k]
        t[PATH_SQUARES] += off * off

    drive = joint_power = most = 0.0
    for j in range(n):
        drive += row[3 * n + j] * row[n + j]
        joint_power += row[tip + 9 + j] * row[n + j]
        most = max(most, abs(row[tip + 9 + j]))
        at = TALLY + JOINT_TALLY * j
        count_joint(row[j], row[n + j], row[3 * n + j], j, i, h, limits, t[at : at + JOINT_TALLY])
    count_signal(force, i, t[SIGNAL:TALLY])
    friction = speed = rubbing = 0.0
    for k in range(3):
        friction += row[tip + 6 + k] * row[tip + 6 + k]
        speed += row[tip + 3 + k] * row[tip + 3 + k]
        rubbing += row[tip + 6 + k] * row[tip + 3 + k]
    friction_power = rubbing + joint_power
    t[TIP_SQUARES], t[FRICTION_SQUARES] = max(t[TIP_SQUARES], speed), max(t[FRICTION_SQUARES], friction)
    t[IN_JOINTS] = max(t[IN_JOINTS], most)

    energy, supplied = row[scalars + KINETIC_ENERGY] + potential, row[scalars + ENERGY_SUPPLIED]
    t[KINETIC] = max(t[KINETIC], row[scalars + KINETIC_ENERGY])
    if i == 0:
        t[START_ENERGY], t[START_SUPPLIED] = energy, supplied
        t[ERROR_AT_START] = select(touching, error, 0.0)
    else:
        dt = h * i - h * (i - 1)
        t[WORK_SIZE] += 0.5 * (abs(drive) + abs(t[DRIVE_BEFORE])) * dt
        t[RUBBING] += 0.5 * (friction_power + t[FRICTION_BEFORE]) * dt
    t[UNACCOUNTED] = max(t[UNACCOUNTED], abs(energy - t[START_ENERGY] - (supplied - t[START_SUPPLIED])))
    t[DRIVE_BEFORE], t[FRICTION_BEFORE] = drive, friction_power

    met = motion <= RESIDUAL_TOLERANCE
    held = (
        (closed <= RESIDUAL_TOLERANCE) & (mode != STUCK),
        met,
        (force > 0.0) & touching,
        met & (friction == 0.0) & (most == 0.0),
        mobility > NEAR_SINGULAR,
    )
    for a in range(5):
        failed = t[FAILED + a]
        t[FAILED + a] = select(held[a] | (failed == failed), failed, h * i)


@kernel_inlined
def count_condition(row: Array, tally: Array) -> None:
    """Count a row's condition number in."""
    condition = row[row.shape[0] - len(SCALARS) + KKT_CONDITION]
    tally[LARGEST_CONDITION] = max(tally[LARGEST_CONDITION], condition)


@kernel
def write_values(last: Array, n: int, count: int, h: float, largest: float, tally: Array, out: Array) -> None:
    """Write the values `out` (value_count(n),) of `count` rows with this tally; `last` are the last row's scalars."""
    t = tally
    for i in range(WIDTH):
        out[i] = 0.0 if i < FAILED_AT else t[FAILED + i - FAILED_AT]
    out[FINAL_FORCE], out[FINAL_ERROR] = last[CONTACT_FORCE], last[CLOSURE_ERROR]
    out[PEAK_FORCE], out[LEAST_FORCE], out[MOBILITY] = t[PEAK], t[LEAST], t[LEAST_MOBILITY]
    out[STABILISER], out[RESIDUAL], out[CONDITION] = t[LARGEST_SHARE], t[LARGEST_RESIDUAL], t[LARGEST_CONDITION]
    out[ERROR], out[CLOSURE_SPEED], out[DEPTH] = t[WORST], t[FASTEST], t[DEEPEST]
    out[JOINT_FRICTION], out[ENERGY] = t[IN_JOINTS], t[UNACCOUNTED]
    out[TIP_SPEED], out[FRICTION] = math.sqrt(t[TIP_SQUARES]), math.sqrt(t[FRICTION_SQUARES])
    out[CONTACT_TIME], out[EXCHANGED], out[RUBBED] = h * t[STEPS_IN_CONTACT], t[WORK_SIZE], -t[RUBBING]
    touches = select(t[TOUCHES] > 0.0, t[TOUCHES], math.nan)
    out[FORCE_RMS] = math.sqrt(t[FORCE_SQUARES] / touches)
    settles = (largest > 0.0) & (t[UNSETTLED] < count - 1)
    out[SETTLED_AT] = select(settles, h * (t[UNSETTLED] + 1), math.nan)
    out[PATH_RMS] = math.sqrt(t[PATH_SQUARES] / count)
    out[MOST_KINETIC], out[START_ERROR] = t[KINETIC], t[ERROR_AT_START]
    out[FORCE_CHATTER] = share_of(t[SIGNAL + ALTERNATING], t[SIGNAL + SIZE])
    write_joints(t[TALLY:], n, out[WIDTH:])
