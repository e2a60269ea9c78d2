"""The dual number of a value and seven derivatives, `dual8`, in compiled code; see `closedloop.jit.dual8`.

The value, lane 0, is what a float would be to the last bit: the derivatives never enter it.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import signature
from numba.extending import lower_cast

from closedloop.jit.dual8 import MANY, along, has_derivatives, settled, slope_of, sought
from closedloop.jit.inside.blocks import at_address
from closedloop.jit.inside.simd8 import DOUBLES, LANE, Vector, made_of, repeated, teach
from closedloop.jit.simd8 import WIDE

_NOTHING = ir.Constant(DOUBLES, [0.0] * WIDE)
_HEADS = ir.Constant(ir.VectorType(LANE, WIDE), [0] * WIDE)
_HEAD_OF_FIRST = ir.Constant(ir.VectorType(LANE, WIDE), [0, *range(WIDE + 1, 2 * WIDE)])
_DOUBLE = ir.DoubleType()


class Dual8(Vector):
    """The type of a value and seven derivatives; a float or a whole number becomes one without derivatives."""

    others = types.Float, types.Integer, types.Boolean


dual8 = Dual8(name="dual8")
made_of(Dual8, DOUBLES)


@lower_cast(types.Float, Dual8)
@lower_cast(types.Integer, Dual8)
@lower_cast(types.Boolean, Dual8)
def _constant(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return builder.insert_element(_NOTHING, context.cast(builder, value, given, types.float64), LANE(0))


def _value(b: Any, x: Any) -> Any:
    return b.extract_element(x, LANE(0))


def _values(b: Any, x: Any) -> Any:
    """Write code for the value in every lane."""
    return b.shuffle_vector(x, ir.Constant(DOUBLES, ir.Undefined), _HEADS)


def _joined(b: Any, value: Any, derivatives: Any) -> Any:
    """Write code for the value of one and the derivatives of the other."""
    return b.shuffle_vector(value, derivatives, _HEAD_OF_FIRST)


def _made(b: Any, value: Any, x: Any, slope: Any) -> Any:
    """Write code for a function's value and, by the chain rule, x's derivatives times a slope."""
    return b.insert_element(b.fmul(repeated(b, slope), x), value, LANE(0))


def _number(x: float) -> Any:
    return ir.Constant(_DOUBLE, x)


def _scalar(context: Any, b: Any, function: Any, *values: Any) -> Any:
    """Write code for what a function makes of floats in compiled code."""
    kinds = (types.float64,) * len(values)
    called = context.typing_context.resolve_value_type(function).get_call_type(context.typing_context, kinds, {})
    return context.get_function(function, called)(b, list(values))


def _product(context: Any, b: Any, x: Any, y: Any) -> Any:
    own = b.fmul(_values(b, x), y)
    return _joined(b, own, _plus_product(b, own, _values(b, y), x))


def _plus_product(b: Any, z: Any, x: Any, y: Any) -> Any:
    """Write code for z + x y, of derivatives: in one operation where the processor has it."""
    kind = ir.FunctionType(DOUBLES, [DOUBLES] * 3)
    return b.call(b.module.declare_intrinsic(f"llvm.fmuladd.v{WIDE}f64", fnty=kind), [x, y, z])


def _scaled(context: Any, b: Any, x: Any, factor: Any) -> Any:
    return b.fmul(x, repeated(b, factor))


def _quotient(context: Any, b: Any, x: Any, y: Any) -> Any:
    x0, y0 = _value(b, x), _value(b, y)
    value = b.fdiv(x0, y0)
    change = _plus_product(b, x, repeated(b, b.fneg(value)), y)
    return _made(b, value, change, b.fdiv(_number(1.0), y0))


def _shared(context: Any, b: Any, x: Any, divisor: Any) -> Any:
    return _made(b, b.fdiv(_value(b, x), divisor), x, b.fdiv(_number(1.0), divisor))


def _root(context: Any, b: Any, x: Any) -> Any:
    """Write code for √x; where x and its derivative are 0, so is that of the root."""
    value = _scalar(context, b, math.sqrt, _value(b, x))
    slope = b.fdiv(_number(0.5), value)
    at_zero = b.fcmp_ordered("==", x, _NOTHING)
    change = b.select(at_zero, _NOTHING, b.fmul(repeated(b, slope), x))
    return b.insert_element(change, value, LANE(0))


def _length(context: Any, b: Any, x: Any, y: Any) -> Any:
    """Write code for √(x² + y²); at the origin, where it has no derivative, for one that is 0."""
    x0, y0 = _value(b, x), _value(b, y)
    value = _scalar(context, b, math.hypot, x0, y0)
    nowhere = b.fcmp_ordered("==", value, _number(0.0))
    inverse = b.select(nowhere, _number(0.0), b.fdiv(_number(1.0), value))
    change = b.fadd(b.fmul(repeated(b, b.fmul(x0, inverse)), x), b.fmul(repeated(b, b.fmul(y0, inverse)), y))
    return b.insert_element(change, value, LANE(0))


def _angle(context: Any, b: Any, y: Any, x: Any) -> Any:
    y0, x0 = _value(b, y), _value(b, x)
    inverse = b.fdiv(_number(1.0), b.fadd(b.fmul(x0, x0), b.fmul(y0, y0)))
    change = b.fsub(b.fmul(repeated(b, b.fmul(x0, inverse)), y), b.fmul(repeated(b, b.fmul(y0, inverse)), x))
    return b.insert_element(change, _scalar(context, b, math.atan2, y0, x0), LANE(0))


def _power(context: Any, b: Any, x: Any, y: Any) -> Any:
    """Write code for x**y, with the logarithm only where the exponent has a derivative."""
    x0, y0 = _value(b, x), _value(b, y)
    value = _scalar(context, b, operator.pow, x0, y0)
    slope = b.fmul(y0, _scalar(context, b, operator.pow, x0, b.fsub(y0, _number(1.0))))
    by_exponent = b.fmul(repeated(b, b.fmul(value, _scalar(context, b, math.log, x0))), y)
    by_exponent = b.select(b.fcmp_ordered("==", y, _NOTHING), _NOTHING, by_exponent)
    return b.insert_element(b.fadd(b.fmul(repeated(b, slope), x), by_exponent), value, LANE(0))


def _whole_power(context: Any, b: Any, x: Any, n: Any) -> Any:
    def power(m: Any) -> Any:
        called = signature(types.float64, types.float64, types.int64)
        return context.get_function(operator.pow, called)(b, [_value(b, x), m])

    slope = b.fmul(b.sitofp(n, _DOUBLE), power(b.sub(n, n.type(1))))
    return _made(b, power(n), x, slope)


def _function(function: Any, slope: Callable[..., Any]) -> Callable[..., Any]:
    """Return what writes a function of one number: `slope(c, x, y)` writes its derivative at x, where it is y."""

    def emit(context: Any, b: Any, x: Any) -> Any:
        x0 = _value(b, x)
        value = _scalar(context, b, function, x0)
        return _made(b, value, x, slope(_Writer(context, b), x0, value))

    return emit


class _Writer:
    """Writes formulae of floats."""

    def __init__(self, context: Any, b: Any) -> None:
        self._context, self.b = context, b

    def __call__(self, function: Any, *values: Any) -> Any:
        return _scalar(self._context, self.b, function, *values)

    def over(self, x: Any) -> Any:
        """Write 1/x."""
        return self.b.fdiv(_number(1.0), x)

    def one_less(self, x: Any) -> Any:
        """Write 1 − x²."""
        return self.b.fsub(_number(1.0), self.b.fmul(x, x))

    def one_more(self, x: Any) -> Any:
        """Write 1 + x²."""
        return self.b.fadd(_number(1.0), self.b.fmul(x, x))


# Functions of one number, and their derivatives.
FUNCTIONS: dict[Any, Callable[[Any, Any, Any], Any]] = {
    math.sin: lambda c, x, y: c(math.cos, x),
    math.cos: lambda c, x, y: c.b.fneg(c(math.sin, x)),
    math.tan: lambda c, x, y: c.one_more(y),
    math.asin: lambda c, x, y: c.over(c(math.sqrt, c.one_less(x))),
    math.acos: lambda c, x, y: c.b.fneg(c.over(c(math.sqrt, c.one_less(x)))),
    math.atan: lambda c, x, y: c.over(c.one_more(x)),
    math.sinh: lambda c, x, y: c(math.cosh, x),
    math.cosh: lambda c, x, y: c(math.sinh, x),
    math.tanh: lambda c, x, y: c.one_less(y),
    math.exp: lambda c, x, y: y,
    math.expm1: lambda c, x, y: c(math.exp, x),
    math.log: lambda c, x, y: c.over(x),
}


def _compared(sign: str) -> Callable[..., Any]:
    def emit(context: Any, b: Any, x: Any, y: Any) -> Any:
        compare = b.fcmp_unordered if sign == "!=" else b.fcmp_ordered
        return compare(sign, _value(b, x), _value(b, y))

    return emit


def _chosen(sign: str) -> Callable[..., Any]:
    """Return what writes the larger or smaller of two, as Python has it: the first of equal ones."""

    def emit(context: Any, b: Any, x: Any, y: Any) -> Any:
        return b.select(b.fcmp_ordered(sign, _value(b, y), _value(b, x)), y, x)

    return emit


def _of_three(choose: Callable[..., Any]) -> Callable[..., Any]:
    return lambda context, b, x, y, z: choose(context, b, choose(context, b, x, y), z)


def _size(context: Any, b: Any, x: Any) -> Any:
    negative = b.fcmp_ordered("<", _value(b, x), _number(0.0))
    turned = b.select(negative, b.fneg(x), x)
    return b.insert_element(turned, _scalar(context, b, abs, _value(b, x)), LANE(0))


def _with_sign(context: Any, b: Any, x: Any, y: Any) -> Any:
    x0 = _value(b, x)
    value = _scalar(context, b, math.copysign, x0, _value(b, y))
    return b.insert_element(b.select(b.fcmp_ordered("==", value, x0), x, b.fneg(x)), value, LANE(0))


def _of_value(function: Any, result: Any) -> Callable[..., Any]:
    """Return what writes a function that has no derivatives."""

    def emit(context: Any, b: Any, x: Any) -> Any:
        value = _scalar(context, b, function, _value(b, x))
        return value if result != dual8 else b.insert_element(_NOTHING, value, LANE(0))

    return emit


def _rounded(context: Any, b: Any, x: Any) -> Any:
    return context.get_function(round, signature(types.int64, types.float64))(b, [_value(b, x)])


def _cut(context: Any, b: Any, x: Any) -> Any:
    return b.fptosi(_value(b, x), ir.IntType(64))


_TWO, _BY_FLOAT = (dual8, dual8), (dual8, types.float64)


def _sum(name: str) -> Callable[..., Any]:
    return lambda context, b, x, y: getattr(b, name)(x, y)


_known: Any
_ARITHMETIC: dict[str, list[tuple[tuple[Any, ...], Callable[..., Any]]]] = {
    "add": [(_TWO, _sum("fadd"))],
    "sub": [(_TWO, _sum("fsub"))],
    "mul": [
        (_BY_FLOAT, _scaled), ((types.float64, dual8), lambda context, b, x, y: _scaled(context, b, y, x)),
        (_TWO, _product),
    ],
    "truediv": [(_BY_FLOAT, _shared), (_TWO, _quotient)],
}  # fmt: skip
for _name, _forms in _ARITHMETIC.items():
    for _operator in (getattr(operator, _name), getattr(operator, f"i{_name}")):
        for _kinds, _emit in _forms:
            teach(_operator, _kinds, dual8, _emit)
for _operator in (operator.pow, operator.ipow):
    teach(_operator, (dual8, types.int64), dual8, _whole_power)
    teach(_operator, _TWO, dual8, _power)
for _name, _sign in (("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">="), ("eq", "=="), ("ne", "!=")):
    teach(getattr(operator, _name), _TWO, types.boolean, _compared(_sign))
teach(operator.neg, (dual8,), dual8, lambda context, b, x: b.fneg(x))
teach(operator.pos, (dual8,), dual8, lambda context, b, x: x)
teach(abs, (dual8,), dual8, _size)
for _known, _sign in ((max, ">"), (min, "<")):
    teach(_known, _TWO, dual8, _chosen(_sign))
    teach(_known, (dual8,) * 3, dual8, _of_three(_chosen(_sign)))
teach(math.sqrt, (dual8,), dual8, _root)
teach(math.hypot, _TWO, dual8, _length)
teach(math.atan2, _TWO, dual8, _angle)
teach(math.copysign, _TWO, dual8, _with_sign)
teach(math.fabs, (dual8,), dual8, _size)
teach(math.pow, _TWO, dual8, _power)
for _known, _slope in FUNCTIONS.items():
    teach(_known, (dual8,), dual8, _function(_known, _slope))
for _known, _result in ((math.isfinite, types.boolean), (math.isnan, types.boolean), (math.isinf, types.boolean),
                        (math.ceil, types.int64), (math.floor, types.int64)):  # fmt: skip
    teach(_known, (dual8,), _result, _of_value(_known, _result))
teach(round, (dual8,), types.int64, _rounded)
teach(int, (dual8,), types.int64, _cut)
teach(float, (dual8,), dual8, lambda context, b, x: x)
teach(bool, (dual8,), types.boolean, lambda context, b, x: b.fcmp_unordered("!=", _value(b, x), _number(0.0)))
teach(sought, (dual8,), dual8, lambda context, b, x: _joined(b, x, _NOTHING))
teach(
    along, (dual8,), dual8,
    lambda context, b, x: b.insert_element(_joined(b, x, _NOTHING), _number(MANY), LANE(WIDE - 1)),
)  # fmt: skip
teach(
    slope_of, (dual8,), types.float64,
    lambda context, b, g: b.fmul(b.extract_element(g, LANE(WIDE - 1)), _number(1.0 / MANY)),
)  # fmt: skip


def _less_share(context: Any, b: Any, x: Any, g: Any, slope: Any) -> Any:
    return _joined(b, x, b.fsub(x, b.fmul(g, repeated(b, b.fdiv(_number(1.0), slope)))))


teach(settled, (dual8, dual8, types.float64), dual8, _less_share)
teach(settled, (dual8,) * 3, dual8, lambda context, b, x, g, slope: _less_share(context, b, x, g, _value(b, slope)))
teach(has_derivatives, (dual8,), types.boolean, lambda context, b, x: ir.IntType(1)(1))
# Of floats.
for _known in (sought, along, slope_of):
    teach(_known, (types.float64,), types.float64, lambda context, b, x: x)
teach(settled, (types.float64,) * 3, types.float64, lambda context, b, x, g, slope: x)
teach(has_derivatives, (types.float64,), types.boolean, lambda context, b, x: ir.IntType(1)(0))


def dual_vector_at(address: Any, n: Any) -> Any:
    """Return the (n,) array of dual8 at an address."""


def dual_matrix_at(address: Any, rows: Any, columns: Any) -> Any:
    """Return the (rows, columns) array of dual8 at an address, row after row."""


def dual_fortran_at(address: Any, rows: Any, columns: Any) -> Any:
    """Return the (rows, columns) array of dual8 at an address, column after column."""


at_address(dual_vector_at, types.Array(dual8, 1, "C"))
at_address(dual_matrix_at, types.Array(dual8, 2, "C"))
at_address(dual_fortran_at, types.Array(dual8, 2, "F"))
