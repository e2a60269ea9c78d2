"""dual8: the value of every operation is a float's to the last bit, its derivatives are those of closed forms."""

import math
import operator

import numba
import numpy as np
import pytest

from closedloop.jit import dual8
from closedloop.jit.calls import address_of
from closedloop.jit.inside.dual8 import dual_vector_at
from closedloop.jit.kernel import numba_ready
from closedloop.jit.simd8 import WIDE, aligned, nearest, select

numba_ready()
compiled = numba.njit(error_model="numpy")
# Operation, and its derivatives with respect to x and y as numpy writes them.
ARITHMETIC = {
    "x + y": ("1.0", "1.0"), "x - y": ("1.0", "-1.0"), "x * y": ("y", "x"), "x / y": ("1/y", "-x/y**2"),
    "2.5 * x": ("2.5", "0.0"), "x / 3.0": ("1/3.0", "0.0"), "3 / y": ("0.0", "-3/y**2"), "1.0 - x": ("-1.0", "0.0"),
    "-x": ("-1.0", "0.0"), "x ** 2": ("2*x", "0.0"), "x ** 3": ("3*x*x", "0.0"),
    "abs(x)": ("np.sign(x)", "0.0"), "max(x, y)": ("x >= y", "x < y"), "min(x, y)": ("x <= y", "x > y"),
    "max(x, y, 0.5)": ("(x >= y) & (x >= 0.5)", "(x < y) & (y >= 0.5)"),
    "select(x < y, x * x, 1.0)": ("np.where(x < y, 2*x, 0.0)", "0.0"),
    "math.copysign(x, y)": ("np.sign(x)*np.sign(y)", "0.0"), "math.hypot(x, y)": ("x/np.hypot(x,y)", "y/np.hypot(x,y)"),
    "math.atan2(x, y)": ("y/(x*x+y*y)", "-x/(x*x+y*y)"), "math.sin(x)": ("np.cos(x)", "0.0"),
    "math.cos(x)": ("-np.sin(x)", "0.0"), "math.tan(x)": ("1/np.cos(x)**2", "0.0"), "math.exp(x)": ("np.exp(x)", "0.0"),
    "math.expm1(x)": ("np.exp(x)", "0.0"), "math.tanh(x)": ("1/np.cosh(x)**2", "0.0"),
    "math.sinh(x)": ("np.cosh(x)", "0.0"), "math.cosh(x)": ("np.sinh(x)", "0.0"), "math.atan(x)": ("1/(1+x*x)", "0.0"),
    "float(x) + int(x)": ("1.0", "0.0"), "x + round(y)": ("1.0", "0.0"), "nearest(x)": ("1.0", "0.0"),
    "sought(x) * y": ("0.0", "x"),
}  # fmt: skip
POSITIVE = {
    "math.sqrt(x)": ("0.5/np.sqrt(x)", "0.0"), "math.log(x)": ("1/x", "0.0"),
    "x ** y": ("y*x**(y-1)", "x**y*np.log(x)"),
    "x ** 0.5": ("0.5/np.sqrt(x)", "0.0"), "math.asin(x / 9)": ("1/np.sqrt(81-x*x)", "0.0"),
    "math.acos(x / 9)": ("-1/np.sqrt(81-x*x)", "0.0"),
}  # fmt: skip
NAMES = {"math": math, "select": select, "nearest": nearest, "sought": dual8.sought}


def apply(operations, x, y):
    """Return what operations make of (K,) duals x and y, (M, K, 8), and of their values, (M, K)."""
    lines = [f"    out[{k} * count + i] = {operation}" for k, operation in enumerate(operations)]
    source = "\n    ".join(["def run(x_of, y_of, out, count):", "for i in range(count):",
                            "    x, y = x_of[i], y_of[i]", *lines])  # fmt: skip
    made = {}
    exec(source, NAMES, made)
    run, count, several = compiled(made["run"]), len(x), len(operations)
    memory = aligned(2 + several, count)
    memory[0], memory[1] = x, y

    @compiled
    def duals(at):
        step = count * 8 * WIDE
        run(dual_vector_at(at, count), dual_vector_at(at + step, count), dual_vector_at(at + 2 * step, several * count),
            count)  # fmt: skip

    duals(address_of(memory))
    alone = np.zeros(several * count)
    run(np.ascontiguousarray(x[:, 0]), np.ascontiguousarray(y[:, 0]), alone, count)
    return memory[2:], alone.reshape(several, count)


@pytest.fixture(scope="module")
def results():
    """Return, by its text, what each operation gives and where, and its derivatives as closed forms say."""
    rng, found = np.random.default_rng(0), {}
    for operations, low in ((ARITHMETIC, -3.0), (POSITIVE, 0.3)):
        x, y = rng.uniform(low, 3.0, (2, 40, WIDE))
        given, alone = apply([*operations], x, y)
        names = {"np": np, "x": x[:, 0], "y": y[:, 0]}
        for i, (text, slopes) in enumerate(operations.items()):
            by = [np.asarray(eval(slope, names))[..., None] for slope in slopes]
            found[text] = given[i], alone[i], by[0] * x[:, 1:] + by[1] * y[:, 1:]
    return found


@pytest.mark.parametrize("operation", [*ARITHMETIC, *POSITIVE])
def test_an_operation_has_its_value_and_its_derivatives(results, operation):
    """The value is a float's to the last bit, the derivatives follow from the chain rule."""
    given, alone, expected = results[operation]
    np.testing.assert_array_equal(given[:, 0], alone)
    np.testing.assert_allclose(given[:, 1:], expected, rtol=2e-14, atol=1e-14)


def test_values_are_those_of_floats_in_the_worst_cases():
    """Signed zeros, infinities and what is no number give the values that they give floats."""
    tricky = [0.0, -0.0, 1.0, -1.5, 1e308, 5e-324, math.inf, -math.inf, math.nan]
    x, y = (np.zeros((81, WIDE)) for _ in range(2))
    x[:, 0], y[:, 0] = np.repeat(tricky, 9), np.tile(tricky, 9)
    operations = ["x + y", "x - y", "x * y", "x / y", "max(x, y)", "min(x, y)", "abs(x)", "-x", "math.hypot(x, y)"]
    given, alone = apply(operations, x, y)
    np.testing.assert_array_equal(given[..., 0], alone)
    there = ~np.isnan(alone)
    np.testing.assert_array_equal(np.signbit(given[..., 0])[there], np.signbit(alone)[there])


@pytest.mark.parametrize("sign", ["<", "<=", ">", ">=", "==", "!="])
def test_a_comparison_is_of_the_values(sign):
    """So a branch is that of a plain run, whatever the derivatives are."""
    x, y = np.random.default_rng(1).normal(size=(2, 9, WIDE))
    x[:, 0], y[:, 0] = np.repeat([0.0, 1.0, math.nan], 3), np.tile([0.0, 1.0, math.nan], 3)
    by = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq,
          "!=": operator.ne}[sign]  # fmt: skip
    given, _ = apply([f"1.0 if x {sign} y else 0.0"], x, y)
    np.testing.assert_array_equal(given[0, :, 0], by(x[:, 0], y[:, 0]))
    assert not np.any(given[..., 1:])


def test_a_root_at_zero_has_no_infinite_derivative_of_what_is_constant():
    """√0 and √(0² + 0²) of numbers whose derivatives are 0 have derivatives 0."""
    x = np.zeros((1, WIDE))
    given, _ = apply(["math.sqrt(x)", "math.hypot(x, x)"], x, x)
    assert not np.any(given)


def test_the_root_of_a_search_gets_its_derivatives():
    """Of x³ = p the bisection gives the value, one Newton step ∂x/∂p = 1/(3 x²), in all seven directions."""
    has_derivatives, sought, along, slope_of, settled = (
        dual8.has_derivatives, dual8.sought, dual8.along, dual8.slope_of, dual8.settled,
    )  # fmt: skip

    @compiled
    def cube_root(p):
        low, high = 0.0 * p, 1.0 + p
        for _ in range(200):
            x = 0.5 * (low + high)
            low, high = (x, high) if x * x * x < p else (low, x)
        if has_derivatives(x):
            x = along(x)
            slope = slope_of(x * x * x - p)
            x = sought(x)
            x = settled(x, x * x * x - p, slope)
        return x

    memory = aligned(2)
    memory[0] = [2.0, *np.arange(1.0, WIDE)]

    @compiled
    def run(at):
        x = dual_vector_at(at, 2)
        x[1] = cube_root(x[0])

    run(address_of(memory))
    root = 2.0 ** (1.0 / 3.0)
    assert memory[1, 0] == cube_root(2.0) == pytest.approx(root, rel=1e-15)
    np.testing.assert_allclose(memory[1, 1:], np.arange(1.0, WIDE) / (3.0 * root**2), rtol=1e-14)
