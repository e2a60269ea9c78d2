"""Numbers of eight lanes in compiled code: what `float64x8` and `dual8` share.

Both are a register of eight float64. They differ in what each operation does with the lanes: each lane for itself
(`float64x8`, see `closedloop.jit.simd8`), or lane 0 the value and the others its derivatives
(`closedloop.jit.inside.dual8`).
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typeconv.castgraph import Conversion
from numba.extending import intrinsic, lower_cast, models, overload, register_model
from numba.np.arrayobj import make_array

from closedloop.jit.dual8 import has_derivatives, sought
from closedloop.jit.inside.blocks import at_address, taught
from closedloop.jit.inside.inline_once import plain
from closedloop.jit.simd8 import MANY_TURNS, WIDE, every, nearest, select

DOUBLES = ir.VectorType(ir.DoubleType(), WIDE)
LANE = ir.IntType(32)


class Vector(types.Type):
    """A type whose values are kept in one register; `others` become one by themselves."""

    others: tuple[type[types.Type], ...] = ()

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Say how another type becomes this one."""
        return Conversion.safe if isinstance(other, self.others) else None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """Return the type of a variable that is at times this, at times the other."""
        return self if isinstance(other, self.others) else None


def made_of(kind: type[Vector], content: Any) -> None:
    """Tell numba what a value of a type is made of."""

    @register_model(kind)
    class Model(models.PrimitiveModel):
        def __init__(self, dmm: Any, fe_type: Any) -> None:
            super().__init__(dmm, fe_type, content)

    plain.append(kind)


def repeated(builder: Any, value: Any, kind: Any = DOUBLES) -> Any:
    """Write code for a number in every lane."""
    nothing = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(nothing, value, LANE(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(LANE, WIDE), [0] * WIDE))


def teach(function: Any, kinds: tuple[Any, ...], result: Any, emit: Callable[..., Any]) -> None:
    """Teach numba a function of vectors: `emit(context, builder, *values)` writes its code.

    It is for arguments of these kinds, of which at least one is a vector if any is; numbers become vectors.
    """
    some = any(isinstance(kind, Vector) for kind in kinds)

    def answer(context: Any, *args: Any) -> Any:
        own = not some or any(isinstance(x, Vector) for x in args)
        fits = own and all(
            x == kind or (isinstance(kind, Vector) and isinstance(x, kind.others) and not isinstance(x, types.Boolean))
            for x, kind in zip(args, kinds, strict=True)
        )
        return result(*kinds) if fits else None

    @taught(function, answer, *kinds)
    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        return emit(context, builder, *values)


_intrinsic: Any = intrinsic  # its annotations know only the function that is written, not the one that is called

_ANSWERS = ir.VectorType(ir.IntType(1), WIDE)
_ALL = ir.IntType(WIDE)((1 << WIDE) - 1)


class Float64x8(Vector):
    """The type of eight float64; a float or a whole number becomes one by being there eight times."""

    others = types.Float, types.Integer


class Bool8(Vector):
    """The type of what a comparison of float64x8 says: eight times yes or no.

    numba takes a sum for a float until it has seen what is added, so a boolean becomes one.
    """

    others = (types.Boolean,)


float64x8, answers = Float64x8(name="float64x8"), Bool8(name="bool8")
made_of(Float64x8, DOUBLES)
made_of(Bool8, _ANSWERS)


@lower_cast(types.Float, Float64x8)
@lower_cast(types.Integer, Float64x8)
def _eight_times(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return repeated(builder, context.cast(builder, value, given, types.float64))


@lower_cast(types.Boolean, Bool8)
def _eight_answers(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return repeated(builder, context.cast(builder, value, given, types.boolean), _ANSWERS)


def _teach(function: Any, kinds: tuple[Any, ...], result: Any, emit: Callable[..., Any]) -> None:
    teach(function, kinds, result, lambda context, builder, *values: emit(builder, *values))


def _bits(builder: Any, x: Any) -> Any:
    return builder.bitcast(x, _ALL.type)


def _one_instruction(name: str) -> Callable[..., Any]:
    return lambda builder, *values: getattr(builder, name)(*values)


def _comparison(sign: str) -> Callable[..., Any]:
    ordered = sign != "!="  # what is not a number differs from everything, itself included
    return lambda builder, x, y: (builder.fcmp_ordered if ordered else builder.fcmp_unordered)(sign, x, y)


def _library(name: str) -> Callable[..., Any]:
    kind = ir.FunctionType(DOUBLES, [DOUBLES])
    return lambda builder, x: builder.call(builder.module.declare_intrinsic(name, fnty=kind), [x])


def _larger(builder: Any, x: Any, y: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", y, x), y, x)


def _smaller(builder: Any, x: Any, y: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", y, x), y, x)


for _name, _instruction in (("add", "fadd"), ("sub", "fsub"), ("mul", "fmul"), ("truediv", "fdiv")):
    for _function in (getattr(operator, _name), getattr(operator, f"i{_name}")):
        _teach(_function, (float64x8, float64x8), float64x8, _one_instruction(_instruction))
for _name, _sign in (("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">="), ("eq", "=="), ("ne", "!=")):
    _teach(getattr(operator, _name), (float64x8, float64x8), answers, _comparison(_sign))
_teach(operator.neg, (float64x8,), float64x8, _one_instruction("fneg"))
_teach(abs, (float64x8,), float64x8, _library(f"llvm.fabs.v{WIDE}f64"))
_teach(math.sqrt, (float64x8,), float64x8, _library(f"llvm.sqrt.v{WIDE}f64"))
_teach(max, (float64x8, float64x8), float64x8, _larger)
_teach(min, (float64x8, float64x8), float64x8, _smaller)
_teach(sought, (float64x8,), float64x8, lambda builder, x: x)
_teach(has_derivatives, (float64x8,), types.boolean, lambda builder, x: ir.IntType(1)(0))
_teach(operator.and_, (answers, answers), answers, _one_instruction("and_"))
_teach(operator.or_, (answers, answers), answers, _one_instruction("or_"))


def _selected(context: Any, condition: Any, yes: Any, no: Any) -> Any:
    if condition == answers:
        return float64x8(answers, float64x8, float64x8)
    kind = context.unify_types(yes, no)
    known = isinstance(kind, types.Number | Vector)
    return kind(types.boolean, kind, kind) if known and condition == types.boolean else None


@taught(select, _selected, types.Any, types.Any, types.Any)
def _lower_select(context: Any, builder: Any, call: Any, values: Any) -> Any:
    return builder.select(*values)


_teach(every, (answers,), types.boolean, lambda builder, x: builder.icmp_unsigned("==", _bits(builder, x), _ALL))
_teach(every, (types.boolean,), types.boolean, lambda builder, x: x)


# For compiled code alone.
@_intrinsic
def lane(typingctx: Any, x: Any, i: Any) -> Any:
    """Return number i of a float64x8."""

    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        return builder.extract_element(values[0], builder.trunc(values[1], LANE))

    return types.float64(float64x8, types.intp), lower


@_intrinsic
def with_lane(typingctx: Any, x: Any, i: Any, number: Any) -> Any:
    """Return a float64x8 with its number i replaced."""

    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        return builder.insert_element(values[0], values[2], builder.trunc(values[1], LANE))

    return float64x8(float64x8, types.intp, types.float64), lower


@_intrinsic
def lane_at(typingctx: Any, array: Any, k: Any, i: Any) -> Any:
    """Return number i of entry k of an array of float64x8, entry after entry: what `lane(array[k], i)` is."""

    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        return builder.load(_place(context, builder, call, values))

    return types.float64(array, types.intp, types.intp), lower


@_intrinsic
def put_at(typingctx: Any, array: Any, k: Any, i: Any, number: Any) -> Any:
    """Replace number i of entry k of an array of float64x8: the others are not read."""

    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        builder.store(values[3], _place(context, builder, call, values))
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, types.float64), lower


def _place(context: Any, builder: Any, call: Any, values: Any) -> Any:
    data = make_array(call.args[0])(context, builder, value=values[0]).data
    entry = builder.bitcast(builder.gep(data, [values[1]]), ir.DoubleType().as_pointer())
    return builder.gep(entry, [values[2]])


def float64x8_at(address: Any, count: Any) -> Any:
    """Return the (count,) array of float64x8 at an address: the memory of an array from `aligned`."""


at_address(float64x8_at, types.Array(float64x8, 1, "C"))


# numba wants the same names and annotations from what it is given and what it gets.
@overload(nearest)
def _nearest(x: Any) -> Any:
    def of_lanes(x: Any) -> Any:
        near = x
        if not every(abs(x) <= MANY_TURNS):
            for i in range(WIDE):
                one = lane(x, i)
                if not abs(one) <= MANY_TURNS:
                    near = with_lane(near, i, math.atan2(math.sin(one), math.cos(one)))
        return near

    def of_numbers(x: Any) -> Any:
        return x if abs(x) <= MANY_TURNS else math.atan2(math.sin(x), math.cos(x))

    return of_lanes if isinstance(x, Float64x8) else of_numbers
