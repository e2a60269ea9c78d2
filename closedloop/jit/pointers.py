"""Arrays by the address of their memory: what crosses from Python to compiled code at each step is then one number.

Each array that is handed over costs some 60 ns, fourteen of them as much as the step. None of them moves during a run,
so their addresses are written down once, in a block of whole numbers, and compiled code makes the arrays anew.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# An interpreted loop asks for the same few arrays at every step. They hold no memory: an array at an address is the
# same whoever has that memory now.
MOST_KEPT = 128


def address_of(array: NDArray[Any]) -> int:
    """Return where the numbers of an array are; they must stay there, and the array be kept."""
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
def whole_at(address: int, n: int) -> Whole:
    """Return the (n,) array of int64 at an address."""
    return np.ctypeslib.as_array((ctypes.c_int64 * int(n)).from_address(int(address)))
