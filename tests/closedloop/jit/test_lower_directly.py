"""Kernels are written for LLVM by code of our own: the same numbers as Python, and as numba by itself."""

import ast
import operator
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import types
from numba.core.compiler import Flags
from numba.core.registry import cpu_target
from numba.core.runtime import _nrt_python, rtsys
from numba.core.targetconfig import ConfigStack

from closedloop.jit.inside.inline_once import call_type
from closedloop.jit.kernel import kernel


def _elements(x, m, f, every_second, whole, flags, last):
    """Read and write elements in every way that kernels do, and in those that are left to numba."""
    n = x.shape[0]
    for i in range(n):
        x[i] += m[0, i] * m[-1, last] - x[-1] / 4 + i // 3 - i % 2
        x[n - 1 - i] -= f[i, 1] * f[1, -2]
        whole[i] = i * 2 - whole[-1 - i]
        flags[i] = x[i] > x[0] or not flags[-1]
    m[1, -1], m[last, 0] = 3, whole[2]  # a whole number becomes a float
    x[0], x[-2] = whole[0], 2**3 + x[1] ** 2
    every_second[1] = every_second[-1] + x[np.uint64(2)]
    row = m[1]
    row[2] += x[1:][0]
    at = (1, 1)
    m[at] += row[at[0]] + m[0][1]
    for value in x:
        whole[1] += int(value > 0.0)
    return float(m[-2, -3]) if x[0] < 1e9 else 0.0


def _given():
    rng = np.random.default_rng(5)
    numbers = rng.normal(size=(4, 4))
    m, f = rng.normal(size=(4, 4)), np.asfortranarray(rng.normal(size=(4, 4)))
    return numbers[0].copy(), m, f, numbers.ravel()[::2], np.arange(4), np.zeros(4, dtype=bool), -1


def test_elements_are_those_of_python_and_of_numba():
    """Signs of indices, orders of memory, whole numbers and flags: to the last bit."""
    results = []
    for function in (kernel(_elements).dispatcher.ordinary, _elements, numba.njit(error_model="numpy")(_elements)):
        given = _given()
        results.append([function(*given), *given])
    for found in results[1:]:
        for ours, theirs in zip(results[0], found, strict=True):
            assert np.array_equal(ours, theirs)


PLUG_INS = {"laws", "compensation", "surface", "integrators", "paths", "impact", "friction"}
OURS = [Path(__file__).parents[3] / name for name in ("closedloop", "validation")]


def _compiled_functions(path):
    """The functions in a file that are compiled: kernels, and the static methods of laws and other plug-ins."""
    for each in ast.walk(ast.parse(path.read_text())):
        if isinstance(each, ast.FunctionDef):
            marks = " ".join(ast.unparse(mark) for mark in each.decorator_list)
            if "kernel" in marks or ("staticmethod" in marks and PLUG_INS & set(path.parts)):
                yield each


def test_no_kernel_of_our_own_has_a_negative_index():
    """It is not tested there, and would read what is before the array."""
    found, functions = [], 0
    for path in (path for folder in OURS for path in folder.rglob("*.py")):
        for function in _compiled_functions(path):
            functions += 1
            for each in ast.walk(function):
                if isinstance(each, ast.Subscript):
                    indices = each.slice.elts if isinstance(each.slice, ast.Tuple) else [each.slice]
                    if any(isinstance(i, ast.UnaryOp) and isinstance(i.op, ast.USub) for i in indices):
                        found.append(f"{path}:{each.lineno}: {ast.unparse(each)}")
    assert not found
    assert functions > 600


@pytest.mark.parametrize("operation", [operator.add, operator.truediv, operator.mod, operator.lt, operator.and_])
def test_kept_answers_are_those_of_numba(operation):
    """The type of an operation is what numba says, the first time and later; a wrong operation is refused."""
    context = cpu_target.typing_context
    function = context.resolve_value_type(operation)
    plain = [types.int64, types.uint64, types.float64, types.boolean]
    asked = 0
    for args in ((a, b) for a in plain for b in plain):
        try:
            wanted = function.get_call_type(context, args, {})
        except numba.TypingError:
            for _ in range(2):
                with pytest.raises(numba.TypingError):
                    call_type(context, function, args)
            continue
        asked += 1
        assert call_type(context, function, args) == call_type(context, function, args) == wanted
    assert asked > 3


def test_an_answer_that_is_compiled_serves_callers_with_the_same_flags():
    """Of a function that numba compiles with the settings of its caller each sort of callers has its own code."""
    context = cpu_target.typing_context
    function, args = context.resolve_value_type(max), (types.float64,) * 2
    code = []
    for error_model in ("python", "numpy", "python", "numpy"):
        flags = Flags()
        flags.error_model = error_model
        with ConfigStack().enter(flags):
            code.append(function.get_impl_key(call_type(context, function, args)))
    assert code[0] is code[2] is not code[1] is code[3]


def test_memory_of_a_user_is_released():
    """A law that numba compiles may own memory: its parts of ours count references, and leave none."""
    from closedloop.jit.inside.inline_once import NestedFunction

    def twice(x):
        def sum_of(y):  # a function within the function
            return y[0] + y[1]

        y = x * 2.0  # an array expression, with memory of its own
        return y, sum_of(y)

    inner = NestedFunction(twice, {}, lambda: numba.njit(twice))
    outer = numba.njit(lambda x: inner(x)[0][1] + inner(x)[1])
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        assert outer(np.array([1.0, 2.0])) == 4.0 + 6.0
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0
