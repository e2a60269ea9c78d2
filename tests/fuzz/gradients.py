"""Derivatives by dual numbers beside Richardson's differences of whole runs: every shipped scenario, key by key.

    python tests/fuzz/gradients.py                       # all: five keys each, at four values of every key
    python tests/fuzz/gradients.py --only wam_slide --values 1 --duration 0.5

A line for each scenario: how many derivatives, how many of them by dual numbers, how many of these agree with the
differences to 1e-6, or to what the differences say of themselves, and the worst. Exit status 1 if one does not.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

import closedloop as cl
import closedloop.studies.gradient.gradient as whole
from closedloop.scenario.file import shipped_scenarios
from closedloop.studies.gradient.exact import DUALS, NOTHING
from closedloop.studies.gradient.keys import Keys

# Of these a scenario gets the first five that it has as real numbers; the others have none.
KEYS = (
    "law.force", "friction.coefficient", "impact.restitution", "law.kd", "law.kp", "compliance.stiffness", "start.q",
    "stabiliser.time_constant", "law.stiffness", "law.damping", "law.force_integral", "start.v", "reference.speed",
    "surface.gap", "friction.static", "joint_friction.coulomb", "friction.stiffness", "tool.mass",
    "impact.rest_speed", "transmission.stiffness", "robot.stop_restitution", "law.mass", "body.0.size",
)  # fmt: skip
OUTPUTS = (
    "rms_force_error", "peak_contact_force", "rms_path_error", "energy_exchanged", "q@end", "v@end", "event_time",
    "contact_force@end", "max_tip_speed",
)  # fmt: skip
VALUES = (1.0, 0.97, 1.05, 1.11)
AGREE = 1e-6


def keys_of(scenario: Any, count: int) -> list[str]:
    """Return the first keys that a scenario has as real numbers."""
    found = []
    for key in KEYS:
        try:
            Keys(scenario, [key])
        except cl.ClosedLoopError:
            continue
        found.append(key)
    return found[:count]


def outputs_of(scenario: Any, key: str) -> list[str]:
    """Return the quantities that a run has."""
    found = []
    run = whole.simulated(scenario, None)
    for name in OUTPUTS:
        try:
            whole.output(name, run)
        except cl.ClosedLoopError:
            continue
        found.append(name)
    return found


def both(scenario: Any, key: str, outputs: Sequence[str]) -> tuple[Any, Any]:
    """Return the derivatives by dual numbers, where there are any, and by differences."""
    exact = cl.gradient(scenario, [key], outputs)
    kept, whole.exact = whole.exact, lambda *given: NOTHING
    try:
        return exact, cl.gradient(scenario, [key], outputs)
    finally:
        whole.exact = kept


def compare(exact: Any, differences: Any, key: str, count: Counter[str]) -> tuple[float, str]:
    """Count the derivatives in, and return the worst disagreement, as a share, and of what it is."""
    worst, which = 0.0, ""
    for of in exact.value:
        count["derivatives"] += 1
        if not exact.method[of][key].startswith(DUALS):
            continue
        count["duals"] += 1
        mine, its = (np.asarray(each.derivative[of][key]) for each in (exact, differences))
        if np.any(np.isnan(its)):
            count["no difference"] += 1
            continue
        off = np.abs(mine - its) - np.asarray(differences.error[of][key])
        size = max(float(np.max(np.abs(its), initial=0.0)), np.finfo(float).tiny)
        share = float(np.max(off, initial=0.0)) / size
        count["agree"] += share <= AGREE
        count["disagree"] += share > AGREE
        if share > worst:
            worst, which = share, f"{of} by {key}"
    return worst, which


def look(name: str, keys: int, values: Sequence[float], duration: float) -> tuple[Counter[str], float, str]:
    """Return the counts of a scenario, the worst disagreement and of what it is."""
    count: Counter[str] = Counter()
    worst: tuple[float, str] = (0.0, "")
    base = cl.load_scenario(name)
    changes = {"time.duration": min(duration, base.time.duration)}
    try:
        scenario = cl.load_scenario(name, changes)
    except cl.ClosedLoopError:
        changes, scenario = {}, base
    for key in keys_of(scenario, keys):
        for factor in values:
            value = (np.array(Keys(scenario, [key]).values[key]) * factor).tolist()
            try:
                at = cl.load_scenario(name, changes | {key: value})
                worst = max(worst, compare(*both(at, key, outputs_of(at, key)), key, count))
            except cl.ClosedLoopError:
                count["refused"] += 1
    return count, *worst


def main() -> int:
    """Compare, print, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=sorted(shipped_scenarios()))
    parser.add_argument("--keys", type=int, default=5)
    parser.add_argument("--values", type=int, default=len(VALUES))
    parser.add_argument("--duration", type=float, default=1.0, help="of each run at most, s")
    options = parser.parse_args()
    total: Counter[str] = Counter()
    for name in options.only:
        count, worst, which = look(name, options.keys, VALUES[: options.values], options.duration)
        total += count
        print(f"{name:32s} {dict(count)} worst {worst:.1e} {which}", flush=True)
    print("all", dict(total))
    return 1 if total["disagree"] else 0


if __name__ == "__main__":
    sys.exit(main())
