"""Decorators of the functions inside a step, which run compiled or interpreted from one source.

A function marked `@kernel` takes arrays and numbers, writes into its array arguments, and has no other state. numba
compiles it; with ``NUMBA_DISABLE_JIT=1`` the same lines run in plain Python.

The outermost function, which Python calls, is marked `@entry_kernel`: it is cached on disk, with everything that it
calls. numba decides from the text of *one* file whether a cached function is stale, and would keep an old `closure.py`
inside a cached `step.py`. So the cache is our own, in a folder named by a digest of all kernel files.
"""

import os
from collections.abc import Callable
from functools import cache, update_wrapper
from typing import Any, TypeVar, cast

from closedloop.base.interrupts import compiler_at_work
from closedloop.jit import plain_numba as plain_numba
from robot_models.cached import cached, cached_property

F = TypeVar("F", bound=Callable[..., Any])


def jit_disabled() -> bool:
    """Whether ``NUMBA_DISABLE_JIT=1``: everything runs interpreted then."""
    return os.environ.get("NUMBA_DISABLE_JIT", "").strip() not in ("", "0")


class Kernel:
    """A function for numba, of which it makes a dispatcher when that is first needed.

    So neither importing a kernel nor running its Python function costs the start of numba, half a second. Where numba
    meets one, in another kernel, `_numba_type_` gives it the dispatcher.

    `function`: the Python function, kept as `py_func`.
    `make`: makes the dispatcher of it.
    `unguarded`: of an entry that catches what a user's function raises, the one that does not: interpreted code runs
        that.
    """

    unguarded: Any = None

    def __init__(self, function: Callable[..., Any], make: Callable[[Callable[..., Any]], Any]) -> None:
        update_wrapper(self, function)
        self.py_func, self.make = function, make

    @cached_property
    def dispatcher(self) -> Any:
        """What numba made of the function."""
        with compiler_at_work():
            numba_ready()
            return self.make(self.py_func)

    @property
    def _numba_type_(self) -> Any:
        return _typeof(self.dispatcher)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the compiled function; it is compiled, or read from the cache, first."""
        return self.dispatcher(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "dispatcher":
            raise AttributeError(name)
        return getattr(self.dispatcher, name)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__  # a name in its module


def _typeof(value: Any) -> Any:
    import numba

    typeof: Any = numba.typeof
    return typeof(value)


@cache
def numba_ready() -> None:
    """Import numba, and teach it what is ours."""
    from closedloop.jit.inside import blocks, dual8, simd8  # noqa: F401


def _made(function: F, make: Callable[[Callable[..., Any]], Any]) -> F:
    return function if jit_disabled() else cast(F, Kernel(function, make))


def kernel(function: F) -> F:
    """Compile `function` into the entry kernel that calls it; strict IEEE arithmetic, no fast-math.

    Kernels own no memory, so numba's reference counting (`_nrt`) is off: it would cost more than a step's arithmetic.
    Hence a kernel may make views but no arrays, and returns only numbers to Python.
    """
    return _made(function, lambda plain: _nested(plain, {"error_model": "numpy", "_nrt": False}))


def _nested(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    if plain_numba():
        return _njit(function, **options)
    from closedloop.jit.inside.inline_once import NestedFunction

    def ordinary() -> Any:
        return _kept(function, _njit(function, **options))

    return NestedFunction(function, options, ordinary)


def _njit(function: Callable[..., Any], long_loops: bool = False, **options: Any) -> Any:
    import numba

    decorate: Any = numba.njit  # its annotations do not know all that it takes
    if not plain_numba():
        from closedloop.jit.inside.inline_once import EntryCompiler, LongLoopsCompiler

        options["pipeline_class"] = LongLoopsCompiler if long_loops else EntryCompiler
    return decorate(**options)(function)


def _kept(function: Callable[..., Any], compiled: Any, identity: str = "") -> Any:
    """Let what numba compiles for Python to call be kept on disk, and Ctrl-C wait until it is compiled."""
    if os.path.isfile(function.__code__.co_filename) and not plain_numba():
        from closedloop.jit.inside.compile_cache import KernelCache

        compiled._cache = KernelCache(function, identity)
    compile_now = compiled.compile

    def compile_uninterrupted(signature: Any) -> Any:
        with compiler_at_work():
            return compile_now(signature)

    compiled.compile = compile_uninterrupted
    return compiled


def inlined_kernel(function: F) -> F:
    """Inline `function` at numba's level: of two large nested functions LLVM would optimise the inner one twice."""
    return _made(function, lambda plain: _njit(plain, error_model="numpy", _nrt=False, inline="always"))


def kernel_inlined(function: F) -> F:
    """Inline `function` into each kernel that calls it, at LLVM's level: there is no call.

    A call passes each array as seven words, and the workspace of a step is forty arrays.
    """
    options = {"error_model": "numpy", "_nrt": False, "forceinline": True}
    return _made(function, lambda plain: _nested(plain, options))


def entry_kernel(function: F, *, nogil: bool = True, identity: str = "", long_loops: bool = False) -> F:
    """Compile `function` on first use and cache it on disk, keyed by the text of every kernel of the package.

    It releases the interpreter's lock unless `nogil` is false: that takes 30 ns. `identity` is, of a function made
    inside another, what it was made from. Loops are vectorised if they are long.
    """

    def make(plain: Callable[..., Any]) -> Any:
        form = getattr(plain, "form", "")  # see `closedloop.jit.dual`
        return _kept(plain, _njit(plain, long_loops, error_model="numpy", nogil=nogil, _nrt=False), identity + form)

    return _made(function, make)


def brief_entry(function: F) -> F:
    """Do as `entry_kernel`, without releasing the interpreter's lock, for calls of a microsecond."""
    return entry_kernel(function, nogil=False)


def long_loops_entry(function: F) -> F:
    """Do as `entry_kernel`, and vectorise loops: those over the rows of many contacts are long."""
    return entry_kernel(function, long_loops=True)


@cached
def kernel_of(member: type[Any], name: str, checked: bool = False) -> Callable[..., Any]:
    """Return a function of a member as a kernel, to be called by the member's entry.

    `checked` has it raise an IndexError where an index is beyond an array; else it would read or write what lies there.
    """
    function: Any = getattr(member, name)
    options = {"error_model": "numpy", "_nrt": False, "boundscheck": checked}
    made: Callable[..., Any] = (
        function if hasattr(function, "py_func") else _made(function, lambda plain: _nested(plain, options))
    )
    return made


def direct(function: F, *arguments: Any) -> F:
    """Return the compiled form of `function` for the types of these arguments: numba's dispatch takes 70 ns a call.

    Compiles or loads it if that has not been done. It does not check its arguments.
    """
    if not hasattr(function, "get_overload"):
        return function  # as with NUMBA_DISABLE_JIT=1
    kinds = tuple(map(_typeof, arguments))
    dispatcher = getattr(function, "dispatcher", cast(Any, function))
    if kinds not in dispatcher.overloads:  # numba's lock would stay taken if Ctrl-C came as it is entered
        dispatcher.compile(kinds)
    return cast(F, dispatcher.get_overload(kinds))


def plain(function: F) -> F:
    """Return the Python function of a kernel, for a single call from Python that is not worth compiling."""
    return cast(F, getattr(function, "py_func", function))


def needs_compiling(function: Callable[..., Any]) -> bool:
    """Whether calling `function` now would compile it first, which takes seconds."""
    dispatcher: Any = vars(function).get("dispatcher") if isinstance(function, Kernel) else function
    if getattr(dispatcher, "overloads", None) or jit_disabled():
        return False
    if plain_numba():
        return True
    from closedloop.jit.cache_folder import is_kept

    return not is_kept(function)
