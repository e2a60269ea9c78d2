"""Laps, interleaved, and what is made of them.

Contestants take turns, A B C C B A A B C ..., so that whatever else the machine does hits all alike, and a ratio is the
median of the ratios of neighbours in time. Beside the wall's time stands the processor's: on a machine that is shared
the share of a core that a contestant got is below one, and ratios are those of the processor's time.

What is printed: one table of all rows, one of the targets.

What the project wants of its speed, as ratios measured in one run.
"""

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant
from validation.speed.repeated import SHORT
from validation.speed.scenes import BOXES, CUBE, ROBOTS, STACKS, TOWERS


@dataclass(frozen=True)
class Timing:
    """What the laps of a contestant took.

    wall: (K,), seconds a step, by the wall's clock, of each lap
    share: (K,), processor time over wall time of each lap: cores that were busy for it
    end: what the last lap came to
    """

    contestant: Contestant
    wall: Array
    share: Array
    end: Array | None

    @property
    def median(self) -> float:
        """Seconds a step."""
        return float(np.median(self.wall))

    @property
    def busy(self) -> Array:
        """Processor seconds a step, of each lap (K,)."""
        return self.wall * self.share

    @property
    def processor(self) -> float:
        """Processor seconds a step."""
        return float(np.median(self.busy))

    @property
    def error(self) -> float | None:
        """How far it ended from the converged answer, rad or m; None where there is none."""
        if self.end is None or self.contestant.converged is None:
            return None
        return float(np.max(np.abs(self.end - self.contestant.converged)))

    @property
    def spread(self) -> float:
        """Half the distance of the quartiles, over the median."""
        low, high = np.percentile(self.wall, [25, 75])
        return float((high - low) / 2 / self.median)


def race(
    contestants: Sequence[Contestant], repeats: int, say: Callable[[str], None] = lambda text: None
) -> dict[tuple[str, str], Timing]:
    """Let every contestant run a lap to get warm and then `repeats` more, in turns.

    Returns (arm, name) -> `Timing`.
    Raises `RuntimeError` if one that does the whole work ends elsewhere than it should: it has not done the same.
    """
    keys = [(c.arm, c.name) for c in contestants]
    ends: dict[tuple[str, str], Array | None] = {}
    for key, contestant in zip(keys, contestants, strict=True):
        say(f"warming up {contestant.name} on {contestant.arm}")
        ends[key] = contestant.lap()[1]
    _check_ends(contestants, ends)
    wall: dict[tuple[str, str], list[float]] = {key: [] for key in keys}
    share: dict[tuple[str, str], list[float]] = {key: [] for key in keys}
    for k in range(repeats):
        say(f"lap {k + 1} of {repeats}")
        gc.collect()
        turn = list(zip(keys, contestants, strict=True))
        for key, contestant in turn if k % 2 == 0 else reversed(turn):
            busy, began = time.process_time(), time.perf_counter()
            seconds, ends[key] = contestant.lap()
            whole, used = time.perf_counter() - began, time.process_time() - busy
            wall[key].append((whole if seconds is None else seconds) / contestant.steps)
            share[key].append(used / whole)
    _check_ends(contestants, ends)
    return {
        key: Timing(contestant, np.array(wall[key]), np.array(share[key]), ends[key])
        for key, contestant in zip(keys, contestants, strict=True)
    }


def ratio(a: Timing, b: Timing, *, wall: bool = False) -> float:
    """Return how many times as long a step of `a` takes as one of `b`: the median over laps of the same turn.

    By the processor's time: where others want the core, long laps lose it for sure and short ones seldom, so that the
    wall would flatter who is quick. What several threads gain shows by the wall only.
    """
    return float(statistics.median(a.wall / b.wall if wall else a.busy / b.busy))


def _check_ends(contestants: Sequence[Contestant], ends: dict[tuple[str, str], Array | None]) -> None:
    for c in contestants:
        end = ends[c.arm, c.name]
        if end is None or c.wanted is None:
            continue
        apart = float(np.max(np.abs(end - c.wanted)))
        if not apart <= c.tolerance:
            raise RuntimeError(
                f"{c.name} on {c.arm} ended {apart:.1e} from where it should, over {c.tolerance:.0e}: "
                "it has not done the same work"
            )


Timings = dict[tuple[str, str], Timing]
ARM = "wam4"


@dataclass(frozen=True)
class Target:
    """A ratio, how large or small it should be, and what it is."""

    what: str
    wanted: float
    least: bool
    measured: float | None

    @property
    def met(self) -> bool | None:
        """Whether the ratio is on the right side; None where it was not measured."""
        if self.measured is None:
            return None
        return self.measured >= self.wanted if self.least else self.measured <= self.wanted


def targets(timings: Timings) -> list[Target]:
    """Return every target with what was measured; None where a contestant is missing."""

    def times(a: str, b: str, wall: bool = False, arm: str = ARM) -> float | None:
        """How many times as long a step of a takes as one of b."""
        over, under = (timings.get((arm, name)) for name in (a, b))
        return ratio(over, under, wall=wall) if over and under else None

    def beside(name: str) -> float | None:
        """How many microseconds a short run takes beside its steps."""
        whole, steps = (timings.get((ARM, each)) for each in (name, f"{name}_steps"))
        return float(np.median(whole.busy - steps.busy)) * SHORT * 1e6 if whole and steps else None

    added = "12 → 30 joints adds: compiled / crba, rnea, Cholesky"
    rows: list[tuple[str, float, bool, Callable[[], float | None]]] = [
        ("MuJoCo from Python / compiled", 15.0, True, lambda: times("mujoco", "compiled")),
        ("bare mj_step / compiled", 5.0, True, lambda: times("mj_step", "compiled")),
        ("compiled batch, one thread / two", 1.8, True, lambda: times("batch_1", "batch_2", wall=True)),
        ("MuJoCo rollout / compiled batch, two threads", 8.0, True, lambda: times("rollout_2", "batch_2", wall=True)),
        ("Pinocchio engine / MuJoCo from Python", 0.7, False, lambda: times("pinocchio", "mujoco")),
        ("Pinocchio engine / its bare calls", 1.4, False, lambda: times("pinocchio", "calls")),
        ("whole cl.simulate / its steps", 1.4, False, lambda: times("call", "call_steps")),
        ("µs of a run from another start beside its 50 steps", 60.0, False, lambda: beside("elsewhere")),
        ("µs of a run with another force beside its 50 steps", 60.0, False, lambda: beside("values")),
        ("a reset of Press-v0 / a step of it", 1.0, False, lambda: times("reset", "gym_step")),
        ("whole compiled batch, one thread / its steps in lanes", 1.25, False, lambda: times("batch_1", "lanes")),
        ("friction: alone / in lanes", 3.0, True, lambda: times("rough", "rough_lanes")),
        ("touchdown: alone / in lanes", 3.0, True, lambda: times("landing", "landing_lanes")),
        ("a ball: alone / in lanes", 3.0, True, lambda: times("round", "round_lanes")),
        ("a soft surface: alone / in lanes", 3.0, True, lambda: times("soft", "soft_lanes")),
        ("MuJoCo from Python / whole cl.simulate", 8.0, True, lambda: times("mujoco", "call")),
        ("H by Newton–Euler columns / composite bodies", 1.0, True, lambda: times("rnea_columns", "crba")),
        ("value and seven derivatives / compiled", of_registers(), False, lambda: times("duals", "compiled")),
        ("the same with friction / compiled", 2.5, False, lambda: times("rubbing_duals", "rubbing")),
        (added, 1.0, False, lambda: growth(timings)),
    ]
    found = [Target(what if what == added else f"{ARM}: {what}", w, least, of()) for what, w, least, of in rows]
    four_bar = times("mujoco", "compiled", arm="four_bar")
    delta = times("constraint_dynamics", "compiled", arm="delta")
    return [
        *found,
        Target("four_bar: MuJoCo from Python, connect / compiled", 5.0, True, four_bar),
        Target("delta: constraintDynamics loop / compiled", 1.0, True, delta),
        *(
            Target(f"{who}: bare mj_step / compiled", least, True, times("mj_step", "compiled", arm=who))
            for who, least in (*((box, 1.0) for box in BOXES), *((scene, 0.2) for scene in (*STACKS, *ROBOTS)))
        ),
        *(
            Target(f"{who}: bare mj_step / time stepping", least, True, times("mj_step", "time_stepping", arm=who))
            for who, least in ((CUBE, 1.0), ("tower_5", 0.8))
        ),
        Target("tower of 10 / of 2: compiled, over mj_step's", 1.0, False, tower_growth(timings)),
    ]


def of_registers() -> float:
    """Return how many plain runs a value and seven derivatives may take: a register of 512 bits holds all eight."""
    import llvmlite.binding as llvm

    return 1.8 if llvm.get_host_cpu_features().get("avx512f", False) else 3.0


def tower_growth(timings: Timings) -> float | None:
    """Return by how much more a step of ours takes with ten boxes than with two, over what MuJoCo's does."""
    keys = [(TOWERS[i], name) for name in ("compiled", "mj_step") for i in (0, -1)]
    if any(key not in timings for key in keys):
        return None
    ours_2, ours_10, theirs_2, theirs_10 = (timings[key].processor for key in keys)
    return (ours_10 / ours_2) / (theirs_10 / theirs_2)


def growth(timings: Timings) -> float | None:
    """Return the time that 18 more joints add to a whole step of ours, over what they add to Pinocchio's algorithms.

    A difference leaves out what does not grow, the calls from Python among it, which would flatter ours.
    """
    keys = [(arm, name) for name in ("compiled", "algorithms") for arm in ("chain12", "chain30")]
    if any(key not in timings for key in keys):
        return None
    ours_12, ours_30, theirs_12, theirs_30 = (timings[key].processor for key in keys)
    return (ours_30 - ours_12) / (theirs_30 - theirs_12)


def as_data(timings: Timings, found: list[Target], extra: dict[str, Any]) -> dict[str, Any]:
    """Return everything that was measured, for JSON; times in seconds."""
    rows = [
        {
            "arm": arm, "name": name, "what": t.contestant.what, "joints": t.contestant.joints,
            "steps": t.contestant.steps, "seconds_per_step": t.median, "processor_seconds_per_step": t.processor,
            "processor_seconds_per_step_and_joint": t.processor / t.contestant.joints, "spread": t.spread,
            "cores_busy": float(t.share.mean()), "laps": t.wall.tolist(), "processor_laps": t.busy.tolist(),
            "error": t.error,
            "over_mujoco": ratio(t, timings[arm, "mujoco"]) if (arm, "mujoco") in timings else None,
        }
        for (arm, name), t in timings.items()
    ]  # fmt: skip
    marks = [
        {"what": t.what, "wanted": t.wanted, "at_least": t.least, "measured": t.measured, "met": t.met} for t in found
    ]
    return {"rows": rows, "targets": marks, **extra}


def show(data: dict[str, Any]) -> None:
    """Print both tables, the cold starts and what is missing."""
    table = Table(box=box.SIMPLE_HEAD, title=f"one step of a slide, median of {data['repeats']} laps in turns")
    columns = ("arm", "who", "µs", "±%", "CPU µs", "a joint", "× MuJoCo", "error")
    for column in columns:
        table.add_column(column, justify="left" if column in ("arm", "who") else "right")
    last = ""
    for row in data["rows"]:
        if row["arm"] == "machine":
            continue
        over = row["over_mujoco"]
        times = ("seconds_per_step", "processor_seconds_per_step", "processor_seconds_per_step_and_joint")
        micro = [1e6 * row[key] for key in times]
        if last and row["arm"] != last:
            table.add_section()
        table.add_row(
            f"{row['arm']} ({row['joints']})" if row["arm"] != last else "", row["what"], f"{micro[0]:.3g}",
            f"{100 * row['spread']:.0f}", f"{micro[1]:.3g}", f"{micro[2]:.3g}", f"{1 / over:.2f}" if over else "–",
            "–" if row["error"] is None else f"{row['error']:.1e}",
        )  # fmt: skip
        last = row["arm"]
    console = Console(highlight=False)
    console.width = max(100, console.width)
    console.print(table)
    console.print("error: of q at the end, rad or m, from the answer with a rigid contact and endlessly short steps\n")
    marks = Table(box=box.SIMPLE_HEAD, title="targets")
    for column in ("ratio", "wanted", "measured", ""):
        marks.add_column(column, justify="left" if column == "ratio" else "right")
    for mark in data["targets"]:
        measured = "not measured" if mark["measured"] is None else f"{mark['measured']:.2f}"
        sign = {True: "✓", False: "✗", None: ""}[mark["met"]]
        marks.add_row(mark["what"], f"{'≥' if mark['at_least'] else '≤'} {mark['wanted']:g}", measured, sign)
    console.print(marks)
    console.print(f"two threads of bare arithmetic do {data['two_threads']:.2f} times the work of one on this machine")
    for name, seconds in data["cold_start_seconds"].items():
        console.print(f"cold start, {name}: {seconds:.2f} s")
    for name, reason in data["missing"].items():
        console.print(f"{name}: {reason}", markup=False)  # [peers] is no style
