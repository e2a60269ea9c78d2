"""What the sections of a scenario are made of: numbers that are numbers, lists that are lists, nothing unknown."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def _number(value: Any) -> Any:
    """Refuse what Python would quietly turn into a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError("must be a number")
    try:
        return float(value)
    except OverflowError:
        raise ValueError("must be a number below 1e308") from None


def _boolean(value: Any) -> Any:
    if not isinstance(value, bool):
        raise ValueError("must be true or false")
    return value


def _gain(value: Any) -> Any:
    """Take one number, or a list of them; pydantic's own union would blame the branch that was not meant."""
    if not isinstance(value, (list, tuple)):
        return _finite(value)
    for index, entry in enumerate(value):
        try:
            _finite(entry)
        except ValueError:
            raise ValueError(f"entry {index} is {entry!r}: must be a finite number") from None
    return tuple(float(entry) for entry in value)


def _finite(value: Any) -> float:
    number = float(_number(value))
    if not math.isfinite(number):
        raise ValueError("must be finite, not NaN or infinite")
    return number


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[float, BeforeValidator(_number), Field(gt=0.0)]
NotNegative = Annotated[float, BeforeValidator(_number), Field(ge=0.0)]
Restitution = Annotated[float, BeforeValidator(_number), Field(ge=0.0, le=1.0)]
Flag = Annotated[bool, BeforeValidator(_boolean)]
Vector3 = tuple[Number, Number, Number]
PerJoint = tuple[Number, ...]
Gain = Annotated[float | tuple[float, ...], BeforeValidator(_gain)]


class Section(BaseModel):
    """Common settings of all sections: nothing unknown, nothing infinite, nothing changed afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
