"""Decorators of the functions inside a step, which run compiled or interpreted from one source.

A function marked `@kernel` takes arrays and numbers, writes into its array arguments, and has no other state. numba
compiles it; with ``NUMBA_DISABLE_JIT=1`` the same lines run in plain Python.

The outermost function, which Python calls, is marked `@entry_kernel`: it is cached on disk, with everything that it
calls. numba decides from the text of *one* file whether a cached function is stale, and would keep an old `closure.py`
inside a cached `step.py`. So the cache is our own, in a folder named by a digest of all kernel files.
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

    Kernels own no memory, so numba's reference counting (`_nrt`) is off: it would cost more than a step's arithmetic.
    Hence a kernel may make views but no arrays, and returns only numbers to Python.
    """
    return _nested(function, {"error_model": "numpy", "_nrt": False})


def _nested(function: F, options: dict[str, Any]) -> F:
    if numba_settings.DISABLE_JIT:
        return function
    return cast(F, NestedFunction(function, options, _kept(function, _njit(**options)(function))))


def _kept(function: F, compiled: Any, identity: str = "") -> Any:
    """Let what numba compiles for Python to call be kept on disk, and Ctrl-C wait until it is compiled.

    numba takes a lock while it compiles, and Ctrl-C at that moment would leave it taken: another thread that compiles
    later would wait for ever. A second Ctrl-C does not wait.
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
    """Inline `function` into each kernel that calls it, at LLVM's level: there is no call.

    A call passes each array as seven words, and the workspace of a step is forty arrays.
    """
    return _nested(function, {"error_model": "numpy", "_nrt": False, "forceinline": True})


def entry_kernel(function: F, *, nogil: bool = True, identity: str = "") -> F:
    """Compile `function` on first use and cache it on disk, keyed by the text of every kernel of the package.

    It releases the interpreter's lock unless `nogil` is false: that takes 30 ns. `identity` is, of a function made
    inside another, what it was made from.
    """
    compiled = _njit(error_model="numpy", nogil=nogil, _nrt=False)(function)
    return cast(F, compiled if numba_settings.DISABLE_JIT else _kept(function, compiled, identity))


def brief_entry(function: F) -> F:
    """Do as `entry_kernel`, without releasing the interpreter's lock, for calls of a microsecond."""
    return entry_kernel(function, nogil=False)


def direct(function: F, *arguments: Any) -> F:
    """Return the compiled form of `function` for the types of these arguments: numba's dispatch takes 70 ns a call.

    Compiles or loads it if that has not been done. It does not check its arguments.
    """
    if not hasattr(function, "get_overload"):
        return function  # as with NUMBA_DISABLE_JIT=1
    kinds = tuple(_typeof(x) for x in arguments)
    dispatcher = cast(Any, function)
    if kinds not in dispatcher.overloads:  # numba's lock would stay taken if Ctrl-C came as it is entered
        dispatcher.compile(kinds)
    return cast(F, dispatcher.get_overload(kinds))


def plain(function: F) -> F:
    """Return the Python function of a kernel, for a single call from Python that is not worth compiling."""
    return cast(F, getattr(function, "py_func", function))


def needs_compiling(function: Callable[..., Any]) -> bool:
    """Whether calling `function` now would compile it first, which takes seconds."""
    if numba_settings.DISABLE_JIT or getattr(function, "signatures", ()):
        return False
    return not is_kept(function)
