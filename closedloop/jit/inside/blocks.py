"""The inside of numba that all kernels need: blocks, arrays by their address, calls by address.

A block (`closedloop.jit.blocks`) is an address and sizes, of which the parts are made where they are asked for. Kernels
count no references, so a compiled function cannot return a view: numba writes arrays (`closedloop.jit.calls`) where
they are called. This is imported when the first kernel is compiled or read from the cache.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_setattr_generic
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_global, signature
from numba.extending import infer_getattr, lower_builtin, lower_getattr_generic, models, register_model
from numba.np.arrayobj import make_array

from closedloop.jit.blocks import Block, Count, blocks, when_made
from closedloop.jit.calls import (
    call_at,
    fortran_at,
    integers_at,
    known_matrix_at,
    matrix_at,
    matrix_of,
    row_of,
    vector_at,
)

# The type, in compiled code, of each class of blocks.
_types: dict[type[Block], Any] = {}


def array_part(context: Any, builder: Any, kind: Any, value: Any, name: str) -> Any:
    """Return compiled code's part of an array (data, shape ...), whose type is `kind`."""
    return builder.extract_value(value, context.data_model_manager[kind].get_field_position(name))


def array_on(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any]) -> Any:
    """Return compiled code's array of a type (C or F order) and shape on the numbers at the pointer `data`."""
    word = context.get_value_type(types.intp)
    size = word(context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides, items = [size], shape[0]
    for length in shape[:-1] if kind.layout == "F" else reversed(shape[1:]):
        strides.append(builder.mul(strides[-1], length))
    if kind.layout == "C":
        strides.reverse()
    for length in shape[1:]:
        items = builder.mul(items, length)
    model = context.data_model_manager[kind]
    # What is known is one constant: each part that is put into it is a line to print and to read.
    known = [ir.Constant(each, ir.Undefined) for each in model.get_value_type().elements]
    for name in ("meminfo", "parent"):
        known[model.get_field_position(name)] = ir.Constant(context.get_value_type(model.get_type(name)), None)
    known[model.get_field_position("itemsize")] = size
    array = ir.Constant(model.get_value_type(), known)
    for name, value in (("nitems", items), ("data", data)):
        array = builder.insert_value(array, value, model.get_field_position(name))
    for name, words in (("shape", shape), ("strides", strides)):
        for i, value in enumerate(words):
            array = builder.insert_value(array, value, [model.get_field_position(name), i])
    return array


def teach(block: type[Block]) -> None:
    """Make `block(memory, *sizes)`, in compiled code, the block's parts as attributes.

    `block.memory` is all of it. Memory of float64 has parts of float64, of float64x8 (`closedloop.jit.simd8`) parts of
    float64x8, of int64 whole numbers. It must outlive the block; numba does not count who refers to it.
    """
    layout = block.layout
    at, shapes = {**layout.at, "memory": Count({})}, {**layout.shape, "memory": (layout.end,)}
    made = f"{block.__module__}.{block.__qualname__}"

    class BlockType(types.Type):
        def __init__(self, dtype: Any) -> None:
            self.dtype = dtype
            super().__init__(name=f"{made} of {dtype}")

    _types[block] = BlockType

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
            if attribute in layout.blocks:
                return _types[layout.blocks[attribute]](value.dtype)
            shape = shapes.get(attribute)
            if shape is None:
                return None
            return types.Array(value.dtype, len(shape), "C") if shape else value.dtype

    def place(context: Any, builder: Any, kind: Any, value: Any, attribute: str) -> tuple[Any, list[Any]]:
        """Write code for the pointer to a part, and its shape; a block's sizes in place of a shape."""

        def size(name: str) -> Any:
            return builder.extract_value(value, 1 + layout.sizes.index(name))

        def number(count: Count) -> Any:
            total = context.get_constant(types.intp, count.terms.get((), 0))
            for product, times in count.terms.items():
                if product:
                    x = size(product[0])
                    for name in product[1:]:
                        x = builder.mul(x, size(name))
                    x = x if times == 1 else builder.mul(x, context.get_constant(types.intp, times))
                    total = builder.add(total, x)
            return total

        data = builder.gep(builder.extract_value(value, 0), [number(at[attribute])])
        if attribute in layout.blocks:
            return data, [size(name) for name in layout.blocks[attribute].layout.sizes]
        return data, [number(count) for count in shapes[attribute]]

    @lower_getattr_generic(BlockType)
    def lower_attribute(context: Any, builder: Any, kind: Any, value: Any, attribute: str) -> Any:
        data, shape = place(context, builder, kind, value, attribute)
        if attribute in layout.blocks:
            part = ir.Constant(context.get_value_type(_types[layout.blocks[attribute]](kind.dtype)), ir.Undefined)
            for i, word in enumerate((data, *shape)):
                part = builder.insert_value(part, word, i)
            return part
        if not shape:
            return context.unpack_value(builder, kind.dtype, data)
        return array_on(context, builder, types.Array(kind.dtype, len(shape), "C"), data, shape)

    @lower_setattr_generic(BlockType)
    def lower_assignment(context: Any, builder: Any, call: Any, arguments: Any, attribute: str) -> None:
        data, shape = place(context, builder, call.args[0], arguments[0], attribute)
        assert not shape
        context.pack_value(builder, call.args[0].dtype, arguments[1], data)


for _block in blocks:
    teach(_block)
when_made.append(teach)


def _compiled(function: Callable[..., Any], kind: Any) -> None:
    """Teach numba one of the functions above."""
    dtype = types.CPointer(kind.dtype)

    @infer_global(function)
    class At(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            fits = len(args) == 1 + kind.ndim and not kws and all(isinstance(x, types.Integer) for x in args)
            return signature(kind, *(types.intp for _ in args)) if fits else None

    @lower_builtin(function, *(types.intp for _ in range(1 + kind.ndim)))
    def lower(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        data = builder.inttoptr(arguments[0], context.get_value_type(dtype))
        return array_on(context, builder, kind, data, list(arguments[1:]))


_compiled(vector_at, types.Array(types.float64, 1, "C"))
_compiled(matrix_at, types.Array(types.float64, 2, "C"))
_compiled(known_matrix_at, types.Array(types.float64, 2, "C"))
_compiled(fortran_at, types.Array(types.float64, 2, "F"))
_compiled(integers_at, types.Array(types.int64, 1, "C"))


@infer_global(row_of)
class RowOf(AbstractTemplate):
    """The type of a row of a matrix."""

    key = row_of

    def generic(self, args: Any, kws: Any) -> Any:
        """Return the signature for a matrix in C order and a whole number."""
        fits = len(args) == 2 and not kws and isinstance(args[0], types.Array) and isinstance(args[1], types.Integer)
        if not fits or args[0].ndim != 2 or args[0].layout != "C":
            return None
        return signature(types.Array(args[0].dtype, 1, "C"), args[0], types.intp)


@lower_builtin(row_of, types.Array, types.intp)
def _lower_row(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    matrix = make_array(call.args[0])(context, builder, value=arguments[0])
    columns = cgutils.unpack_tuple(builder, matrix.shape)[1]
    data = builder.gep(matrix.data, [builder.mul(arguments[1], columns)])
    return array_on(context, builder, call.return_type, data, [columns])


@infer_global(matrix_of)
class MatrixOf(AbstractTemplate):
    """The type of the first numbers of a vector as a matrix."""

    key = matrix_of

    def generic(self, args: Any, kws: Any) -> Any:
        """Return the signature for a vector in C order and two whole numbers."""
        fits = len(args) == 3 and not kws and isinstance(args[0], types.Array)
        if not fits or args[0].ndim != 1 or args[0].layout != "C":
            return None
        return signature(types.Array(args[0].dtype, 2, "C"), args[0], types.intp, types.intp)


@lower_builtin(matrix_of, types.Array, types.intp, types.intp)
def _lower_matrix(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    vector = make_array(call.args[0])(context, builder, value=arguments[0])
    return array_on(context, builder, call.return_type, vector.data, list(arguments[1:]))


_WORD = ir.IntType(64)


@infer_global(call_at)
class _CallAt(AbstractTemplate):
    key = call_at

    def generic(self, args: Any, kws: Any) -> Any:
        fits = len(args) == 3 and not kws and all(isinstance(x, types.Integer) for x in args)
        return signature(types.int64, types.int64, types.int64, types.int64) if fits else None


@lower_builtin(call_at, types.int64, types.int64, types.int64)
def _lower_call_at(context: Any, builder: Any, call: Any, values: Any) -> Any:
    kind = ir.FunctionType(_WORD, [_WORD, _WORD])
    return builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
