"""A user's law as the loop calls it, the line at which it failed, and a digest of its text.

It is a Python function or object, or a function that numba compiles.

    def press(x):                                   # x: `closedloop.control.law.LawInput`
        return x.C - x.A[0] * x.f_des - 5.0 * x.v

    def press(t, q, v, terms):                      # or time, q, q̇ and `Terms` of that state alone
        return terms.bias - 15.0 * terms.jacobian[2] - 5.0 * v

Either may be marked `numba.njit`; it is then compiled once for the run, separately, and called without Python, in both
engines. A compiled law may also write the torque, as its last argument, rather than return it.

A callable object may have a `reset`, which is called at the beginning of each run; a class is instantiated for each
run. A law that needs parameters in the scenario, or states that are integrated, is a
`closedloop.control.law.ControlLaw`.
"""

import inspect
import math
import os
import sys
import traceback
from collections.abc import Callable
from copy import deepcopy
from functools import lru_cache, partial
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import numba
import numpy as np
from numba import types
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import DivergenceError, LawError, ScenarioError, one_line
from closedloop.control.law import LawInput
from closedloop.jit.calls import callback, compiled_address, forget_entry, interpreted_address, is_compiled
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import jit_disabled, numba_ready, plain_numba
from closedloop.jit.uninterrupted import compiler_at_work
from closedloop.jit.user_code import source_digest, why_not_compiled
from closedloop.loop.step.entries import START, TORQUE, law_input
from closedloop.loop.step.memory import Loop, loop_at
from closedloop.mechanics.robot.pinocchio import Terms
from closedloop.simulation.engines.failures import not_finite, when
from robot_models.cached import cached_property

# What an entry answers when the law gave no torque.
RAISED, NOT_FINITE, WRONG_LENGTH = 1, 2, 3
# Which of what a law sees are numbers.
NUMBERS = ("t", "f_des", "f_measured", "pressed")


def law_failure(law: Any, error: BaseException, t: float) -> LawError:
    """Return what a law raised at t, s, as the error of the run: file, line, type and message in one line."""
    what = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
    names = "; help(closedloop.LawInput) lists its attributes" if "'LawInput' object has no" in what else ""
    return LawError(f"stopped at t = {t:.6g} s: the law failed: {_where(law, error)}{what}{names}", t)


def fresh(law: Any) -> Any:
    """Return a law in its state before any run: a deep copy of a callable object, else the law itself.

    A law with a `reset` is reset by every run; one that cannot be copied is returned as it is.
    """
    if isinstance(law, (FunctionType, MethodType, type)) or hasattr(law, "py_func") or hasattr(law, "reset"):
        return law
    try:
        return deepcopy(law)
    except Exception:  # whatever an object may hold
        return law


def law_digest(law: Any) -> str:
    """Return the SHA-256 of a law's source, see `closedloop.jit.user_code.source_digest`."""
    return source_digest(_function(law))


def _function(law: Any) -> Any:
    """Return the function, or the class of the object, that a law was written as."""
    while isinstance(law, partial):
        law = law.func
    law = getattr(law, "py_func", law)
    return law if hasattr(law, "__code__") or hasattr(law, "__func__") else type(law)


def _where(law: Any, error: BaseException) -> str:
    """Return 'file:line: ' of the innermost frame in the law's own file, else of the innermost frame."""
    frames = traceback.extract_tb(error.__traceback__)[1:]  # the first is the caller
    if not frames:
        return ""
    code = getattr(_function(law), "__code__", None)
    own = [frame for frame in frames if code is not None and frame.filename == code.co_filename]
    last = (own or frames)[-1]
    file = last.filename
    try:
        near = os.path.relpath(file)
    except (OSError, ValueError):  # another drive, or the working folder is gone
        near = file
    return f"{one_line(file if near.startswith(os.pardir) or file.startswith('<') else near)}:{last.lineno}: "


class Arguments:
    """How a law is called: whether with a `LawInput`, and whether it writes the torque, as its last argument."""

    def __init__(self, sees_input: bool, writes: bool) -> None:
        self.sees_input, self.writes = sees_input, writes


SIGNATURES = "must be law(x) or law(t, q, v, terms), returning the torque Q"


def arguments_of(law: Any) -> Arguments:
    """Return how a law is called, from the number of its arguments; of a class, how an object of it is."""
    compiled = is_compiled(law)
    try:
        given = law.py_func if compiled else law.__call__ if isinstance(law, type) else law
        parameters = list(inspect.signature(given).parameters.values())[isinstance(law, type) :]
    except (TypeError, ValueError):  # a function of C, which does not say
        return Arguments(False, False)
    places = [each for each in parameters if each.kind in _POSITIONAL]
    least = sum(each.default is each.empty for each in places)
    most = math.inf if any(each.kind is each.VAR_POSITIONAL for each in parameters) else len(places)
    count = least if math.isfinite(most) else 4
    by_name = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY and each.default is each.empty]
    fits = count in (1, 2, 4, 5) if compiled else count == 1 or (least <= 4 <= most)
    if not fits or by_name:
        takes = f"{least} arguments" + (f" and {', '.join(by_name)} by name" if by_name else "")
        besides = "; or, compiled, with torque besides, writing it" if compiled else ""
        raise ScenarioError(f"the law {_place(law)}{name_of(law)} takes {takes}: {SIGNATURES}{besides}")
    return Arguments(count in (1, 2) and (compiled or count == 1), compiled and count in (2, 5))


def _place(law: Any) -> str:
    """Return "file:line: " of a law's function, "" if it has no file."""
    code = getattr(_function(law), "__code__", None)
    return "" if code is None else f"{os.path.basename(code.co_filename)}:{code.co_firstlineno}: "


_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def name_of(law: Any) -> str:
    """Return the name of a law, for messages: of an object, that of its class."""
    return str(getattr(law, "__name__", type(law).__name__))


_READ = {d: types.Array(types.float64, d, "C", readonly=True) for d in (1, 2)}
_TERMS: Any = types.NamedTuple((_READ[2], _READ[1], _READ[1], _READ[2], _READ[1]), Terms)  # type: ignore[no-untyped-call]
_MATRICES = ("H", "L", "A", "X", "S", "J", "frame")


def _kind_of(name: str) -> Any:
    if name in NUMBERS:
        return types.float64
    return types.float64[::1] if name == "scratch" else _READ[2 if name in _MATRICES else 1]


_INPUT: Any = types.NamedTuple(tuple(map(_kind_of, LawInput._fields)), LawInput)  # type: ignore[no-untyped-call]


@lru_cache(maxsize=32)
@compiler_at_work()
def compiled_law(law: Any) -> Any:
    """Return the entry of a law of numba's, or say why there can be none; see `closedloop.jit.calls`."""
    if not is_compiled(law):
        raise ScenarioError(f"engine = 'compiled': the law {name_of(law)} {_how_to_compile(law)}")
    ways = arguments_of(law)
    asked: tuple[Any, ...] = (_INPUT,) if ways.sees_input else (types.float64, _READ[1], _READ[1], _TERMS)
    if ways.writes:
        asked += (types.float64[::1],)
    files = [law.py_func.__code__.co_filename]
    try:
        law.compile(asked)
        result = law.overloads[asked].signature.return_type
        if ways.writes:
            _check(law, result, result == types.none, "must return nothing: it writes the torque")
        else:
            array = isinstance(result, types.Array) and result.ndim == 1
            real = array and isinstance(result.dtype, types.Integer | types.Float)
            _check(law, result, real, "must be a one-dimensional array of real numbers, one torque a joint")
        return _entry_of(law, ways)
    except ScenarioError:
        raise
    except Exception as error:  # numba's own, and whatever else its compiler fails with
        why = why_not_compiled(error, files, {"LawInput": LawInput._fields, "Terms": Terms._fields})
        raise ScenarioError(
            f"the law {name_of(law)} cannot be compiled: {why}; or leave it to Python, without @numba.njit, with the "
            "engine 'pinocchio'"
        ) from None


def _how_to_compile(law: Any) -> str:
    """Return what is to be done with a law in Python that compiled code is to call."""
    if isinstance(law, FunctionType | BuiltinFunctionType):
        return "is not compiled: mark it with @numba.njit, or use the engine 'pinocchio'"
    return (
        "is a Python object, which may have a memory and cannot be called by compiled code: write it as a class "
        "derived from closedloop.ControlLaw, with its memory as `states`, a function torque(x, par, z, torque), and "
        "rates(x, par, z, f, torque, dz) for what is integrated (docs/controllers.md), and name it as law.kind; or use "
        "the engine 'pinocchio'"
    )


def _check(law: Any, result: Any, right: bool, cure: str) -> None:
    if not right:
        raise ScenarioError(f"the compiled law {name_of(law)} returns {result}: {cure}")


def _same(x: Array) -> Array:
    return x


with compiler_at_work():
    numba_ready()
    # An array of one and of two dimensions, as one of which compiled code can only read.
    _read, _read2 = (numba.njit(_READ[d](_READ[d]))(_same) for d in (1, 2))


def _inner(function: Any) -> Any:
    """Compile a part of an entry: only compiled code calls it, so it is optimised once, in the entry."""

    if plain_numba():
        return numba.njit(function)
    from closedloop.jit.inside.inline_once import NestedFunction

    return NestedFunction(function, {}, lambda: numba.njit(function))


def _entry_of(law: Any, ways: Arguments) -> Any:
    """Return the entry of a law that has been compiled for what it asks."""
    if ways.sees_input:

        @_inner
        def given(x: Any) -> Any:
            return (
                LawInput(
                    x.t, _read(x.q), _read(x.v), _read2(x.H), _read(x.C), _read2(x.L), _read2(x.A), _read2(x.X),
                    _read2(x.S), _read(x.drift), _read(x.p), _read(x.u), _read(x.r), _read2(x.J), _read(x.Jdot_v),
                    _read2(x.frame), _read(x.q_des), _read(x.v_des), _read(x.qdd_des), _read(x.p_des), _read(x.u_des),
                    _read(x.a_des), x.f_des, x.f_measured, _read(x.f_tangential), x.pressed, x.scratch,
                ),
            )  # fmt: skip

    else:

        @_inner
        def given(x: Any) -> Any:
            terms = Terms(_read2(x.H), _read(x.C), _read(x.r), _read2(x.J), _read(x.Jdot_v))
            return x.t, _read(x.q), _read(x.v), terms

    if ways.writes:

        @_inner
        def ask(x: Any, torque: Array) -> int:
            torque[:] = 0.0
            law(*given(x), torque)
            return 0

    else:

        @_inner
        def ask(x: Any, torque: Array) -> int:
            answer = law(*given(x))
            if answer.shape[0] != torque.shape[0]:
                return WRONG_LENGTH
            for k in range(torque.shape[0]):  # of torque[:] = answer numba compiles the text of an error, for 5 s
                torque[k] = answer[k]
            return 0

    @numba.njit(nogil=True)
    def entry(address: int, what: int) -> int:
        if what != TORQUE:
            return 0
        state, constants, w = loop_at(address)
        try:
            answer = ask(law_input(state, constants, w), w.torque)
        except Exception:
            return RAISED
        for torque in w.torque:
            if not math.isfinite(torque):
                return NOT_FINITE
        return int(answer)

    return entry


Law = Callable[..., ArrayLike]
"""A user's control law: of a `LawInput`, or of time, s; q, q̇ (n,) read-only; `Terms` -> torque Q (n,), N m."""


class UserLaw:
    """A user's law, connected to a loop.

    Attributes
    ----------
    error : Exception or None
        Why the law gave no torque, if it did not.
    fault : str
        What is wrong with a torque that is not finite, in words.
    interruption : BaseException or None
        Ctrl-C that came as compiled code called the law, before its first line.
    """

    def __init__(self, law: Law, loop: Loop) -> None:
        self._law, self._loop = (law() if isinstance(law, type) else law), loop
        self.error: BaseException | None = None
        self.interruption: BaseException | None = None
        self.fault = ""
        self._called: tuple[int, Any] | None = None
        self._usual_hook: Callable[[sys.UnraisableHookArgs], Any] | None = None
        self._number = 0

    def connect(self, compiled: bool = True) -> None:
        """Write the address of the law into the memory: for a compiled loop, or for an interpreted one."""
        state = self._loop.state
        state.settings.general = 1
        if not compiled or jit_disabled():
            self._number = self._number or interpreted_address(self._entry)
            state.law.entry = self._number
        elif is_compiled(self._law):
            from closedloop.simulation.engines.law_source import compiled_law

            state.law.entry = compiled_address(compiled_law(self._law))
        else:
            if self._called is None:
                self._called = callback(self._entry)
                self._usual_hook, sys.unraisablehook = sys.unraisablehook, self._keep_interruption
            state.law.entry = self._called[0]

    def close(self) -> None:
        """Release the law: the loop does not call it any more."""
        forget_entry(self._number)
        if self._usual_hook is not None:
            sys.unraisablehook, self._usual_hook = self._usual_hook, None

    def _keep_interruption(self, lost: "sys.UnraisableHookArgs") -> None:
        """Keep what was raised as the law was entered, and end the run at the state that it was entered for.

        A signal that comes while compiled code runs is answered as soon as Python runs: at the entry of `_entry`, where
        nothing can catch what its handler raises. It may be entered for the torque or for something else of that state.
        """
        frame = None if lost.exc_traceback is None else lost.exc_traceback.tb_frame
        if frame is not None and frame.f_code is UserLaw._entry.__code__ and frame.f_locals["self"] is self:
            self.interruption = lost.exc_value
            self._loop.state.raised = 1
            if frame.f_locals["what"] == TORQUE:  # none was given: nothing may be computed with the one before
                self._loop.w.torque[:] = np.nan
        elif self._usual_hook is not None:
            self._usual_hook(lost)

    def failure(self) -> BaseException:
        """Return why the law gave no torque."""
        t = float(self._loop.w.time)
        if self.interruption is not None:
            return self.interruption
        if self.error is None:  # of a compiled law the message is lost: it is evaluated again, interpreted
            if not np.all(np.isfinite(self._loop.w.torque)):
                return self._not_finite(self._loop.w.torque, t)
            self._entry(0, TORQUE)
        return self.error or LawError(f"{when(t)}: the law failed", t)

    def _not_finite(self, torque: Array, t: float) -> DivergenceError:
        self.fault = not_finite(torque)
        return DivergenceError(f"{when(t)}: {self.fault}", t)

    def _entry(self, address: int, what: int) -> int:
        try:
            if self.interruption is not None:
                return RAISED
            if what == TORQUE:
                self._evaluate()
            elif what == START and hasattr(self._law, "reset"):
                self._law.reset()
        except BaseException as error:  # nothing can be raised through compiled code
            self.error = error
            return RAISED
        return 0

    @cached_property
    def _ways(self) -> Arguments:
        """How the law is called: asked once, as looking at a signature takes as long as a short law."""
        return arguments_of(self._law)

    def _evaluate(self) -> None:
        """Evaluate the law, check the torque, and write it into the memory."""
        state, constants, w = self._loop
        t, n = float(w.time), w.q.size
        x = interpreted(law_input)(state, constants, w)
        given: tuple[Any, ...] = (_copied(x),) if self._ways.sees_input else _copied_terms(t, x)
        try:
            if self._ways.writes:
                answer: Any = np.zeros(n)
                self._law(*given, answer)
            else:
                answer = self._law(*given)
        except (Exception, SystemExit) as error:
            raise law_failure(self._law, error, t) from error
        fault = ""
        try:
            torque = np.asarray(answer)
        except (TypeError, ValueError):  # lists of different lengths
            torque, fault = np.zeros(0), f"{str(answer)[:60]!r}"
        if torque.dtype.kind not in "iuf":
            fault = f"{str(answer)[:60]!r}"
        elif not fault and torque.shape != (n,):
            fault = f"Q of shape {torque.shape}"
        if fault:
            raise not_a_torque(fault, t, n)
        if not np.all(np.isfinite(torque)):
            raise self._not_finite(torque, t)
        w.torque[:] = torque


def _copied(x: LawInput) -> LawInput:
    """Return the input of a Python law: copies, which it may keep, and read-only."""
    values: list[Any] = []
    value: Any
    for name, value in zip(LawInput._fields, x, strict=True):
        if name in NUMBERS:
            values.append(float(value))
        else:
            values.append(value if name == "scratch" else _kept(value))
    return LawInput(*values)


def _copied_terms(t: float, x: LawInput) -> tuple[float, Array, Array, Terms]:
    """Return the arguments (t, q, v, terms) of a Python law, likewise: a quarter of the input's arrays."""
    terms = Terms(_kept(x.H), _kept(x.C), _kept(x.r), _kept(x.J), _kept(x.Jdot_v))
    return t, _kept(x.q), _kept(x.v), terms


def _kept(value: Array) -> Array:
    """Return a copy of an array, read-only."""
    value = value.copy()
    value.setflags(write=False)
    return value


def not_a_torque(returned: str, t: float, n: int) -> ScenarioError | LawError:
    """Return the error of a law that returned no torque of n joints at t, s; at t = 0 s it is a `ScenarioError`."""
    what = f"the law returned {returned} at t = {t:g} s: must be {n} real numbers, one torque a joint, ({n},)"
    return LawError(f"{when(t)}: {what}", t) if t > 0.0 else ScenarioError(what)
