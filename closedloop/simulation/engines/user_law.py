"""A user's law as the loop calls it: a Python function or object, or a function that numba compiles.

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

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import DivergenceError, LawError, ScenarioError
from closedloop.control.law import LawInput
from closedloop.jit.calls import callback, compiled_address, forget_entry, interpreted_address, is_compiled
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import jit_disabled
from closedloop.loop.step.entries import START, TORQUE, law_input
from closedloop.loop.step.memory import Loop
from closedloop.mechanics.robot.pinocchio import Terms
from closedloop.simulation.engines.failures import not_finite, when
from closedloop.simulation.engines.law_source import NUMBERS, RAISED, Arguments, arguments_of, law_failure
from robot_models.cached import cached_property

Law = Callable[..., ArrayLike]
"""A user's control law: of a `LawInput`, or of time, s; q, q̇ (n,) read-only; `Terms` -> torque Q (n,), N m."""


class UserLaw:
    """A user's law, connected to a loop.

    `error`, Exception or None: why the law gave no torque, if it did not.
    `fault`, str: what is wrong with a torque that is not finite, in words.
    `interruption`, BaseException or None: ctrl-C that came as compiled code called the law, before its first line.
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
            from closedloop.simulation.engines.compiled_law import compiled_law

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
        given: tuple[Any, ...]
        if self._ways.sees_input:
            given = (_copied(x),)
        else:
            given = t, _kept(x.q), _kept(x.v), Terms(_kept(x.H), _kept(x.C), _kept(x.r), _kept(x.J), _kept(x.Jdot_v))
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
            what = f"the law returned {fault} at t = {t:g} s: must be {n} real numbers, one torque a joint, ({n},)"
            raise (LawError(f"{when(t)}: {what}", t) if t > 0.0 else ScenarioError(what))
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


def _kept(value: Array) -> Array:
    """Return a copy of an array, read-only."""
    value = value.copy()
    value.setflags(write=False)
    return value
