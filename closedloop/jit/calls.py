"""Functions called by address: how the loop, compiled once, calls what a scenario chooses.

A member of a family of plug-ins is compiled by itself, into an entry of two whole numbers: the address of the loop's
memory (`closedloop.step.memory.loop_at`), and what is asked of it. The loop finds the entry's address in its memory
and calls it, at some 2 ns over a call that is inlined, and is not compiled again for another member.

Interpreted, an address is a number under which the Python function is kept.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from itertools import count
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin

from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import kernel

Entry = Callable[[int, int], int]

_WORD = ir.IntType(64)
_KIND = types.int64, types.int64
_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)

_interpreted: dict[int, Entry] = {}
_numbers = count(1)


@cache
def kernel_of(member: type[Any], name: str) -> Callable[..., Any]:
    """Return a function of a member as a kernel, to be called by the member's entry."""
    function: Any = getattr(member, name)
    made: Callable[..., Any] = function if hasattr(function, "py_func") else kernel(function)
    return made


def call_at(address: int, loop: int, what: int) -> int:
    """Call the entry at an address with its two numbers, and return its answer."""
    return _interpreted[int(address)](int(loop), int(what))


@infer_global(call_at)
class _CallAt(AbstractTemplate):
    key = call_at

    def generic(self, args: Any, kws: Any) -> Any:
        fits = len(args) == 3 and not kws and all(isinstance(x, types.Integer) for x in args)
        return signature(types.int64, types.int64, types.int64, types.int64) if fits else None


@lower_builtin(call_at, types.int64, types.int64, types.int64)
def _lower_call_at(context: Any, builder: Any, call: Any, values: Any) -> Any:
    kind = ir.FunctionType(_WORD, [_WORD, _WORD])
    return builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])


def entry_address(entry: Any) -> int:
    """Return the address of an entry: of machine code, or with ``NUMBA_DISABLE_JIT=1`` of the function itself."""
    return compiled_address(entry) if is_compiled(entry) else _address_of_function(entry)


@cache
def _address_of_function(entry: Entry) -> int:
    return interpreted_address(entry)


def twin_address(entry: Any) -> int:
    """Return the number by which interpreted code calls an entry, interpreted too."""
    return _address_of_function(interpreted(entry))


def compiled_address(entry: Any) -> int:
    """Return the address of an entry that numba compiles, compiling it first or reading it from the cache."""
    compiled = entry.get_compile_result(types.int64(*_KIND))
    return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name))


def interpreted_address(entry: Entry) -> int:
    """Return a number by which interpreted code calls an entry; it is kept until `forget_entry`."""
    number = next(_numbers)
    _interpreted[number] = entry
    return number


def forget_entry(address: int) -> None:
    """Keep an interpreted entry no longer."""
    _interpreted.pop(address, None)


def callback(entry: Entry) -> tuple[int, Any]:
    """Return an address by which compiled code calls a Python function, and what is to be kept as long as it does.

    The function must catch whatever it raises: nothing can be raised through compiled code.
    """
    kept = _CALLBACK(entry)
    address = ctypes.cast(kept, ctypes.c_void_p).value
    assert address is not None
    return address, kept


def is_compiled(function: Any) -> bool:
    """Whether a function is one of numba's; with ``NUMBA_DISABLE_JIT=1`` none is."""
    return isinstance(function, numba.core.dispatcher.Dispatcher)
