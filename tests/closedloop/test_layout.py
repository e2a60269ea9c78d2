"""Views into one block of numbers: the same in compiled code as in Python, side by side, and none over another."""

import numpy as np
import pytest

from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.jit.memory_views import Count, Layout
from closedloop.step.memory import LAYOUT, Work, memory_size, workspace

SIZES = [(1, 0, 1, 1), (2, 3, 4, 1), (4, 0, 1, 1), (7, 21, 4, 6), (30, 5, 1, 2)]


@pytest.mark.parametrize("sizes", SIZES)
def test_views_cover_the_block_side_by_side(sizes):
    """Each number of the block belongs to one view."""
    memory = np.zeros(memory_size(*sizes))
    for i, view in enumerate(workspace(memory, *sizes)):
        assert np.all(view == 0.0)
        view[...] = i + 1
    assert np.all(memory > 0.0)


# One line a field: the name of an attribute must be written out for numba.
_lines = [
    f"    block.{name}[:] = {100.0 + i}\n    shapes[{i}] = block.{name}.size, block.{name}.shape[-1]\n"
    for i, name in enumerate(Work._fields)
]
_made: dict = {}
exec("def mark(block, shapes):\n" + "".join(_lines), _made)
_mark = kernel(_made["mark"])


@entry_kernel
def _mark_all(memory, n, k, stages, ring, shapes):
    block = workspace(memory, n, k, stages, ring)
    _mark(block, shapes)


@pytest.mark.parametrize("sizes", SIZES)
def test_compiled_views_are_those_of_python(sizes):
    """Compiled code, a call away from where the block was cut, writes where Python reads."""
    memory, shapes = np.zeros(memory_size(*sizes)), np.zeros((len(Work._fields), 2), dtype=np.int64)
    _mark_all(memory, *sizes, shapes)
    for i, view in enumerate(workspace(memory, *sizes)):
        assert np.all(view == 100.0 + i)
        assert shapes[i].tolist() == [view.size, view.shape[-1]]


def test_every_part_of_the_work_is_in_the_layout():
    """The type that Python sees and the layout name the same parts."""
    assert set(Work._fields) == set(LAYOUT.at)


def test_counts_are_polynomials():
    """A count is worth what the same sum of products is worth in numbers."""
    n, k = Count.of("n"), Count.of("k")
    count = 2 * n * (n + k) + 3 * k * 1 + 7
    for a, b in ((1, 1), (4, 0), (7, 3)):
        assert count.value({"n": a, "k": b}) == 2 * a * (a + b) + 3 * b + 7
    assert Count({("n",): 0}).terms == {}


def test_a_layout_needs_all_its_sizes():
    """Sizes are given in order, and none is left out."""
    layout = Layout(("n",), [("x", (Count.of("n"),)), ("y", (2, 3))])
    assert layout.size(5) == 11
    with pytest.raises(ValueError, match="zip"):
        layout.size()
