"""Blocks: parts by name in one memory, the same in compiled code as in Python, side by side, and none over another."""

from operator import attrgetter

import numba
import numpy as np
import pytest

from closedloop.control.reference.desired import Reference
from closedloop.jit.blocks import Count, Layout
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.loop.step.record_row import (
    ARM_RECORDED,
    CONTACT_RECORDED,
    RECORDED,
    ArmRow,
    ContactRow,
    Row,
    recorded,
    row_width,
)
from closedloop.mechanics.contacts.memory import Contacts
from closedloop.mechanics.loops.memory import LoopRows

SIZES = [(1, 0, 1, 1, 0), (2, 3, 4, 1, 2), (4, 0, 1, 1, 0), (7, 21, 4, 6, 1), (30, 5, 1, 2, 3)]


def names_of(kind):
    """Return the names of all numbers and arrays of a class of blocks, those of blocks in it with a dot."""
    inner = (f"{name}.{own}" for name, block in kind.layout.blocks.items() for own in names_of(block))
    return sorted([*kind.layout.shape, *inner], key=lambda name: place(kind, name))


def place(kind, name):
    """Return where a part begins in the memory of a block of any sizes."""
    found = kind.place(name, *(2 + i for i in range(len(kind.layout.sizes))))
    return found.start if isinstance(found, slice) else found


def parts(block):
    """Return all parts of a block by name, in the order of the memory."""
    return {name: np.asarray(attrgetter(name)(block)) for name in names_of(type(block))}


def put(block, name, value):
    """Write a number of a block, by its name."""
    *outer, own = name.split(".")
    setattr(attrgetter(".".join(outer))(block) if outer else block, own, value)


@pytest.mark.parametrize("sizes", SIZES)
def test_parts_cover_the_memory_side_by_side(sizes):
    """Each number of the memory belongs to one part, and a part is written through its name."""
    memory = np.zeros(Work.count(*sizes))
    block = Work(memory, *sizes)
    for i, (name, part) in enumerate(parts(block).items()):
        assert np.all(part == 0.0)
        if part.ndim:
            part[...] = i + 1
        else:
            put(block, name, i + 1)
    assert np.all(memory > 0.0)
    assert all(np.all(part == i + 1) for i, part in enumerate(parts(block).values()))


@pytest.mark.parametrize("n", [1, 4, 30])
def test_numbers_may_follow_arrays(n):
    """Their place depends on the sizes; `place` knows it, and columns side by side have the same parts."""
    memory = np.arange(float(Row.count(n)))
    row, columns = Row(memory, n), Row(np.stack([memory, -memory], axis=1), n)
    seen = []
    for name in Row.layout.at:
        here = getattr(row, name)
        assert np.array_equal(here, memory[Row.place(name, n)])
        assert np.array_equal(getattr(columns, name), np.stack([here, -here], axis=-1))
        seen += np.ravel(here).tolist()
    assert seen == memory.tolist()
    row.energy_supplied = 0.5
    assert memory[-1] == 0.5


@pytest.mark.parametrize("contacts", [0, 2])
def test_recorded_columns_are_those_written(contacts):
    """Each part of a row, of its arm and of its contacts is found by its name; what rows do not have is no number."""
    n, width = 3, row_width(3, True, contacts)
    rows = np.zeros((5, width))
    for k, memory in enumerate(rows):
        arm, behind = memory[Row.count(n) :], memory[width - ContactRow.count(contacts) :]
        blocks = Row(memory, n), ArmRow(arm, n), *([ContactRow(behind, contacts)] if contacts else [])
        for i, (name, part) in enumerate((name, part) for block in blocks for name, part in parts(block).items()):
            block = next(block for block in blocks if name in block.layout.at)
            setattr(block, name, 100.0 * k + i) if not part.ndim else part.__setitem__(..., 100.0 * k + i)
    names = [*RECORDED, *ARM_RECORDED, *(CONTACT_RECORDED if contacts else ())]
    for i, name in enumerate(names):
        column = recorded(rows, n, name, contacts).reshape(5, -1)
        assert np.array_equal(column, np.full_like(column, 1.0) * (100.0 * np.arange(5.0)[:, None] + i)), name
    bare = np.delete(rows, np.s_[Row.count(n) : Row.count(n) + ArmRow.count(n)], axis=1)
    for name in ARM_RECORDED:
        assert recorded(bare, n, name, contacts).shape == (5, n)
        assert np.all(np.isnan(recorded(bare, n, name, contacts)))


ARRAYS = [name for name, part in parts(Work(np.zeros(Work.count(*SIZES[0])), *SIZES[0])).items() if part.ndim]
NUMBERS = [name for name in names_of(Work) if name not in ARRAYS]


@kernel
def _set(array, value):
    array[:] = value
    return array.size


# One line a part: the name of an attribute must be written out for numba.
_lines = [f"    shapes[{i}] = _set(block.{name}, {100.0 + i})\n" for i, name in enumerate(ARRAYS)]
_lines += [f"    block.{name} += {500.0 + i}\n    read[{i}] = block.{name}\n" for i, name in enumerate(NUMBERS)]
_made: dict = {"_set": _set}
exec("def mark(block, shapes, read):\n" + "".join(_lines), _made)
_mark = kernel(_made["mark"])


@entry_kernel
def _mark_all(memory, n, k, stages, ring, tendons, shapes, read):
    block = Work(memory, n, k, stages, ring, tendons)
    _mark(block, shapes, read)


@pytest.mark.slow
@pytest.mark.parametrize("sizes", SIZES)
def test_compiled_parts_are_those_of_python(sizes):
    """Compiled code, a call away from where the block was made, reads and writes where Python does."""
    memory, shapes, read = np.ones(Work.count(*sizes)), np.zeros(len(ARRAYS), dtype=np.int64), np.zeros(len(NUMBERS))
    _mark_all(memory, *sizes, shapes, read)
    block = Work(memory, *sizes)
    assert all(np.all(attrgetter(name)(block) == 100.0 + i) for i, name in enumerate(ARRAYS))
    assert [attrgetter(name)(block).size for name in ARRAYS] == shapes.tolist()
    assert [attrgetter(name)(block) for name in NUMBERS] == [501.0 + i for i in range(len(NUMBERS))] == read.tolist()


@entry_kernel
def _count_up(numbers):
    state = State(numbers)
    state.mode = state.row + 2
    state.row += 1


def test_whole_numbers_stay_whole():
    """A block on whole numbers holds whole numbers, also those that floats cannot tell apart."""
    state = State(np.zeros(State.count(), dtype=np.int64))
    state.row = 2**53 + 1
    _count_up(state.memory)
    assert (int(state.mode), int(state.row)) == (2**53 + 3, 2**53 + 2)


@entry_kernel
def _misspelt(numbers):
    State(numbers).mood = 1


def test_a_name_that_is_not_there_is_refused():
    """Compiled code cannot write to a part that the block does not have."""
    with pytest.raises(numba.TypingError, match="mood"):
        _misspelt(np.zeros(State.count(), dtype=np.int64))


def test_no_record_has_more_than_forty_parts():
    """Each record of the loop's memory belongs to an owner; none has more than 40 parts of its own."""
    kinds, seen = [State, Constants, Work, Contacts, LoopRows], set()
    while kinds:
        kind = kinds.pop()
        seen.add(kind.__name__)
        kinds += kind.layout.blocks.values()
        assert len(kind.layout.at) <= 40, kind
    assert {"Settings", "TipContact", "JointSpace"} <= seen


def test_a_block_in_a_block_has_its_own_memory():
    """It is at its place in the outer one's memory, and all of it can be read at once, in compiled code too."""
    work = Work(np.arange(float(Work.count(2, 3, 4, 1, 0))), 2, 3, 4, 1, 0)
    begin = Work.place("reference.q", 2, 3, 4, 1, 0).start
    np.testing.assert_array_equal(work.reference.memory, np.arange(begin, begin + Reference.count(2)))
    assert _sum_of_reference(work.memory, 2, 3, 4, 1) == np.sum(work.reference.memory)


@entry_kernel
def _sum_of_reference(memory, n, k, stages, ring):
    total = 0.0
    for x in Work(memory, n, k, stages, ring, 0).reference.memory:
        total += x
    return total


def test_constants_are_laid_out_for_their_joints():
    """Parts whose shape depends on the joints have it."""
    constants = Constants(np.zeros(Constants.count(3, 7, 2, 4, 5, 6, 2)), 3, 7, 2, 4, 5, 6, 2)
    assert constants.gravity.shape == (3,)
    assert constants.law.shape == (7,)
    assert constants.friction.shape == (4,)
    assert constants.joint_friction.shape == (3, 5)


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
