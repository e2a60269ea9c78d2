"""A formula φ(x, y, z) as text, and as a list of numbers for `closedloop.mechanics.surface.second_order` to evaluate.

The text is read by Python's own grammar, and of that nothing is taken but numbers, x, y, z, pi, + - * / **, parentheses
and the functions named here: a file that holds a formula can make no code run. The formula becomes a list of
instructions, each of which is the result of one operation on the results before it, with equal parts computed once.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable

from closedloop.mechanics.surface.second_order import (
    ADD,
    FUNCTIONS,
    INSTRUCTION,
    MULTIPLY,
    NUMBERS,
    POWER,
    SCALE,
    SHIFT,
    SUBTRACT,
    VARIABLE,
    function_value,
)

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

    Raises
    ------
    ValueError
        If it is not real and finite.
    """
    try:
        number = value()
    except (ArithmeticError, ValueError):
        number = math.nan
    if not isinstance(number, float) or not math.isfinite(number):
        raise ValueError("has a part that is not a finite number: a division by zero, or a root of a negative number")
    return number


def instructions(text: str) -> tuple[float, ...]:
    """Return a formula as the list that `closedloop.mechanics.surface.second_order.evaluate` reads, with room for its
    results.

    Raises
    ------
    ValueError
        If it is no formula, or does not depend on x, y and z; says what is wrong, after the text.
    """
    if len(text) > LONGEST:
        raise ValueError(f"is too long: it has more than {LONGEST} characters")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
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
