"""How far a slider of the lab reaches, and in which steps: from the value that it starts with, the bounds of the key's
field, and its unit.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, get_args

import annotated_types
import numpy as np
from pydantic.fields import FieldInfo

from closedloop.base.sections import field_units, sizes
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

# How far a slider reaches from zero where the scenario has zero, by unit.
USUAL = {
    "N": 10.0, "s": 0.02, "1/s": 200.0, "N/m": 2000.0, "N s/m": 200.0, "N m/rad": 1000.0, "N m s/rad": 100.0, "m": 0.05,
    "m/s": 0.05, "rad": 3.2, "rad/s": 1.0, "N m": 10.0, "kg": 10.0,
}  # fmt: skip
LOG_SPAN = 30.0  # a logarithmic slider reaches so many times up and down
POSITIONS = 400  # of a slider


def span(
    key: str, field: FieldInfo, value: float, unit: str, scenario: Scenario, index: int | None = None,
    model: RobotModel | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return form, low, high and step of a slider that starts at a value."""
    least, most = _bounds(field)
    if key.startswith("start.q") and unit == "1":  # of a quaternion
        return _linear(-1.0, 1.0)
    if key.startswith("start.q") and model is not None and not model.balls and index is not None and index < model.n:
        low, high = float(model.position_lower[index]), float(model.position_upper[index])
        least, most = (
            (low if math.isfinite(low) else value - math.pi),
            (high if math.isfinite(high) else value + math.pi),
        )
        return _linear(min(least, value), max(most, value))
    if least >= 0.0 and value > 0.0 and unit not in ("", "N") and not _is_instant(key, unit):
        low, high = math.log10(max(value / LOG_SPAN, _smallest(field))), math.log10(min(value * LOG_SPAN, most))
        return {"form": "log", "low": low, "high": high, "step": (high - low) / POSITIONS}
    if math.isfinite(least) and most <= 1.0:
        return _linear(least, most)
    if unit == "" and -1.0 <= value <= 1.0 and isinstance(index, int):
        return _linear(-1.0, 1.0)  # a direction
    if _is_instant(key, unit):
        return _linear(0.0, max(2.0 * value, scenario.time.duration), 0.05)
    if key == "law.force" and scenario.surface.contact == "unilateral" and value >= 0.0:
        least = max(least, 0.0)  # with less the tip only leaves the surface
    reach = 3.0 * abs(value) or USUAL.get(unit, 1.0)
    return _linear(max(-reach, least), min(reach, most))


def _is_instant(key: str, unit: str) -> bool:
    """Whether a key is an instant or a duration of the run, not a time constant."""
    return unit == "s" and key.rpartition(".")[2] in ("start", "stop", "at", "pd_start", "duration", "times")


def _linear(low: float, high: float, step: float | None = None) -> dict[str, Any]:
    if high <= low:
        high = low + 1.0
    fine = 10.0 ** math.floor(math.log10((high - low) / POSITIONS)) if step is None else step
    fine = next((k * fine for k in (1, 2, 5, 10) if (high - low) / (k * fine) <= POSITIONS), 10 * fine)
    return {"form": "linear", "low": low, "high": high, "step": fine}


def _bounds(field: FieldInfo) -> tuple[float, float]:
    """Return the least and the greatest number that a field takes."""
    least, most = -math.inf, math.inf
    for part in (*field.metadata, *_inner(field.annotation)):
        if isinstance(part, annotated_types.Gt | annotated_types.Ge):
            least = max(least, float(getattr(part, "gt", getattr(part, "ge", -math.inf))))
        elif isinstance(part, annotated_types.Lt | annotated_types.Le):
            most = min(most, float(getattr(part, "lt", getattr(part, "le", math.inf))))
    for size in sizes(Annotated[field.annotation, *field.metadata, None]):
        least, most = max(least, -size.most), min(most, size.most)
    # Times, rates and gains have no bound below in their type where it takes a word or a list beside a number.
    if _is_gain(field) or field_units(field) & {"s", "1/s", "1/s²"}:
        least = max(least, 0.0)
    return least, most


def _is_gain(field: FieldInfo) -> bool:
    return any(size.why == "no drive is so stiff" for size in sizes(Annotated[field.annotation, *field.metadata, None]))


def _smallest(field: FieldInfo) -> float:
    return max((size.least for size in sizes(Annotated[field.annotation, *field.metadata, None])), default=0.0) or 1e-12


def _inner(annotation: Any) -> list[Any]:
    """Return the annotations of a key that may be left out, or of one that takes a number or a word."""
    found: list[Any] = []
    for part in get_args(annotation):
        found += [*getattr(part, "__metadata__", ()), *_inner(part)]
        found += [more for each in getattr(part, "__metadata__", ()) for more in getattr(each, "metadata", ())]
    return found


def nearest_round(x: float) -> float:
    """Return the 1, 2 or 5 times a power of ten that is nearest to x > 0 on a logarithmic scale."""
    power = math.floor(math.log10(x))
    steps = [step * 10.0**p for p in (power, power + 1) for step in (1.0, 2.0, 5.0)]
    best = steps[int(np.argmin([abs(math.log(step / x)) for step in steps]))]
    return float(f"{best:.3g}")
