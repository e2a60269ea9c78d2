"""Columns that only some runs have: the states of their control laws, and what functions of one's own add.

What a column is cannot be looked up in a table then: a `Run` has it as `added`, and its file as the attribute `added`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from traceback import extract_tb
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.base.errors import LawError, RunFileError, ScenarioError, one_line
from closedloop.jit.parameters import state_block
from closedloop.record.columns.record import Record
from closedloop.record.columns.recorded import Column
from closedloop.scenario.scenario import Scenario

Function = Callable[[Any], ArrayLike]
Recorded = Mapping[str, Function | tuple[Function, str]]
"""Columns of one's own: by name a function of the `Run`, -> (N,) or (N, k); or that and the unit of what it returns."""

# A name that CSV, MATLAB, NetCDF and Python take as it is.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,59}")
# The integral of the force error is a state of nearly every law, and zero without its gain.
_USUAL = "force_error"
# Names of a file's dimensions and labels, which no column may have.
RESERVED = frozenset(
    {"joint", "coordinate", "joint_type", "axis", "event", "contact", "contact_tangent", "component", "kind"}
)


def state_columns(scenario: Scenario, n: int) -> dict[str, tuple[Column, int | slice]]:
    """Return the columns ``law_NAME`` and ``compensation_NAME`` of a run of n joints, and the place of each state.

    The places are among the states of the law and its compensation, in the loop's order. A joint's state is a column
    (N, n). The integral of the force error is one only where `law.force_integral` asks for it.
    """
    found: dict[str, tuple[Column, int | slice]] = {}
    before = 0
    for section, part in (("law", scenario.law), ("compensation", scenario.compensation)):
        block = state_block(type(part))
        for name, shape in block.layout.shape.items():
            if name == _USUAL and section == "law" and scenario.law.force_integral == 0.0:
                continue
            place = block.place(name, n)
            where = slice(before + place.start, before + place.stop) if isinstance(place, slice) else before + place
            dims = ("time", "joint") if shape else ("time",)
            found[f"{section}_{name}"] = Column(dims, "", f"state {name} of {section}.kind = {part.kind}"), where
        before += block.count(n)
    return found


def recorded_states(scenario: Scenario, n: int) -> int:
    """Return how many numbers of a row are states of the law and its compensation: all of them, or none."""
    if not state_columns(scenario, n):
        return 0
    return sum(state_block(type(part)).count(n) for part in (scenario.law, scenario.compensation))


def check_names(record: Recorded, taken: set[str]) -> None:
    """Refuse names of columns that are taken or no names, and what is no function."""
    for name, given in record.items():
        if not (isinstance(name, str) and _NAME.fullmatch(name)):
            raise ScenarioError(
                f"record: {str(name)[:80]!r}: must be a letter and up to 59 letters, digits and underscores after it"
            )
        if name in taken:
            raise ScenarioError(f"record: {name!r}: a run has this already; use another name")
        function, unit = given if isinstance(given, tuple) and len(given) == 2 else (given, "")
        if not callable(function) or not isinstance(unit, str):
            raise ScenarioError(
                f'record: {name!r}: must be a function of the run, or such a function and a unit: (function, "W")'
            )


def own_columns(run: Record, record: Recorded) -> tuple[dict[str, NDArray[Any]], dict[str, Column]]:
    """Return the columns that functions of one's own give of a run of at least one row, and what each is.

    One that raises something, or returns anything but a finite real number, or k of them, a row is refused.
    """
    values, columns = {}, {}
    for name, given in record.items():
        function, unit = given if isinstance(given, tuple) else (given, "")
        values[name] = _values(run, name, function)
        text = (getattr(function, "__doc__", None) or "").strip().partition("\n")[0]
        said = f"{getattr(function, '__module__', '?')}:{getattr(function, '__qualname__', type(function).__name__)}"
        dims = ("time",) if values[name].ndim == 1 else ("time", f"{name}_part")
        columns[name] = Column(dims, unit, text or f"returned by {said}")
    return values, columns


def _values(run: Record, name: str, function: Function) -> NDArray[Any]:
    rows, end = len(run), float(run.time[-1])
    try:
        answer: Any = function(run)
    except (Exception, SystemExit) as error:
        what = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
        raise LawError(f"record: {name!r}: {_where(error)}{what}", end, run) from error
    try:
        found = np.array(answer)
    except (TypeError, ValueError):  # lists of different lengths
        found = np.array(None)
    must = f"must be one real number a row, ({rows},), or k of them, ({rows}, k)"
    if found.dtype.kind not in "biuf":
        raise LawError(f"record: {name!r}: the function returned {one_line(repr(answer))[:60]}: {must}", end, run)
    if found.ndim not in (1, 2) or found.shape[0] != rows or found.size == 0:
        raise LawError(f"record: {name!r}: the function returned an array of shape {found.shape}: {must}", end, run)
    bad = ~np.isfinite(found.reshape(rows, -1)).all(axis=1)
    if bad.any():
        first = int(np.argmax(bad))
        shown = found.reshape(rows, -1)[first]
        raise LawError(
            f"record: {name!r}: in row {first}, t = {run.time[first]:g} s, it is {shown[~np.isfinite(shown)][0]}: must "
            "be finite", end, run,
        )  # fmt: skip
    return found.astype(float)


def _where(error: BaseException) -> str:
    """Return 'file:line: ' of where a function failed, "" of one that is not Python's."""
    frames = extract_tb(error.__traceback__)[1:]  # the first is the caller
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}: " if frames else ""


def as_text(added: Mapping[str, Column]) -> str:
    """Return the text that a file has of them."""
    return json.dumps({name: [list(dims), units, meaning] for name, (dims, units, meaning) in added.items()})


def from_text(text: str) -> dict[str, Column]:
    """Return what `as_text` wrote, and refuse anything else."""
    found = json.loads(text)
    try:
        added = {name: Column(tuple(dims), units, meaning) for name, (dims, units, meaning) in found.items()}
    except (AttributeError, TypeError, ValueError):
        added = {"": Column((), "", "")}
    for name, (dims, units, meaning) in added.items():
        own = ("time",), ("time", "joint"), ("time", f"{name}_part")
        if not _NAME.fullmatch(name) or dims not in own or not isinstance(units, str) or not isinstance(meaning, str):
            raise RunFileError("is damaged: attribute 'added' must be a table of columns: dimensions, unit, meaning")
    return added
