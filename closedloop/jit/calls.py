"""Addresses of functions, of arrays and of their parts: at each step one number is passed to compiled code.

Each array passed costs some 60 ns, fourteen of them as much as the step. None of them moves during a run, so their
addresses are stored once, in a block of whole numbers, and compiled code makes array views from them.

A plug-in that a scenario chooses is compiled separately, into an entry with two integer arguments: the address of the
loop's memory (`closedloop.loop.step.memory.loop_at`), and which of its functions to call. The loop reads the entry's
address from its memory and calls it, at some 2 ns over an inlined call, and is not compiled again for another plug-in.

In interpreted code an address is a negative number under which the Python function is registered, or machine code's.
"""

import ctypes
from collections.abc import Callable
from functools import cache, lru_cache
from itertools import count
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, IntArray
from closedloop.base.interrupts import compiler_at_work
from closedloop.jit import plain_numba

# Views kept for an interpreted loop, which makes the same few at every step. They own no memory, so a view stays valid
# for any array at that address.
MOST_KEPT = 128


def address_of(array: NDArray[Any]) -> int:
    """Return the address of an array's data; the caller keeps the array alive and in place."""
    return int(array.__array_interface__["data"][0])  # a third of the time of `ctypes.data`


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
    """Return a row of a matrix: what `matrix[i]` is."""
    return matrix[i]


def matrix_of(vector: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Return the first numbers of a vector as a matrix, row after row."""
    return vector[0 : rows * columns].reshape(rows, columns)


Entry = Callable[[int, int], int]

_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)

_interpreted: dict[int, Entry] = {}
_numbers = count(-1, -1)
_addresses: WeakKeyDictionary[Any, int] = WeakKeyDictionary()  # of machine code, by the entries that keep it
_plain: WeakKeyDictionary[Any, Any] = WeakKeyDictionary()  # what keeps it, see `closedloop.jit.plain_numba`


def call_at(address: int, loop: int, what: int) -> int:
    """Call the entry at an address with its two numbers, and return its answer."""
    number = int(address)
    return (_interpreted[number] if number < 0 else function_at(number))(int(loop), int(what))


@cache
def function_at(address: int) -> Entry:
    """Return the compiled entry at an address for Python to call."""
    return _CALLBACK(address)


def entry_address(entry: Any) -> int:
    """Return the address of an entry: of machine code, or with ``NUMBA_DISABLE_JIT=1`` of the function itself."""
    return compiled_address(entry) if is_compiled(entry) else address_of_function(entry)


@cache
def address_of_function(entry: Entry) -> int:
    """Return the number by which interpreted code calls an entry that is kept for good."""
    return interpreted_address(entry)


def compiled_address(entry: Any) -> int:
    """Return the address of an entry that numba compiles, compiling it first or reading it from the cache.

    LLVM is asked once for each entry, uninterrupted.
    """
    if entry not in _addresses:
        with compiler_at_work():
            from numba import cfunc, types

            kind = types.int64(types.int64, types.int64)
            if plain_numba():
                _plain[entry] = cfunc(kind, **entry.targetoptions)(entry.py_func)
                _addresses[entry] = _plain[entry].address
            else:
                from closedloop.jit.inside.machine import address_of_compiled

                _addresses[entry] = address_of_compiled(entry.get_compile_result(kind))
    return _addresses[entry]


def interpreted_address(entry: Entry) -> int:
    """Return a number by which interpreted code calls an entry; it is kept until `forget_entry`."""
    number = next(_numbers)
    _interpreted[number] = entry
    return number


def forget_entry(address: int) -> None:
    """Keep an interpreted entry no longer."""
    _interpreted.pop(address, None)


def callback(entry: Entry) -> tuple[int, Any]:
    """Return an address by which compiled code calls a Python function, and an object to be kept as long as it does.

    The function must catch all exceptions: none can pass through compiled code.
    """
    kept = _CALLBACK(entry)
    address = ctypes.cast(kept, ctypes.c_void_p).value
    assert address is not None
    return address, kept


def is_compiled(function: Any) -> bool:
    """Whether a function is one of numba's; with ``NUMBA_DISABLE_JIT=1`` none is."""
    return hasattr(function, "py_func") and hasattr(function, "targetoptions")
