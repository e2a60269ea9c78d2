"""Kernels interpreted: a kernel's Python function, with the functions that it calls interpreted too.

The globals of a kernel's Python function are compiled functions. Its twin is the same code with other globals, in which
every compiled function is replaced by its twin. Both do IEEE arithmetic in the same order, so the results are the same
to the last bit; `math.hypot`, which Python implements itself, is the C library's in the twin, as in compiled code.

`Interim` is what begins a run before its loop is compiled.
"""

from __future__ import annotations

import math
import threading
import time as clock
import types
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from closedloop.jit import background
from closedloop.jit.buffers import with_buffers
from closedloop.jit.calls import (
    NOT_WITH_BUFFERS,
    Entry,
    NeedsArraysError,
    address_of_function,
    entry_address,
    give_with_buffers,
)
from closedloop.jit.kernel import direct, needs_compiling
from closedloop.jit.lanewise import LANEWISE, on_arrays

F = TypeVar("F", bound=Callable[..., Any])

_MATH = types.ModuleType("math", "The module `math` as compiled code has it.")
_MATH.__dict__.update({name: value for name, value in vars(math).items() if not name.startswith("_")})
_MATH.__dict__["hypot"] = np.hypot

# Twins, and the globals of twins, by the identity of what they are of, which is kept with them; with arrays, or with
# buffers (`closedloop.jit.buffers`).
_twins: dict[tuple[int, bool], tuple[Any, Any]] = {}
_globals: dict[tuple[int, bool], tuple[dict[str, Any], dict[str, Any]]] = {}
_making = threading.RLock()


def interpreted(function: F, buffers: bool = False) -> F:
    """Return the twin of a function that numba has been given: the same source, interpreted.

    It gives what the compiled form gives, to the last bit, with one exception: where Python's arithmetic raises an
    ArithmeticError or a ValueError (1.0 / 0.0, math.sqrt(-1.0)), compiled code goes on with what IEEE 754 says. What
    numpy warns of in the twin, compiled code does in silence.

    Parameters
    ----------
    function : callable
        A function with the attribute `py_func`; another is returned as it is, as with ``NUMBA_DISABLE_JIT=1``.
    buffers : bool
        Whether what it takes by address are buffers: twice as fast, and refused by some kernels with an exception.
    """
    if not hasattr(function, "py_func"):
        return function
    if getattr(function, "unguarded", None) is not None:
        return cast(F, interpreted(cast(Any, function).unguarded, buffers))
    key = id(function), buffers
    with _making:
        if key not in _twins:
            source = function.py_func
            if buffers and hasattr(source, "takes_arrays"):
                _twins[key] = function, on_arrays(interpreted(function))
                return cast(F, _twins[key][1])
            cells = tuple(types.CellType(_twin_value(cell.cell_contents, buffers)) for cell in source.__closure__ or ())
            names = _twin_globals(source.__globals__, buffers)
            if hasattr(source, "lanewise"):
                names = names | LANEWISE
            twin = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__, cells)
            twin.__kwdefaults__, twin.__doc__ = source.__kwdefaults__, source.__doc__
            twin.__qualname__ = source.__qualname__
            _twins.setdefault(key, (function, twin))
        return cast(F, _twins[key][1])


def twin_address(entry: Entry) -> int:
    """Return the number by which interpreted code calls an entry, interpreted too; see `closedloop.jit.calls`."""
    address = address_of_function(interpreted(entry))
    if getattr(entry, "unguarded", None) is None:  # a user's is written for arrays
        give_with_buffers(address, interpreted(entry, buffers=True))
    return address


def _twin_globals(names: dict[str, Any], buffers: bool) -> dict[str, Any]:
    key = id(names), buffers
    if key not in _globals:
        # Entered before it is filled: two modules may have functions of each other.
        _globals[key] = names, dict(names)
        _globals[key][1].update({name: _twin_value(value, buffers) for name, value in names.items()})
    return _globals[key][1]


def _twin_value(value: Any, buffers: bool) -> Any:
    if value is math:
        return _MATH
    if buffers and (other := with_buffers(value)) is not value:
        return other
    return interpreted(value, buffers) if callable(value) else value


# Calls after which it is known how long they take; seconds between two looks for the compiled form; and how many times
# longer than compiling the rest of a run must take, interpreted, for it to wait for the compiler instead.
PROBE, BETWEEN_LOOKS, WORTH_WAITING = 50, 0.5, 1.5
# Calls of each function that were interpreted so far in this process: many short runs are as good as a long one.
_so_far: Counter[str] = Counter()


class Interim:
    """A kernel that is called again and again: interpreted, until its compiled form is there.

    After the first calls it is known what is sooner. Where compiling is, it is done, or waited for, at once; else a
    process in the background does it (`closedloop.jit.background`), and this one goes over to the compiled form as
    soon as that is on the disk. Each call begins from what the last one left, so nothing depends on when that is.

    Parameters
    ----------
    function : callable
        The kernel, an `entry_kernel`.
    written : sequence of arrays
        What a call reads and changes: it is put back if a call must be begun again, or is interrupted.
    calls : int
        How many calls there will be, about.
    seconds : float
        How long compiling takes, about.
    with_it : sequence of callables
        What else the caller will want compiled.
    on_compiled : callable
        Called before the compiled form is, for the first time.
    later : sequence of callables
        What later runs will want: compiled in the background as well, and not waited for.
    buffers : bool
        Whether buffers may be tried. A call that they cannot do is begun again with arrays: so only where `written` is
        all that a call changes.

    Attributes
    ----------
    compiling : float
        Time that was spent on compiling or loading the compiled form so far, s.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        written: Sequence[NDArray[Any]],
        calls: int,
        seconds: float,
        with_it: Sequence[Callable[..., Any]] = (),
        on_compiled: Callable[[], None] = lambda: None,
        later: Sequence[Callable[..., Any]] = (),
        buffers: bool = False,
    ) -> None:
        self._function, self._twin, self._written = function, interpreted(function), written
        self._quick, self._with_buffers = interpreted(function, buffers), buffers
        self._calls, self._seconds, self._with_it = calls, seconds, (function, *with_it)
        self._later = later
        self._on_compiled = on_compiled
        self._compiled: Callable[..., Any] | None = None
        self._done, self._seconds_done, self._look_at, self._decided = 0, 0.0, 0.0, False
        self.compiling = 0.0

    @property
    def interpreting(self) -> bool:
        """Whether the compiled form is not in use yet."""
        return self._compiled is None

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel."""
        if self._compiled is not None:
            return self._compiled(*arguments)
        began = clock.perf_counter()
        if began >= self._look_at:
            self._look_at = began + BETWEEN_LOOKS
            if not any(map(needs_compiling, self._with_it)):
                return self._compile(arguments)(*arguments)
            if self._decided:
                self._compile_behind()  # again, if another process was compiling something else
        before = [array.copy() for array in self._written]
        busy = clock.thread_time()  # of the processor: on a loaded machine compiling takes longer by as much
        try:
            with np.errstate(all="ignore"):
                answer = self._interpret(arguments, before)
        except (ArithmeticError, ValueError):  # where compiled code would go on
            self._put_back(before)
            return self._compile(arguments)(*arguments)
        except BaseException:
            self._put_back(before)
            raise
        _so_far[self._function.__name__] += 1
        self._done += 1
        self._seconds_done += clock.thread_time() - busy
        if not self._decided and (self._done >= PROBE or _so_far[self._function.__name__] >= PROBE > self._calls):
            self._decided = True
            self._decide((self._calls - self._done) * self._seconds_done / self._done, arguments)
        return answer

    def _interpret(self, arguments: tuple[Any, ...], before: Sequence[NDArray[Any]]) -> Any:
        """Call the kernel interpreted: with buffers, or with arrays where it cannot do with them."""
        while self._with_buffers:
            try:
                return self._quick(*arguments)
            except NeedsArraysError:
                self._put_back(before)
            except ArithmeticError:  # such as a division by zero, of which arrays make an infinity
                self._put_back(before)
                break
            except NOT_WITH_BUFFERS:
                self._put_back(before)
                self._with_buffers = False
        return self._twin(*arguments)

    def _decide(self, left: float, arguments: tuple[Any, ...]) -> None:
        """Wait for the compiler, or let it work in the background, when the rest would take `left` seconds."""
        if left > WORTH_WAITING * self._seconds:
            self._compile(arguments)
        else:
            self._compile_behind()

    def _compile_behind(self) -> None:
        wanted = (*self._with_it, *self._later)
        background.start([function for function in wanted if needs_compiling(function)])

    def _compile(self, arguments: tuple[Any, ...]) -> Callable[..., Any]:
        began = clock.perf_counter()
        background.make_ready(*self._with_it)
        compiled = direct(self._function, *arguments)
        self._on_compiled()
        self._compiled = compiled
        self.compiling += clock.perf_counter() - began
        return compiled

    def _put_back(self, before: Sequence[NDArray[Any]]) -> None:
        for array, earlier in zip(self._written, before, strict=True):
            array[...] = earlier


def call_now(function: Callable[..., Any], written: Sequence[NDArray[Any]], *arguments: Any) -> Any:
    """Call a kernel once, interpreted if its compiled form is not there; `written` as for `Interim`."""
    return function(*arguments) if at_hand(function) else Interim(function, written, 1, 0.0)(*arguments)


# Whether what a run calls once or twice is compiled before that, where it is not yet.
_compiled_first: ContextVar[bool] = ContextVar("_compiled_first", default=True)


@contextmanager
def not_compiled_first() -> Iterator[None]:
    """Let `call_once` interpret meanwhile what is not compiled yet: for one run, and not for a batch of them."""
    token = _compiled_first.set(False)
    try:
        yield
    finally:
        _compiled_first.reset(token)


def call_once(function: Callable[..., Any], written: Sequence[NDArray[Any]], brief: bool, *arguments: Any) -> Any:
    """Call a kernel of which a run needs a call or two; within `not_compiled_first` interpreted, if that is brief.

    Parameters
    ----------
    function : callable
        The kernel, an `entry_kernel`.
    written : sequence of arrays
        What the call changes: it is put back if the call must be begun again, compiled.
    brief : bool
        Whether it is done, interpreted, before it would be compiled; else it is compiled first.
    *arguments
        An entry among them is given to the kernel as its address, see `closedloop.jit.calls`.
    """
    needed = function, *filter(callable, arguments)
    if brief and not _compiled_first.get() and not all(map(at_hand, needed)):
        before = [array.copy() for array in written]
        try:
            with np.errstate(all="ignore"):
                return interpreted(function)(*_by_address(arguments, twin_address))
        except (ArithmeticError, ValueError):  # where compiled code would go on
            for array, earlier in zip(written, before, strict=True):
                array[...] = earlier
    background.make_ready(*needed)
    return function(*_by_address(arguments, entry_address))


def _by_address(arguments: Sequence[Any], address: Callable[[Entry], int]) -> Iterator[Any]:
    return (address(each) if callable(each) else each for each in arguments)


def at_hand(function: Callable[..., Any]) -> bool:
    """Whether calling a kernel needs no compiler, or is to wait for it, as no process may compile in the background."""
    return bool(background.refused()) or not needs_compiling(function)
