"""Functions called by address: how the loop, compiled once, calls the plug-ins that a scenario chooses.

A plug-in is compiled separately, into an entry with two integer arguments: the address of the loop's memory
(`closedloop.loop.step.memory.loop_at`), and which of its functions to call. The loop reads the entry's address from its
memory and calls it, at some 2 ns over an inlined call, and is not compiled again for another plug-in.

In interpreted code an address is a negative number under which the Python function is registered, or machine code's.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from itertools import count
from typing import Any
from weakref import WeakKeyDictionary

from closedloop.jit.uninterrupted import compiler_at_work

Entry = Callable[[int, int], int]

_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)

_interpreted: dict[int, Entry] = {}
_with_buffers: dict[int, Entry] = {}
_numbers = count(-1, -1)
_addresses: WeakKeyDictionary[Any, int] = WeakKeyDictionary()  # of machine code, by the entries that keep it


def call_at(address: int, loop: int, what: int) -> int:
    """Call the entry at an address with its two numbers, and return its answer."""
    number = int(address)
    return (_interpreted[number] if number < 0 else function_at(number))(int(loop), int(what))


@cache
def function_at(address: int) -> Entry:
    """Return the compiled entry at an address for Python to call."""
    return _CALLBACK(address)


# What Python raises where buffers cannot do what arrays can.
NOT_WITH_BUFFERS = TypeError, AttributeError, NotImplementedError


class NeedsArraysError(Exception):
    """An entry cannot do with buffers; it gets arrays from now on, and the call of the loop has to be begun again."""


def call_with_buffers(address: int, loop: int, what: int) -> int:
    """Do as `call_at` in code that is interpreted with buffers (`closedloop.jit.buffers`)."""
    number = int(address)
    entry = _with_buffers.get(number)
    if entry is None:
        return call_at(number, loop, what)
    try:
        return entry(int(loop), int(what))
    except NOT_WITH_BUFFERS as error:
        del _with_buffers[number]
        raise NeedsArraysError from error


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
            from numba import types

            compiled = entry.get_compile_result(types.int64(types.int64, types.int64))
            _addresses[entry] = int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name))
    return _addresses[entry]


def give_with_buffers(address: int, entry: Entry) -> None:
    """Let code that is interpreted with buffers call this form of an entry that is kept for good."""
    _with_buffers[address] = entry


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
