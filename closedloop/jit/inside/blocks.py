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


def taught(function: Callable[..., Any], answer: Callable[..., Any], *kinds: Any) -> Callable[..., Any]:
    """Return a decorator of what writes LLVM's code of a function: it teaches numba the function.

    `answer(context, *args)` returns the signature for arguments of such types, None where there is none; `kinds` are
    the types, or their classes, that the code is for.
    """

    @infer_global(function)
    class Typing(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            return answer(self.context, *args) if len(args) == len(kinds) and not kws else None

    return lower_builtin(function, *kinds)


def at_address(function: Callable[..., Any], kind: Any) -> None:
    """Teach numba a function that makes an array of a type of an address and the array's shape."""
    whole = (types.intp,) * (1 + kind.ndim)

    def answer(context: Any, *args: Any) -> Any:
        return kind(*whole) if all(isinstance(x, types.Integer) for x in args) else None

    @taught(function, answer, *whole)
    def lower(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        data = builder.inttoptr(arguments[0], context.get_value_type(types.CPointer(kind.dtype)))
        return array_on(context, builder, kind, data, list(arguments[1:]))


at_address(vector_at, types.Array(types.float64, 1, "C"))
at_address(matrix_at, types.Array(types.float64, 2, "C"))
at_address(known_matrix_at, types.Array(types.float64, 2, "C"))
at_address(fortran_at, types.Array(types.float64, 2, "F"))
at_address(integers_at, types.Array(types.int64, 1, "C"))


def _in_rows(kind: Any, ndim: int) -> bool:
    return isinstance(kind, types.Array) and kind.ndim == ndim and kind.layout == "C"


def _row(context: Any, matrix: Any, i: Any) -> Any:
    fits = _in_rows(matrix, 2) and isinstance(i, types.Integer)
    return types.Array(matrix.dtype, 1, "C")(matrix, types.intp) if fits else None


@taught(row_of, _row, types.Array, types.intp)
def _lower_row(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    matrix = make_array(call.args[0])(context, builder, value=arguments[0])
    columns = cgutils.unpack_tuple(builder, matrix.shape)[1]
    data = builder.gep(matrix.data, [builder.mul(arguments[1], columns)])
    return array_on(context, builder, call.return_type, data, [columns])


def _matrix(context: Any, vector: Any, rows: Any, columns: Any) -> Any:
    return types.Array(vector.dtype, 2, "C")(vector, types.intp, types.intp) if _in_rows(vector, 1) else None


@taught(matrix_of, _matrix, types.Array, types.intp, types.intp)
def _lower_matrix(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    vector = make_array(call.args[0])(context, builder, value=arguments[0])
    return array_on(context, builder, call.return_type, vector.data, list(arguments[1:]))


_THREE = (types.int64,) * 3


def _call(context: Any, *args: Any) -> Any:
    return types.int64(*_THREE) if all(isinstance(x, types.Integer) for x in args) else None


@taught(call_at, _call, *_THREE)
def _lower_call_at(context: Any, builder: Any, call: Any, values: Any) -> Any:
    word = ir.IntType(64)
    kind = ir.FunctionType(word, [word, word])
    return builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
