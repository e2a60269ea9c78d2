"""What a comparison with measurements found: numbers for a program, and a table for a reader."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from closedloop.studies.identify.identify import Estimate, Identification
from closedloop.studies.identify.regressor import BOUNDED

# The relative RMS error of the torque, in the part that was not fitted, that a model may have.
HELD_OUT = 0.10


@dataclass
class Judged:
    """A comparison of a robot's model with its log.

    numbers: for a program; as JSON has them, so that what is not known is None
    lines: for a reader
    faults: what does not agree with the measurement, a line each; agreement if empty
    notes: why values are not given, a line each
    """

    robot: str
    source: str
    numbers: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def possible(e: Estimate) -> Estimate:
    """Return an estimate, or one that says why it is not given if it is negative beyond its interval and cannot be."""
    if e.why or e.high >= 0.0 or not e.name.startswith(BOUNDED):
        return e
    why = f"it comes out as {with_half(e)}, which cannot be: the model lacks something that looks like it"
    return e._replace(value=np.nan, low=-np.inf, high=np.inf, why=why)


def entries(estimates: Sequence[Estimate]) -> dict[str, Any]:
    """Return the values and intervals of estimates as lists; None where the log does not tell, with the reason."""
    told = {
        "value": [number_or_none(e.value) for e in estimates],
        "interval": [[number_or_none(e.low), number_or_none(e.high)] for e in estimates],
        "unit": estimates[0].unit,
    }
    reasons = {e.name: e.why for e in estimates if e.why}
    return told | ({"not_identifiable": reasons} if reasons else {})


def with_half(e: Estimate) -> str:
    """Return the value of an estimate and half of its interval, as text."""
    return f"{e.value:.4g} ± {(e.high - e.low) / 2:.2g}"


def number_or_none(x: float) -> float | None:
    """Return a number as JSON has it."""
    return float(x) if np.isfinite(x) else None


def add_torques(judged: Judged, found: Identification, tested: str) -> None:
    """Add the errors of the torque, joint by joint, and a fault for each joint beyond `HELD_OUT`."""
    names = found.robot.joint_names
    summary = found.summary()
    judged.numbers["torque"] = {
        "joints": list(names),
        "held_out_error": [number_or_none(x) for x in found.held_out],
        "fitted_error": [number_or_none(x) for x in found.relative_error],
        "used_share": [float(x) for x in found.used.mean(axis=0)],
        "held_out": tested,
    }
    for key in ("condition", "cutoff_hz", "windows", "correlation", "model_misses_something"):
        judged.numbers[key] = summary[key]
    judged.lines += ["", f"torque, RMS of the error over that of the torque (condition {found.solution.condition:.1f})"]
    judged.lines += [f"  {'':22}" + "".join(f"{name[:14]:>15}" for name in names)]
    rows = {"not fitted": found.held_out, "fitted": found.relative_error, "share of rows used": found.used.mean(axis=0)}
    for label, row in rows.items():
        judged.lines.append(f"  {label:22}" + "".join(f"{100 * x:13.1f} %" for x in row))
    judged.lines.append(f"  not fitted: {tested}")
    for name, error in zip(names, found.held_out, strict=True):
        if not error <= HELD_OUT:
            judged.faults.append(f"torque of {name}: {100 * error:.1f} % where not fitted, over {100 * HELD_OUT:.0f} %")
    if found.misses:
        judged.lines.append(f"  residual not white, the model misses something: {', '.join(found.misses)}")


def add_parameters(judged: Judged, found: Identification, kinds: Sequence[str]) -> None:
    """Add values and intervals of what each joint has."""
    judged.lines += ["", f"by joint, with {100 * found.confidence:.0f} % intervals"]
    for kind in kinds:
        estimates = [possible(e) for e in found.joints(kind)]
        judged.numbers[kind] = entries(estimates)
        judged.notes += [f"{e.name}: {e.why}" for e in estimates if "cannot be" in e.why]
        texts = ["-" if e.why else with_half(e) for e in estimates]
        judged.lines.append(f"  {kind:14} {estimates[0].unit:9}" + "".join(f"{text:>18}" for text in texts))
