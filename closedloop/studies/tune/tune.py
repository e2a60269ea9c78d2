"""`cl.tune`: numbers of a scenario, gains above all, that minimise a value of its runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.studies.tune.evaluate import Runs
from closedloop.studies.tune.given import limit_of, varied
from closedloop.studies.tune.result import Tuning
from closedloop.studies.tune.search import MEAN, WORST, Found, Search

MOST_STARTS = 1000
# By which share of its range each number is moved to say how sensitive the optimum is.
MOVED = 0.1


@arguments_checked(vary="keys with two ends each, such as {'law.kd': (1, 10)}")
def tune(
    scenario: Scenario,
    vary: Mapping[str, Sequence[float]],
    minimise: str | Mapping[str, float] = "rms_force_error",
    subject_to: Sequence[str] = (),
    *,
    over: Mapping[str, Sequence[Any]] | None = None,
    robust: str = WORST,
    log: Sequence[str] = (),
    starts: int = 4,
    seed: int = 0,
    iterations: int = 60,
    kept: str | Path | None = None,
    progress: bool | Callable[[int], None] = False,
    workers: int | None = None,
) -> Tuning:
    """Find the numbers of a scenario that minimise a value of its runs.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`. The first search starts from its numbers.
    vary : mapping of str to (low, high)
        Keys and ranges, ``{"law.kp": (100, 2000), "law.kd[1]": (5, 100)}``; each entry of a list varies alone.
    minimise : str, or mapping of str to float
        A value of `Run.summary`, or values and weights, whose weighted sum is minimised. If a value has a number for
        each joint, the largest magnitude is taken.
    subject_to : sequence of str
        Constraints, ``["peak_contact_force<=12", "modulus_margin@3>=0.5"]``: values of the summary, or margins of the
        force loop at an instant (`linearise`): gain_margin (dB), phase_margin (°), delay_margin (s), modulus_margin.
    over : mapping of str to sequence, optional
        Variations, ``{"friction.coefficient": [0.2, 0.4, 0.6]}``, every value with every other. Constraints
        hold for all.
    robust : "worst" or "mean"
        Which value over the variations is minimised: the largest or the mean.
    log : sequence of str
        Keys whose ranges are searched evenly in their logarithms.
    starts : int
        Number of searches: one starts from the scenario's numbers, the others from the best of points drawn from the
        ranges.
    seed : int
        Seed of these points.
    iterations : int
        Largest number of iterations of each search.
    kept : path, optional
        File in which all runs are kept; an interrupted tuning continues from it.
    progress : bool or callable
        True shows the number of runs on standard error; a callable gets it.
    workers : int, optional
        Threads; the result is the same for any number.

    Returns
    -------
    Tuning
        If no point meets the constraints, `feasible` is False, and the point is the nearest that was found.

    Raises
    ------
    ScenarioError
        If a key, a value or a constraint is at fault, or nothing can be run in the ranges.
    OutputError
        If the file is of another tuning, such as that of another robot, or cannot be written.
    """
    if robust not in (WORST, MEAN):
        raise ScenarioError(f"tune: robust = {robust!r}: must be {WORST!r} or {MEAN!r}")
    if not 1 <= starts <= MOST_STARTS:
        raise ScenarioError(f"tune: starts = {starts}: must be a whole number from 1 to {MOST_STARTS}")
    if seed < 0:
        raise ScenarioError(f"tune: seed = {seed}: must be a whole number, 0 or more")
    weights = {minimise: 1.0} if isinstance(minimise, str) else dict(minimise)
    if not weights:
        raise ScenarioError("tune: minimise: names no value, such as rms_force_error")
    some, limits = varied(scenario, vary, log), [limit_of(text) for text in subject_to]
    with ExitStack() as open_until_done:
        report: Callable[[int], None] = _silent
        if progress is True:
            from closedloop.base.progress import counter

            report = open_until_done.enter_context(counter(f"tuning {scenario.name}"))
        elif progress:
            report = progress
        runs = Runs(
            scenario, some, weights, limits, over or {}, Path(kept) if kept is not None else None, report, workers
        )  # fmt: skip
        search = Search(runs, len(some), robust, iterations)
        start = np.array([each.share for each in some])
        found = search.run(start, starts, seed)
        if not math.isfinite(found.value):
            Variants(scenario, tuple(runs.changes(start))).scenario(tuple(runs.changes(start).values()))
            met = f" ({', '.join(name for name, _ in runs.refused.most_common(2))})" if runs.refused else ""
            raise ScenarioError(f"tune: no run in these ranges could be made to its end and be good{met}; narrow them")
        return _tuning(scenario, runs, search, found, robust)


def _tuning(scenario: Scenario, runs: Runs, search: Search, found: Found, robust: str) -> Tuning:
    """Return the outcome of a search, with how sensitive it is."""
    moved = []
    for i in range(len(runs.some)):
        for sign in (-MOVED, MOVED):
            point = found.x.copy()
            point[i] += sign
            moved.append(point)
    inside = [point for point in moved if np.all((point >= 0.0) & (point <= 1.0))]
    known = {x.tobytes(): search.merit(seen[0]) for x, seen in zip(inside, search.look(np.array(inside)), strict=True)}
    change = [known.get(point.tobytes(), math.nan) - found.value for point in moved]
    sensitivity = {each.name: (change[2 * i], change[2 * i + 1]) for i, each in enumerate(runs.some)}
    changes = runs.changes(found.x)
    tuned = Variants(scenario, tuple(changes)).scenario(tuple(changes.values()))
    as_it_was = runs.as_it_is()
    now = runs.values(found.x[None])[0]
    weighted = sum(weight * as_it_was[:, runs.names.index(name)] for name, weight in runs.minimise.items())
    before = search.merit(np.asarray(weighted))
    return Tuning(
        tuned, scenario, runs.some, runs.numbers(found.x), runs.minimise, runs.limits, runs.variations, robust,
        found.value, before, {name: now[:, i] for i, name in enumerate(runs.names)},
        {name: as_it_was[:, i] for i, name in enumerate(runs.names)}, found, sensitivity, runs.done,
    )  # fmt: skip


def _silent(done: int) -> None:
    """Report nothing."""
