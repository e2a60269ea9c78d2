"""A user's law as source: how it is called, the line at which it failed, and a digest of its text."""

import inspect
import math
import os
import traceback
from copy import deepcopy
from functools import partial
from types import FunctionType, MethodType
from typing import Any

from closedloop.base.errors import LawError, ScenarioError, one_line
from closedloop.jit.calls import is_compiled
from closedloop.jit.user_code import source_digest

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
