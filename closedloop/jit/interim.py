"""What begins a run before its kernels are compiled: calls that are interpreted as long as that is sooner."""

import time as clock
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.jit import background
from closedloop.jit.calls import Entry, entry_address
from closedloop.jit.interpreted import interpreted, twin_address
from closedloop.jit.kernel import direct, needs_compiling

# Calls after which it is known how long they take; seconds between two looks for the compiled form; and how many times
# longer than compiling the rest of a run must take, interpreted, for it to wait for the compiler, which then has all
# cores.
PROBE, BETWEEN_LOOKS, WORTH_WAITING = 50, 0.5, 1.0
# What is called by address is there well before the rest if it takes less than this share of the time.
MUCH_SOONER = 0.5
# Calls of each function that were interpreted so far in this process: many short runs are as good as a long one.
_so_far: Counter[str] = Counter()


class Interim:
    """A kernel that is called again and again: interpreted, until its compiled form is there.

    After the first calls, and at each look, it is known what is sooner. Where compiling is, it is waited for; else a
    process in the background does it (`closedloop.jit.background`), and this one goes over to the compiled form as
    soon as that is on the disk. Each call begins from what the last one left, so nothing depends on when that is.

    `function`: the kernel, an `entry_kernel`.
    `written`: what a call reads and changes: it is put back if a call must be begun again, or is interrupted.
    `calls`: how many calls there will be, about.
    `with_it`: what else the caller will want compiled.
    `on_compiled`: called before the compiled form is, for the first time.
    `called`: what of this it calls by address.
    `on_called_compiled`: called once these are compiled, though the kernel itself is not: from then on it may call them
        so.
    `share_done`: returns which share of all work is done; of the calls, if left out.
    `later`: what later runs will want: compiled in the background as well, and not waited for.
    `compiling`, float: time that was spent on compiling or loading the compiled form so far, s.
    """

    def __init__(
        self, function: Callable[..., Any], written: Sequence[NDArray[Any]], calls: int,
        with_it: Sequence[Callable[..., Any]] = (), on_compiled: Callable[[], None] = lambda: None,
        later: Sequence[Callable[..., Any]] = (), called: Sequence[Callable[..., Any]] = (),
        on_called_compiled: Callable[[], None] = lambda: None, share_done: Callable[[], float] | None = None,
    ) -> None:  # fmt: skip
        self._function, self._twin, self._written = function, interpreted(function), written
        self._calls, self._with_it = calls, (function, *with_it)
        self._later = later
        self._on_compiled, self._on_called_compiled, self._called = on_compiled, on_called_compiled, called
        self._compiled: Callable[..., Any] | None = None
        self._done, self._look_at = 0, 0.0
        self._share_done = share_done or (lambda: self._done / self._calls)
        # What was done at the last look, and the time of calls since, s.
        self._share, self._done_then, self._seconds_since = 0.0, 0, 0.0
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
        if began >= self._look_at or self._done == PROBE:
            self._look_at = began + BETWEEN_LOOKS
            if self._is_to_be_compiled():
                return self._compile(arguments)(*arguments)
        before = _copies(self._written)
        busy = clock.thread_time()  # of the processor: on a loaded machine compiling takes longer by as much
        try:
            with np.errstate(all="ignore"):
                answer = self._twin(*arguments)
        except (ArithmeticError, ValueError):  # where compiled code would go on
            _put_back(self._written, before)
            return self._compile(arguments)(*arguments)
        except BaseException:
            _put_back(self._written, before)
            raise
        _so_far[self._function.__name__] += 1
        self._done += 1
        if self._done > 1:
            self._seconds_since += clock.thread_time() - busy
        else:  # which has made the interpreted functions
            self._share, self._done_then = self._share_done(), 1
        return answer

    def _is_to_be_compiled(self) -> bool:
        """Whether the compiled form is there, or waiting for it is sooner; if not, have it compiled in the background.

        The pace is that of the calls since the last look: those of a run's phases differ by far. It is about to change
        if what is called by address is there well before the rest.
        """
        if not any(map(needs_compiling, self._with_it)):
            return True
        if self._done < PROBE and not _so_far[self._function.__name__] >= PROBE > self._calls:
            return False
        background.start([function for function in (*self._with_it, *self._later) if needs_compiling(function)])
        share = self._share_done()
        gained = share - self._share or (self._done - self._done_then) / self._calls  # where work halts, by calls
        left = (1.0 - share) * self._seconds_since / gained if gained > 0.0 else 0.0
        self._share, self._seconds_since, self._done_then = share, 0.0, self._done
        wait = background.seconds_left(self._with_it)
        if self._called and not any(map(needs_compiling, self._called)):
            self._called = ()
            self._on_called_compiled()
            return False
        if self._called and background.seconds_left(self._called) < MUCH_SOONER * wait:
            return False
        return left > WORTH_WAITING * wait

    def _compile(self, arguments: tuple[Any, ...]) -> Callable[..., Any]:
        began = clock.perf_counter()
        background.make_ready(*self._with_it)
        compiled = direct(self._function, *arguments)
        self._on_compiled()
        self._compiled = compiled
        self.compiling += clock.perf_counter() - began
        return compiled


def _copies(arrays: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    return [array.copy() for array in arrays]


def _put_back(arrays: Sequence[NDArray[Any]], before: Sequence[NDArray[Any]]) -> None:
    for array, earlier in zip(arrays, before, strict=True):
        array[...] = earlier


def call_now(function: Callable[..., Any], written: Sequence[NDArray[Any]], *arguments: Any) -> Any:
    """Call a kernel once, interpreted if its compiled form is not there; `written` as for `Interim`."""
    return function(*arguments) if at_hand(function) else Interim(function, written, 1)(*arguments)


# Processor time, s, of the calls of each function that `call_once` has interpreted: many are as good as a long one.
_spent: defaultdict[str, float] = defaultdict(float)

# Whether what a run calls once or twice is compiled before that, where it is not yet.
_compiled_first: ContextVar[bool] = ContextVar("_compiled_first", default=True)


class not_compiled_first:  # a context, as those beside it
    """Let `call_once` interpret meanwhile what is not compiled yet: for one run, and not for a batch of them."""

    __slots__ = ("_token",)

    def __enter__(self) -> None:
        self._token = _compiled_first.set(False)

    def __exit__(self, *raised: object) -> None:
        _compiled_first.reset(self._token)


def compiles_ahead() -> bool:
    """Whether what a run will want is compiled in the background: within `not_compiled_first`."""
    return not _compiled_first.get()


def compile_ahead(functions: Sequence[Callable[..., Any]]) -> None:
    """Have compiled in the background what a run will want that may begin interpreted, see `compiles_ahead`."""
    if compiles_ahead():
        background.start([function for function in functions if not at_hand(function)])


def call_once(function: Callable[..., Any], written: Sequence[NDArray[Any]], brief: bool, *arguments: Any) -> Any:
    """Call a kernel of which a run needs a call or two; within `not_compiled_first` interpreted, if that is brief.

    `function`: the kernel, an `entry_kernel`.
    `written`: what the call changes: it is put back if the call must be begun again, compiled.
    `brief`: whether it is done, interpreted, before it would be compiled; else it is compiled first.
    `*arguments`: an entry among them is given to the kernel as its address, see `closedloop.jit.calls`.
    """
    needed = function, *filter(callable, arguments)
    interpretable = brief and not _compiled_first.get() and not all(map(at_hand, needed))
    if interpretable and _spent[function.__name__] <= background.seconds_to_compile(needed):
        before, busy = _copies(written), clock.thread_time()
        try:
            with np.errstate(all="ignore"):
                return interpreted(function)(*_by_address(arguments, twin_address))
        except (ArithmeticError, ValueError):  # where compiled code would go on
            _put_back(written, before)
        finally:
            _spent[function.__name__] += clock.thread_time() - busy
    background.make_ready(*needed)
    return function(*_by_address(arguments, entry_address))


def _by_address(arguments: Sequence[Any], address: Callable[[Entry], int]) -> Iterator[Any]:
    return (address(each) if callable(each) else each for each in arguments)


def at_hand(function: Callable[..., Any]) -> bool:
    """Whether calling a kernel needs no compiler, or is to wait for it, as no process may compile in the background."""
    return not needs_compiling(function) or bool(background.refused())
