"""The table of `python -m validation.measured pressing`: each test measured and simulated, and what the fit says.

The numbers of a machine are fitted to tests: for every engine the same tests, the same search, the same budget. The
cost is a sum of squares over the tests: of the logarithms of first peak, frequency of the swing and settling time,
of the time without contact, and of the force itself in the first second. Nelder and Mead's simplex finds a minimum over
the logarithms of the numbers. Derivatives do not help it: the largest line of a spectrum and the last crossing of a
band jump. Intervals are those of the residuals made linear at the minimum.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from scipy.optimize import least_squares, minimize

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, ModelError
from closedloop.base.files import reason_of, write_whole
from validation.measured.judged import WORSE, Judged, number_or_none, paired
from validation.measured.pressing.machine import (
    CYCLE,
    SMOOTH,
    STEP,
    ClosedLoopArm,
    Figures,
    MuJoCoArm,
    Parameter,
    Touchdown,
    figures,
    read,
    scenario,
    smoothed,
)
from validation.measured.pressing.machine import LOST as LOST_BELOW

# A test counts in the fit by its place in this list; files with other tests are predicted.
TRAINING = (
    "direct_F100_g0.5_v0.10", "direct_F100_g0.5_v0.25", "straight_F15_g0.5_v0.25", "straight_F15_g1_v0.25",
    "straight_F55_g0.5_v0.25", "straight_F55_g1_v0.25", "ramp_F15_g1_v0.10", "ramp_F15_g1_v0.25", "ramp_F55_g0.5_v0.25",
    "ramp_F55_g1_v0.10",
)  # fmt: skip
# Simulations of all tests for each number that is fitted, the first simplex, and a new one after this share of them.
BUDGET, SIZE, AGAIN = 6, 1.15, 0.6
# What a residual is divided by: a share of the peak, of the frequency, of the settling time, s without contact, and of
# the RMS of the force about the commanded one.
PEAK, FREQUENCY, SETTLING, LOST, FORCE = 0.1, 0.1, 0.3, 0.3, 1.0
LONGEST, WORST = 1.0, 3.0  # s of the force that count; the largest residual of a figure
DIFFERENCE, CONFIDENCE = 0.05, 1.96


class Engine(Protocol):
    """What simulates a test."""

    name: ClassVar[str]
    parameters: ClassVar[Sequence[Parameter]]

    def simulate(self, values: Mapping[str, float], test: Touchdown) -> tuple[Array, Array]:
        """Return time (N,), s, 0 at the first contact, and force (N,), N."""


@dataclass(frozen=True)
class Fit:
    """Values by name, their intervals (low, high), the cost, and how often all tests were simulated."""

    values: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    cost: float
    simulations: int


@cache
def measured_figures(test: Touchdown) -> Figures:
    """Return the figures of what was measured."""
    return figures(test.time, test.measured, test.force, test.rest)


def residuals(engine: Engine, values: Mapping[str, float], tests: Sequence[Touchdown]) -> Array:
    """Return the residuals of all tests."""
    parts = []
    for test in tests:
        time, force = engine.simulate(values, test)
        have, want = figures(time, force, test.force, test.rest), measured_figures(test)
        each = np.array([
            np.log(max(have.peak, 1.0) / want.peak) / PEAK, np.log(have.frequency / want.frequency) / FREQUENCY,
            np.log((have.settling + SMOOTH) / (want.settling + SMOOTH)) / SETTLING, (have.lost - want.lost) / LOST,
        ])  # fmt: skip
        t = np.arange(0.0, LONGEST, STEP)
        both = [smoothed(np.interp(t, at, f), SMOOTH)[:: round(SMOOTH / STEP)] for at, f in
                ((time, force), (test.time, test.measured))]  # fmt: skip
        size = np.sqrt(np.mean((both[1] - test.force) ** 2) * len(both[0]))
        parts += [np.clip(each, -WORST, WORST), np.clip((both[0] - both[1]) / size / FORCE, -WORST, WORST)]
    return np.concatenate(parts)


def fit(engine: Engine, tests: Sequence[Touchdown], budget: int | None = None, told: Callable[[str], Any] | None = None,
        first: Mapping[str, float] | None = None) -> Fit:  # fmt: skip
    """Return the values that simulate the tests best, from `first` on, or from the first values of the parameters."""
    names = [p.name for p in engine.parameters]
    low, high = (np.log([getattr(p, end) for p in engine.parameters]) for end in ("low", "high"))
    best = np.log([(first or {}).get(p.name, p.first) for p in engine.parameters])
    used, least = 0, np.inf
    budget = int(BUDGET * len(names)) if budget is None else budget

    def values_at(x: Array) -> dict[str, float]:
        return dict(zip(names, map(float, np.exp(x)), strict=True))

    def cost(x: Array) -> float:
        r = residuals(engine, values_at(x), tests)
        return float(r @ r) / len(tests)

    while budget > used:
        simplex = np.vstack([best, best + np.diag(np.full(len(best), np.log(SIZE)))])
        options = {
            "maxfev": min(int(AGAIN * budget) + 1, budget - used),
            "initial_simplex": np.clip(simplex, low, high),
        }
        found = minimize(cost, best, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)), options=options)
        used += int(found.nfev)
        if found.fun < least:
            best, least = found.x, float(found.fun)
        if told is not None:
            told(f"{engine.name} {used:4} {least:9.4f}  " + " ".join(f"{v:.4g}" for v in values_at(best).values()))
    return Fit(values_at(best), intervals(engine, values_at(best), tests), least, used)


def intervals(
    engine: Engine, values: Mapping[str, float], tests: Sequence[Touchdown]
) -> dict[str, tuple[float, float]]:
    """Return an interval of each value, of the residuals made linear in the logarithms by differences of 5 %."""
    at = residuals(engine, values, tests)
    rows = [
        (residuals(engine, {**values, name: x * (1.0 + DIFFERENCE)}, tests) - at) / np.log1p(DIFFERENCE)
        for name, x in values.items()
    ]
    J = np.array(rows).T
    variance = float(at @ at) / max(1, len(at) - len(rows))
    half = CONFIDENCE * np.sqrt(variance * np.maximum(np.diag(np.linalg.pinv(J.T @ J, rcond=1e-10)), 0.0))
    half = np.where(np.any(J != 0.0, axis=0), np.minimum(half, np.log(1e6)), np.log(1e6))
    return {n: (x * float(np.exp(-h)), x * float(np.exp(h))) for (n, x), h in zip(values.items(), half, strict=True)}


def set_point_speed(test: Touchdown, mass: float, damping: float, lag: float) -> tuple[Array, Array]:
    """Return time (N,), s, from the first contact on, and the speed (N,), m/s, that the measured force asks for.

    That of `servo_admittance`, M v̇ = g (f_s − f_des − B v), B in contact only, with f_s behind the force by a low-pass.
    It starts at the logged speed.
    """
    edges = np.arange(0.0, test.rest, CYCLE)
    area = np.concatenate([[0.0], np.cumsum(np.diff(test.time) * 0.5 * (test.measured[1:] + test.measured[:-1]))])
    force = np.diff(np.interp(edges, test.time, area)) / CYCLE
    assert test.desired is not None
    speed, reading, found = -float(np.interp(0.0, *test.desired)), 0.0, []
    for f in force:
        reading += (1.0 - np.exp(-CYCLE / lag)) * (f - reading)
        held = damping if f > LOST_BELOW else 0.0
        # The damper is taken at the new speed, so that no damper makes the step unstable.
        speed = (speed + CYCLE * test.gain * (reading - test.force) / mass) / (1.0 + CYCLE * test.gain * held / mass)
        speed = min(max(speed, -test.limit), test.limit)
        found.append(speed)
    return edges[1:], np.array(found)


def force_mode(test: Touchdown) -> tuple[float, float, float, float]:
    """Return mass, kg, damper, N s/m, and lag, s, by the logged desired speed of a test, and the share not explained.

    No simulated arm is in it: the measured force goes in, the logged speed of the set point comes out.
    """
    assert test.desired is not None
    at, logged = test.desired

    def misses(x: Array) -> Array:
        time, speed = set_point_speed(test, *np.exp(x))
        wanted = np.interp(time, at, logged)
        return np.asarray((np.abs(speed) - wanted) / np.sqrt(np.sum(wanted * wanted)))

    bounds = np.log([[5.0, 20.0, 1e-3], [500.0, 2e4, 0.2]])
    found = min(
        (least_squares(misses, np.log([45.0, b, 0.01]), bounds=bounds) for b in (300.0, 2000.0)), key=lambda f: f.cost
    )
    mass, damping, lag = map(float, np.exp(found.x))
    return mass, damping, lag, float(np.sqrt(2.0 * found.cost))


OURS, PEER = ClosedLoopArm.name, MuJoCoArm.name
# What a prediction may differ by: means over the tests, of sizes of the difference.
GOALS = {"peak_percent": 15.0, "frequency_percent": 10.0, "settling_percent": 30.0, "mean_newton": 1.0}
# A number whose interval spans more than this factor is not determined.
DETERMINED = 4.0


def judge(given: Path | None = None, fitted: Path | None = None) -> Judged:
    """Fit the machine to tests of a file, or take a fit, and predict the other tests.

    given: the measurements, see `touchdowns.read`
    fitted: a file of fitted numbers: used if it exists, else written
    Raises `ModelError` if a file cannot be read, or nothing is there to fit or to predict.
    """
    if given is None:
        raise ModelError("pressing: its measurements are not part of the package (GPL-3): give them, --data FILE.npz")
    tests = read(given)
    fits = fits_of(tests, given, fitted)
    rest = [test for test in tests if test.name not in fits[OURS]["tests"]]
    if not rest:
        raise ModelError(f"{given}: every test is one that the machine was fitted to: give others")
    judged = Judged("A UR10e in its force mode comes down", str(given))
    judged.lines.append(f"{len(rest)} tests predicted, with numbers fitted to {len(fits[OURS]['tests'])} others")
    sizes = {}
    for engine in engines(fits):
        found = [_simulated(engine, fits[engine.name]["values"], test) for test in rest]
        sizes[engine.name] = sizes_of_differences(rest, found)
        judged.numbers[engine.name] = _errors(rest, found, sizes[engine.name]) | {
            "each": {test.name: one._asdict() for test, one in zip(rest, found, strict=True)},
            "values": fits[engine.name]["values"], "intervals": fits[engine.name]["intervals"],
        }  # fmt: skip
    judged.numbers["measured"] = {test.name: measured_figures(test)._asdict() for test in rest}
    _table(judged, rest)
    _goals(judged, list(sizes))
    if PEER in sizes:
        compare(judged, rest, sizes[OURS], sizes[PEER])
    repeats(judged, tests)
    _fitted(judged, fits)
    _mode(judged, tests)
    _why(judged, fits[OURS]["values"], tests)
    return judged


def engines(fits: Mapping[str, Any]) -> list[Engine]:
    """Return the engines that have been fitted and are installed."""
    found: list[Engine] = [ClosedLoopArm()]
    if PEER in fits and find_spec("mujoco") is not None:
        found.append(MuJoCoArm())
    return found


def fits_of(tests: Sequence[Touchdown], given: Path, fitted: Path | None) -> dict[str, Any]:
    """Return values, intervals and tests of each engine by its name: read from a file, or found and written to it."""
    if fitted is not None and fitted.exists():
        return _read_fits(fitted)
    training = [test for test in tests if test.name in TRAINING]
    if not training:
        raise ModelError(f"{given}: has none of the tests to fit to, {', '.join(TRAINING)}: give --fitted FILE")
    fits = {OURS: _entry(fit(ClosedLoopArm(), training, told=print), training)}
    halves = (training[::2], training[1::2]) if len(training) > 1 else ()
    fits[OURS]["halves"] = [fit(ClosedLoopArm(), half, told=print).values for half in halves]
    if find_spec("mujoco") is not None:
        fits[PEER] = _entry(fit(MuJoCoArm(), training, told=print), training)
    if fitted is not None:
        write_whole(fitted, f"{json.dumps(fits, indent=2)}\n".encode())
    return fits


def _entry(found: Fit, tests: Sequence[Touchdown]) -> dict[str, Any]:
    return dataclasses.asdict(found) | {"tests": [test.name for test in tests]}


def _read_fits(path: Path) -> dict[str, Any]:
    try:
        fits = json.loads(path.read_text(encoding="utf-8"))
        for kind, parameters in ((OURS, ClosedLoopArm.parameters), (PEER, MuJoCoArm.parameters)):
            for p in parameters if kind in (OURS, *fits) else ():
                if not float(fits[kind]["values"][p.name]) > 0.0:
                    raise ModelError(f"{path}: {kind}: {p.name} must be above 0")
                list(fits[kind]["intervals"][p.name])
            list(fits[kind]["tests"] if kind in fits else ())
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ValueError, KeyError, TypeError):
        raise ModelError(f"{path}: is no fit, as --fitted writes it to a file that is not there yet") from None
    return dict(fits)


def _simulated(engine: Engine, values: Mapping[str, float], test: Touchdown) -> Figures:
    time, force = engine.simulate(values, test)
    return figures(time, force, test.force, test.rest)


def settles(found: Figures, test: Touchdown) -> bool:
    """Whether the force stays within its band before the rest ends."""
    return found.settling < test.rest - 2.0 * SMOOTH


def sizes_of_differences(tests: Sequence[Touchdown], found: Sequence[Figures]) -> dict[str, Array]:
    """Return the sizes (N,) of the differences from what was measured; NaN for a settling time that was not."""
    measured = [measured_figures(test) for test in tests]
    have, want = (np.array([(one.peak, one.frequency, one.settling) for one in each]).T for each in (found, measured))
    peak, frequency, settling = 100.0 * np.abs(have / want - 1.0)
    settled = np.array([settles(one, test) for one, test in zip(measured, tests, strict=True)])
    return {
        "peak_percent": peak, "frequency_percent": frequency, "settling_percent": np.where(settled, settling, np.nan),
        "mean_newton": np.array([abs(a.mean - b.mean) for a, b in zip(found, measured, strict=True)]),
    }  # fmt: skip


def _errors(tests: Sequence[Touchdown], found: Sequence[Figures], sizes: Mapping[str, Array]) -> dict[str, Any]:
    """Return the mean sizes of the differences; of the settling time over the tests that settle as measured."""
    pairs = zip(tests, map(measured_figures, tests), found, strict=True)
    return {
        **{key: float(np.nanmean(each)) if np.isfinite(each).any() else None for key, each in sizes.items()},
        "tests": len(tests), "tests_that_settle": int(np.isfinite(sizes["settling_percent"]).sum()),
        "settle_alike": sum(settles(want, test) == settles(one, test) for test, want, one in pairs),
    }  # fmt: skip


def _table(judged: Judged, tests: Sequence[Touchdown]) -> None:
    """Add each figure of each test: measured, then simulated by each engine."""
    names = [name for name in (OURS, PEER) if name in judged.numbers]
    units = ("N", "", "s", "Hz", "1/s", "s", "N", "N")
    judged.lines += ["", f"each: measured, {', '.join(names)}; no settling time: the force does not settle"]
    columns = [f"{name}{', ' + unit if unit else ''}" for name, unit in zip(Figures._fields, units, strict=True)]
    judged.lines.append(f"  {'':26}" + "".join(f"{column:>22}" for column in columns))
    for test in tests:
        rows = [judged.numbers["measured"], *(judged.numbers[name]["each"] for name in names)]
        texts = []
        for key in Figures._fields:
            told = [_text(key, Figures(**row[test.name]), test) for row in rows]
            texts.append(f"{' '.join(told):>22}")
        judged.lines.append(f"  {test.name:26}" + "".join(texts))


def _text(key: str, found: Figures, test: Touchdown) -> str:
    value = getattr(found, key)
    if key == "settling" and not settles(found, test):
        return "-"
    return f"{value:.0f}" if key in ("peak", "losses") else f"{value:.2f}"


def _goals(judged: Judged, names: Sequence[str]) -> None:
    """Add the mean differences, and a fault for each beyond its goal."""
    judged.lines += ["", "mean difference from the measurement (goal)"]
    for name in names:
        told = judged.numbers[name]
        parts = [f"{key} {told[key]:.3g} ({GOALS[key]:g})" for key in GOALS if told[key] is not None]
        alike = f"{told['settle_alike']} of {told['tests']} settle, or do not, as measured"
        judged.lines.append(f"  {name:12}{', '.join(parts)}; {alike}")
    ours = judged.numbers[OURS]
    judged.faults += [f"{k}: {ours[k]:.3g}, over {goal:g}" for k, goal in GOALS.items() if (ours[k] or 0.0) > goal]


def kind_of(test: Touchdown) -> tuple[str, float, float, float]:
    """Return what tests have in common that come down alike: they are repeats of one another."""
    return test.place, test.force, test.gain, test.limit


def compare(judged: Judged, tests: Sequence[Touchdown], ours: Mapping[str, Array], peers: Mapping[str, Array]) -> None:
    """Add the difference of the engines in each test, and what it says of each figure; a fault where it is worse."""
    kinds = [kind_of(test) for test in tests]
    found = {key: paired(ours[key], peers[key], kinds) for key in GOALS}
    each = {test.name: {key: ours[key][i] - peers[key][i] for key in GOALS} for i, test in enumerate(tests)}
    judged.numbers["paired"] = {
        key: {part: x if isinstance(x, str) else number_or_none(x) for part, x in one._asdict().items()}
        | {"each": {name: number_or_none(row[key]) for name, row in each.items()}}
        for key, one in found.items()
    }
    judged.lines += ["", f"size of the difference, {OURS} less {PEER}: below 0, {OURS} is nearer to the measurement"]
    judged.lines.append(f"  {'':26}" + "".join(f"{key:>20}" for key in GOALS))
    for name, row in (each | {"mean": {key: one.mean for key, one in found.items()}}).items():
        texts = (f"{row[key]:.2f}" if np.isfinite(row[key]) else "-" for key in GOALS)
        judged.lines.append(f"  {name:26}" + "".join(f"{text:>20}" for text in texts))
    for key, one in found.items():
        said = f"{one.mean:.3g}, {one.low:.2g} to {one.high:.2g} ({100.0 * one.confidence:.0f} %): {one.verdict}"
        judged.lines.append(f"  {key}: {said}")
        if one.verdict == WORSE:
            judged.faults.append(f"{key} less that of {PEER}: {said}")


def repeats(judged: Judged, tests: Sequence[Touchdown]) -> None:
    """Add by how much measured figures of repeats scatter: the standard deviation about the mean of each kind.

    A frequency that the force does not determine would differ as much from repeat to repeat.
    """
    kinds: dict[Any, list[Touchdown]] = {}
    for test in tests:
        kinds.setdefault(kind_of(test), []).append(test)
    repeated = [each for each in kinds.values() if len(each) > 1]
    free = sum(len(each) - 1 for each in repeated)
    told = judged.numbers["repeats"] = {}
    for key in GOALS if free else ():
        name, unit = key.split("_")
        each = [np.array([getattr(measured_figures(test), name) for test in one]) for one in repeated]
        about = [(x - x.mean()) / (x.mean() / 100.0 if unit == "percent" else 1.0) for x in each]
        told[key] = float(np.sqrt(sum(x @ x for x in about) / free))
    if told:
        parts, count = ", ".join(f"{key} {x:.2g}" for key, x in told.items()), free + len(repeated)
        judged.lines += ["", f"{count} measured tests are repeats of {len(repeated)} kinds, and scatter by {parts}"]


def _fitted(judged: Judged, fits: Mapping[str, Any]) -> None:
    """Add the fitted numbers and their intervals, which are not determined, and where fits to halves differ.

    Half the tests determine a number √2 times less well, and two of them differ by √2 times that again: by twice the
    half width of the interval, or less, in 95 % of the cases.
    """
    for name, parameters in ((OURS, ClosedLoopArm.parameters), (PEER, MuJoCoArm.parameters)):
        if name not in fits:
            continue
        halves = fits[name].get("halves", [])
        beside = ", and what the tests of even and of odd places give" if halves else ""
        judged.lines += ["", f"fitted, {name}, with 95 % intervals{beside}"]
        for p in parameters:
            low, high = fits[name]["intervals"][p.name]
            value, each = fits[name]["values"][p.name], [half[p.name] for half in halves]
            told = f"  {p.name:20}{value:10.3g}{low:12.2g} to {high:.2g} {p.unit}".ljust(66)
            told += "".join(f"{x:10.3g}" for x in each)
            told += "   not determined" if high > DETERMINED * low else ""
            if each and abs(np.log(each[0] / each[1])) > np.log(high / low):
                told += "   halves differ"
                judged.numbers[name].setdefault("halves_differ", []).append(p.name)
            judged.lines.append(told.rstrip())


def _mode(judged: Judged, tests: Sequence[Touchdown]) -> None:
    """Add what the desired speed in the log says of the force mode at each gain scaling: medians over the tests."""
    told: dict[str, dict[str, float]] = {}
    logged = [test for test in tests if test.desired is not None]
    for gain in sorted({test.gain for test in logged}):
        each = np.median([force_mode(test) for test in logged if test.gain == gain], axis=0)
        told[f"{gain:g}"] = dict(zip(("mass", "damping", "lag", "missed"), each.tolist(), strict=True))
    judged.numbers["force_mode"] = told
    if told:
        judged.lines += ["", "the force mode by its own log, the desired speed: medians over the tests"]
    for name, one in told.items():
        found = f"{one['mass']:5.1f} kg, {one['damping']:5.0f} N s/m, {1e3 * one['lag']:.0f} ms late"
        judged.lines.append(f"  gain scaling {name:>4}: {found}; {100 * one['missed']:.0f} % of the speed unexplained")


def _why(judged: Judged, values: Mapping[str, float], tests: Sequence[Touchdown]) -> None:
    """Add the slowest oscillating pole of the loop at rest in each kind of test."""
    judged.lines += ["", "the loop at rest, linear: the pole that swings, and its part"]
    poles = judged.numbers["poles"] = {}
    kinds = {(test.place, test.force, test.gain): test for test in reversed(tests)}
    for test in reversed(kinds.values()):
        at = swing_pole(values, test)
        if at is None:
            continue
        place = test.name.rpartition("_")[0]
        poles[place] = {"frequency": at.frequency, "damping": at.damping}
        part = max(at.participation, key=lambda name: at.participation[name])
        judged.lines.append(f"  {place:20}{at.frequency:6.2f} Hz, damping ratio {at.damping:.2f}, of the {part}")


def swing_pole(values: Mapping[str, float], test: Touchdown) -> Any:
    """Return the oscillating pole of lowest frequency of the loop at rest, or None if there is none."""
    try:
        loop = cl.linearise(scenario(values, test), at=test.rest - 0.1)
    except ClosedLoopError:
        return None
    found = [pole for pole in loop.poles() if pole.s.imag > 0.0 and pole.participation.get("law", 0.0) > 0.1]
    return min(found, key=lambda pole: pole.frequency, default=None)
