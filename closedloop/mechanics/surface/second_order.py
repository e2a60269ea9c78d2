"""A formula's value with its gradient and second derivatives, by forward differentiation: exact, no differences.

Each result carries ten numbers, u, ∇u and the upper triangle of ∇∇u, and each operation follows its own rule:

    u v        ∇ = u ∇v + v ∇u,     ∇∇ = u ∇∇v + v ∇∇u + ∇u ∇vᵀ + ∇v ∇uᵀ
    f(u)       ∇ = f' ∇u,           ∇∇ = f' ∇∇u + f'' ∇u ∇uᵀ

(A. Griewank and A. Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, ch. 13.)
"""

from __future__ import annotations

import math
from typing import Any

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import kernel

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
