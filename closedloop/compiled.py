"""One source, two ways to run it: the decorators of everything that happens inside a step.

A function marked `@kernel` takes arrays and numbers, writes into the arrays it is given, and keeps nothing.
numba compiles it; with ``NUMBA_DISABLE_JIT=1`` the very same lines run in plain Python.

The outermost function is marked `@entry_kernel`: it alone is cached on disk, with everything that it calls.
numba decides from the time stamp of *one* file whether a cached function is stale, which would silently keep an
old `closure.py` inside a cached `step.py`. So the cache sits in a folder named after the text of all kernel files.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as _config

from closedloop.nested import NestedFunction

numba_settings: Any = _config  # its attributes are made at run time, which type checkers cannot see

_typeof: Any = numba.typeof
_njit: Any = numba.njit  # its annotations do not know all that it takes

# What tells a file whose text the compiled code depends on.
MARKS = (b"\n@kernel", b"\n@inlined_kernel", b"\n@entry_kernel", b"\n@brief_entry", b"@lower_builtin")

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
    return cast(F, NestedFunction(function, options, _njit(**options)(function)))


def inlined_kernel(function: F) -> F:
    """Make `function` a part of the kernel that calls it: of two large functions, one nested in the other, LLVM would
    optimise the inner one twice."""
    return cast(F, _njit(error_model="numpy", _nrt=False, inline="always")(function))


def kernel_inlined(function: F) -> F:
    """Compile `function` into each kernel that calls it, machine code and all: it costs no call.

    A call hands over each array as seven words, and the workspace of a step is forty arrays.
    """
    return _nested(function, {"error_model": "numpy", "_nrt": False, "forceinline": True})


def entry_kernel(function: F, *, nogil: bool = True) -> F:
    """Compile `function` on first use and cache it on disk, keyed by the text of every kernel of the package.

    It lets other threads of Python run unless `nogil` is false: that takes 30 ns.
    """
    before = numba_settings.CACHE_DIR
    numba_settings.CACHE_DIR = str(cache_folder())
    try:
        return cast(F, _njit(error_model="numpy", cache=True, nogil=nogil, _nrt=False)(function))
    except RuntimeError:  # numba found no folder that it may write: compile in every process
        return cast(F, _njit(error_model="numpy", _nrt=False)(function))
    finally:
        numba_settings.CACHE_DIR = before


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
    dispatcher.compile(kinds)
    return cast(F, dispatcher.get_overload(kinds))


def plain(function: F) -> F:
    """Return the Python function that a kernel was made of: to call it once from Python is not worth compiling it."""
    return cast(F, getattr(function, "py_func", function))


def needs_compiling(function: Callable[..., Any]) -> bool:
    """Whether calling `function` now would compile it first, which takes seconds."""
    if numba_settings.DISABLE_JIT or getattr(function, "signatures", ()):
        return False
    return not any(cache_folder().rglob(f"*.{function.__name__}-*.nbc"))


@lru_cache(maxsize=1)
def cache_folder() -> Path:
    """Where the compiled entry kernels of exactly this source are kept."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        text = path.read_bytes()
        if any(mark in text for mark in MARKS):
            digest.update(text)
    return _cache_root() / f"closedloop-{digest.hexdigest()[:16]}"


def _cache_root() -> Path:
    """NUMBA_CACHE_DIR if set, the package's own __pycache__ if writable, else the user's cache folder."""
    if numba_settings.CACHE_DIR:
        return Path(numba_settings.CACHE_DIR)
    beside = Path(__file__).parent / "__pycache__"
    with suppress(OSError):
        beside.mkdir(exist_ok=True)
    if os.access(beside, os.W_OK):
        return beside
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def forget_old_caches() -> None:
    """Delete the compiled code of earlier versions of the source; called after a compilation, never on a warm start."""
    for folder in _cache_root().glob("closedloop-*"):
        if folder != cache_folder():
            shutil.rmtree(folder, ignore_errors=True)
