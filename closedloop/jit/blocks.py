"""Blocks: memory of which each part has a name, `block.name`, in Python and, at no cost, in compiled code.

A block is a class whose annotations say, in order, what the memory holds: single numbers, and arrays with their shapes
in a few sizes (number of joints, of stages ...) that are known only when the block is made. `Layout` counts with such
sizes as symbols, so the one description gives the size of the memory and the places of its parts.

    class Motion(Block, sizes=("n",)):
        time: float                       # one number: motion.time = 0.5
        q: Annotated[Array, N]            # an array: motion.q[0]

    motion = Motion(np.zeros(Motion.count(4)), 4)

Inside compiled code a tuple of forty arrays would travel as three hundred words from call to call. There a block is
its address and its sizes, and an array is made where it is asked for: `_compiled_views` teaches numba to.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, get_args, get_type_hints

import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_setattr_generic
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_global, signature
from numba.extending import (
    infer_getattr,
    lower_builtin,
    lower_getattr_generic,
    models,
    register_model,
)
from numba.np.arrayobj import make_array, populate_array
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Sizes of blocks whose places are remembered.
MOST_PLACES = 64
# Name, begin, end and shape of a part.
Place = tuple[str, int, int, tuple[int, ...]]
# A product of sizes, as a sorted tuple of their names, and how many of it there are.
Terms = dict[tuple[str, ...], int]


class Count:
    """A whole number in terms of sizes that are not yet known: a polynomial."""

    def __init__(self, terms: Terms) -> None:
        self.terms = {product: count for product, count in terms.items() if count}

    @classmethod
    def of(cls, x: Count | int | str) -> Count:
        """Return a number, or a size by its name, as a count."""
        if isinstance(x, Count):
            return x
        return cls({(x,): 1} if isinstance(x, str) else {(): x})

    def __add__(self, other: Count | int) -> Count:
        terms = dict(self.terms)
        for product, count in Count.of(other).terms.items():
            terms[product] = terms.get(product, 0) + count
        return Count(terms)

    def __mul__(self, other: Count | int) -> Count:
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

    Parameters
    ----------
    sizes : sequence of str
        Names of the sizes, in the order in which they are given later.
    fields : sequence of (name, shape)
        A shape is a tuple of numbers and `Count`s, () for a single number; the fields follow each other.
    """

    def __init__(self, sizes: Sequence[str], fields: Sequence[tuple[str, tuple[Count | int, ...]]]) -> None:
        self.sizes = tuple(sizes)
        self.at: dict[str, Count] = {}
        self.shape: dict[str, tuple[Count, ...]] = {}
        end = Count({})
        for name, shape in fields:
            counts = tuple(Count.of(x) for x in shape)
            self.at[name], self.shape[name] = end, counts
            size = Count.of(1)
            for count in counts:
                size = size * count
            end = end + size
        self.end = end
        # A batch asks for the same few sizes thousands of times.
        self._places: dict[tuple[int, ...], Mapping[str, Place]] = {}
        # An interpreted loop asks for the same views at every step.
        self._last: tuple[Array | None, tuple[int, ...], dict[str, Array]] = None, (), {}

    def size(self, *sizes: int) -> int:
        """Return how many numbers the block has."""
        return self.end.value(dict(zip(self.sizes, sizes, strict=True)))

    def views(self, memory: Array, *sizes: int) -> dict[str, Array]:
        """Return the arrays of a block by their names; of a block of arrays, memory (size, ...), those of each."""
        whose, for_sizes, found = self._last
        if whose is memory and for_sizes == sizes:
            return found
        each, places = memory.shape[1:], self.places(*sizes).values()
        found = {name: memory[begin:end].reshape(shape + each) for name, begin, end, shape in places if shape}
        self._last = memory, sizes, found
        return found

    def places(self, *sizes: int) -> Mapping[str, Place]:
        """Return name, begin, end and shape of each field, by its name."""
        places = self._places.get(sizes)
        if places is None:
            known = dict(zip(self.sizes, sizes, strict=True))
            places = {}
            for name, at in self.at.items():
                shape = tuple(count.value(known) for count in self.shape[name])
                places[name] = name, at.value(known), at.value(known) + math.prod(shape), shape
            if len(self._places) >= MOST_PLACES:
                self._places.clear()
            self._places[sizes] = places
        return places


def array_on(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any]) -> Any:
    """Return compiled code's array of a type (C or F order) and shape on the numbers at the pointer `data`."""
    size = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides = [size]
    for length in shape[:-1] if kind.layout == "F" else reversed(shape[1:]):
        strides.append(builder.mul(strides[-1], length))
    if kind.layout == "C":
        strides.reverse()
    array = make_array(kind)(context, builder)
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=size, meminfo=None, parent=None)
    return array._getvalue()


class Block:
    """Base of all blocks; a subclass names its parts by annotations, see above.

    Parameters
    ----------
    memory : (count(*sizes),) array, or (count(*sizes), ...) of arrays side by side
        What the parts are views of; kept.
    sizes : int
        Those that the class names, in order.
    """

    layout: ClassVar[Layout]

    def __init_subclass__(cls, sizes: Sequence[str] = ()) -> None:
        fields = []
        for name, hint in get_type_hints(cls, include_extras=True).items():
            if name != "layout":
                fields.append((name, get_args(hint)[1:] if hasattr(hint, "__metadata__") else ()))
        cls.layout = Layout(sizes, fields)
        for name, shape in cls.layout.shape.items():
            if not shape:
                at = cls.layout.at[name]
                first = set(at.terms) <= {()}
                setattr(cls, name, _number(at.value({})) if first else _number_after_arrays(name))
        _compiled_views(cls)

    def __init__(self, memory: NDArray[Any], *sizes: int) -> None:
        self.memory, self.sizes = memory, sizes
        self.__dict__.update(self.layout.views(memory, *sizes))

    @classmethod
    def count(cls, *sizes: int) -> int:
        """Return how many numbers of memory a block takes."""
        return cls.layout.size(*sizes)

    @classmethod
    def place(cls, name: str, *sizes: int) -> int | slice:
        """Return where a part is in the memory: the index of a number, the slice of an array."""
        _, begin, end, shape = cls.layout.places(*sizes)[name]
        return slice(begin, end) if shape else begin


def _number(place: int) -> property:
    """Return a single number of a block as an attribute."""

    def read(block: Block) -> Any:
        return block.memory[place]

    def write(block: Block, value: Any) -> None:
        block.memory[place] = value

    return property(read, write)


def _number_after_arrays(name: str) -> property:
    """Return a single number whose place depends on the sizes as an attribute."""

    def read(block: Block) -> Any:
        return block.memory[block.layout.places(*block.sizes)[name][1]]

    def write(block: Block, value: Any) -> None:
        block.memory[block.layout.places(*block.sizes)[name][1]] = value

    return property(read, write)


def _compiled_views(block: type[Block]) -> None:
    """Make `block(memory, *sizes)`, in compiled code, the block's parts as attributes.

    Memory of float64 has parts of float64, of float64x8 (`closedloop.jit.simd8`) parts of float64x8, of int64 whole
    numbers. It must outlive the block; numba does not count who refers to it.
    """
    layout, made = block.layout, f"{block.__module__}.{block.__qualname__}"

    class BlockType(types.Type):
        def __init__(self, dtype: Any) -> None:
            self.dtype = dtype
            super().__init__(name=f"{made} of {dtype}")

    @register_model(BlockType)
    class Model(models.StructModel):
        def __init__(self, dmm: Any, fe_type: Any) -> None:
            sizes = ((name, types.intp) for name in layout.sizes)
            super().__init__(dmm, fe_type, [("base", types.CPointer(fe_type.dtype)), *sizes])

    @infer_global(block, typing_key=made)
    class Views(AbstractTemplate):
        key = made

        def generic(self, args: Any, kws: Any) -> Any:
            fits = len(args) == 1 + len(layout.sizes) and isinstance(args[0], types.Array) and not kws
            return signature(BlockType(args[0].dtype), *args) if fits and args[0].layout == "C" else None

    @lower_builtin(made, types.Array, types.VarArg(types.Any))
    def lower_views(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        struct = cgutils.create_struct_proxy(call.return_type)(context, builder)
        struct.base = make_array(call.args[0])(context, builder, value=arguments[0]).data
        for name, kind, value in zip(layout.sizes, call.args[1:], arguments[1:], strict=True):
            setattr(struct, name, context.cast(builder, value, kind, types.intp))
        return struct._getvalue()

    @infer_getattr
    class Attributes(AttributeTemplate):
        key = BlockType

        def generic_resolve(self, value: Any, attribute: str) -> Any:  # type: ignore[override]
            shape = layout.shape.get(attribute)
            if shape is None:
                return None
            return types.Array(value.dtype, len(shape), "C") if shape else value.dtype

    def place(context: Any, builder: Any, kind: Any, value: Any, attribute: str) -> tuple[Any, list[Any]]:
        """Write code for the pointer to a part, and its shape."""
        struct = cgutils.create_struct_proxy(kind)(context, builder, value=value)

        def number(count: Count) -> Any:
            total = context.get_constant(types.intp, count.terms.get((), 0))
            for product, times in count.terms.items():
                if product:
                    x = getattr(struct, product[0])
                    for name in product[1:]:
                        x = builder.mul(x, getattr(struct, name))
                    total = builder.add(total, builder.mul(x, context.get_constant(types.intp, times)))
            return total

        data = builder.gep(struct.base, [number(layout.at[attribute])])
        return data, [number(count) for count in layout.shape[attribute]]

    @lower_getattr_generic(BlockType)
    def lower_attribute(context: Any, builder: Any, kind: Any, value: Any, attribute: str) -> Any:
        data, shape = place(context, builder, kind, value, attribute)
        if not shape:
            return context.unpack_value(builder, kind.dtype, data)
        return array_on(context, builder, types.Array(kind.dtype, len(shape), "C"), data, shape)

    @lower_setattr_generic(BlockType)
    def lower_assignment(context: Any, builder: Any, call: Any, arguments: Any, attribute: str) -> None:
        data, shape = place(context, builder, call.args[0], arguments[0], attribute)
        assert not shape
        context.pack_value(builder, call.args[0].dtype, arguments[1], data)
