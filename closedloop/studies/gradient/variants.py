"""Runs of a scenario with slightly other numbers, and whether the same things happen in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.simulation.prepare import Cache, prepare
from closedloop.simulation.simulate import as_run, check_engine, run_loop
from robot_models import RobotModel

# What `difference` says of runs that differ in nothing but that an event is between other rows.
PAST_A_ROW = "an event moves past a row"


class Happening(NamedTuple):
    """An event, without its instant."""

    kind: str
    contact: int
    row: int  # the last row at or before it


@dataclass(frozen=True)
class Sample:
    """What is kept of a run."""

    values: Array  # (M,): all quantities, one after the other; empty if it could not be run to its end
    happened: tuple[Happening, ...]  # its events, in order
    instants: tuple[float, ...]  # their instants, s
    why: str = ""  # why it could not be run to its end; "" if it could
    # (M,): of the run itself: the largest entry of the quantity that each is of
    scale: Array = field(default_factory=lambda: np.empty(0))


def simulated(scenario: Scenario, model: RobotModel | None, cache: Cache | None = None) -> Run:
    """Run a scenario on the compiled engine, or on Pinocchio's if its integrator chooses its steps."""
    engine = PINOCCHIO if scenario.time.integrator in ADAPTIVE else COMPILED
    check_engine(scenario, engine, None)
    problem = prepare(scenario, model, cache)
    rows, events, failure, seconds = run_loop(problem, engine=engine)
    run = as_run(
        problem, rows, events, seconds, engine, law=("scenario", ""), with_states=True,
        stopped=str(failure) if failure else None,
    )  # fmt: skip
    if failure is not None:
        failure.run = run
        raise failure
    return run


def sample(run: Run, read: Callable[[Run], Array]) -> Sample:
    """Return what is kept of a run."""
    step = run.scenario.time.step
    events = run.events
    happened = tuple(Happening(event.kind, event.contact, int(event.time / step * (1.0 + 1e-15))) for event in events)
    return Sample(read(run), happened, tuple(event.time for event in events))


def samples(
    scenarios: Sequence[Callable[[], Scenario]],
    read: Callable[[Run], Array],
    model: RobotModel | None,
    report: Callable[[int, int], None],
    workers: int | None = None,
) -> list[Sample]:
    """Run scenarios side by side; one that cannot be, or stops, says why."""
    if not scenarios:
        return []
    found: list[Sample | None] = [None] * len(scenarios)
    done, shared = Done(), Cache()

    def one(cache: Cache, i: int) -> None:
        try:
            found[i] = sample(simulated(scenarios[i](), model, cache), read)
        except ClosedLoopError as error:
            found[i] = Sample(np.empty(0), (), (), str(error).splitlines()[0])
        done.add()

    side_by_side(
        one, len(scenarios), threads_for(COMPILED, workers), lambda: Cache(shared=shared),
        lambda: report(done.count, len(scenarios)), done,
    )  # fmt: skip
    return [each for each in found if each is not None]


def difference(base: Sample, other: Sample) -> str:
    """Return what happens in one run and not in the other, in words; "" if nothing does, `PAST_A_ROW` see there."""
    if other.why:
        return other.why
    for i, (mine, its) in enumerate(zip(base.happened, other.happened, strict=False)):
        if mine[:2] != its[:2]:
            return (
                f"event {i}, {mine.kind} at {base.instants[i]:.6g} s, becomes {its.kind} at {other.instants[i]:.6g} s"
            )
    here, there = len(base.happened), len(other.happened)
    if here > there:
        return f"event {there}, {base.happened[there].kind} at {base.instants[there]:.6g} s, no longer happens"
    if there > here:
        return f"{other.happened[here].kind} at {other.instants[here]:.6g} s happens besides"
    if base.values.shape != other.values.shape:
        return "there are other values"
    rows = ([each.row for each in run.happened] for run in (base, other))
    return "" if next(rows) == next(rows) else PAST_A_ROW
