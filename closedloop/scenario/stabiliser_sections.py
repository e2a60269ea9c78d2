"""[stabiliser]: what keeps the closure error small, one section a kind."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from closedloop.base.sections import NotNegative, Section, Size, usual

DAMPING_RATIO = Size(1e6, "", "no closure is damped so", 1e-6, "nothing would die out")
TIME_CONSTANT = Size(1e300, "s", "no run lasts so long", 1e-9, "no step resolves it")


def _time_constant(value: Any) -> Any:
    if isinstance(value, str):
        if value != "auto":
            raise ValueError('must be a number of seconds, or "auto"')
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError('must be a number of seconds, or "auto"')
    if not 0 < value <= TIME_CONSTANT.most:  # compared as it is: a whole number may be too large for a float
        raise ValueError('must be greater than 0 and finite, or "auto"')
    return float(value)


TimeConstant = Annotated[float | Literal["auto"], BeforeValidator(_time_constant)]


class BaumgarteGains(Section):
    """Parameters of Baumgarte's stabiliser: s_v = 2ζ/T, s_p = 1/T²."""

    damping_ratio: Annotated[NotNegative, DAMPING_RATIO] = Field(
        0.707, description="damping ratio ζ with which the closure error dies out"
    )
    time_constant: Annotated[TimeConstant, TIME_CONSTANT] | None = Field(
        None,
        description='T, s; time.step if left out, 1 ms with dop853; "auto": two steps, or twice the shortest stable T '
        "where that is longer",
    )


class BaumgarteSection(BaumgarteGains):
    """[stabiliser] kind = "baumgarte": a spring and a damper inside Eq. 24, as in the paper."""

    kind: Literal["baumgarte"] = "baumgarte"


class ProjectionSection(Section):
    """[stabiliser] kind = "projection": position and velocity are projected onto the closure after each step."""

    kind: Literal["projection"] = "projection"


class BothSection(BaumgarteGains):
    """[stabiliser] kind = "both": Baumgarte inside the step, projection after it."""

    kind: Literal["both"] = "both"


class NoStabiliserSection(Section):
    """[stabiliser] kind = "none": the closure drifts (Fig. 7)."""

    kind: Literal["none"] = "none"


Stabiliser = Annotated[
    BaumgarteSection | ProjectionSection | BothSection | NoStabiliserSection,
    Field(discriminator="kind"),
    usual(BaumgarteSection),
]
