"""Whole runs of the compiled engine beside those of Pinocchio's: every shipped scenario, row by row and event by event.

The two engines step by the same machine and differ in the rounding of their terms only. What rounding may become is
measured, not guessed: twins of the Pinocchio run start a few units in the last place beside it, and how far they have
drifted apart by an instant is how far the compiled run may be. Where rounding decides an event, some twins part and
others do not, so a run that seems too far away is held against more of them. Where slip sets in on falling friction
(Stribeck), they part by powers of ten in a few steps: from there on the motion is not determined by double precision,
in any engine.
"""

import dataclasses
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from unittest import mock

import numpy as np

import closedloop
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.robot.tree import Tree, tree_of
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.simulate import run_loop
from validation.engines.slides import SAME_SCHEME, SlideCheck
from validation.oracle.spatial import Array
from validation.tolerances import EPS, Tolerance

TWINS, MOST_TWINS = 3, 12

# In units of the twins' spread so far, and one rounding more.
SAME_RUN = Tolerance(
    "same run",
    100.0,
    "rounding of the terms acts at every step, a twin's displacement of some ε once, and three twins are few: between "
    "them a factor of some ten, and of ten more where it grows by powers",
)

INSTANT = 1e-11
"""How far apart the instants of an event may be in any case [s]: the gauge that they are zeros of, in m, m/s or N, is
known to 1e-12 or so and passes zero with some 0.1 of its unit a second."""

LOST = 1e-6
"""From the instant on at which the twins' spread lets q differ by this [rad], a comparison of q says little."""


@dataclass(frozen=True)
class Recorded:
    """What an engine recorded: rows, in the order of `closedloop.loop.step.record_row.Row`, and events."""

    rows: Array
    events: Array
    seconds: float


def shipped() -> tuple[str, ...]:
    """Return the names of the shipped scenarios."""
    return tuple(closedloop.shipped_scenarios())


def record(problem: Problem, engine: str) -> Recorded:
    """Run a problem to its end, or raise why it stopped."""
    began = clock.perf_counter()
    rows, events, failure, _ = run_loop(problem, engine=engine)
    if failure is not None:
        raise failure
    return Recorded(rows, events, clock.perf_counter() - began)


@contextmanager
def faulty_tree(fault: Callable[[Tree], Tree | None]) -> Iterator[None]:
    """Give the compiled engine a faulty tree for a while; a tree that cannot carry the fault stays sound."""

    def tree(of: Problem) -> Tree:
        sound = tree_of(of.robot.model, of.robot.tip)
        return fault(sound) or sound

    with mock.patch("closedloop.simulation.engines.compiled.compiled_tree", tree):
        yield


def compare_runs(name: str, overrides: dict[str, object] | None = None) -> Iterator[SlideCheck]:
    """Compare a run of the compiled engine with Pinocchio's: q, q̇, Q, r, ṙ, f, e of each row, and events."""
    of = closedloop.prepare(closedloop.load_scenario(name, overrides or {}))
    ours, theirs = record(of, "compiled"), record(of, "pinocchio")
    twins = [record(twin(of, seed), "pinocchio") for seed in range(TWINS)]
    checks = _held(name, of, ours, theirs, twins)
    while not all(check.passed for check in checks) and len(twins) < MOST_TWINS:
        twins.append(record(twin(of, len(twins)), "pinocchio"))
        checks = _held(name, of, ours, theirs, twins)
    yield from checks


def _held(name: str, of: Problem, ours: Recorded, theirs: Recorded, twins: list[Recorded]) -> list[SlideCheck]:
    """Return the checks of a run against another and its twins."""
    worst, share = "", -1.0
    lost = ""
    for what, (where, unit) in _columns(of, theirs).items():
        allowed = SAME_RUN.value * _spread(theirs, twins, where) + SAME_SCHEME.value * unit
        difference = np.max(np.abs(ours.rows[:, where] - theirs.rows[:, where]), axis=1)
        margin = float(np.max(difference / allowed))
        if not margin <= share:
            worst, share = f"{what} {np.max(difference):.0e}", margin
        if what == "q":
            lost = _lost(of, allowed)
    text = f"{name}: {worst} apart{lost}"
    checks = [SlideCheck("compiled", text, share, 1.0, SAME_RUN.argument, ours.seconds)]
    if len(theirs.events) or len(ours.events):
        checks.append(_events(name, ours, theirs, twins))
    return checks


def twin(of: Problem, seed: int) -> Problem:
    """Return a problem with the start and all that is desired a few units in the last place beside."""
    rng = np.random.default_rng(seed)
    table = of.table * (1.0 + EPS * rng.uniform(-4.0, 4.0, of.table.shape))
    return dataclasses.replace(of, q=of.q + EPS * rng.uniform(-4.0, 4.0, of.robot.n), table=table)


def compare_compiled(say: Callable[[str], None] = lambda text: None) -> Iterator[SlideCheck]:
    """Compare the two engines on every shipped scenario."""
    for name in shipped():
        say(f"running {name} in the compiled engine")
        yield from compare_runs(name)


def _columns(of: Problem, run: Recorded) -> dict[str, tuple[slice, float]]:
    """Return what of a row is compared, and one unit of rounding of each."""
    n, rows = of.robot.n, run.rows
    terms = of.robot.terms(of.q, of.v)
    A = of.plane.normal @ terms.jacobian
    mobility = float(A @ np.linalg.solve(terms.mass_matrix, A))
    mass = 1.0 / mobility if mobility > 0.0 else 0.0  # a tip that does not move along n has no contact force
    # A stabiliser turns the rounding of r, of a metre, into this much of f, and of Q where the law hears of f.
    answer = EPS * of.stabiliser[1] * mass

    def part_of(name: str, extra: float = 0.0) -> tuple[slice, float]:
        place = Row.place(name, n)
        part = place if isinstance(place, slice) else slice(place, place + 1)
        return part, EPS * max(1.0, float(np.max(np.abs(rows[:, part])))) + extra

    return {
        "q": part_of("q"),
        "v": part_of("v", EPS * of.stabiliser[1] * of.h),
        "Q": part_of("torque", answer),
        "r": part_of("position"),
        "ṙ": part_of("velocity", EPS * of.stabiliser[1] * of.h),
        "f": part_of("contact_force", answer),
        "e": part_of("closure_error"),
    }


def _spread(run: Recorded, twins: list[Recorded], columns: slice) -> Array:
    """Return how far apart a run and its twins have been by each row."""
    apart = [np.max(np.abs(twin.rows[:, columns] - run.rows[:, columns]), axis=1) for twin in twins]
    return np.asarray(np.maximum.accumulate(np.max(apart, axis=0)))


def _lost(of: Problem, allowed: Array) -> str:
    """Return, in words, from when on rounding decides the motion; "" if never."""
    beyond = np.flatnonzero(allowed > LOST)
    return f"; from {beyond[0] * of.h:.3g} s on rounding decides" if beyond.size else ""


def _events(name: str, ours: Recorded, theirs: Recorded, twins: list[Recorded]) -> SlideCheck:
    """Compare kinds and instants of the events as far as the twins have the same; a missing event is inf."""
    kinds = [list(run.events[:, 1]) for run in (theirs, ours, *twins)]
    agreed = 0
    while all(len(k) > agreed and k[agreed] == kinds[0][agreed] for k in (kinds[0], *kinds[2:])):
        agreed += 1
    what = f"{name}: instants of {agreed} events"
    worst = 0.0
    if kinds[1][:agreed] != kinds[0][:agreed] or (agreed == len(kinds[0]) and len(kinds[1]) != agreed):
        worst = np.inf
    elif agreed:
        instants = [run.events[:agreed, 0] for run in (theirs, ours, *twins)]
        apart = np.maximum.accumulate(np.max([np.abs(t - instants[0]) for t in instants[2:]], axis=0))
        worst = float(np.max(np.abs(instants[1] - instants[0]) / (SAME_RUN.value * apart + INSTANT)))
    return SlideCheck("compiled", what, worst, 1.0, SAME_RUN.argument, ours.seconds)
