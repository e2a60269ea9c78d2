"""A law of one's own that numba compiles, as the entry that the loop calls; see
`closedloop.simulation.engines.user_law`."""

import math
from functools import lru_cache
from types import BuiltinFunctionType, FunctionType
from typing import Any

import numba
from numba import types

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.interrupts import compiler_at_work
from closedloop.control.law import LawInput
from closedloop.jit.calls import is_compiled
from closedloop.jit.kernel import numba_ready, plain_numba
from closedloop.jit.user_code import why_not_compiled
from closedloop.loop.step.entries import TORQUE, law_input
from closedloop.loop.step.memory import loop_at
from closedloop.mechanics.robot.pinocchio import Terms
from closedloop.simulation.engines import law_source
from closedloop.simulation.engines.law_source import NOT_FINITE, RAISED, WRONG_LENGTH

_READ = {d: types.Array(types.float64, d, "C", readonly=True) for d in (1, 2)}
_TERMS: Any = types.NamedTuple((_READ[2], _READ[1], _READ[1], _READ[2], _READ[1]), Terms)  # type: ignore[no-untyped-call]
_KINDS: dict[str, Any] = dict.fromkeys(law_source.NUMBERS, types.float64) | {"scratch": types.float64[::1]}
_KINDS |= dict.fromkeys(("H", "L", "A", "X", "S", "J", "frame"), _READ[2])


_INPUT: Any = types.NamedTuple(tuple(_KINDS.get(name, _READ[1]) for name in LawInput._fields), LawInput)  # type: ignore[no-untyped-call]


@lru_cache(maxsize=32)
@compiler_at_work()
def compiled_law(law: Any) -> Any:
    """Return the entry of a law of numba's, or say why there can be none; see `closedloop.jit.calls`."""
    if not is_compiled(law):
        raise ScenarioError(f"engine = 'compiled': the law {law_source.name_of(law)} {_how_to_compile(law)}")
    ways = law_source.arguments_of(law)
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
            f"the law {law_source.name_of(law)} cannot be compiled: {why}; or leave it to Python, without @numba.njit, "
            "with the engine 'pinocchio'"
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
        raise ScenarioError(f"the compiled law {law_source.name_of(law)} returns {result}: {cure}")


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


def _entry_of(law: Any, ways: law_source.Arguments) -> Any:
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
