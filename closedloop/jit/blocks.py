"""Blocks: one array with named fields, `block.name`, in Python and, at no cost, in compiled code.

A block is a class whose annotations name its fields in order: single numbers, arrays with their shapes in a few sizes
(number of joints, of stages ...) that are known only when the block is made, and other blocks of some of these sizes.
`Layout` treats the sizes as symbols, so one description gives the size of the memory and the offset of every field.

    class Motion(Block, sizes=("n",)):
        time: float                       # one number: motion.time = 0.5
        q: Annotated[Array, N]            # an array: motion.q[0]

    class Arm(Block, sizes=("n",)):
        motion: Motion                    # a block: arm.motion.q[0]

    arm = Arm(np.zeros(Arm.count(4)), 4)

In compiled code a tuple of forty arrays would be passed as three hundred words in every call. A block is passed as its
address and its sizes, and an array view is made where a field is read: see `closedloop.jit.inside.blocks`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array

# Layouts of different sizes that are kept.
MOST_LAYOUTS = 64
# Name, begin, end and shape of a part.
Place = tuple[str, int, int, tuple[int, ...]]
# A product of sizes, as a sorted tuple of their names, and how many of it there are.
Terms = dict[tuple[str, ...], int]


class Count:
    """A whole number as a polynomial in sizes that are not yet known."""

    def __init__(self, terms: Terms) -> None:
        self.terms = {product: count for product, count in terms.items() if count}

    @classmethod
    def of(cls, x: "Count | int | str") -> "Count":
        """Return a number, or a size by its name, as a count."""
        if isinstance(x, Count):
            return x
        return cls({(x,): 1} if isinstance(x, str) else {(): x})

    def __add__(self, other: "Count | int") -> "Count":
        terms = dict(self.terms)
        for product, count in Count.of(other).terms.items():
            terms[product] = terms.get(product, 0) + count
        return Count(terms)

    def __mul__(self, other: "Count | int") -> "Count":
        terms: Terms = {}
        for a, x in self.terms.items():
            for b, y in Count.of(other).terms.items():
                product = tuple(sorted(a + b))
                terms[product] = terms.get(product, 0) + x * y
        return Count(terms)

    __radd__ = __add__
    __rmul__ = __mul__

    def value(self, sizes: Mapping[str, int]) -> int:
        """Return the number once the sizes are known."""
        total = 0
        for product, count in self.terms.items():
            for name in product:
                count *= sizes[name]
            total += count
        return total


class Layout:
    """Where each field of a block is, in order.

    `sizes`: names of the sizes, in the order in which they are given later.
    `fields`, sequence of (name, shape or class): a shape is a tuple of numbers and `Count`s, () for a single number; a
        class is that of a block. The fields follow each other.
    """

    def __init__(
        self, sizes: Sequence[str], fields: "Sequence[tuple[str, tuple[Count | int, ...] | type[Block]]]"
    ) -> None:
        self.sizes = tuple(sizes)
        self.at: dict[str, Count] = {}
        self.end = Count({})
        self.shape: dict[str, tuple[Count, ...]] = {}
        self.blocks: dict[str, type[Block]] = {}
        for name, shape in fields:
            if isinstance(shape, type):
                self.at[name], self.blocks[name] = self.end, shape
                self.end += shape.layout.end
                continue
            counts = tuple(Count.of(x) for x in shape)
            self.at[name], self.shape[name] = self.end, counts
            size = Count.of(1)
            for count in counts:
                size = size * count
            self.end += size
        # A batch makes blocks of the same few sizes thousands of times.
        self.places = lru_cache(MOST_LAYOUTS)(self._places)
        self._counted = lru_cache(MOST_LAYOUTS * (len(self.blocks) + 1))(self._value)
        # An interpreted loop makes blocks of the same views at every step.
        self._last: tuple[Array | None, tuple[int, ...], dict[str, Any]] = None, (), {}

    def size(self, *sizes: int) -> int:
        """Return how many numbers the block has."""
        return self._counted(self.end, sizes)

    def _value(self, count: Count, sizes: tuple[int, ...]) -> int:
        """Return a count for sizes."""
        return count.value(dict(zip(self.sizes, sizes, strict=True)))

    def views(self, memory: Array, *sizes: int) -> dict[str, Any]:
        """Return the arrays and blocks of a block by their names; memory is (size, ...), of blocks side by side too."""
        whose, for_sizes, last = self._last
        if whose is memory and for_sizes == sizes:
            return last
        each, places = memory.shape[1:], self.places(*sizes).values()
        found: dict[str, Any] = {
            name: memory[begin:end].reshape(shape + each) for name, begin, end, shape in places if shape
        }
        for name, kind in self.blocks.items():
            inner = self.sizes_of(kind, sizes)
            begin = self._counted(self.at[name], sizes)
            found[name] = kind(memory[begin : begin + kind.count(*inner)], *inner)
        self._last = memory, sizes, found
        return found

    def sizes_of(self, kind: "type[Block]", sizes: Sequence[int]) -> tuple[int, ...]:
        """Return the sizes of a block in this one, whose sizes are given."""
        known = dict(zip(self.sizes, sizes, strict=True))
        return tuple(known[name] for name in kind.layout.sizes)

    def _places(self, *sizes: int) -> Mapping[str, Place]:
        """Return name, begin, end and shape of each number and array, by its name."""
        places: dict[str, Place] = {}
        for name, counts in self.shape.items():
            shape, begin = tuple(self._value(count, sizes) for count in counts), self._value(self.at[name], sizes)
            places[name] = name, begin, begin + math.prod(shape), shape
        return places


# All blocks; and what is done with each that is made later, once numba is in use.
blocks: "list[type[Block]]" = []
when_made: "list[Callable[[type[Block]], None]]" = []


class Block:
    """Base of all blocks; a subclass names its fields by annotations, see above.

    `memory`, (count(*sizes),) array, or (count(*sizes), ...) of arrays side by side: the array that the fields are
        views of.
    `sizes`: those that the class names, in order.
    """

    layout: ClassVar[Layout]

    def __init_subclass__(cls, sizes: Sequence[str] = ()) -> None:
        fields = []
        for name, hint in get_type_hints(cls, include_extras=True).items():
            if name != "layout":
                shape = get_args(hint)[1:] if hasattr(hint, "__metadata__") else ()
                fields.append((name, hint if isinstance(hint, type) and issubclass(hint, Block) else shape))
        cls.layout = Layout(sizes, fields)
        for name, shape in cls.layout.shape.items():
            if not shape:
                at = cls.layout.at[name]
                setattr(cls, name, _number(name, at.value({}) if set(at.terms) <= {()} else None))
        blocks.append(cls)
        for teach in when_made:
            teach(cls)

    def __init__(self, memory: NDArray[Any], *sizes: int) -> None:
        self.memory, self.sizes = memory, sizes
        self.__dict__.update(self.layout.views(memory, *sizes))

    @property
    def kept(self) -> dict[str, Any]:
        """The objects that are kept with this block, by their names."""
        return self.__dict__.setdefault("_kept", {})

    def keep_alive(self, **others: Any) -> None:
        """Keep objects, by a name, as long as this block is kept: those to whose memory it has addresses."""
        self.kept.update(others)

    @classmethod
    def count(cls, *sizes: int) -> int:
        """Return how many numbers of memory a block takes."""
        return cls.layout.size(*sizes)

    @classmethod
    def place(cls, name: str, *sizes: int) -> int | slice:
        """Return where a part is in the memory: the index of a number, the slice of an array; "a.b" is of block a."""
        outer, _, inner = name.partition(".")
        if inner:
            kind, known = cls.layout.blocks[outer], dict(zip(cls.layout.sizes, sizes, strict=True))
            first, at = cls.layout.at[outer].value(known), kind.place(inner, *cls.layout.sizes_of(kind, sizes))
            return slice(first + at.start, first + at.stop) if isinstance(at, slice) else first + at
        _, begin, end, shape = cls.layout.places(*sizes)[name]
        return slice(begin, end) if shape else begin


def arrays_of(what: Any) -> Iterator[NDArray[Any]]:
    """Return the arrays of memory and of all that is kept with it, one after the other."""
    if isinstance(what, np.ndarray):
        yield what
    elif isinstance(what, Block):
        yield what.memory
        yield from arrays_of(what.kept)
    elif isinstance(what, dict):
        for part in what.values():
            yield from arrays_of(part)
    elif isinstance(what, (tuple, list)):
        for part in what:
            yield from arrays_of(part)


def _number(name: str, offset: int | None) -> property:
    """Return a single number of a block as an attribute; without an offset its place depends on the sizes."""

    def read(block: Block) -> Any:
        return block.memory[block.layout.places(*block.sizes)[name][1] if offset is None else offset]

    def write(block: Block, value: Any) -> None:
        block.memory[block.layout.places(*block.sizes)[name][1] if offset is None else offset] = value

    return property(read, write)
