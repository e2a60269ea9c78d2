"""A formula φ(x, y, z), and its value with first and second derivatives, by forward differentiation.

Each result carries ten numbers, u, ∇u and the upper triangle of ∇∇u, and each operation follows its own rule:

    u v        ∇ = u ∇v + v ∇u,     ∇∇ = u ∇∇v + v ∇∇u + ∇u ∇vᵀ + ∇v ∇uᵀ
    f(u)       ∇ = f' ∇u,           ∇∇ = f' ∇∇u + f'' ∇u ∇uᵀ

(A. Griewank and A. Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, ch. 13.)

A formula φ(x, y, z) as text, and as the list of numbers that is evaluated.

The text is read by Python's own grammar, and of that nothing is taken but numbers, x, y, z, pi, + - * / **, parentheses
and the functions named here: a file that holds a formula can make no code run. The formula becomes a list of
instructions, each of which is the result of one operation on the results before it, with equal parts computed once.
"""

import ast
import math
from collections.abc import Callable
from typing import Any

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import kernel
from robot_models.errors import warnings_heard

# What an instruction does with results a and b before it, and its constant c: a + b, a − b, a b, c a, a + c, a ** c.
ADD, SUBTRACT, MULTIPLY, SCALE, SHIFT, POWER = range(6)
# x, y, z: this and the two after it.
VARIABLE = 10
SQRT, EXP, LOG, SIN, COS, TAN, SINH, COSH, TANH, ATAN = range(20, 30)
FUNCTIONS = {
    "sqrt": SQRT, "exp": EXP, "log": LOG, "sin": SIN, "cos": COS, "tan": TAN, "sinh": SINH, "cosh": COSH,
    "tanh": TANH, "atan": ATAN,
}  # fmt: skip
# Numbers of an instruction, and of a result.
INSTRUCTION, NUMBERS = 4, 10
# Beyond it exp overflows.
LARGEST_EXPONENT = 700.0


@kernel
def function_at(code: int, u: float, c: float) -> tuple[float, float, float]:
    """Return f(u), f'(u) and f''(u) of a function, of u ** c for POWER; NaN where it has none."""
    outside = not math.isfinite(u)
    if code in (SQRT, LOG):
        outside = outside or not u > 0.0
    elif code in (EXP, SINH, COSH):
        outside = outside or abs(u) > LARGEST_EXPONENT
    elif code == POWER:
        outside = outside or (u == 0.0 and c < 2.0) or (u < 0.0 and c != math.floor(c))
    if outside:
        return math.nan, math.nan, math.nan
    if code == POWER:
        return u**c, c * u ** (c - 1.0), c * (c - 1.0) * u ** (c - 2.0)
    if code == SQRT:
        f = math.sqrt(u)
        return f, 0.5 / f, -0.25 / (f * u)
    if code == EXP:
        f = math.exp(u)
        return f, f, f
    if code == LOG:
        return math.log(u), 1.0 / u, -1.0 / (u * u)
    if code in (SIN, COS):
        s, k = math.sin(u), math.cos(u)
        return (s, k, -s) if code == SIN else (k, -s, -k)
    if code in (SINH, COSH):
        s, k = math.sinh(u), math.cosh(u)
        return (s, k, s) if code == SINH else (k, s, k)
    if code == TAN:
        f = math.tan(u)
        return f, 1.0 + f * f, 2.0 * f * (1.0 + f * f)
    if code == TANH:
        f = math.tanh(u)
        return f, 1.0 - f * f, -2.0 * f * (1.0 - f * f)
    slope = 1.0 / (1.0 + u * u)
    return math.atan(u), slope, -2.0 * u * slope * slope


def function_value(code: int, u: float) -> float:
    """Return f(u) of a function of `FUNCTIONS`; NaN where it has none."""
    value: tuple[Any, ...] = interpreted(function_at)(code, u, 0.0)
    return float(value[0])


@kernel
def product(u: Array, v: Array, out: Array) -> None:
    """Write the product of two results."""
    out[0] = u[0] * v[0]
    for i in range(1, 4):
        out[i] = u[0] * v[i] + v[0] * u[i]
    k = 4
    for i in range(1, 4):
        for j in range(i, 4):
            out[k] = u[0] * v[k] + v[0] * u[k] + u[i] * v[j] + u[j] * v[i]
            k += 1


@kernel
def composed(f: float, slope: float, bend: float, u: Array, out: Array) -> None:
    """Write f(u) of a result u, with f' and f'' there."""
    out[0] = f
    for i in range(1, 4):
        out[i] = slope * u[i]
    k = 4
    for i in range(1, 4):
        for j in range(i, 4):
            out[k] = slope * u[k] + bend * u[i] * u[j]
            k += 1


@kernel
def evaluate(tape: Array, x: float, y: float, z: float, gradient: Array, hessian: Array) -> float:
    """Return φ(x, y, z), and write ∇φ (3,) and ∇∇φ (3, 3).

    `tape` has the number of instructions, the instructions (code, a, b, constant), and room for their results.
    """
    count = int(tape[0])
    at = 1 + count * INSTRUCTION
    for k in range(count):
        begin = 1 + k * INSTRUCTION
        code, c, first = int(tape[begin]), tape[begin + 3], at + k * NUMBERS
        a, b = at + int(tape[begin + 1]) * NUMBERS, at + int(tape[begin + 2]) * NUMBERS
        u, v, out = tape[a : a + NUMBERS], tape[b : b + NUMBERS], tape[first : first + NUMBERS]
        if code == MULTIPLY:
            product(u, v, out)
        elif code == ADD:
            for i in range(NUMBERS):
                out[i] = u[i] + v[i]
        elif code == SUBTRACT:
            for i in range(NUMBERS):
                out[i] = u[i] - v[i]
        elif code == SCALE:
            for i in range(NUMBERS):
                out[i] = c * u[i]
        elif code == SHIFT:
            for i in range(1, NUMBERS):
                out[i] = u[i]
            out[0] = u[0] + c
        elif VARIABLE <= code < VARIABLE + 3:
            for i in range(NUMBERS):
                out[i] = 0.0
            out[0] = x if code == VARIABLE else (y if code == VARIABLE + 1 else z)
            out[1 + code - VARIABLE] = 1.0
        else:
            f, slope, bend = function_at(code, u[0], c)
            composed(f, slope, bend, u, out)
    last = at + (count - 1) * NUMBERS
    entry = 4
    for i in range(3):
        gradient[i] = tape[last + 1 + i]
        for j in range(i, 3):
            hessian[i, j] = hessian[j, i] = tape[last + entry]
            entry += 1
    return float(tape[last])


VARIABLES = ("x", "y", "z")
CONSTANTS = {"pi": math.pi}
LONGEST, MOST_INSTRUCTIONS = 2000, 300
# Whole powers up to this are products: quicker, and without a derivative of a power at zero.
LARGEST_PRODUCT = 16

# A part of a formula: a number, or the place of the instruction that computes it.
Part = float | int
_OPERATIONS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}


class _Tape:
    """The instructions so far; numbers are floats, and places ints."""

    def __init__(self) -> None:
        self.places: dict[tuple[int, int, int, float], int] = {}

    def put(self, code: int, a: int = 0, b: int = 0, constant: float = 0.0) -> int:
        place = self.places.setdefault((code, a, b, constant), len(self.places))
        if place >= MOST_INSTRUCTIONS:
            raise ValueError(f"is too long: it has more than {MOST_INSTRUCTIONS} operations")
        return place

    def add(self, a: Part, b: Part) -> Part:
        if isinstance(a, float) and isinstance(b, float):
            return a + b
        if isinstance(a, float):
            a, b = b, a
        return self.put(SHIFT, int(a), 0, b) if isinstance(b, float) else self.put(ADD, int(a), b)

    def multiply(self, a: Part, b: Part) -> Part:
        if isinstance(a, float) and isinstance(b, float):
            return a * b
        if isinstance(a, float):
            a, b = b, a
        return self.put(SCALE, int(a), 0, b) if isinstance(b, float) else self.put(MULTIPLY, int(a), b)

    def subtract(self, a: Part, b: Part) -> Part:
        if isinstance(a, float) or isinstance(b, float):
            return self.add(a, self.multiply(b, -1.0))
        return self.put(SUBTRACT, a, b)

    def power(self, a: Part, b: Part) -> Part:
        if isinstance(b, int):  # a**b = exp(b log a)
            return self.call("exp", self.multiply(b, self.call("log", a)))
        if isinstance(a, float):
            return _number(lambda: a**b)
        if b.is_integer() and 1.0 <= b <= LARGEST_PRODUCT:
            return self._product(a, int(b))
        return 1.0 if b == 0.0 else self.put(POWER, a, 0, b)

    def _product(self, a: int, power: int) -> int:
        if power == 1:
            return a
        half = self._product(a, power // 2)
        square = self.put(MULTIPLY, half, half)
        return self.put(MULTIPLY, square, a) if power % 2 else square

    def call(self, name: str, a: Part) -> Part:
        if isinstance(a, float):
            return _number(lambda: function_value(FUNCTIONS[name], a))
        return self.put(FUNCTIONS[name], a)

    def of(self, node: ast.expr) -> Part:
        """Return what a node of the grammar is."""
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return _number(lambda: float(value))
            case ast.Name(id=name) if name in VARIABLES:
                return self.put(VARIABLE + VARIABLES.index(name))
            case ast.Name(id=name) if name in CONSTANTS:
                return CONSTANTS[name]
            case ast.Name(id=name):
                raise ValueError(f"'{name}' is unknown: {known()}")
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.of(operand)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self.multiply(self.of(operand), -1.0)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATIONS:
                return self._combined(_OPERATIONS[type(op)], self.of(left), self.of(right))
            case ast.BinOp(op=ast.BitXor()):
                raise ValueError("has a ^: a power is written **")
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
                return self.call(name, self.of(argument))
            case ast.Call(func=ast.Name(id=name)):
                raise ValueError(
                    f"'{name}' takes one argument" if name in FUNCTIONS else f"'{name}' is unknown: {known()}"
                )
        raise ValueError(f"{ast.unparse(node)[:40]!r} is not allowed in a formula: {known()}")

    def _combined(self, sign: str, a: Part, b: Part) -> Part:
        if sign == "/":
            return self.multiply(a, self.power(b, -1.0))
        do = {"+": self.add, "-": self.subtract, "*": self.multiply, "**": self.power}[sign]
        return do(a, b)


def known() -> str:
    """Return, in words, what a formula may be made of."""
    return f"a formula has x, y, z, pi, numbers, + - * / **, and {', '.join(FUNCTIONS)}"


def _number(value: Callable[[], float]) -> float:
    """Return a number of a formula.

    Raises ValueError if it is not real and finite.
    """
    try:
        number = value()
    except (ArithmeticError, ValueError):
        number = math.nan
    if not isinstance(number, float) or not math.isfinite(number):
        raise ValueError("has a part that is not a finite number: a division by zero, or a root of a negative number")
    return number


def instructions(text: str) -> tuple[float, ...]:
    """Return a formula as the list that `closedloop.mechanics.surface.expression.evaluate` reads, with room for its
    results.

    Raises ValueError if it is no formula, or does not depend on x, y and z; says what is wrong, after the text.
    """
    if len(text) > LONGEST:
        raise ValueError(f"is too long: it has more than {LONGEST} characters")
    try:
        with warnings_heard():  # one thread at a time: where two parse at once Python 3.11 fails (CPython issue 106905)
            node = ast.parse(text.strip(), mode="eval").body
        tape = _Tape()
        last = tape.of(node)
    except (SyntaxError, RecursionError, MemoryError) as error:
        said = error.msg if isinstance(error, SyntaxError) else "nested too deeply"
        raise ValueError(f"is not a formula ({said}): {known()}") from None
    if isinstance(last, float):
        raise ValueError("does not depend on x, y or z: it does not define a surface")
    count = len(tape.places)
    if last != count - 1:  # what it is comes last
        tape.put(SHIFT, last, 0, 0.0)
        count += 1
    numbers = [float(count)]
    for code, a, b, constant in tape.places:
        numbers += [float(code), float(a), float(b), constant]
    return (*numbers, *([0.0] * (count * NUMBERS)))


assert INSTRUCTION == 4  # code, a, b and constant
