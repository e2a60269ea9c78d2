"""The errors that the steps of a run add, from what its signals are from row to row, in each mode of contact.

What they say of a run, and why, is `closedloop.record.report.step_error`, which takes them of whole columns. Both forms
are needed, as of `closedloop.record.report.alternation`; `tests/closedloop/test_measured.py` holds them equal.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.table import Reference
from closedloop.jit.blocks import Block, Count
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import every, select
from closedloop.mechanics.closure.contact_force import FREE

# The error of the force, and the three of the tip's position.
SIGNALS = 4
# Of fewer rows than this in one mode nothing is known of what they resolve.
SPAN = 4
_NO_MODE = -1.0
# Of a kink at a row, what a scheme of order two and more leaves, as a share of what one of order one does: only its
# last stage is evaluated on the other side. That has a sixth of the weight in rk4, which makes a third, and a third
# more is room for kinks that follow each other.
KINK_SHARE = 0.45
# The last stage of a step already has the path, force or law that jumps at its end, with a sixth of the weight in rk4.
# Of a jump at the last row no row shows how fast f decays after it: a sixth of it, where it decays within a step.
ENDING = 1.0 / 6.0


class Swing(Block):
    """What is remembered of a signal."""

    before: float  # the last value, the last two differences, and the last but one cut
    slope: float
    slope_before: float
    cut: float
    turn: float  # the last two changes of a cut difference
    turn_before: float
    turned: float  # of this stretch: the sum of the errors of its steps, and its range
    low: float
    high: float
    error: float  # of the stretches before
    lowest: float  # of all rows
    highest: float


class Swings(Block, sizes=("n",)):
    """What is remembered of a run's signals in the stretch of rows in one mode of contact, and of n joints' torques."""

    mode: float
    counted: float  # of the rows that count
    stretches: float
    steepest: float  # of the force: the largest cut difference, and the most that one was cut by
    jump: float
    ended: float  # the most that the last difference was cut by
    struck: float  # of a sampled law: the largest error of the force in the row with which contact begins
    wanted: float  # the last force asked for, and the most that it changes in a step in which contact begins
    begun: float
    asked: float  # its last two differences from row to row, and the largest cut one
    asked_before: float
    ramp: float
    kick: float  # and the largest change of the torques from sample to sample, summed over the joints
    samples: float
    force: float  # the last, 0 off the surface, and its largest change with which contact begins or ends
    changed: float
    sticks: float  # whether a tip in contact stuck or began to slip
    each: Annotated[Array, SIGNALS, Swing.count()]
    torque: Annotated[Array, Count.of("n")]  # the last, and its last two differences
    turned: Annotated[Array, Count.of("n")]
    turned_before: Annotated[Array, Count.of("n")]


@kernel_inlined
def cut_slope(before: Any, slope: Any, after: Any) -> Any:
    """Return a difference; one that is larger than both of its neighbours is a jump, and the nearer of them counts.

    The nearer by value: of 0, 20, −4, a jump and the decay after it, the jump counts as 0 and not as 4.
    """
    lower, upper = select(before < after, before, after), select(before < after, after, before)
    isolated = (abs(slope) > abs(before)) & (abs(slope) > abs(after))
    return select(isolated, select(slope < 0.0, lower, upper), slope)


@kernel_inlined
def local_error(before: Any, turn: Any, after: Any, order: int) -> Any:
    """Return the error that a step of a scheme of this order adds where a difference changes by `turn`.

    It is half of |turn| with order one. With order p a signal that goes as e^λt adds (hλ)ᵖ⁻¹ of that, or less, where
    hλ is by how much the change itself changes: r, the difference of the changes `before` and `after` from it, over the
    largest of the three. Where r is one and more, at a kink, p counts no more.
    """
    size, first, last = abs(turn), abs(turn - before), abs(after - turn)
    base, beside = select(abs(before) > abs(after), abs(before), abs(after)), select(first > last, first, last)
    base = select(base > size, base, size)
    r = beside / select(base > 0.0, base, 1.0)
    r = select(r > 1.0, 1.0, r)
    error = 0.5 * size
    if order > 1:
        error = KINK_SHARE * error
        for _ in range(order - 1):
            error = error * r
    return error


@kernel_inlined
def begin_swings(swings: Swings) -> None:
    """Write what is remembered of no row."""
    swings.mode, swings.counted, swings.stretches, swings.steepest = _NO_MODE, 0.0, 0.0, 0.0
    swings.jump, swings.struck, swings.kick, swings.samples = 0.0, 0.0, 0.0, 0.0
    swings.wanted = swings.begun = swings.force = swings.changed = swings.sticks = swings.ended = 0.0
    swings.asked = swings.asked_before = swings.ramp = 0.0
    for k in range(SIGNALS):
        swing = Swing(swings.each[k])
        swing.error, swing.lowest, swing.highest = 0.0, np.inf, -np.inf


@kernel_inlined
def count_swings(
    row: Any, wanted: Reference, i: int, held: int, order: int, sampled: int, swings: Swings
) -> None:  # fmt: skip
    """Count row i in; every `held`-th counts, all to the range. In lanes the mode changes in all at once, or never.

    `sampled` is 1 where the law's torque is held for so many rows, and 0 where it is a function of the state.
    """
    if not every(row.mode == swings.mode):
        end_stretch(held, order, swings)
        begins = (swings.mode == FREE) & (row.mode != FREE)
        moved = abs(wanted.force - swings.wanted)
        swings.begun = select(begins & (moved > swings.begun), moved, swings.begun)
        changed = abs(select(row.mode != FREE, row.contact_force, 0.0) - swings.force)
        swings.changed = select((swings.mode >= FREE) & (changed > swings.changed), changed, swings.changed)
        swings.sticks = select((swings.mode > FREE) & (row.mode != FREE), 1.0, swings.sticks)
        if sampled == 1:
            off = abs(row.contact_force - wanted.force)
            swings.struck = select(begins & (off > swings.struck), off, swings.struck)
        swings.mode, swings.counted = row.mode, 0.0
    asked = wanted.force - swings.wanted if i > 0 else 0.0 * wanted.force
    swings.ramp = max(swings.ramp, abs(cut_slope(swings.asked_before, swings.asked, asked)))
    swings.asked_before, swings.asked = swings.asked, asked
    swings.wanted, swings.force = wanted.force, select(row.mode != FREE, row.contact_force, 0.0)
    for k in range(SIGNALS):
        if k == 0:
            x = select(row.mode != FREE, row.contact_force - wanted.force, 0.0)
        else:
            x = row.position[k - 1] - wanted.position[k - 1]
        swing = Swing(swings.each[k])
        swing.lowest, swing.highest = min(swing.lowest, x), max(swing.highest, x)
        if i % held == 0:
            count_swing(x, swings.counted, order, swing)
    if i % held == 0:
        swings.counted += 1.0
        force = Swing(swings.each[0])
        swings.steepest = max(swings.steepest, select(swings.counted > 2.0, abs(force.cut) / held, 0.0))
        cut_by = abs(force.slope_before) - abs(force.cut)
        swings.jump = max(swings.jump, select(swings.counted > 2.0, cut_by, 0.0))
        if sampled == 1:
            count_torques(row, swings)


@kernel_inlined
def count_torques(row: Any, swings: Swings) -> None:
    """Count the torques of a sample in: isolated jumps are cut, and only samples in contact count."""
    kick = 0.0 * row.mode
    for j in range(swings.torque.shape[0]):
        slope = select(swings.samples > 0.0, row.torque[j] - swings.torque[j], 0.0)
        before = select(swings.samples > 2.0, swings.turned_before[j], 0.0)
        kick = kick + abs(cut_slope(before, select(swings.samples > 1.0, swings.turned[j], 0.0), slope))
        swings.turned_before[j], swings.turned[j], swings.torque[j] = swings.turned[j], slope, row.torque[j]
    swings.kick = max(swings.kick, select(row.mode != FREE, kick, 0.0))
    swings.samples += 1.0


@kernel_inlined
def turn_of(cut: Any, swing: Swing, order: int) -> Any:
    """Return by how much the last difference, cut, is another than the one before.

    With order one a jump at a row is exact, and so is what it leaves to decay: the change to it and from it is no error
    of a step. A stage at the end of the step before already has the jump.
    """
    turn = cut - swing.cut
    if order > 1:
        return turn
    return select((cut == swing.slope) & (swing.cut == swing.slope_before), turn, 0.0)


@kernel_inlined
def count_swing(x: float, count: float, order: int, swing: Swing) -> None:
    """Count a value in, before which `count` have been."""
    slope = select(count > 0.0, x - swing.before, 0.0)
    cut = cut_slope(swing.slope_before, swing.slope, slope)
    turn = select(count > 2.0, turn_of(cut, swing, order), 0.0)
    swing.turned = select(count > 2.0, swing.turned, 0.0) + local_error(swing.turn_before, swing.turn, turn, order)
    swing.low = select(count > 0.0, min(swing.low, x), x)
    swing.high = select(count > 0.0, max(swing.high, x), x)
    swing.turn_before, swing.turn = select(count > 0.0, swing.turn, 0.0), turn
    swing.slope_before = select(count > 0.0, swing.slope, 0.0)
    swing.before, swing.slope, swing.cut = x, slope, cut


@kernel_inlined
def end_stretch(held: int, order: int, swings: Swings) -> None:
    """Add what the rows in this mode come to, to the errors."""
    known = swings.counted >= SPAN
    swings.stretches += select(swings.counted > 0.0, 1.0, 0.0)
    for k in range(SIGNALS):
        swing = Swing(swings.each[k])
        last = cut_slope(swing.slope_before, swing.slope, 0.0)
        turn = turn_of(last, swing, order)
        turned = swing.turned + local_error(swing.turn_before, swing.turn, turn, order)
        turned = turned + local_error(swing.turn, turn, 0.0, order)
        swing.error += select(swings.counted > 0.0, select(known, turned, 0.5 * (swing.high - swing.low)) / held, 0.0)
        if k == 0:
            steep = abs(last) + ENDING * (abs(swing.slope) - abs(last))
            swings.steepest = max(swings.steepest, select(swings.counted > 2.0, steep / held, 0.0))
            swings.ended = select(swings.counted > 1.0, abs(swing.slope) - abs(last), 0.0)
            swings.jump = max(swings.jump, swings.ended)
