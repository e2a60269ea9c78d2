"""How much of a signal alternates from row to row: chatter.

What alternates is the part x_i = ... + (−1)^i a: its second differences are 4 a and change their sign from row to row,
so a quarter of the smaller of two neighbours is taken wherever they differ in sign.

Both forms are needed: a batch has one row at a time, of one run or of eight; a `Run` has columns, and interpreted the
loop would take a thousand times as long. `tests/closedloop/record/test_measured.py` holds them equal.
"""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.simd8 import select

# An alternation is seen in so many values.
SPAN = 4


class Signal(Block):
    """What is remembered of a signal whose values are counted one by one."""

    before: float  # last value, difference and second difference
    slope: float
    turn: float
    alternating: float  # the sum of what alternates


@kernel_inlined
def count_signal(x: float, i: int, signal: Signal) -> None:
    """Count the value that a signal has in row i."""
    slope = x - signal.before
    turn = slope - signal.slope
    if i >= SPAN - 1:  # the first has no difference, the second no second one, the third none before it
        smaller = min(abs(turn), abs(signal.turn))
        signal.alternating += select(turn * signal.turn < 0.0, 0.25 * smaller, 0.0)
    signal.before, signal.slope, signal.turn = x, slope, turn


def alternation(signal: Array) -> Array:
    """Return how much of each column (N, n) alternates, summed over the rows, (n,)."""
    turn = np.diff(signal, 2, axis=0)
    alternates = turn[1:] * turn[:-1] < 0.0
    amplitude: Array = 0.25 * np.minimum(np.abs(turn[1:]), np.abs(turn[:-1]))
    total: Array = np.sum(amplitude, axis=0, where=alternates)
    return total
