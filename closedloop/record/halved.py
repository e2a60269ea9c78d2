"""The comparison with a run at half the step that a file holds: refused unless it is exactly one."""

from __future__ import annotations

import math
from typing import Any

from closedloop.base.errors import RunFileError
from closedloop.loop.events.table import KINDS
from closedloop.record.report.halved import MAIN_COLUMNS
from closedloop.record.report.measures import MEASURES

_WORD, _COUNT, _SIZE, _NUMBER = "text", "count", "size", "number"
_TOP = {"step": _SIZE, "stopped": _WORD, "rows": _COUNT, "modes_differ": _COUNT, "force": _SIZE, "position": _SIZE}
_NEVER_NONE = {"step", "rows", "modes_differ", "unit", "count"}
_COLUMN = {"max": _SIZE, "rms": _SIZE, "unit": _WORD, "at": _SIZE}
_VALUE = {"value": _NUMBER, "at_half": _NUMBER, "difference": _SIZE, "unit": _WORD}
_EVENT = {"count": _COUNT, "at_half": _COUNT, "max_time_difference": _SIZE, "at": _SIZE}
_PARTS = {"columns": (MAIN_COLUMNS, _COLUMN), "values": (MEASURES, _VALUE), "events": (KINDS.values(), _EVENT)}


def checked_comparison(found: Any) -> dict[str, Any]:
    """Return what a file holds if it is what `closedloop.record.report.halved.halved_comparison` returns.

    Raises
    ------
    RunFileError
        If it is not.
    """
    good = isinstance(found, dict) and set(found) == {*_TOP, *_PARTS} and _is_table(found, _TOP)
    for name, (keys, spec) in _PARTS.items():
        good = good and isinstance(found[name], dict) and set(found[name]) <= set(keys)
        good = good and all(isinstance(row, dict) and set(row) == set(spec) for row in found[name].values())
        good = good and all(_is_table(row, spec) for row in found[name].values())
    if not good:
        raise RunFileError("is damaged: attribute 'halved' is not a comparison with a run at half the step")
    table: dict[str, Any] = found
    return table


def _is_table(row: dict[str, Any], spec: dict[str, str]) -> bool:
    return all(_is(row[key], kind, key) for key, kind in spec.items())


def _is(value: Any, kind: str, key: str) -> bool:
    if value is None:
        return key not in _NEVER_NONE
    if kind == _WORD:
        return isinstance(value, str)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    whole = kind != _COUNT or isinstance(value, int)
    return whole and math.isfinite(value) and (kind == _NUMBER or value >= 0)
