"""Derivatives by dual numbers beside Richardson's differences of whole runs: every shipped scenario, key by key.

    python tests/fuzz/gradients.py                       # all: five keys each, at four values of every key
    python tests/fuzz/gradients.py --only wam_slide --values 1 1.05 --duration 0.5

A line for each scenario: how many derivatives, how many of them by dual numbers, how many of these agree with the
differences to 1e-6, or to what the differences say of themselves, and the worst; with `--why`, why others are not by
dual numbers. Exit status 1 if one does not agree.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

import closedloop as cl
import closedloop.studies.gradient.gradient as whole
from closedloop.scenario.file import shipped_scenarios
from closedloop.studies.gradient.differences import variant
from closedloop.studies.gradient.exact import DUALS, NOTHING
from closedloop.studies.gradient.guard import rounded
from closedloop.studies.gradient.keys import SIZE_OF_ZERO, Keys
from closedloop.studies.gradient.variants import difference, sample, samples

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
# Of a fit: runs, the polynomial's degree, and how many standard errors off a derivative may be.
POINTS, DEGREE, SURE = 32, 6, 5.0
VALUES = (1.0, 0.97, 1.05, 1.11)
# A derivative that is 0 but for rounding is compared with this share of the quantity's size over the key's.
AGREE, OF_SIZE = 1e-6, 1e-2
notices = logging.getLogger("closedloop.studies.gradient")


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


def outputs_of(scenario: Any) -> list[str]:
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
        some = [of for of in outputs if exact.method[of][key].startswith(DUALS)]
        return exact, cl.gradient(scenario, [key], some) if some else exact
    finally:
        whole.exact = kept


def fitted(scenario: Any, key: str, of: str, wanted: float) -> tuple[Any, Any]:
    """Return derivatives by polynomials through many runs, and their standard errors; NaN where other events happen.

    A difference of few runs does not know how large what it cannot see is: the stabiliser makes some 1e-10 N of the
    rounding of an instant of impact. The scatter of many runs about a polynomial tells. The runs are brought closer
    together until the errors are as wanted.
    """
    keys, at = Keys(scenario, [key]), whole.output(of, run := whole.simulated(scenario, None))
    base = sample(run, at.of)
    shares = np.cos(np.pi * (np.arange(POINTS) + 0.5) / POINTS)
    basis = np.polynomial.chebyshev.chebvander(shares, DEGREE)
    rates = np.polynomial.chebyshev.chebval(0.0, np.polynomial.chebyshev.chebder(np.eye(DEGREE + 1)))
    weights = rates @ np.linalg.pinv(basis)
    slopes, errors = [], []
    for direction in keys.directions:
        best = np.full(base.values.shape, np.nan), np.full(base.values.shape, np.inf)
        for half in direction.step * 0.25 ** np.arange(1, 6):
            runs = samples([variant(keys, direction, half * share) for share in shares], at.of, None, lambda *_: None)
            if any(difference(base, each) for each in runs):
                continue
            values = np.array([each.values for each in runs])
            fit = np.linalg.lstsq(basis, values.reshape(POINTS, -1), rcond=None)[0]
            off = values - (basis @ fit).reshape(values.shape)
            scatter = np.sqrt(np.sum(off * off, axis=0) / (POINTS - DEGREE - 1)) * np.linalg.norm(weights) / half
            better = scatter < best[1]
            slope = np.tensordot(weights, values, 1) / half
            best = np.where(better, slope, best[0]), np.where(better, scatter, best[1])
            if np.all(best[1] <= wanted):
                break
        slopes.append(best[0])
        errors.append(best[1])
    shape = np.shape(at.of(run)) + keys.values[key].shape
    slope, error = (np.stack(each, axis=-1).reshape(shape) for each in (slopes, errors))
    return slope, error


def compare(
    scenario: Any, exact: Any, differences: Any, key: str, key_size: float, count: Counter[str]
) -> tuple[float, str]:
    """Count the derivatives in, and return the worst disagreement, as a share, and of what it is."""
    worst, which, run = 0.0, "", whole.simulated(scenario, None)
    for of in exact.value:
        count["derivatives"] += 1
        if not exact.method[of][key].startswith(DUALS):
            continue
        count["duals"] += 1
        mine, its = (np.asarray(each.derivative[of][key]) for each in (exact, differences))
        natural = rounded(run, whole.output(of, run)) / key_size
        size = max(float(np.max(np.abs(mine), initial=0.0)), OF_SIZE * natural, np.finfo(float).tiny)
        error = np.asarray(differences.error[of][key])
        if not np.all(np.abs(mine - its) <= AGREE * size + error):
            its, error = fitted(scenario, key, of, 0.1 * AGREE * size)
            error = SURE * error
        if np.any(np.isnan(its)):
            count["no difference"] += 1
            continue
        off = float(np.max(np.abs(mine - its), initial=0.0)) / size
        share = float(np.max(np.abs(mine - its) - error, initial=0.0)) / size
        count["to 1e-6" if off <= AGREE else "to the error" if share <= AGREE else "disagree"] += 1
        if share > AGREE:
            notices.debug("%s by %s: %s, by differences %s to %s", of, key, mine, its, error)
        elif off > AGREE:
            notices.debug("%s by %s: agrees to %.1e, the differences' error", of, key, off)
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
                size = float(np.max(np.abs(value))) or SIZE_OF_ZERO
                worst = max(worst, compare(at, *both(at, key, outputs_of(at)), key, size, count))
            except cl.ClosedLoopError as error:
                count["refused"] += 1
                notices.debug("refused: %s", str(error).splitlines()[0])
    return count, *worst


def main() -> int:
    """Compare, print, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=sorted(shipped_scenarios()))
    parser.add_argument("--keys", type=int, default=5)
    parser.add_argument("--values", nargs="+", type=float, default=VALUES, help="of each key, as shares of its own")
    parser.add_argument("--duration", type=float, default=1.0, help="of each run at most, s")
    parser.add_argument("--why", action="store_true", help="say why derivatives are not by dual numbers")
    options = parser.parse_args()
    if options.why:
        logging.basicConfig(format="    %(message)s")
        notices.setLevel(logging.DEBUG)
    total: Counter[str] = Counter()
    for name in options.only:
        count, worst, which = look(name, options.keys, options.values, options.duration)
        total += count
        print(f"{name:32s} {dict(count)} worst {worst:.1e} {which}", flush=True)
    print("all", dict(total))
    return 1 if total["disagree"] else 0


if __name__ == "__main__":
    sys.exit(main())
