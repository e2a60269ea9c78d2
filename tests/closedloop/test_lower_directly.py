"""Kernels are written for LLVM by code of our own: the same numbers as Python, and as numba by itself."""

import operator

import numba
import numpy as np
import pytest
from numba import types
from numba.core.registry import cpu_target

from closedloop.jit.kernel import kernel
from closedloop.jit.typing_once import call_type


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


def _ends(x, m, i):
    """Write the last numbers, by indices that are known, beside one that is computed."""
    x[-2] = x[-1] + m[-1, i] + m[i, -2]
    m[-1, -1], m[i, 0] = x[i], m[-2, -1]
    return x[-3]


def test_known_indices_of_our_own_kernels_may_count_from_the_end():
    """Computed ones do not: of these it is not looked whether they are negative."""
    results = []
    for module in ("closedloop.somewhere", "their_law"):
        _ends.__module__ = module
        for function in (kernel(_ends).dispatcher.ordinary, _ends):
            x, m = np.arange(4.0), np.arange(16.0).reshape(4, 4) ** 2
            results.append([function(x, m, 2), x, m])
    for found in results[1:]:
        for ours, theirs in zip(results[0], found, strict=True):
            assert np.array_equal(ours, theirs)


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


def test_a_function_that_is_compiled_for_its_caller_is_asked_each_time():
    """Of a function that numba compiles with the settings of its caller no answer is kept."""
    from closedloop.jit import typing_once

    context = cpu_target.typing_context
    function = context.resolve_value_type(np.hypot)
    other = context.resolve_value_type(round)
    for each, args in ((function, (types.float64,) * 2), (other, (types.float64, types.int64))):
        found = call_type(context, each, args)
        kept = (id(each), args) in typing_once._answers
        assert kept == (each.get_impl_key(found) is each.typing_key)
