"""Derivatives by dual numbers beside Richardson's differences of whole runs: every shipped scenario, key by key.

    python tests/fuzz/gradients.py                       # all: five keys each, at four values of every key
    python tests/fuzz/gradients.py --only wam_slide --values 1 1.05 --duration 0.5

A line for each scenario: how many derivatives, how many of them by dual numbers, how many of these agree with the
differences to 1e-6, or to what the differences say of themselves, and the worst; with `--why`, why others are not by
dual numbers. Exit status 1 if one does not agree.
"""

import argparse
import logging
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import closedloop as cl
import closedloop.studies.gradient.gradient as whole
from closedloop.scenario.load import shipped_scenarios
from closedloop.studies.gradient import differences
from closedloop.studies.gradient.differences import SIZE_OF_ZERO, Keys, along, difference, samples, slices_of
from closedloop.studies.gradient.exact import exact, rounded

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
# Of a list so many entries are compared at each value of the key, at the next value the next ones: a mechanism has 24.
ENTRIES = 3
# What moves late moves within a short run.
EARLIER = {
    "stewart": {"reference.start": 0.02},
    "panda_polish": {"reference.start": 0.05},
    "push_block": {"reference.start": 0.0},
}
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


def outputs_of(run: Any) -> list[Any]:
    """Return the quantities that a run has."""
    found = []
    for name in OUTPUTS:
        with suppress(cl.ClosedLoopError):
            found.append(differences.output(name, run))
    return found


class Compared:
    """Derivatives of quantities of a run along some entries of a key, found in three ways.

    Parameters
    ----------
    scenario, key : Scenario, str
    entries : slice
        Which entries of the key, counted as if it were flat.

    Attributes
    ----------
    outputs : list of Output
        The quantities that have derivatives by dual numbers, and of which the others are taken.
    duals : (M, entries) array
        Of all of these quantities, one after the other.
    """

    def __init__(self, scenario: Any, key: str, entries: slice) -> None:
        self.run, self.keys = differences.simulated(scenario, None), Keys(scenario, [key])
        self._directions = self.keys.directions[entries]
        self.given = self.outputs = outputs_of(self.run)
        found = exact(self.keys, self.run, self._base(), self.outputs, None, lambda *_: None)
        self._directions = [each for each in self._directions if each in found.found]  # beside others is another run
        if found.outputs and self._directions:
            self.duals = np.stack([found.found[each].best.value for each in self._directions], -1)
        self.outputs = found.outputs if self._directions else []

    def parts(self) -> list[tuple[Any, slice]]:
        """Return the quantities, and which of all entries are theirs."""
        return list(zip(self.outputs, slices_of(self.outputs, self.run), strict=True))

    def _base(self) -> Any:
        return whole._sampled(self.run, self.outputs)

    def _read(self, run: Any) -> Any:
        return np.concatenate([each.of(run).ravel() for each in self.outputs])

    def _read_with_rows(self, run: Any) -> Any:
        """Return all quantities, and then the row at which each is attained, 0 if it is not a largest value."""
        speeds = np.linalg.norm(run.velocity, axis=1)
        at = {"peak_contact_force": np.argmax(run.contact_force), "max_tip_speed": np.argmax(speeds)}
        rows = [np.full(part.stop - part.start, at.get(output.name, 0)) for output, part in self.parts()]
        return np.concatenate([self._read(run), *rows])

    def richardson(self) -> tuple[Any, Any]:
        """Return the derivatives (M, entries) and the estimates of their errors; NaN where there are none."""
        base = self._base()
        found = along(self.keys, self._directions, base, self._read, None, lambda *_: None)
        parts = [found[direction].part(slice(0, base.values.size)) for direction in self._directions]
        return np.stack([part.value for part in parts], -1), np.stack([part.error for part in parts], -1)

    def fitted(self, wanted: Any) -> tuple[Any, Any]:
        """Return derivatives by polynomials through many runs, and their standard errors; NaN if other events happen.

        A difference of few runs does not know how large what it cannot see is: the stabiliser makes some 1e-10 N of the
        rounding of an instant of impact. The scatter of many runs about a polynomial tells. The runs are brought closer
        together until the errors are as wanted, (M,), and a largest value is attained at one row in all of them.
        """
        shares = np.cos(np.pi * (np.arange(POINTS) + 0.5) / POINTS)
        basis = np.polynomial.chebyshev.chebvander(shares, DEGREE)
        rates = np.polynomial.chebyshev.chebval(0.0, np.polynomial.chebyshev.chebder(np.eye(DEGREE + 1)))
        weights = rates @ np.linalg.pinv(basis)
        base, slopes, errors = self._base(), [], []
        for direction in self._directions:
            best, least = np.full(base.values.shape, np.nan), np.full(base.values.shape, np.inf)
            for half in direction.step * 0.25 ** np.arange(1, 6):
                beside = [partial(self.keys.scenario_at, {direction: half * share}) for share in shares]
                runs = samples(beside, self._read_with_rows, None, lambda *_: None)
                if any(difference(base, replace(each, values=each.values[: base.values.size])) for each in runs):
                    continue
                values, rows = np.split(np.array([each.values for each in runs]), 2, axis=1)
                off = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
                scatter = np.sqrt(np.sum(off * off, axis=0) / (POINTS - DEGREE - 1)) * np.linalg.norm(weights) / half
                better = (scatter < least) & np.all(rows == rows[0], axis=0)
                best, least = np.where(better, weights @ values / half, best), np.where(better, scatter, least)
                if np.all((least <= wanted) | ~better & np.isfinite(least)):  # at shorter steps rounding is more
                    break
            slopes.append(best)
            errors.append(least)
        return np.stack(slopes, -1), np.stack(errors, -1)


def compare(scenario: Any, key: str, entries: slice, key_size: float, count: Counter[str]) -> tuple[float, str]:
    """Count the derivatives in, and return the worst disagreement, as a share, and of what it is."""
    three = Compared(scenario, key, entries)
    count["derivatives"] += len(three.given)
    count["duals"] += len(three.outputs)
    worst, which = 0.0, ""
    if not three.outputs:
        return worst, which
    mine, (its, error) = three.duals, three.richardson()
    size = np.empty((mine.shape[0], 1))
    for output, part in three.parts():
        natural = OF_SIZE * rounded(three.run, output) / key_size
        size[part] = max(float(np.max(np.abs(mine[part]), initial=0.0)), natural, np.finfo(float).tiny)
    left = [part for _, part in three.parts() if not np.all((np.abs(mine - its) <= AGREE * size + error)[part])]
    if left:
        wanted = np.full(mine.shape[0], np.inf)
        for part in left:
            wanted[part] = 0.1 * AGREE * size[part, 0]
        fit = three.fitted(wanted)
        for part in left:
            its[part], error[part] = fit[0][part], SURE * fit[1][part]
    for output, part in three.parts():
        of = output.name
        if np.any(np.isnan(its[part])):
            count["no difference"] += 1
            continue
        apart = np.abs(mine - its)[part] / size[part]
        off = float(np.max(apart, initial=0.0))
        share = float(np.max(apart - error[part] / size[part], initial=0.0))
        count["to 1e-6" if off <= AGREE else "to the error" if share <= AGREE else "disagree"] += 1
        if share > AGREE:
            notices.debug("%s by %s: %s, by differences %s to %s", of, key, mine[part], its[part], error[part])
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
    changes = {"time.duration": min(duration, base.time.duration)} | EARLIER.get(name, {})
    try:
        scenario = cl.load_scenario(name, changes)
    except cl.ClosedLoopError:
        changes, scenario = {}, base
    for key in keys_of(scenario, keys):
        for i, factor in enumerate(values):
            value = (np.array(Keys(scenario, [key]).values[key]) * factor).tolist()
            try:
                at = cl.load_scenario(name, changes | {key: value})
                begin = i * ENTRIES % max(np.size(value), 1)
                size = float(np.max(np.abs(value))) or SIZE_OF_ZERO
                worst = max(worst, compare(at, key, slice(begin, begin + ENTRIES), size, count))
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
