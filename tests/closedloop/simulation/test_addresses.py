"""Arrays by their addresses: the same numbers, in the same places, from Python and from compiled code."""

import numpy as np

from closedloop.jit.calls import address_of, fortran_at, integers_at, matrix_at, vector_at
from closedloop.jit.kernel import kernel


@kernel
def _double(vector, matrix, fortran, whole):
    for x in (vector_at(vector, 6),):
        for i in range(6):
            x[i] *= 2.0
    m, f, w = matrix_at(matrix, 2, 3), fortran_at(fortran, 2, 3), integers_at(whole, 2)
    for i in range(2):
        w[i] += 10
        for j in range(3):
            m[i, j] += 10.0 * i + j
            f[i, j] += 10.0 * i + j
    return m.shape[0] * 10 + f.shape[1]


def test_arrays_are_where_their_addresses_say():
    """Compiled code and plain Python write the same into the arrays whose addresses they are given."""
    results = []
    for function in (_double, _double.py_func):
        vector, whole = np.arange(6.0), np.array([1, 2])
        matrix, fortran = np.zeros((2, 3)), np.zeros((2, 3), order="F")
        assert function(*(address_of(x) for x in (vector, matrix, fortran, whole))) == 23
        results.append((vector, matrix, fortran, whole))
        assert np.array_equal(vector, 2.0 * np.arange(6))
        assert np.array_equal(matrix, [[0, 1, 2], [10, 11, 12]])
        assert np.array_equal(matrix, fortran)
        assert whole.tolist() == [11, 12]
