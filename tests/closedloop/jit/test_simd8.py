"""float64x8: every operation gives each of the eight what it gives a float, to the last bit."""

import math
from functools import cache

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError

from closedloop.jit.calls import address_of
from closedloop.jit.inside.simd8 import float64x8_at, lane, lane_at, put_at, with_lane
from closedloop.jit.simd8 import WIDE, aligned, every, nearest, select

compiled = numba.njit(error_model="numpy")
TRICKY = [0.0, -0.0, 1.0, -1.5, 1e308, 5e-324, math.inf, -math.inf, math.nan, 0.1, 1e16 + 2.0, 2.0 / 3.0]


def pairs():
    """Return two arrays (K, WIDE) with every pair of tricky numbers and many ordinary ones."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(TRICKY, TRICKY)
    x, y = ([*given.ravel(), *rng.normal(size=112)] for given in (x, y))
    assert len(x) % WIDE == 0
    return np.reshape(x, (-1, WIDE)), np.reshape(y, (-1, WIDE))


def same(a, b):
    """Whether two arrays agree bit by bit, one NaN being as good as another."""
    return np.array_equal(np.where(np.isnan(a), 0.0, a).view(np.int64), np.where(np.isnan(b), 0.0, b).view(np.int64))


def both_ways(operations, *given):
    """Return what operations on x and y, given as text, make of two arrays: of float64x8, and of each of their numbers.

    All of them are in one compiled function of each kind: a function for each takes ten times as long to compile.
    """
    count = len(given[0])
    memory = aligned(2 + len(operations), count)
    memory[:2] = given
    alone = np.zeros((len(operations), count * WIDE))
    lines = [f"out[{k} * count + i] = {operation}" for k, operation in enumerate(operations)]
    source = "\n        ".join(["def apply(x_of, y_of, out, count):", *lines])
    source = source.replace(
        ":\n        ", ":\n    for i in range(count):\n        x, y = x_of[i], y_of[i]\n        ", 1
    )
    made = {}
    exec(source, globals(), made)
    apply = compiled(made["apply"])

    @compiled
    def all_lanes(at, count, several):
        x, y = float64x8_at(at, count), float64x8_at(at + count * 8 * WIDE, count)
        apply(x, y, float64x8_at(at + 2 * count * 8 * WIDE, several * count), count)

    all_lanes(address_of(memory), count, len(operations))
    apply(given[0].ravel(), given[1].ravel(), alone.reshape(-1), count * WIDE)
    return memory[2:], alone.reshape(-1, count, WIDE)


TWO = (
    "x + y", "x - y", "x * y", "x / y", "max(x, y)", "min(x, y)", "x + 3 * y - 0.5",
    "select(x < y, x, 1.0)", "select(x <= y, x, y)", "select(x > y, 2, y)", "select(x >= y, x, y)",
    "select(x == y, x, -y)", "select(x != y, x, -y)",
    "select((x < 1.0) & (y < 1.0), x, y)", "select((x < 1.0) | (y < 1.0), x, y)",
)  # fmt: skip
ONE = "-x", "abs(x)", "math.sqrt(x)"


@cache
def of_pairs():
    """Return both ways of all of them, of all pairs."""
    return both_ways([*TWO, *ONE], *pairs())


@pytest.mark.parametrize("operation", [*TWO, *ONE])
def test_an_operation_on_eight_is_that_on_each(operation):
    """Arithmetic, comparisons and choices of one or two float64x8 are those of their numbers."""
    at = [*TWO, *ONE].index(operation)
    lanes, alone = of_pairs()
    assert same(lanes[at], alone[at])


def test_angles_of_many_turns():
    """Only angles of many turns are brought near, whichever of the eight they are."""
    x = np.array([0.0, 1e6, -1e6, 1.0000001e6, -3e9, 1e15, 2.5, -1e7] * 2).reshape(2, WIDE)
    x[1] /= 1e5  # none of many turns but one
    (lanes,), (alone,) = both_ways(["nearest(x)"], x, x)
    assert same(lanes, alone)
    assert np.all(np.abs(lanes) <= 1e6)
    assert np.allclose(np.sin(lanes), np.sin(x), rtol=0, atol=1e-12)


def test_every_needs_all_eight():
    """A check holds if it holds in all eight; what is not a number fails it."""
    memory = aligned(1)

    @compiled
    def all_positive(at):
        return every(float64x8_at(at, 1)[0] > 0.0)

    memory[:] = 1.0
    assert all_positive(address_of(memory))
    for i in range(WIDE):
        for bad in (0.0, math.nan):
            memory[:] = 1.0
            memory[0, i] = bad
            assert not all_positive(address_of(memory))
    assert compiled(lambda x: every(x > 0.0))(1.0)
    assert not compiled(lambda x: every(x > 0.0))(-1.0)


def test_lanes_are_read_and_written_one_by_one():
    """A float64x8's numbers can be taken out and put in."""
    memory = aligned(2)
    memory[0] = np.arange(WIDE)

    @compiled
    def turn(at):
        x = float64x8_at(at, 2)
        for i in range(WIDE):
            x[1] = with_lane(x[1], i, lane(x[0], WIDE - 1 - i))

    turn(address_of(memory))
    assert np.array_equal(memory[1], np.arange(WIDE)[::-1])


def test_lanes_of_entries_are_read_and_written_in_place():
    """Number by number, of an array of any shape; nothing beside them changes."""
    memory = aligned(4)
    memory[:] = np.arange(4.0 * WIDE).reshape(4, WIDE)
    wanted = memory.copy()
    wanted[3, 1:3] = wanted[0, 5], wanted[2, 6]

    @compiled
    def copy(at):
        x = float64x8_at(at, 4)
        put_at(x, 3, 1, lane_at(x, 0, 5))
        put_at(x.reshape(2, 2), 3, 2, lane_at(x.reshape(2, 2), 2, 6))

    copy(address_of(memory))
    assert np.array_equal(memory, wanted)


def test_a_comparison_of_lanes_decides_nothing():
    """A branch on eight answers at once would be wrong for some of them, so it must not compile."""

    @compiled
    def branch(at):
        return 1 if float64x8_at(at, 1)[0] > 0.0 else 0

    with pytest.raises(TypingError):
        branch(address_of(aligned(1)))


def test_as_plain_python():
    """The same names work in plain Python, for numbers."""
    assert (select(True, 1.0, 2.0), select(False, 1.0, 2.0)) == (1.0, 2.0)
    assert (every(True), every(False)) == (True, False)
    assert nearest(3.0) == 3.0
    assert abs(nearest(1e7 * math.tau + 1.0) - 1.0) < 1e-8
