"""The cache of compiled code on disk, as numba's dispatchers use it.

A file holds numba's serialised code and a digest of it, so a file that was truncated or changed is detected, and its
function is compiled again. numba's own files have no digest, and an index in which two processes overwrite each other's
entries. If the folder cannot be used (disk full, no permission, no folder), the code is compiled in the process and the
run goes on. What a compiled function depends on outside of the package are users' functions that it calls, and their
constants.
"""

import hashlib
import os
import re
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core.caching import IndexDataCacheFile, _Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from closedloop.jit.cache_folder import CODE, MAGIC, cache_folder, claim, forget_old_caches, trusted_content
from closedloop.jit.inside.machine import compiler_and_processor
from robot_models.cached import cached_property

# What the folder's name answers for: the text of the package's kernels, and versions.
KNOWN = ("closedloop", "robot_models", "numba", "numpy", "math", "builtins")


def users_text(function: Any) -> bytes:
    """Return what users' functions say that a function calls, itself among them, wherever they are defined.

    Their instructions, and the numbers, texts and arrays that they take from their modules: numba makes constants of
    them.
    """
    said: list[bytes] = []
    seen: set[int] = set()
    waiting = [function]
    while waiting:
        each = waiting.pop()
        each = getattr(each, "py_func", each)
        if not isinstance(each, FunctionType) or id(each) in seen:
            continue
        seen.add(id(each))
        values = [cell.cell_contents for cell in each.__closure__ or ()]
        if (each.__module__ or "").partition(".")[0] not in KNOWN:
            for code in _codes(each.__code__):
                said += [code.co_code, repr([x for x in code.co_consts if not isinstance(x, CodeType)]).encode()]
                values += _values(each, code)
        said += [_constant(value) for value in values]
        waiting += values
    return b"\0".join(said)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _codes(inner)


def _values(function: FunctionType, code: CodeType) -> list[Any]:
    """Return what the names in a function's text stand for, in its module or in a module that this has imported."""
    found = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
    modules = [value for value in found if isinstance(value, ModuleType) and value.__name__ not in KNOWN]
    return found + [vars(module)[name] for module in modules for name in code.co_names if name in vars(module)]


def _constant(value: Any) -> bytes:
    if isinstance(value, np.ndarray):
        return repr((value.dtype.str, value.shape)).encode() + value.tobytes()
    simple = isinstance(value, bool | int | float | complex | str | bytes | np.generic | type(None))
    simple = simple or (isinstance(value, tuple) and all(isinstance(x, bool | int | float | str) for x in value))
    return repr(value).encode(errors="surrogatepass") if simple else b""


BLAS = "scipy.linalg.cython_blas"


def import_array_functions() -> None:
    """Import numba's array functions, if they are not there yet, as if scipy's BLAS were imported already.

    numba does so when it loads or compiles its first function, and imports all of scipy.linalg to detect BLAS: 0.3 s of
    processor time, for functions that no kernel here calls. Code that uses BLAS imports it before it is compiled.
    """
    if "numba.np.arraymath" in sys.modules or "scipy.linalg" in sys.modules or find_spec("scipy") is None:
        return
    sys.modules[BLAS] = ModuleType(BLAS)
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[BLAS]


class KernelCache(_Cache):
    """The cache of one function: loads compiled code for numba's dispatcher, and saves it.

    `function`: the Python function; its source must be a file.
    `identity`: of a function made inside another, what it was made from; by default a digest of its closure.
    """

    def __init__(self, function: Callable[..., Any], identity: str = "") -> None:
        self._function, self._made_of = function, identity

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(cache_folder())

    def enable(self) -> None:
        """Do nothing: it is never disabled."""

    def disable(self) -> None:
        """Do nothing: it is never disabled."""

    def flush(self) -> None:
        """Do nothing: what is compiled again takes the place of what was there."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled form for a signature, or None if it is not there as it was written."""
        import_array_functions()
        target_context.refresh()
        codegen = target_context.codegen()
        try:
            form = self._load(sig, codegen)
            found = form and CompileResult._rebuild(target_context, *form)
        except Exception:  # as it was written, but by another version of some package: anything may be missing
            return None
        if found is None or getattr(sig, "return_type", None) not in (None, found.signature.return_type):
            return None
        with suppress(OSError):
            _claim_once()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled form; what cannot be kept is compiled again in the next process."""
        if data.library.has_dynamic_globals or any(not lifted.can_cache for lifted in data.lifted):
            return
        with suppress(OSError):
            code = dumps((self._key(sig, data.codegen), data._reduce()))
            file = self._file(sig, data.codegen)
            unfinished = file.with_name(f"{file.name}.tmp.{uuid.uuid4().hex[:16]}")
            claim(file.parent)
            try:
                unfinished.write_bytes(code + _seal(code))
                unfinished.chmod(unfinished.stat().st_mode & ~0o022)  # what others can write is not loaded
                os.replace(unfinished, file)
            except BaseException:
                with suppress(OSError):
                    unfinished.unlink()
                raise
            _forget_once()

    def _load(self, sig: Any, codegen: Any) -> Any:
        file = self._file(sig, codegen)
        content = trusted_content(file)
        if content is None:
            return None
        code = content[: -len(MAGIC) - 32]
        if content[len(code) :] != _seal(code):
            return None
        key, found = IndexDataCacheFile(str(file.parent), "", None)._load_data(file.name)
        return found if key == self._key(sig, codegen) else None

    @cached_property
    def _identity(self) -> tuple[bytes, ...]:
        """Digests of what the code depends on beside the kernels: the function, what it encloses, its file."""
        cells = self._function.__closure__ or ()
        parts = (
            self._made_of.encode() or (dumps(tuple(cell.cell_contents for cell in cells)) if cells else b""),
            self._function.__code__.co_code,
            Path(self._function.__code__.co_filename).read_bytes(),
            users_text(self._function),
        )
        return tuple(hashlib.sha256(part).digest() for part in parts)

    def _key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (_arguments(sig), self._place(sig, codegen), *self._identity)

    def _place(self, sig: Any, codegen: Any) -> str:
        """Return what tells the files of a function apart: its signature, what it encloses, processor and versions.

        Not where its source lies: a copy finds what was compiled.
        """
        code = self._function.__code__
        where = (self._function.__module__, os.path.basename(code.co_filename), code.co_firstlineno, self._identity)
        return repr((str(_arguments(sig)), codegen.magic_tuple(), compiler_and_processor(), where))

    def _file(self, sig: Any, codegen: Any) -> Path:
        function = self._function
        name = re.sub(r"[^\w.]", "", f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}")
        digest = hashlib.sha256(self._place(sig, codegen).encode(errors="surrogatepass")).hexdigest()
        return cache_folder() / f"{name}-{digest[:32]}{CODE}"


def _arguments(sig: Any) -> Any:
    """Return the types of the arguments of a signature: numba gives it with the type of the answer, or without."""
    return tuple(getattr(sig, "args", sig))


def _seal(code: bytes) -> bytes:
    """Return what stands at the end of a file, where numba does not look."""
    return hashlib.sha256(code).digest() + MAGIC


@lru_cache(maxsize=1)
def _claim_once() -> None:
    claim(cache_folder())


@lru_cache(maxsize=1)
def _forget_once() -> None:
    forget_old_caches()
