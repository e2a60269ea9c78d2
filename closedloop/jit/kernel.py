"""One source, two ways to run it: the decorators of everything that happens inside a step.

A function marked `@kernel` takes arrays and numbers, writes into the arrays it is given, and keeps nothing.
numba compiles it; with ``NUMBA_DISABLE_JIT=1`` the very same lines run in plain Python.

The outermost function is marked `@entry_kernel`: what Python calls is cached on disk, with everything that it calls.
numba decides from the text of *one* file whether a cached function is stale, which would silently keep an old
`closure.py` inside a cached `step.py`. So the cache is our own, in a folder named after the text of all kernel files.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from closedloop.interrupts import held_back
from closedloop.jit.cache_folder import cache_folder as cache_folder
from closedloop.jit.cache_folder import is_kept
from closedloop.jit.cache_folder import numba_settings as numba_settings
from closedloop.jit.compile_cache import KernelCache
from closedloop.jit.inline_once import NestedFunction

_typeof: Any = numba.typeof
_njit: Any = numba.njit  # its annotations do not know all that it takes

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` into the entry kernel that calls it; strict IEEE arithmetic, no fast-math.

    Kernels own no memory, so numba need not count who refers to it (`_nrt`): counting would cost more than a step's
    arithmetic. Hence a kernel may make views, but neither arrays nor anything that it returns to Python but numbers.
    """
    return _nested(function, {"error_model": "numpy", "_nrt": False})


def _nested(function: F, options: dict[str, Any]) -> F:
    if numba_settings.DISABLE_JIT:
        return function
    return cast(F, NestedFunction(function, options, _kept(function, _njit(**options)(function))))


def _kept(function: F, compiled: Any, identity: str = "") -> Any:
    """Let what numba compiles for Python to call be kept on disk, and Ctrl-C wait until it is compiled.

    numba takes a lock while it compiles, and Ctrl-C just as it does so would leave it taken: what another thread
    compiles later would wait for ever. A second Ctrl-C does not wait.
    """
    if os.path.isfile(function.__code__.co_filename):
        compiled._cache = KernelCache(function, identity)
    compile_now = compiled.compile

    def compile_uninterrupted(signature: Any) -> Any:
        with held_back(signal.SIGINT):
            return compile_now(signature)

    compiled.compile = compile_uninterrupted
    return compiled


def inlined_kernel(function: F) -> F:
    """Make `function` a part of the kernel that calls it: of two large functions, one nested in the other, LLVM would
    optimise the inner one twice."""
    return cast(F, _njit(error_model="numpy", _nrt=False, inline="always")(function))


def kernel_inlined(function: F) -> F:
    """Compile `function` into each kernel that calls it, machine code and all: it costs no call.

    A call hands over each array as seven words, and the workspace of a step is forty arrays.
    """
    return _nested(function, {"error_model": "numpy", "_nrt": False, "forceinline": True})


def entry_kernel(function: F, *, nogil: bool = True, identity: str = "") -> F:
    """Compile `function` on first use and cache it on disk, keyed by the text of every kernel of the package.

    It lets other threads of Python run unless `nogil` is false: that takes 30 ns. `identity` says, of a function made
    inside another, what it was made of.
    """
    compiled = _njit(error_model="numpy", nogil=nogil, _nrt=False)(function)
    return cast(F, compiled if numba_settings.DISABLE_JIT else _kept(function, compiled, identity))


def brief_entry(function: F) -> F:
    """Do as `entry_kernel`, for what is done before another thread could begin."""
    return entry_kernel(function, nogil=False)


def direct(function: F, *arguments: Any) -> F:
    """Return what `function` calls for arguments like these, itself: numba's choice among forms takes 70 ns each time.

    Compiles or loads it if that has not been done. It no longer checks what it is given.
    """
    if not hasattr(function, "get_overload"):
        return function  # as with NUMBA_DISABLE_JIT=1
    kinds = tuple(_typeof(x) for x in arguments)
    dispatcher = cast(Any, function)
    if kinds not in dispatcher.overloads:  # numba's lock would stay taken if Ctrl-C came as it is entered
        dispatcher.compile(kinds)
    return cast(F, dispatcher.get_overload(kinds))


def plain(function: F) -> F:
    """Return the Python function that a kernel was made of: to call it once from Python is not worth compiling it."""
    return cast(F, getattr(function, "py_func", function))


def needs_compiling(function: Callable[..., Any]) -> bool:
    """Whether calling `function` now would compile it first, which takes seconds."""
    if numba_settings.DISABLE_JIT or getattr(function, "signatures", ()):
        return False
    return not is_kept(function)
