"""The slide compared: each engine's trajectory against the simulator's, with the error that must remain and why.

Each comparison says what was compared, how far apart the two were, how far apart two correct engines may be, and in
what order they approach each other. Nothing counts before the engine's constraint was seen to act (`slide_acts`).

Whole runs of the compiled engine are compared with those of Pinocchio's: every shipped scenario, row by row and event
by event. The two engines step by the same machine and differ in the rounding of their terms only. What rounding may
become is measured, not guessed: twins of the Pinocchio run start a few units in the last place beside it, and how far
they have drifted apart by an instant is how far the compiled run may be. Where rounding decides an event, some twins
part and others do not, so a run that seems too far away is held against more of them. Where slip sets in on falling
friction (Stribeck), they part by powers of ten in a few steps: from there on the motion is not determined by double
precision, in any engine.
"""

import dataclasses
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np

import closedloop
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import Tree, tree_of
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.simulate import run_loop
from validation.engines.drake import Drake, slide_drake
from validation.engines.exudyn import Exudyn, slide_exudyn
from validation.engines.interface import EPS, Engine, Missing, Tolerance, installed
from validation.engines.mujoco import IMPEDANCES, MuJoCo, slide_mujoco
from validation.engines.trajectories import SHORT, Trajectory, at_zero, problem, slide_closedloop, slide_oracle
from validation.oracle.spatial import Array

SAME_SCHEME = Tolerance(
    "same scheme",
    32.0,
    "both loops compute e = n·r − d to a few ε·1 m; the stabiliser turns that into a force s_p·δe / (AH⁻¹Aᵀ), and "
    "forgets it within its time constant, so errors do not pile up; in units of ε·1 m·s_p / (AH⁻¹Aᵀ)",
)

RIGID_PART = Tolerance(
    "rigid part",
    1e-9,
    "without the stabiliser's s_p = 1e6 nothing magnifies the rounding of r: what is left is a force of 10 N and "
    "torques of 30 N m, summed to some hundred ε each, in states that differ by rounding; newton",
)

SOFTNESS = Tolerance(
    "softness",
    1e-5,
    "MuJoCo's hardest contact is off by about f·R/s = 10 N·1e-3, s = AH⁻¹Aᵀ; the polynomial through three softnesses "
    "1:2:4 removes the first two powers of R/s and leaves 8 (R/s)³ f = 1e-7 N times the steps (some ten) for which a "
    "disturbance of f lasts; newton",
)

SECOND_ORDER = Tolerance(
    "second order",
    2e-5,
    "generalized-α has the error c₂h² + O(h³) in f, 1.5e-4 N at h = 0.25 ms; (4 f(h/2) − f(h))/3 removes c₂ and leaves "
    "some 1e-6 N, to which index 3 adds the rounding of positions over h², 4e-6 N at 0.25 ms and four times that at "
    "half the step; RK4's own error is 5e-8 N; newton",
)

OTHER_STABILISER = Tolerance(
    "other stabiliser",
    1e-4,
    "once its compliance is extrapolated to zero, Drake's step is semi-implicit Euler with the closure held at the "
    "level of velocities, which undoes e in one step where Baumgarte takes some; the two differ by the stabiliser's "
    "share of f at a change of the reference rate, which is of second order in h: 5e-4 N at 2 ms, a sixteenth of that "
    "at 0.5 ms, and a factor of three; newton",
)

ORDERS = Tolerance(
    "order",
    0.35,
    "how far a measured order, log₂ of the ratio of errors at h and h/2, may be from the one that the scheme has",
)

STEPS = (1e-3, 5e-4, 2.5e-4)
"""Of Exudyn [s]; at half the last, rounding takes over."""

DRAKE_STEPS = (2e-3, 1e-3, 5e-4)
"""[s]"""

STIFFNESSES = (1e4, 5e3, 2.5e3)
"""Of Drake's contact, S [kg]; see `slide_drake`."""


@dataclass(frozen=True)
class SlideCheck:
    """One comparison of two slides; it passes if its error is a number within its tolerance.

    engine; what: the quantity compared; error; tolerance, in the unit of the error; argument: for the tolerance;
    seconds: of the engine's runs
    """

    engine: str
    what: str
    error: float
    tolerance: float
    argument: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Tell whether the error is within the tolerance; a NaN is not."""
        return bool(self.error <= self.tolerance)


Slide = Callable[..., Trajectory]


def compare_slides() -> Iterator[SlideCheck | Missing]:
    """Compare the slides of all engines with the simulator's, one after the other; about six seconds in all."""
    yield from compare_oracle()
    peers: tuple[tuple[type[Engine], Callable[[], Iterator[SlideCheck]]], ...] = (
        (MuJoCo, compare_mujoco),
        (Exudyn, compare_exudyn),
        (Drake, compare_drake),
    )
    for engine, compare in peers:
        if installed(engine):
            yield from compare()
        else:
            yield Missing(engine.name, engine.install)


def compare_oracle(overrides: dict[str, Any] | None = None) -> Iterator[SlideCheck]:
    """Compare the slide with the hand-written loop, which steps by the same scheme: equal to rounding.

    overrides: keys of the scenario that are set otherwise; without any it is the whole slide, eight seconds
    """
    of = problem(overrides)
    span = f"{of.scenario.time.duration:g} s"
    ours, theirs = slide_closedloop(of), slide_oracle(of)
    terms = of.robot.terms(of.q, of.v)
    A = of.plane.normal @ terms.jacobian
    unit = EPS * of.stabiliser[1] / float(A @ np.linalg.solve(terms.mass_matrix, A))
    yield _check(ours, theirs, "contact_force", f"f(t) [N], {span}", SAME_SCHEME.value * unit, SAME_SCHEME)
    difference = rigid_force(of, ours) - rigid_force(of, theirs)
    worst = float(np.max(np.abs(difference)))
    what = f"f(t) less the stabiliser's share [N], {span}"
    yield SlideCheck(theirs.engine, what, worst, RIGID_PART.value, RIGID_PART.argument, theirs.seconds)
    yield _check(ours, theirs, "closure_error", f"e(t) [m], {span}", SAME_SCHEME.value * EPS, SAME_SCHEME)
    yield _check(ours, theirs, "q", f"q(t) [rad], {span}", SAME_SCHEME.value * EPS, SAME_SCHEME)


def rigid_force(of: Problem, slide: Trajectory) -> Array:
    """Return f + (s_v ė + s_p e) / (A H⁻¹Aᵀ) [N] of each row: the force without what answers the closure error."""
    s_v, s_p = of.stabiliser
    force = np.empty(len(slide.time))
    for k, (q, v) in enumerate(zip(slide.q, slide.v, strict=True)):
        terms = of.robot.terms(q, v)
        A = of.plane.normal @ terms.jacobian
        answer = (s_v * float(A @ v) + s_p * slide.closure_error[k]) / float(A @ np.linalg.solve(terms.mass_matrix, A))
        force[k] = slide.contact_force[k] + answer
    return force


def compare_mujoco() -> Iterator[SlideCheck]:
    """Compare the whole slide with MuJoCo's at three softnesses, and with their limit."""
    yield slide_acts("mujoco", lambda of, contact: slide_mujoco(of, IMPEDANCES[0], contact=contact))
    of = problem()
    ours = slide_closedloop(of)
    runs = [slide_mujoco(of, d) for d in IMPEDANCES]
    limit = at_zero(runs, [run.softness for run in runs])
    raw = _worst(ours.contact_force, runs[0].contact_force)
    note = f"; the hardest run itself is {raw:.1e} N off"
    yield _check(ours, limit, "contact_force", f"f(t) [N], 8 s, softness → 0{note}", SOFTNESS.value, SOFTNESS)
    # The same relative error of e, which the stabiliser's s_p turns into f.
    metre = SOFTNESS.value / of.stabiliser[1]
    yield _check(ours, limit, "closure_error", "e(t) [m], 8 s, softness → 0", metre, SOFTNESS)
    errors = [_worst(ours.contact_force, run.contact_force) for run in runs]
    yield _order("mujoco", "order in the softness", errors[::-1], 1.0, limit.seconds)


def compare_exudyn() -> Iterator[SlideCheck]:
    """Compare the start of the motion with Exudyn's at decreasing steps, and their limit with that of the simulator."""
    yield slide_acts("exudyn", lambda of, contact: slide_exudyn(of, contact=contact))
    fine = slide_closedloop(problem(SHORT | {"time.integrator": "rk4", "time.step": STEPS[-1] / 2}))
    runs = [slide_exudyn(problem(SHORT | _step(h))) for h in STEPS]
    errors = [_worst(_sampled(fine, run.step).contact_force, run.contact_force) for run in runs]
    seconds = sum(run.seconds for run in runs)
    yield _order("exudyn", "order of f(t) in h", errors, 2.0, seconds)
    coarse = [_sampled(run, STEPS[0]) for run in runs[-2:]]
    limit = at_zero(coarse, [run.step**2 for run in runs[-2:]])
    against = _sampled(fine, STEPS[0])
    note = f"; at {STEPS[-1] * 1e3:g} ms itself {errors[-1]:.1e} N off"
    what = f"f(t) [N], first 0.3 s, h → 0 in both{note}"
    yield _check(against, replace(limit, seconds=seconds), "contact_force", what, SECOND_ORDER.value, SECOND_ORDER)


def compare_drake() -> Iterator[SlideCheck]:
    """Compare the start of the motion with Drake's at decreasing steps, compliance extrapolated to zero at each."""
    yield slide_acts("drake", lambda of, contact: slide_drake(of, contact=contact))
    ours, limits = [], []
    for h in DRAKE_STEPS:
        of = problem(SHORT | _step(h))
        runs = [slide_drake(of, stiffness=s) for s in STIFFNESSES]
        ours.append(slide_closedloop(of))
        limits.append(at_zero(runs, [run.softness for run in runs]))
    errors = [_worst(a.contact_force, b.contact_force) for a, b in zip(ours, limits, strict=True)]
    seconds = sum(limit.seconds for limit in limits)
    yield _order("drake", "order of f(t) in h", errors, 2.0, seconds)
    first, last = DRAKE_STEPS[0] * 1e3, DRAKE_STEPS[-1] * 1e3
    what = f"f(t) [N], first 0.3 s at {last:g} ms, compliance → 0; at {first:g} ms {errors[0]:.1e} N"
    limit = replace(limits[-1], seconds=seconds)
    yield _check(ours[-1], limit, "contact_force", what, OTHER_STABILISER.value, OTHER_STABILISER)


def slide_acts(engine: str, slide: Slide) -> SlideCheck:
    """Press for 20 ms with the surface and without: with it f stays at 10 N and the tip in place, without it falls.

    Without the surface 10 N move the tip by ½ f AH⁻¹Aᵀ t², half a millimetre; with it by nothing but softness. The
    error is the tip's motion with the surface over its motion without, infinite if f is not what the law asks for.
    """
    of = problem({"time.duration": 0.02})
    held, free = slide(of, True), slide(of, False)
    moved, fell = (float(np.max(np.abs(run.closure_error))) for run in (held, free))
    wanted = float(of.settings[0])
    right = bool(np.max(np.abs(held.contact_force - wanted)) < 1e-2 * wanted and np.all(free.contact_force == 0.0))
    argument = "the softest of the contacts used gives way by f/k = 1e-7 m, a free tip falls by 5e-4 m"
    error = moved / fell if right and fell > 1e-4 else float("inf")
    return SlideCheck(
        engine, "the surface acts: motion with it over motion without", error, 1e-3, argument, held.seconds
    )


def _step(h: float) -> dict[str, float]:
    """Return the overrides of a step with Baumgarte's time constant in the same proportion as in the scenario."""
    return {"time.step": h, "stabiliser.time_constant": h}


def _sampled(run: Trajectory, step: float) -> Trajectory:
    """Return every so-manieth row of a run, those `step` [s] apart."""
    every = round(step / run.step)
    parts = {name: getattr(run, name)[::every] for name in ("time", "q", "v", "contact_force", "closure_error")}
    return replace(run, step=step, **parts)


def _worst(a: Array, b: Array) -> float:
    return float(np.max(np.abs(a - b)))


def _check(
    ours: Trajectory, theirs: Trajectory, column: str, what: str, tolerance: float, because: Tolerance
) -> SlideCheck:
    error = _worst(getattr(ours, column), getattr(theirs, column)) if theirs.pressed else float("inf")
    return SlideCheck(theirs.engine, what, error, float(tolerance), because.argument, theirs.seconds)


def _order(engine: str, what: str, errors: Sequence[float], wanted: float, seconds: float) -> SlideCheck:
    """Check that errors at parameters each half the one before fall with the power `wanted`."""
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    text = f"{what}, {wanted:g} wanted: " + ", ".join(f"{x:.2f}" for x in orders)
    return SlideCheck(engine, text, float(np.max(np.abs(orders - wanted))), ORDERS.value, ORDERS.argument, seconds)


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

    def tree(of: Robot) -> Tree:
        sound = tree_of(of.model, of.tip)
        return fault(sound) or sound

    with mock.patch("closedloop.simulation.engines.loops.compiled_tree", tree):
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
    return dataclasses.replace(of.with_table(table), q=of.q + EPS * rng.uniform(-4.0, 4.0, of.robot.n))


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
        "q": part_of("q"), "v": part_of("v", EPS * of.stabiliser[1] * of.h), "Q": part_of("torque", answer),
        "r": part_of("position"), "ṙ": part_of("velocity", EPS * of.stabiliser[1] * of.h),
        "f": part_of("contact_force", answer), "e": part_of("closure_error"),
    }  # fmt: skip


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
