"""Engines with fitted parameters, judged on tosses that they were not fitted to.

For every engine the fit has the same tosses, the same optimiser, the same budget. The table of `python -m
validation.measured cubes`: engines side by side, and the published figures beside.

The state that a toss begins with, from all rows before the cube touches the board instead of from the first alone.

In the air the centre follows a parabola, and a body with three equal moments of inertia turns with a constant angular
velocity, so the rows of the flight give position, velocity, orientation and angular velocity by least squares.

What the log alone says of cube and board: where the centre of mass is, how level the board, how equal the sides.

In the air the centre of mass follows a parabola, and the middle of the cube turns about it. One linear least squares
over all flights gives the mass's place in the cube and the acceleration of gravity in the axes of the log. At the end
of a toss the cube lies on one of its six sides.

Restitution and friction of single corners, from the rows before and after the first impact of each toss.

One corner strikes while the others are clear of the board. Parabolas through rows before and after give its rate along
the normal, e = −v⁺/v⁻, and the change of the centre's velocity, the impulse over the mass, μ = |Δv_t|/Δv_n, if the
corner slides throughout. Neither needs an engine, nor the inertia of the cube.
"""

import importlib.util
import json
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from validation.measured.cubes.engine import (
    FALL,
    RATE,
    ClosedLoopCube,
    CubeEngine,
    DrakeCube,
    MuJoCoCube,
    Toss,
    corners,
    errors,
    first_row,
    mean_errors,
    read,
)
from validation.measured.judged import DATA, Judged

# Half the side of the cube in the log and the height of its lowest corner above which it has touched nothing, m.
SIDE, CLEAR = 0.1026, 0.006
# Rows that a flight needs for a fit, and steps of the fit of the rotation: errors are a few degrees.
FEWEST_ROWS, STEPS = 5, 4


def heights(toss: Toss) -> Array:
    """Return the height of the lowest corner of a sharp cube at each row, m."""
    turned = rotations(toss.states).as_matrix()[:, 2, :]
    return toss.states[:, 6] + (turned @ np.array(corners(SIDE, 0.0)).T).min(axis=1)


def rotations(states: Array) -> Rotation:
    """Return the orientations of states (N, 13)."""
    return Rotation.from_quat(states[:, :4], scalar_first=True)


def flight(toss: Toss) -> int:
    """Return how many rows there are before the cube touches the board."""
    touched = np.flatnonzero(heights(toss) < CLEAR)
    return int(touched[0]) if len(touched) else len(toss.states)


def fitted_start(toss: Toss) -> Array:
    """Return the state (13,) that fits the flight best; the first row if the flight is too short to tell."""
    n = flight(toss)
    if n < FEWEST_ROWS:
        return first_row(toss)
    states, time = toss.states[:n], np.arange(n) / RATE
    basis = np.stack([np.ones(n), time], axis=1)
    fallen = states[:, 4:7] + np.outer(time * time, [0.0, 0.0, 0.5 * FALL])
    position, velocity = np.linalg.lstsq(basis, fallen, rcond=None)[0]
    measured = rotations(states)
    first, turning = measured[0], (measured[-1] * measured[0].inv()).as_rotvec() / time[-1]
    for _ in range(STEPS):
        error = (measured * (Rotation.from_rotvec(np.outer(time, turning)) * first).inv()).as_rotvec()
        by, faster = np.linalg.lstsq(basis, error, rcond=None)[0]
        first, turning = Rotation.from_rotvec(by) * first, turning + faster
    in_cube = first.inv().apply(turning)
    return np.concatenate([first.as_quat(scalar_first=True), position, in_cube, velocity])


# Rows at the end of a toss that are taken for rest.
LAST = 8


@dataclass(frozen=True)
class Geometry:
    """What the log says.

    centre: (3,), of mass, from the middle of the cube, m, axes of the cube
    gravity: (3,), acceleration of the centre of mass in the air, m/s², axes of the log
    slope: (2,), of the board along x and y, rad, from the heights of cubes at rest
    heights: (6,), mean height of the middle of a cube that lies on each of its sides, m: −x, +x, −y, +y, −z, +z up
    """

    centre: Array
    gravity: Array
    slope: Array
    heights: Array


def geometry(tosses: Sequence[Toss]) -> Geometry:
    """Return what the log of tosses says of cube and board."""
    square, side = np.zeros((6, 6)), np.zeros(6)
    for toss in tosses:
        n = flight(toss)
        if n < FEWEST_ROWS:
            continue
        time = np.arange(n) / RATE
        turned = rotations(toss.states[:n]).as_matrix()
        columns = np.concatenate([-turned, np.einsum("t,ij->tij", time * time / 2.0, np.eye(3))], axis=2)
        line = np.stack([np.ones(n), time], axis=1)  # a start and a velocity of each toss, taken out of everything
        out = np.eye(n) - line @ np.linalg.pinv(line)
        columns = np.einsum("ts,sij->tij", out, columns).reshape(3 * n, 6)
        place = (out @ toss.states[:n, 4:7]).reshape(3 * n)
        square, side = square + columns.T @ columns, side + columns.T @ place
    found = np.asarray(np.linalg.solve(square, side), dtype=np.float64)
    ends = np.array([toss.states[-LAST:, 4:7].mean(axis=0) for toss in tosses])
    plane: Array = np.linalg.lstsq(np.column_stack([np.ones(len(ends)), ends[:, :2]]), ends[:, 2], rcond=None)[0]
    upwards = np.array([rotations(toss.states[-1:]).as_matrix()[0, 2] for toss in tosses])
    axis = np.abs(upwards).argmax(axis=1)
    lies = 2 * axis + (upwards[np.arange(len(axis)), axis] > 0.0)
    heights = np.array([ends[lies == k, 2].mean() if (lies == k).any() else np.nan for k in range(6)])
    return Geometry(found[:3], found[3:], plane[1:], heights)


def geometry_lines(tosses: Sequence[Toss]) -> list[str]:
    """Return what the log says of cube and board, in words."""
    g = geometry(tosses)
    tilt = np.degrees(np.arctan(np.linalg.norm(g.gravity[:2]) / abs(g.gravity[2])))
    level = np.degrees(np.arctan(np.linalg.norm(g.slope)))
    x, y, z = 1e3 * g.centre
    low, high = 1e3 * np.nanmin(g.heights), 1e3 * np.nanmax(g.heights)
    return [
        f"centre of mass {x:.2f}, {y:.2f}, {z:.2f} mm from the middle of the cube",
        f"gravity {np.linalg.norm(g.gravity):.3f} m/s², {tilt:.2f}° from the vertical of the log",
        f"board {level:.2f}° from the horizontal of the log",
        f"the middle of a cube at rest is {low:.2f} to {high:.2f} mm high, by the side it lies on",
    ]


# Every so many tosses one is fitted to, so many in all; the others judge.
EVERY, TOSSES = 10, 40
# Simulations of these tosses that an optimiser may ask for, and that it may ask for before it begins anew.
BUDGET, ROUND = 200, 70
# The first simplex goes so far from the start in each parameter: by this factor.
SIZE = 1.25
# What a toss counts that was not completed, in % of the side and in degrees.
NOT_COMPLETED = 100.0


@dataclass(frozen=True)
class Fit:
    """Fitted values of an engine's parameters, the cost there, and the simulations that it took."""

    values: tuple[float, ...]
    cost: float
    simulations: int


def training(tosses: Sequence[Toss]) -> list[Toss]:
    """Return the tosses to fit to."""
    return list(tosses[::EVERY][:TOSSES])


def fit(
    engine: CubeEngine, tosses: Sequence[Toss], budget: int = BUDGET, told: Callable[[str], None] | None = None
) -> Fit:
    """Fit an engine to tosses: Nelder and Mead's method, in the logarithms of the parameters.

    What becomes least is the mean position error in % of the side plus the mean rotation error in degrees. The cost is
    rough, since tosses tumble one way or the other, and a simplex can collapse on a slope of it: after `ROUND`
    simulations a new one begins at the best values so far.

    tosses: see `training`
    budget: simulations of all of them
    told: gets a line after each simulation
    """
    starts = [first_row(toss) for toss in tosses]
    low, high = (np.log([getattr(p, end) for p in engine.parameters]) for end in ("low", "high"))
    first = np.log([p.start for p in engine.parameters])

    def cost(x: Array) -> float:
        values = [float(value) for value in np.exp(x)]
        means = mean_errors(tosses, engine.simulate(values, starts, tosses))
        found = float(np.where(np.isnan(means), NOT_COMPLETED, means).mean(axis=0).sum())
        if told is not None:
            told(f"{engine.name} {found:8.4f}  " + " ".join(f"{value:.5g}" for value in values))
        return found

    best, used, least = first, 0, np.inf
    while budget - used > len(first) + 1:
        simplex = np.vstack([best, best + np.diag(_sizes(engine))])
        found = minimize(
            cost, best, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)),
            options={
                "maxfev": min(ROUND, budget - used), "initial_simplex": np.clip(simplex, low, high), "xatol": 1e-4,
                "fatol": 1e-4,
            },
        )  # fmt: skip
        used += int(found.nfev)
        if found.fun < least:
            best, least = found.x, float(found.fun)
    return Fit(tuple(float(value) for value in np.exp(best)), least, used)


def _sizes(engine: CubeEngine) -> Array:
    """Return the first simplex's edges: a side is known to a per cent, the others are not."""
    return np.array([0.01 if p.name == "side" else np.log(SIZE) for p in engine.parameters])


FITTED = DATA / "cube_fits.json"
# The package that an engine needs.
PACKAGES = {ClosedLoopCube: "closedloop", MuJoCoCube: "mujoco", DrakeCube: "pydrake"}
RESAMPLES, SEED = 4000, 28
# Instants of the table of errors over time, s, and the width of the mean about each.
INSTANTS, ABOUT = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), 0.05
MOST_IMPACTS = 5


@dataclass(frozen=True)
class Tried:
    """What an engine made of the tosses.

    paths: (rows, 7), from the first row
    means: (tosses, 2), mean position error, % of the side, and rotation error, degrees, of each; NaN where not
        completed
    started: (tosses, 2), the same, from the state fitted to the flight
    seconds: wall time of a toss
    """

    engine: CubeEngine
    paths: list[Array]
    means: Array
    started: Array
    seconds: float


def engines() -> list[CubeEngine]:
    """Return the engines that are installed."""
    return [engine() for engine, package in PACKAGES.items() if importlib.util.find_spec(package)]


def fits() -> dict[str, Any]:
    """Return what `python -m validation.measured.cubes` has written: values and cost by engine."""
    return json.loads(FITTED.read_text(encoding="utf-8"))


def fitted(engine: CubeEngine) -> list[float]:
    """Return the fitted values of an engine's parameters."""
    values = fits()[engine.name]["values"]
    return [float(values[p.name]) for p in engine.parameters]


def held_out(tosses: Sequence[Toss], shipped: Sequence[Toss]) -> list[Toss]:
    """Return the tosses that no engine was fitted to: those that do not begin as one of the training set does."""
    known = {toss.states[0].astype(np.float32).tobytes() for toss in training(shipped)}
    return [toss for toss in tosses if toss.states[0].astype(np.float32).tobytes() not in known]


def tried(engine: CubeEngine, tosses: Sequence[Toss]) -> Tried:
    """Simulate the tosses from both starts."""
    values = fitted(engine)
    engine.simulate(values, [first_row(tosses[0])], tosses[:1])  # what is compiled or read once is not timed
    began = clock.perf_counter()
    paths = engine.simulate(values, [first_row(toss) for toss in tosses], tosses)
    seconds = (clock.perf_counter() - began) / len(tosses)
    started = engine.simulate(values, [fitted_start(toss) for toss in tosses], tosses)
    return Tried(engine, paths, mean_errors(tosses, paths), mean_errors(tosses, started), seconds)


def interval(values: Array) -> list[float]:
    """Return the 95 % interval of the mean of values, by bootstrap."""
    rng = np.random.default_rng(SEED)
    means = values[rng.integers(0, len(values), (RESAMPLES, len(values)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return [float(low), float(high)]


def numbers_of(one: Tried) -> dict[str, Any]:
    """Return the figures of an engine, of the tosses that it completed."""
    done = np.asarray(~np.isnan(one.means).any(axis=1))
    both = ~np.isnan(one.started).any(axis=1)
    told: dict[str, Any] = {
        "completed": int(done.sum()), "tosses": len(done), "seconds_per_toss": one.seconds,
        "parameters": {p.name: x for p, x in zip(one.engine.parameters, fitted(one.engine), strict=True)},
    }  # fmt: skip
    for column, name in enumerate(("position_percent", "rotation_degrees")):
        if not done.any():
            told[name] = None
            continue
        told[name] = float(one.means[done, column].mean())
        told[f"{name}_interval"] = interval(one.means[done, column])
        told[f"{name}_median"] = float(np.median(one.means[done, column]))
        told[f"{name}_start_fitted"] = float(one.started[both, column].mean()) if both.any() else None
    return told


def against(ours: Tried, theirs: Tried) -> dict[str, Any]:
    """Return by how much our mean error is below another engine's, with the interval over the tosses both completed."""
    both = ~np.isnan(ours.means).any(axis=1) & ~np.isnan(theirs.means).any(axis=1)
    told: dict[str, Any] = {}
    rng = np.random.default_rng(SEED)
    drawn = rng.integers(0, both.sum(), (RESAMPLES, both.sum()))
    for column, name in enumerate(("position", "rotation")):
        a, b = ours.means[both, column], theirs.means[both, column]
        shares = 1.0 - a[drawn].mean(axis=1) / b[drawn].mean(axis=1)
        low, high = np.percentile(shares, [2.5, 97.5])
        told[name] = {"below": float(1.0 - a.mean() / b.mean()), "interval": [float(low), float(high)]}
    return told


def over_time(tosses: Sequence[Toss], one: Tried) -> list[tuple[float, float, float]]:
    """Return instant, s, and mean position and rotation error of the rows about it that were simulated."""
    found = [errors(toss, path) for toss, path in zip(tosses, one.paths, strict=True)]
    at = np.concatenate([np.arange(len(position)) for position, _ in found]) / RATE
    position, rotation = (np.concatenate([each[k] for each in found]) for k in (0, 1))
    rows = [(t, np.abs(at - t) <= ABOUT / 2.0) for t in INSTANTS]
    return [(t, float(position[near].mean()), float(rotation[near].mean())) for t, near in rows if near.any()]


def impacts_before(toss: Toss) -> NDArray[np.int64]:
    """Return how many impacts there were until each row, told from the lowest corner: where its fall ends at the board.

    Impacts within two rows of each other are counted once.
    """
    lowest = heights(toss)
    falls = np.diff(lowest) < -0.3 / RATE  # m: a fall of 0.3 m/s
    ends = np.flatnonzero(falls[:-1] & ~falls[1:]) + 1
    counted = np.zeros(len(lowest), dtype=np.int64)
    counted[flight(toss) :] = 1
    for end in ends[ends > flight(toss) + 2]:
        counted[end:] += 1
    return counted


def over_impacts(tosses: Sequence[Toss], one: Tried) -> list[tuple[int, float, float]]:
    """Return number of impacts, and mean position and rotation error of the rows that have had so many."""
    found = [errors(toss, path) for toss, path in zip(tosses, one.paths, strict=True)]
    counted = np.concatenate(
        [impacts_before(toss)[: len(each[0])] for toss, each in zip(tosses, found, strict=True)]
    ).clip(max=MOST_IMPACTS)
    position, rotation = (np.concatenate([each[k] for each in found]) for k in (0, 1))
    rows = [(k, counted == k) for k in range(MOST_IMPACTS + 1)]
    return [(k, float(position[some].mean()), float(rotation[some].mean())) for k, some in rows if some.any()]


# Mean position error, % of the side, and mean rotation error, degrees, of engines that others fitted to these tosses:
# B. Acosta, W. Yang, M. Posa, Validating robotics simulators on real-world impacts, IEEE Robotics and Automation
# Letters 7(3), 2022.
PUBLISHED = {"Drake": (13.5, 16.5), "Bullet": (14.9, 16.5), "MuJoCo": (25.1, 21.7)}
OURS = "closedloop"
Growth = Callable[[Sequence[Toss], Tried], Sequence[tuple[float, float, float]]]


def judge(given: Path | None = None) -> Judged:
    """Simulate the tosses with every engine that is installed, and compare.

    A fault is a toss that this package does not complete, or an engine that is closer to the tosses on average.

    Raises `ModelError` if the file cannot be read, or has no toss that the engines were not fitted to.
    """
    shipped = read()
    tosses = held_out(read(given) if given else shipped, shipped)
    if not tosses:
        raise ModelError(f"{given}: every toss is one that the engines were fitted to: give others")
    judged = Judged(
        "A cube tossed onto a board", "DAIRLab, dair_pll (ContactNets), BSD-3" if given is None else str(given)
    )
    known = fits()
    results = {engine.name: tried(engine, tosses) for engine in engines() if engine.name in known}
    trained = len(training(shipped))
    judged.lines += [
        f"{len(tosses)} tosses, simulated from the first row; engines are fitted to {trained} others by one search",
        "",
        f"  {'':12}{'position':>10}{'95 %':>16}{'rotation':>11}{'95 %':>16}"
        f"{'completed':>11}{'start fitted':>18}{'a toss':>10}",
    ]
    for name, one in results.items():
        told = judged.numbers[name] = numbers_of(one) | {"simulations": known[name]["simulations"]}
        judged.lines.append(_line(name, told))
        if told["completed"] < told["tosses"] and name == OURS:
            judged.faults.append(f"{told['tosses'] - told['completed']} of {told['tosses']} tosses were not completed")
    for name, (position, rotation) in PUBLISHED.items():
        judged.lines.append(f"  {name:12}{position:>8.1f} %{'published':>16}{rotation:>10.1f}°")
    judged.numbers["published"] = {
        name: {"position_percent": p, "rotation_degrees": r} for name, (p, r) in PUBLISHED.items()
    }
    judged.lines += ["", "fitted"]
    for name, one in results.items():
        values = judged.numbers[name]["parameters"]
        listed = (
            f"{p.name} {values[p.name]:.4g}{'' if p.unit == '1' else ' ' + p.unit}" for p in one.engine.parameters
        )
        judged.lines.append(f"  {name:12}{', '.join(listed)}")
    _compare(judged, results)
    _growth(judged, results, tosses)
    return judged


def _line(name: str, told: dict[str, Any]) -> str:
    done = f"{told['completed']}/{told['tosses']}"
    if told["position_percent"] is None:
        return f"  {name:12}{done:>64}"
    low, high = told["position_percent_interval"]
    turned_low, turned_high = told["rotation_degrees_interval"]
    started = f"{told['position_percent_start_fitted']:.1f} %, {told['rotation_degrees_start_fitted']:.1f}°"
    return (
        f"  {name:12}{told['position_percent']:>8.1f} %{f'{low:.1f} to {high:.1f}':>16}"
        f"{told['rotation_degrees']:>10.1f}°{f'{turned_low:.1f} to {turned_high:.1f}':>16}"
        f"{done:>11}{started:>18}{1e3 * told['seconds_per_toss']:>7.0f} ms"
    )


def _compare(judged: Judged, results: dict[str, Tried]) -> None:
    """Add by how much this package's errors are below those of each other engine."""
    others = [name for name in results if name != OURS]
    if others:
        judged.lines += ["", "mean errors of closedloop below those of"]
    for name in others:
        below = judged.numbers[OURS].setdefault("below", {})[name] = against(results[OURS], results[name])
        texts = []
        for kind, each in below.items():
            low, high = (100 * end for end in each["interval"])
            texts.append(f"{kind} {100 * each['below']:+.1f} % ({low:+.1f} to {high:+.1f})")
            if each["below"] < 0.0:
                judged.faults.append(f"{kind} error: {-100 * each['below']:.1f} % above that of {name}")
        judged.lines.append(f"  {name:12}{', '.join(texts)}")


def _growth(judged: Judged, results: dict[str, Tried], tosses: list[Toss]) -> None:
    """Add the errors over time and over the number of impacts: small differences grow with each."""
    growths: tuple[tuple[str, str, Growth], ...] = (
        ("errors at an instant, s", "over_time", over_time),
        ("errors after a number of impacts", "over_impacts", over_impacts),
    )
    for title, key, rows_of in growths:
        judged.lines += ["", title]
        for name, one in results.items():
            rows = rows_of(tosses, one)
            judged.numbers[name][key] = [list(row) for row in rows]
            told = (f"{at:>4g}: {position:>4.1f} %, {rotation:>4.1f}°" for at, position, rotation in rows)
            judged.lines.append(f"  {name:12}{'  '.join(told)}")


# Rows before and after an impact, those in which the corner may be lowest, and how high all others have to be, m.
BEFORE, AFTER, LOWEST, ALL_OTHERS = 7, 5, (-2, 4), 0.012


@dataclass(frozen=True)
class Corner:
    """What one corner did: rates along the normal, m/s, before and after; and |Δv_t|/Δv_n of the centre."""

    before: float
    after: float
    ratio: float


def corner_impacts(tosses: Sequence[Toss]) -> list[Corner]:
    """Return the first impacts of those tosses in which a single corner strikes."""
    at = np.array(corners(SIDE, 0.0))
    found = []
    for toss in tosses:
        first, place = flight(toss), toss.states[:, 4:7]
        if first < BEFORE + 2 or first + AFTER + LOWEST[1] > len(place):
            continue
        axes = rotations(toss.states).as_matrix()
        heights = place[:, 2, None] + (axes @ at.T)[:, 2, :]
        corner = int(heights[first].argmin())
        if np.delete(heights[first - 1 : first + AFTER], corner, axis=1).min() < ALL_OTHERS:
            continue
        low = first + LOWEST[0] + int(heights[first + LOWEST[0] : first + LOWEST[1], corner].argmin())
        path = place + axes @ at[corner]
        left, right = np.arange(low - BEFORE, low), np.arange(low + 1, low + 1 + AFTER)
        before, after = (_rate(path, rows, low)[2] for rows in (left, right))
        change = _rate(place, right, low) - _rate(place, left, low)
        found.append(Corner(float(before), float(after), float(np.hypot(*change[:2]) / change[2])))
    return found


def _rate(path: Array, rows: NDArray[np.int64], at: int) -> Array:
    """Return the velocity (3,) at a row of a parabola through others, m/s."""
    t = (rows - at) / RATE
    return np.linalg.lstsq(np.stack([t**p for p in range(3)], axis=1), path[rows], rcond=None)[0][1]


def impact_lines(tosses: Sequence[Toss]) -> list[str]:
    """Return what the impacts say, in words."""
    impacts = corner_impacts(tosses)
    v, w, ratio = (np.array([getattr(x, name) for x in impacts]) for name in ("before", "after", "ratio"))
    e = -w / v
    fast = -v > np.median(-v)
    lines = [f"{len(e)} first impacts of single corners, at {-v.max():.2f} to {-v.min():.2f} m/s"]
    for name, x in (("restitution", e), ("friction, if they slide", ratio)):
        low, high = interval(x)
        lines.append(
            f"  {name:24} {x.mean():.3f} ({low:.3f} to {high:.3f}), one impact ± {x.std():.3f}; slower half "
            f"{x[~fast].mean():.3f}, faster half {x[fast].mean():.3f}"
        )
    return lines
