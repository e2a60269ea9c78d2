"""Many runs of one scenario at once, on all cores.

    table = cl.simulate_batch(cl.load_scenario("wam_slide"), {"law.force": [5.0, 10.0, 15.0]})
    table.to_pandas()[["law.force", "min_contact_force"]]

Each thread has a `Worker` and takes the next block of runs when it has finished one. The compiled engine releases the
interpreter's lock while it steps, so threads run in parallel and share memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError
from closedloop.base.optional import needs
from closedloop.base.progress import reporting
from closedloop.base.second_process import cores
from closedloop.jit.simd8 import WIDE
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario, families
from closedloop.simulation.batch.table import kept_columns, key_type, schema, table_of
from closedloop.simulation.batch.threads import Done, side_by_side
from closedloop.simulation.batch.worker import Outcome, Worker, failed
from closedloop.simulation.cache import Cache
from closedloop.simulation.engines.lanes import FEWEST, uses_lanes
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.user_law import Law
from closedloop.simulation.simulate import check_engine
from robot_models import RobotModel

if TYPE_CHECKING:
    import pyarrow as pa

MOST_THREADS = 1000
# Keys in which the runs of one set of lanes may differ; see `closedloop.simulation.engines.lanes.Kind`.
OF_ANY_KIND = (
    "law.force", "law.kp", "law.kd", "law.pd_start", "stabiliser.time_constant", "stabiliser.damping_ratio", "start.",
    "reference.", "force_profile.", "surface.", "surface_motion.", "friction.", "compliance.", "impact.",
)  # fmt: skip
# But for these.
OF_A_KIND = ("surface.contact", *(f"{part}.kind" for part in ("surface", "surface_motion", "friction", "compliance")))


@arguments_checked(changes="a list with one value for each run, by its key: {'law.force': [5.0, 10.0]}")
def simulate_batch(
    scenario: Scenario,
    changes: Mapping[str, Sequence[Any]],
    *,
    grid: bool = False,
    keep: Iterable[str] = (),
    engine: str = COMPILED,
    workers: int | None = None,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
    law: Law | None = None,
) -> pa.Table:
    """Simulate a scenario many times with some keys changed, and return a table of the runs.

    Parameters
    ----------
    scenario : Scenario
        What the runs have in common.
    changes : mapping of str to sequence
        Dotted keys, as `load_scenario` takes them, and for each a value per run: run i has the i-th of every key.
    grid : bool
        Whether every value of a key goes with every value of the others instead; the last key changes fastest.
    keep : iterable of str
        Columns of the runs to keep whole, as lists: "f" or "contact_force", "e" or "closure_error", "q", "torque" ...
    engine : "compiled" or "pinocchio"
        See `simulate`. Pinocchio takes any integrator, and one core.
    workers : int, optional
        Threads; as many as there are cores if left out. The table is the same, to the last bit, for any number.
    model : RobotModel, optional
        The robot to use instead of loading the one that the scenario names.
    progress : bool or callable
        True draws a bar on standard error; a callable gets (runs done, runs in all).
    law : callable, optional
        A user's law in place of the scenario's, see `simulate`; the compiled engine takes one that numba has compiled.

    Returns
    -------
    pyarrow.Table
        A row for each run, in order: its number, the changed keys, ``status`` ("done", "stopped", "refused", "failed":
        an unforeseen error) with its ``reason``, the values of `Run.summary` (empty where there is none), the
        events, when each of the paper's assumptions failed, and the kept columns. Units and meanings are the fields'
        metadata. A run that fails is a row like any other.

    Raises
    ------
    ScenarioError
        If a key is unknown, lengths differ, the engine does not cover the scenario, or no run could be read.
    """
    needs("pyarrow")
    if not changes:
        raise ScenarioError("changes: name at least one key and its values, such as {'law.force': [5.0, 10.0]}")
    keys = tuple(changes)
    points = _points(changes, grid)
    columns = kept_columns(keep)
    variants = Variants(scenario, keys)
    check_engine(variants.look(points), engine, law)
    threads, shared = threads_for(engine, workers), Cache()
    blocks = in_blocks(variants, points, engine, len(points), threads, lanes=law is None)
    outcomes: list[Outcome | None] = [None] * len(points)
    done = Done()

    def one(worker: Worker, at: int) -> None:
        some = run_variants(worker, variants, [points[i] for i in blocks[at]], engine, done.add)
        for i, outcome in zip(blocks[at], some, strict=True):
            outcomes[i] = outcome

    with reporting(progress, scenario.name, len(points)) as report:
        side_by_side(
            one, len(blocks), threads, lambda: Worker(engine, columns, model, len(points), shared, law),
            lambda: report(done.count, len(points)), done,
        )  # fmt: skip
    kinds = {key: key_type([point[k] for point in points]) for k, key in enumerate(keys)}
    return table_of(schema(kinds, columns, scenario), 0, points, [x for x in outcomes if x is not None], columns)


def in_blocks(
    variants: Variants, points: Sequence[Sequence[Any]], engine: str, runs: int, threads: int = 1, *, lanes: bool = True
) -> list[list[int]]:
    """Return the numbers of all points: in blocks of those that may share SIMD lanes, the others one by one.

    Parameters
    ----------
    threads : int
        How many threads take blocks; each should get some.
    lanes : bool
        Whether lanes may be used: they have no law of a user's.
    """
    tells_kinds = [at for at, key in enumerate(variants.keys) if not key.startswith(OF_ANY_KIND) or key in OF_A_KIND]
    kinds: dict[tuple[str, ...], list[int]] = {}
    for i, point in enumerate(points):
        kinds.setdefault(tuple(repr(point[at]) for at in tells_kinds), []).append(i)
    width = max(FEWEST, min(WIDE, -(-len(points) // threads)))
    blocks = []
    for members in kinds.values():
        alone = not lanes or len(members) < FEWEST
        each = 1 if alone or not _use_lanes(variants, [points[i] for i in members[:WIDE]], engine, runs) else width
        blocks += [members[first : first + each] for first in range(0, len(members), each)]
    return blocks


def _use_lanes(variants: Variants, points: Sequence[Sequence[Any]], engine: str, runs: int) -> bool:
    """Whether the runs with these values, of one kind, use lanes: decided by the first that can be read."""
    for values in points:
        try:
            return uses_lanes(variants.scenario(values), engine, runs)
        except Exception:  # reported in its own row
            continue
    return False


def run_variants(
    worker: Worker, variants: Variants, points: Sequence[Sequence[Any]], engine: str, ran: Callable[[], None]
) -> list[Outcome]:
    """Run the variants with these values, a block of `in_blocks`; one that cannot even be read says why.

    `ran` is called after each.
    """
    outcomes: list[Outcome | None] = []
    scenarios = []
    for values in points:
        try:
            scenario = variants.scenario(values)
            check_engine(scenario, engine, worker.law)
            scenarios.append(scenario)
            outcomes.append(None)
        except Exception as error:  # the border of a row: see `failed`
            outcomes.append(failed(error))
            ran()
    came_to = iter(worker.run_all(scenarios, ran))
    return [next(came_to) if outcome is None else outcome for outcome in outcomes]


def threads_for(engine: str, workers: int | None) -> int:
    """Return how many threads to use: one for Pinocchio, which Python drives, else one a core, unless told."""
    if workers is not None and not 1 <= workers <= MOST_THREADS:
        raise ScenarioError(f"workers = {workers}: must be at least 1, and at most {MOST_THREADS}")
    if engine != COMPILED:
        return 1
    return workers or cores()


def _points(changes: Mapping[str, Sequence[Any]], grid: bool) -> list[tuple[Any, ...]]:
    values: list[list[Any]] = []
    for key, given in changes.items():
        try:
            listed = given.tolist() if hasattr(given, "tolist") else None if isinstance(given, str) else list(given)
        except TypeError:
            listed = None
        if isinstance(listed, list) and (family := families().get(key)):
            listed = [family.named(value, key) for value in listed]
        if not isinstance(listed, list):
            raise ScenarioError(f"changes[{key!r}] = {given!r}: must be a list with one value for each run")
        if not listed:
            raise ScenarioError(f"changes[{key!r}]: is empty; give one value for each run")
        values.append(listed)
    if grid:
        return list(itertools.product(*values))
    lengths = {key: len(listed) for key, listed in zip(changes, values, strict=True)}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise ScenarioError(
            f"changes: {said} values: give each as many, one for each run, or combine them all: grid=True"
        )
    return list(zip(*values, strict=True))
