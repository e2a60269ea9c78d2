"""Arrays by address, and parts of arrays: at each step one number is passed from Python to compiled code.

Each array passed costs some 60 ns, fourteen of them as much as the step. None of them moves during a run, so their
addresses are stored once, in a block of whole numbers, and compiled code makes array views from them.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, IntArray

# Views kept for an interpreted loop, which makes the same few at every step. They own no memory, so a view stays valid
# for any array at that address.
MOST_KEPT = 128


def address_of(array: NDArray[Any]) -> int:
    """Return the address of an array's data; the caller keeps the array alive and in place."""
    return int(array.ctypes.data)


@lru_cache(maxsize=MOST_KEPT)
def vector_at(address: int, n: int) -> Array:
    """Return the (n,) array of float64 at an address."""
    return np.ctypeslib.as_array((ctypes.c_double * int(n)).from_address(int(address)))


@lru_cache(maxsize=MOST_KEPT)
def matrix_at(address: int, rows: int, columns: int) -> Array:
    """Return the (rows, columns) array of float64 at an address, row after row."""
    return vector_at(address, rows * columns).reshape(rows, columns)


@lru_cache(maxsize=MOST_KEPT)
def fortran_at(address: int, rows: int, columns: int) -> Array:
    """Return the (rows, columns) array of float64 at an address, column after column."""
    return vector_at(address, rows * columns).reshape(rows, columns, order="F")


@lru_cache(maxsize=MOST_KEPT)
def integers_at(address: int, n: int) -> IntArray:
    """Return the (n,) array of int64 at an address."""
    return np.ctypeslib.as_array((ctypes.c_int64 * int(n)).from_address(int(address)))


@lru_cache(maxsize=MOST_KEPT)
def known_matrix_at(address: int, rows: int, columns: int) -> Array:
    """Return what `matrix_at` does, of numbers that nothing of a scenario changes: floats in every form of a kernel."""
    return vector_at(address, rows * columns).reshape(rows, columns)


def row_of(matrix: NDArray[Any], i: int) -> NDArray[Any]:
    """Return a row of a matrix: what `matrix[i]` is, which a buffer refuses (`closedloop.jit.buffers`)."""
    return matrix[i]


def matrix_of(vector: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Return the first numbers of a vector as a matrix, row after row."""
    return vector[0 : rows * columns].reshape(rows, columns)
