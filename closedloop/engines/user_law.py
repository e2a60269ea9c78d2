"""A law of one's own inside the compiled engine: a function that numba compiles, called without Python between steps.

    @numba.njit
    def press(t, q, v, terms):                # the same law for both engines
        return terms.bias - 15.0 * terms.jacobian[2] - 5.0 * v

    @numba.njit
    def press(t, q, v, terms, torque):        # or written in place, which spares the arrays
        for j in range(q.size):
            torque[j] = terms.bias[j] - 15.0 * terms.jacobian[2, j] - 5.0 * v[j]

The law is compiled once for the run, by itself, in a fraction of a second; the loop calls it through its address, so
that a change of the law does not compile the loop anew. It needs the terms before the loop does, so they are computed
twice where the law is evaluated.
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
from numpy.typing import NDArray

from closedloop.control import Law
from closedloop.engines.compiled import ALL
from closedloop.engines.failures import not_finite, when
from closedloop.engines.own_law import law_failure
from closedloop.errors import (
    LawError,
    ScenarioError,
    one_line,
)
from closedloop.events.phases import NOT_FINITE, TERMS, TERMS_AND_LAW
from closedloop.events.table import EVENT_WIDTH
from closedloop.jit.background import make_ready
from closedloop.jit.kernel import entry_kernel
from closedloop.robot.pinocchio import Robot, Terms
from closedloop.robot.tree import Tree, tree_terms, work_size
from closedloop.step.memory import TIME, Whole, Work

Array = NDArray[np.float64]

# What the loop returns beside `NOT_FINITE` and what `closedloop.events` does: the law gave too few or many torques.
WRONG_LENGTH = -2

_typeof: Any = numba.typeof  # of numba, only some is typed

_READ = {d: types.Array(types.float64, d, "C", readonly=True) for d in (1, 2)}
# t, q, q̇, H, C, r, Jᵣ, J̇ᵣq̇ and the torque, which alone may be written; 0, or WRONG_LENGTH.
_LAW: Any = types.int64(
    types.float64, _READ[1], _READ[1], _READ[2], _READ[1], _READ[1], _READ[2], _READ[1], types.float64[::1]
)
_TERMS: Any = types.NamedTuple((_READ[2], _READ[1], _READ[1], _READ[2], _READ[1]), Terms)  # type: ignore[no-untyped-call]


def is_compiled(law: Any) -> bool:
    """Whether a law is a function of numba's; with ``NUMBA_DISABLE_JIT=1`` none is."""
    return hasattr(law, "py_func") and hasattr(law, "targetoptions")


def writes_torque(law: Any) -> bool:
    """Whether a compiled law writes the torque, as its fifth argument, rather than returns it.

    Raises
    ------
    ScenarioError
        If it takes neither four nor five arguments.
    """
    count = len(inspect.signature(law.py_func).parameters)
    if count not in (4, 5):
        raise ScenarioError(
            f"the law {_name(law)} takes {count} arguments: must be (t, q, v, terms), returning Q, or "
            "(t, q, v, terms, torque), writing it"
        )
    return count == 5


def as_returning(law: Law, n: int) -> Law:
    """Return a law in the form that the Pinocchio engine calls; one that writes its torque gets zeros (n,) to fill."""
    if not is_compiled(law) or not writes_torque(law):
        return law
    write: Any = law

    def returning(t: float, q: Array, v: Array, terms: Terms) -> Array:
        torque = np.zeros(n)
        write(t, q, v, terms, torque)
        return torque

    return returning


@lru_cache(maxsize=32)
def compiled_law(law: Any) -> Any:
    """Compile a law for the loop, or say why that cannot be.

    Parameters
    ----------
    law : function of numba.njit
        ``law(t, q, v, terms) -> Q`` or ``law(t, q, v, terms, torque)``: t, s; q and q̇ (n,), read-only; `Terms` of that
        state, read-only; Q (n,), N m, returned as a one-dimensional array of real numbers, or written into zeros.

    Returns
    -------
    function
        Of t, q, q̇, H, C, r, Jᵣ, J̇ᵣq̇ and the torque, which it writes.

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
    asked: tuple[Any, ...] = (types.float64, _READ[1], _READ[1], _TERMS)
    writes = writes_torque(law)
    if writes:
        asked += (types.float64[::1],)
    try:
        law.compile(asked)
        result = law.overloads[asked].signature.return_type
        if writes:
            _check(law, result, result == types.none, "must return nothing: it writes the torque")
            return _writing(law)
        array = isinstance(result, types.Array) and result.ndim == 1
        real = array and isinstance(result.dtype, types.Integer | types.Float)
        _check(law, result, real, "must be a one-dimensional array of real numbers, one torque a joint")
        return _returning(law)
    except NumbaError as error:
        raise ScenarioError(
            f"engine = 'compiled': numba cannot compile the law {_name(law)}: {_why(error)}; "
            "use the engine 'pinocchio' for it"
        ) from None


def _check(law: Any, result: Any, right: bool, cure: str) -> None:
    if not right:
        raise ScenarioError(f"engine = 'compiled': the law {_name(law)} returns {result}: {cure}")


def _writing(law: Any) -> Any:
    @numba.njit(_LAW)  # type: ignore[untyped-decorator]
    def call(
        t: float, q: Array, v: Array, H: Array, C: Array, r: Array, J: Array, drift: Array, torque: Array
    ) -> int:  # fmt: skip
        law(t, q, v, Terms(H, C, r, J, drift), torque)
        return 0

    return call


def _returning(law: Any) -> Any:
    @numba.njit(_LAW)  # type: ignore[untyped-decorator]
    def call(
        t: float, q: Array, v: Array, H: Array, C: Array, r: Array, J: Array, drift: Array, torque: Array
    ) -> int:  # fmt: skip
        answer = law(t, q, v, Terms(H, C, r, J, drift))
        if answer.shape[0] != torque.shape[0]:
            return WRONG_LENGTH
        torque[:] = answer
        return 0

    return call


def _name(law: Any) -> str:
    return str(getattr(law, "__name__", law))


def _why(error: NumbaError) -> str:
    """Return the line of numba's message that says what is wrong, and the line of the law where."""
    lines = [line.strip() for line in str(error).splitlines()]
    if any("setitem(readonly" in line for line in lines):
        return "it writes into q, v or terms, which are there to be read"
    told = [line for line in lines if line and not line.startswith(("Failed in", "-", "No implementation"))]
    where = next((line for line in lines if line.startswith("File ")), "")
    what = next((line for line in told if line != where), str(type(error).__name__))
    return one_line(f"{what} ({where.rstrip(':')})" if where else what)


@entry_kernel
def _go_on(
    run: Any, law: Any, request: int, tree: Tree, work: Array, k: Array, state: Whole, memory: Array, table: Array,
    tableau: Array, rows: Array, events: Array, now: Array, q: Array, v: Array, torque: Array, own: Array,
) -> int:  # fmt: skip
    """Go on as `run` does, and evaluate the law whenever it is asked for."""
    n = q.shape[0]
    H, C, J = own[0 : n * n].reshape(n, n), own[n * n : n * n + n], own[n * n + n : n * n + 4 * n].reshape(3, n)
    at = n * n + 4 * n
    r, drift, scratch = own[at : at + 3], own[at + 3 : at + 6], own[at + 6 :]
    while request in (TERMS, TERMS_AND_LAW):
        if request == TERMS_AND_LAW:
            tree_terms(tree, q, v, scratch, H, C, J, r, drift)
            for i in range(n):
                torque[i] = 0.0
                for j in range(i):
                    H[i, j] = H[j, i]
            status = law(now[TIME], q, v, H, C, r, J, drift, torque)
            if status != 0:
                return WRONG_LENGTH
            for i in range(n):
                if not math.isfinite(torque[i]):
                    return NOT_FINITE
        request = run(tree, work, k, state, memory, table, tableau, rows, events, ALL)
    return request


def loop_with_law(
    run: Any, law: Any, call: Any, tree: Tree, work: Array, w: Work, arrays: tuple[Any, ...]
) -> Callable[[Array], int]:
    """Return a function of the table of events that goes on with a run, the law included; see `_go_on`.

    Parameters
    ----------
    run : function
        `run_compiled` or `run_compiled_with_more`.
    law, call : functions
        The law, and what `compiled_law` made of it.
    tree, work, w, arrays
        What `run` takes before the events, and the views into its memory.
    """
    n = w.q.shape[0]
    views = (w.now, w.q, w.v, w.torque, np.zeros(n * n + 4 * n + 6 + work_size(n)))
    # By address (`FunctionType`), so that one compilation serves every law; numba would make one for each.
    numbers = [_typeof(x) for x in (tree, work, *arrays, np.zeros((1, EVENT_WIDTH)))]
    signature = types.int64(
        types.FunctionType(types.int64(*numbers, types.int64)), types.FunctionType(_LAW), types.int64, *numbers,
        *(_typeof(x) for x in views),
    )  # fmt: skip
    make_ready(run, _go_on)
    loop: Any = _go_on
    entry = loop.get_compile_result(signature).entry_point
    request = TERMS_AND_LAW

    def go_on(events: Array) -> int:
        nonlocal request
        try:
            answer = int(entry(run, call, request, tree, work, *arrays, events, *views))
        except Exception as error:  # only the law can raise here
            raise law_failure(law, error, float(w.now[TIME])) from error
        request = TERMS
        if answer == WRONG_LENGTH:
            raise not_a_torque("Q of another length", float(w.now[TIME]), n)
        return answer

    return go_on


def checked_law(law: Law, robot: Robot, q: Array, v: Array) -> Callable[[float, Array], str]:
    """Wrap a user's law: give it read-only copies, check what it returns, and write that into the torque.

    The function returned takes t, s, reads the state from q and q̇ (n,), writes Q (n,), N m, and returns what is wrong
    with it in words, or "".
    """

    if hasattr(law, "py_func"):
        from closedloop.engines.user_law import as_returning

        law = as_returning(law, robot.n)

    def evaluate(t: float, torque: Array) -> str:
        q_, v_ = q.copy(), v.copy()
        q_.setflags(write=False)
        v_.setflags(write=False)
        try:
            answer = law(t, q_, v_, robot.terms(q, v))
        except (Exception, SystemExit) as error:
            raise law_failure(law, error, t) from error
        fault = ""
        try:
            given = np.asarray(answer)
        except (TypeError, ValueError):  # lists of different lengths
            given, fault = np.zeros(0), f"{str(answer)[:60]!r}"
        if given.dtype.kind not in "iuf":
            fault = f"{str(answer)[:60]!r}"
        elif not fault and given.shape != torque.shape:
            fault = f"Q of shape {given.shape}"
        if fault:
            raise not_a_torque(fault, t, robot.n)
        if not np.all(np.isfinite(given)):
            return not_finite(given)
        torque[:] = given
        return ""

    return evaluate


def not_a_torque(returned: str, t: float, n: int) -> ScenarioError | LawError:
    """Return the error of a law that returned at t, s, what is no torque of n joints; at t = 0 s nothing ran yet."""
    what = f"the law returned {returned} at t = {t:g} s: must be {n} real numbers, one torque a joint, ({n},)"
    return LawError(f"{when(t)}: {what}", t) if t > 0.0 else ScenarioError(what)
