"""A law of one's own as the loop calls it: a Python function or object, or a function that numba compiles.

    def press(x):                                   # x: `closedloop.control.law_input.LawInput`
        return x.C - x.A[0] * x.f_des - 5.0 * x.v

    def press(t, q, v, terms):                      # or time, q, q̇ and `Terms` of that state alone
        return terms.bias - 15.0 * terms.jacobian[2] - 5.0 * v

Either may be marked `numba.njit`; it is then compiled once for the run, by itself, and called without Python between
steps, in both engines. A compiled one may also write the torque, as its last argument, rather than return it.

An object that is called may have a `reset`, which is called at the beginning of each run; of a class given as it is, a
new object is made for each run. A law that needs parameters in the scenario, or states that are integrated, is a
`closedloop.control.law.ControlLaw`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numba import NumbaError, types
from numpy.typing import ArrayLike, NDArray

from closedloop.control.law_input import LawInput
from closedloop.engines.failures import not_finite, when
from closedloop.engines.own_law import law_failure
from closedloop.errors import DivergenceError, LawError, ScenarioError
from closedloop.jit.calls import callback, compiled_address, forget_entry, interpreted_address, is_compiled
from closedloop.jit.kernel import numba_settings, plain
from closedloop.robot.pinocchio import Terms
from closedloop.step.entries import START, TORQUE, law_input
from closedloop.step.memory import Loop, loop_at
from closedloop.user_code import why_not_compiled

Array = NDArray[np.float64]
Law = Callable[..., ArrayLike]
"""A control law of one's own: of a `LawInput`, or of time, s; q, q̇ (n,) read-only; `Terms` -> torque Q (n,), N m."""

# What an entry answers when the law gave no torque.
RAISED, NOT_FINITE, WRONG_LENGTH = 1, 2, 3

_READ = {d: types.Array(types.float64, d, "C", readonly=True) for d in (1, 2)}
_TERMS: Any = types.NamedTuple((_READ[2], _READ[1], _READ[1], _READ[2], _READ[1]), Terms)  # type: ignore[no-untyped-call]
_MATRICES = ("H", "L", "A", "X", "S", "J", "frame")
_NUMBERS = ("t", "f_des", "f_measured", "pressed")


def _kind_of(name: str) -> Any:
    if name in _NUMBERS:
        return types.float64
    return types.float64[::1] if name == "scratch" else _READ[2 if name in _MATRICES else 1]


_INPUT: Any = types.NamedTuple(tuple(map(_kind_of, LawInput._fields)), LawInput)  # type: ignore[no-untyped-call]


class UserLaw:
    """A law of one's own in a loop's memory.

    Parameters
    ----------
    law : callable
        See above.
    loop : Loop
        The memory.

    Attributes
    ----------
    error : Exception or None
        Why the law gave no torque, if it did not.
    fault : str
        What is wrong with a torque that is not finite, in words.
    """

    def __init__(self, law: Law, loop: Loop) -> None:
        self._law, self._loop = (law() if isinstance(law, type) else law), loop
        self.error: BaseException | None = None
        self.fault = ""
        self._called: tuple[int, Any] | None = None
        self._number = 0

    def connect(self, compiled: bool = True) -> None:
        """Write into the memory where the law is: for a compiled loop, or for one that is interpreted."""
        state = self._loop.state
        if not compiled or numba_settings.DISABLE_JIT:
            self._number = self._number or interpreted_address(self._entry)
            state.law = self._number
        elif is_compiled(self._law):
            state.law = compiled_address(compiled_law(self._law))
        else:
            self._called = self._called or callback(self._entry)
            state.law = self._called[0]

    def close(self) -> None:
        """Say that the loop does not call the law any more."""
        forget_entry(self._number)

    def failure(self) -> BaseException:
        """Return why the law gave no torque."""
        t = float(self._loop.w.time)
        if self.error is None:  # a compiled one: its own words are lost on the way
            if not np.all(np.isfinite(self._loop.w.torque)):
                return self._not_finite(self._loop.w.torque, t)
            self._entry(0, TORQUE)
        return self.error or LawError(f"{when(t)}: the law failed", t)

    def _not_finite(self, torque: Array, t: float) -> DivergenceError:
        self.fault = not_finite(torque)
        return DivergenceError(f"{when(t)}: {self.fault}", t)

    def _entry(self, address: int, what: int) -> int:
        try:
            if what == TORQUE:
                self._ask()
            elif what == START and hasattr(self._law, "reset"):
                self._law.reset()
        except BaseException as error:  # nothing can be raised through compiled code
            self.error = error
            return RAISED
        return 0

    def _ask(self) -> None:
        """Evaluate the law, check what it returns, and write that into the torque."""
        state, constants, w = self._loop
        t, n = float(w.time), w.q.size
        x = _copied(plain(law_input)(state, constants, w))
        ways = arguments_of(self._law)
        given: tuple[Any, ...] = (x,) if ways.sees_input else (t, x.q, x.v, Terms(x.H, x.C, x.r, x.J, x.Jdot_v))
        try:
            if ways.writes:
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
    """Return what a law in Python gets: arrays that may be kept, and not written to."""
    values: list[Any] = []
    value: Any
    for name, value in zip(LawInput._fields, x, strict=True):
        if name in _NUMBERS:
            values.append(float(value))
            continue
        if name != "scratch":
            value = value.copy()
            value.setflags(write=False)
        values.append(value)
    return LawInput(*values)


class Arguments:
    """How a law is called: whether with a `LawInput`, and whether it writes the torque, as its last argument."""

    def __init__(self, sees_input: bool, writes: bool) -> None:
        self.sees_input, self.writes = sees_input, writes


def arguments_of(law: Any) -> Arguments:
    """Return how a law is called, from the number of its arguments.

    Raises
    ------
    ScenarioError
        If a compiled law takes none of the known numbers. (What a Python law is called with wrongly, Python says.)
    """
    compiled = is_compiled(law)
    try:
        parameters = inspect.signature(law.py_func if compiled else law).parameters.values()
    except (TypeError, ValueError):
        return Arguments(False, False)
    asked = [each for each in parameters if each.default is each.empty and each.kind in _POSITIONAL]
    count = len(asked) if not any(each.kind is each.VAR_POSITIONAL for each in parameters) else 4
    if compiled and count not in (1, 2, 4, 5):
        raise ScenarioError(
            f"the law {_name(law)} takes {count} arguments: must be (x) or (t, q, v, terms), returning Q, or with "
            "torque besides, writing it"
        )
    return Arguments(count in (1, 2) and (compiled or count == 1), compiled and count in (2, 5))


_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def not_a_torque(returned: str, t: float, n: int) -> ScenarioError | LawError:
    """Return the error of a law that returned at t, s, what is no torque of n joints; at t = 0 s nothing ran yet."""
    what = f"the law returned {returned} at t = {t:g} s: must be {n} real numbers, one torque a joint, ({n},)"
    return LawError(f"{when(t)}: {what}", t) if t > 0.0 else ScenarioError(what)


@lru_cache(maxsize=32)
def compiled_law(law: Any) -> Any:
    """Return the entry of a law of numba's, or say why there can be none; see `closedloop.jit.calls`.

    Raises
    ------
    ScenarioError
        If it is no such function: a Python function, other arguments, what numba cannot compile, another result.
    """
    if not is_compiled(law):
        raise ScenarioError(
            f"engine = 'compiled': the law {_name(law)} is not compiled: mark it with @numba.njit, "
            "or use the engine 'pinocchio'"
        )
    ways = arguments_of(law)
    asked: tuple[Any, ...] = (_INPUT,) if ways.sees_input else (types.float64, _READ[1], _READ[1], _TERMS)
    if ways.writes:
        asked += (types.float64[::1],)
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
    except NumbaError as error:
        raise ScenarioError(
            f"engine = 'compiled': numba cannot compile the law {_name(law)}: {_why(error)}; "
            "use the engine 'pinocchio' for it"
        ) from None


def _check(law: Any, result: Any, right: bool, cure: str) -> None:
    if not right:
        raise ScenarioError(f"engine = 'compiled': the law {_name(law)} returns {result}: {cure}")


@numba.njit(_READ[1](_READ[1]))
def _read(x: Array) -> Array:
    """Return an array of which compiled code can only read."""
    return x


@numba.njit(_READ[2](_READ[2]))
def _read2(x: Array) -> Array:
    return x


def _entry_of(law: Any, ways: Arguments) -> Any:
    """Return the entry of a law that has been compiled for what it asks."""
    if ways.sees_input:

        @numba.njit
        def given(x: Any) -> Any:
            return (
                LawInput(
                    x.t, _read(x.q), _read(x.v), _read2(x.H), _read(x.C), _read2(x.L), _read2(x.A), _read2(x.X),
                    _read2(x.S), _read(x.drift), _read(x.p), _read(x.u), _read(x.r), _read2(x.J), _read(x.Jdot_v),
                    _read2(x.frame), _read(x.q_des), _read(x.v_des), _read(x.p_des), _read(x.u_des), _read(x.a_des),
                    x.f_des, x.f_measured, x.pressed, x.scratch,
                ),
            )  # fmt: skip

    else:

        @numba.njit
        def given(x: Any) -> Any:
            terms = Terms(_read2(x.H), _read(x.C), _read(x.r), _read2(x.J), _read(x.Jdot_v))
            return x.t, _read(x.q), _read(x.v), terms

    if ways.writes:

        @numba.njit
        def ask(x: Any, torque: Array) -> int:
            torque[:] = 0.0
            law(*given(x), torque)
            return 0

    else:

        @numba.njit
        def ask(x: Any, torque: Array) -> int:
            answer = law(*given(x))
            if answer.shape[0] != torque.shape[0]:
                return WRONG_LENGTH
            torque[:] = answer
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


def _name(law: Any) -> str:
    return str(getattr(law, "__name__", law))


def _why(error: NumbaError) -> str:
    if "setitem(readonly" in str(error):
        return "it writes into q, v or terms, which are there to be read"
    return why_not_compiled(error)
