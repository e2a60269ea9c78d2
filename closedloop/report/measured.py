"""The figures of a run's summary in one compiled pass over its rows.

`closedloop.report.summary` has the same figures from the columns of a `Run`, in numpy. A batch of ten thousand runs
makes no columns, and numpy would hold the interpreter's lock.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import entry_kernel
from closedloop.contact import FREE, STUCK
from closedloop.events import EVENT_COLUMNS, KINDS
from closedloop.report.assumptions import NAMES, NEAR_SINGULAR, RESIDUAL_TOLERANCE
from closedloop.report.measures import MEASURES, SETTLED
from closedloop.step import SCALARS
from closedloop.tree import Tree, tree_potential_energy

Array = NDArray[np.float64]

(
    FINAL_FORCE, PEAK_FORCE, LEAST_FORCE, STABILISER, ERROR, FINAL_ERROR, CLOSURE_SPEED, TIP_SPEED, RESIDUAL, CONDITION,
    MOBILITY, ENERGY, EXCHANGED, DEPTH, CONTACT_TIME, FRICTION, JOINT_FRICTION, RUBBED, STRUCK, RATE_CUT,
    FORCE_RMS, SETTLED_AT, PATH_RMS,
) = range(len(MEASURES))  # fmt: skip
# After them: how often each kind of event was, and when each assumption first failed, s, NaN if it held.
EVENTS_AT = len(MEASURES)
FAILED_AT = EVENTS_AT + len(KINDS)
WIDTH = FAILED_AT + len(NAMES)

(
    CONTACT_FORCE, STABILISER_FORCE, CLOSURE_ERROR, CLOSURE_RATE, MODE, MOTION_RESIDUAL, CLOSURE_RESIDUAL,
    KKT_CONDITION, NORMAL_MOBILITY, KINETIC_ENERGY,
) = (
    SCALARS.index(name)
    for name in (
        "contact_force", "stabiliser_force", "closure_error", "closure_rate", "mode", "residual_motion",
        "residual_closure", "kkt_condition", "normal_mobility", "kinetic_energy",
    )
)  # fmt: skip
EVENT_TIME, EVENT_KIND, EVENT_CUT, EVENT_LOSS = (
    EVENT_COLUMNS[f"event_{name}"].at for name in ("time", "kind", "rate_cut", "energy_lost")
)


@entry_kernel
def measure_rows(
    tree: Tree, scratch: Array, rows: Array, count: int, table: Array, nodes: int, h: float, frame: Array,
    events: Array, happened: int, out: Array,
) -> None:  # fmt: skip
    """Write the figures of a run; those that do not exist are NaN.

    Parameters
    ----------
    tree : Tree
        The robot, for its potential energy.
    scratch : array
        From `closedloop.compiled_engine.compiled_work`.
    rows : (>= count, width) array
        The record, in the order of `closedloop.step.Row`, of which `count` >= 1 rows are the run's, `h` seconds apart.
    table : (P, >= 2 n + 10) array
        What is desired, `nodes` rows to each of the record's, see `closedloop.step.reference_row`.
    frame : (3, 3) array
        Contact frame: rows n, t1, t2 in base axes.
    events : (>= happened, EVENT_WIDTH) array
        See `closedloop.events`.
    out : (WIDTH,) array
        Written: `MEASURES` in their order, counts of `KINDS`, and when the assumptions first failed.
    """
    n = tree.n
    sines = scratch[n * n + n :]  # what the terms leave there, and more
    tip, scalars = 4 * n, 5 * n + 9
    for i in range(WIDTH):
        out[i] = 0.0 if i < FAILED_AT else math.nan
    # What is written to `out` at once would be written at every row: locals stay in registers.
    peak, least, least_mobility = -math.inf, math.inf, math.inf
    stabiliser = residual = condition = depth = worst = fastest = in_joints = unaccounted = 0.0
    largest = 0.0
    for i in range(count):
        largest = max(largest, abs(table[i * nodes, 2 * n + 9]))
    start = work = exchanged = rubbed = lost = before = power_before = friction_before = 0.0
    force_squares = path_squares = tip_squares = friction_squares = 0.0
    touches, in_contact, unsettled, event = 0, 0, -1, 0
    for i in range(count):
        row = rows[i]
        force, error, rate = row[scalars + CONTACT_FORCE], row[scalars + CLOSURE_ERROR], row[scalars + CLOSURE_RATE]
        mode, motion = row[scalars + MODE], row[scalars + MOTION_RESIDUAL]
        mobility = row[scalars + NORMAL_MOBILITY]
        touching = mode != FREE
        peak, least, least_mobility = max(peak, force), min(least, force), min(least_mobility, mobility)
        stabiliser = max(stabiliser, abs(row[scalars + STABILISER_FORCE]))
        residual = max(residual, motion, row[scalars + CLOSURE_RESIDUAL])
        condition = max(condition, row[scalars + KKT_CONDITION])
        depth = max(depth, -error)

        wanted = table[i * nodes]
        miss = force - wanted[2 * n + 9]
        if abs(miss) > SETTLED * largest:
            unsettled = i
        if touching:
            touches += 1
            in_contact += 1 if i < count - 1 else 0
            force_squares += miss * miss
            worst, fastest = max(worst, abs(error)), max(fastest, abs(rate))
        for t in range(1, 3):
            off = -wanted[2 * n + t]
            for k in range(3):
                off += frame[t, k] * row[tip + k]
            path_squares += off * off

        power = joint_power = most = 0.0
        for j in range(n):
            power += row[3 * n + j] * row[n + j]
            joint_power += row[tip + 9 + j] * row[n + j]
            most = max(most, abs(row[tip + 9 + j]))
        friction = speed = rubbing = 0.0
        for k in range(3):
            friction += row[tip + 6 + k] * row[tip + 6 + k]
            speed += row[tip + 3 + k] * row[tip + 3 + k]
            rubbing += row[tip + 6 + k] * row[tip + 3 + k]
        friction_power = rubbing + joint_power
        total = power + (force * rate + friction_power)
        tip_squares, friction_squares = max(tip_squares, speed), max(friction_squares, friction)
        in_joints = max(in_joints, most)

        energy = row[scalars + KINETIC_ENERGY] + tree_potential_energy(tree, row[0:n], sines)
        if i == 0:
            start = energy
        else:
            dt = h * i - h * (i - 1)
            work += 0.5 * (total + before) * dt
            exchanged += 0.5 * (abs(power) + abs(power_before)) * dt
            rubbed += 0.5 * (friction_power + friction_before) * dt
        while event < happened and events[event, EVENT_TIME] <= h * i:
            lost += events[event, EVENT_LOSS]
            event += 1
        unaccounted = max(unaccounted, abs(energy - start - (work - lost)))
        before, power_before, friction_before = total, power, friction_power

        met = motion <= RESIDUAL_TOLERANCE
        one_row = row[scalars + CLOSURE_RESIDUAL] <= RESIDUAL_TOLERANCE and mode != STUCK
        held = (
            one_row, met, force > 0.0 and touching, met and friction == 0.0 and most == 0.0, mobility > NEAR_SINGULAR
        )  # fmt: skip
        for a in range(5):
            if not held[a] and math.isnan(out[FAILED_AT + a]):
                out[FAILED_AT + a] = h * i

    last = rows[count - 1]
    out[FINAL_FORCE], out[PEAK_FORCE], out[LEAST_FORCE] = last[scalars + CONTACT_FORCE], peak, least
    out[STABILISER], out[RESIDUAL], out[CONDITION], out[MOBILITY] = stabiliser, residual, condition, least_mobility
    out[ERROR], out[FINAL_ERROR], out[CLOSURE_SPEED] = worst, last[scalars + CLOSURE_ERROR], fastest
    out[DEPTH], out[JOINT_FRICTION], out[ENERGY] = depth, in_joints, unaccounted
    out[TIP_SPEED], out[FRICTION] = math.sqrt(tip_squares), math.sqrt(friction_squares)
    out[CONTACT_TIME], out[EXCHANGED], out[RUBBED] = h * in_contact, exchanged, -rubbed
    for i in range(happened):
        out[STRUCK] += events[i, EVENT_LOSS]
        out[RATE_CUT] = max(out[RATE_CUT], events[i, EVENT_CUT])
        out[EVENTS_AT + int(events[i, EVENT_KIND]) - 1] += 1.0
    out[FORCE_RMS] = math.sqrt(force_squares / touches) if touches > 0 else math.nan
    out[SETTLED_AT] = h * (unsettled + 1) if largest > 0.0 and unsettled < count - 1 else math.nan
    out[PATH_RMS] = math.sqrt(path_squares / count)
