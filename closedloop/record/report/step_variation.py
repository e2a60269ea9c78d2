"""Half of the total variation of a signal's first difference, row by row, in each mode of contact: the error of a step.

What it says of a run, and why, is `closedloop.record.report.step_error`, which takes it of whole columns. Both forms
are needed, as of `closedloop.record.report.alternation`; `tests/closedloop/test_measured.py` holds them equal.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import every, select
from closedloop.loop.step.memory import Reference
from closedloop.mechanics.closure.contact_force import FREE

Array = NDArray[np.float64]

# The error of the force, and the three of the tip's position.
SIGNALS = 4
# Of fewer rows than this in one mode nothing is known of what they resolve.
SPAN = 4
_NO_MODE = -1.0


class Swing(Block):
    """What is remembered of a signal."""

    before: float  # the last value, the last two differences, and the last but one cut
    slope: float
    slope_before: float
    cut: float
    turned: float  # of this stretch: the sum of what the cut differences change by, and its range
    low: float
    high: float
    error: float  # of the stretches before
    lowest: float  # of all rows
    highest: float


class Swings(Block):
    """What is remembered of a run's signals in the stretch of rows in one mode of contact."""

    mode: float
    counted: float  # of the rows that count
    each: Annotated[Array, SIGNALS, Swing.count()]


@kernel_inlined
def cut_slope(before: Any, slope: Any, after: Any) -> Any:
    """Return a difference that counts with no more than the larger of its neighbours: what is isolated is a jump."""
    beside = select(abs(before) > abs(after), abs(before), abs(after))
    size = select(abs(slope) < beside, abs(slope), beside)
    return select(slope < 0.0, -size, size)


@kernel_inlined
def begin_swings(swings: Swings) -> None:
    """Write what is remembered of no row."""
    swings.mode, swings.counted = _NO_MODE, 0.0
    for k in range(SIGNALS):
        swing = Swing(swings.each[k])
        swing.error, swing.lowest, swing.highest = 0.0, np.inf, -np.inf


@kernel_inlined
def count_swings(row: Any, wanted: Reference, i: int, held: int, swings: Swings) -> None:
    """Count row i in; every `held`-th counts, all to the range. In lanes the mode changes in all at once, or never."""
    if not every(row.mode == swings.mode):
        end_stretch(held, swings)
        swings.mode, swings.counted = row.mode, 0.0
    for k in range(SIGNALS):
        if k == 0:
            x = select(row.mode != FREE, row.contact_force - wanted.force, 0.0)
        else:
            x = row.position[k - 1] - wanted.position[k - 1]
        swing = Swing(swings.each[k])
        swing.lowest, swing.highest = min(swing.lowest, x), max(swing.highest, x)
        if i % held == 0:
            count_swing(x, swings.counted, swing)
    if i % held == 0:
        swings.counted += 1.0


@kernel_inlined
def count_swing(x: float, count: float, swing: Swing) -> None:
    """Count a value in, before which `count` have been."""
    slope = select(count > 0.0, x - swing.before, 0.0)
    cut = cut_slope(swing.slope_before, swing.slope, slope)
    swing.turned = select(count > 2.0, swing.turned + abs(cut - swing.cut), 0.0)
    swing.low = select(count > 0.0, min(swing.low, x), x)
    swing.high = select(count > 0.0, max(swing.high, x), x)
    swing.slope_before = select(count > 0.0, swing.slope, 0.0)
    swing.before, swing.slope, swing.cut = x, slope, cut


@kernel_inlined
def end_stretch(held: int, swings: Swings) -> None:
    """Add what the rows in this mode come to, to the errors."""
    for k in range(SIGNALS):
        swing = Swing(swings.each[k])
        last = cut_slope(swing.slope_before, swing.slope, 0.0)
        turned = swing.turned + abs(last - swing.cut)
        known = select(swings.counted >= SPAN, turned, swing.high - swing.low)
        swing.error += select(swings.counted > 0.0, 0.5 * known / held, 0.0)
