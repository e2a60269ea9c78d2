"""What the project wants of its speed, as ratios measured in one run."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from validation.speed.bodies import CUBE, TOWERS
from validation.speed.feet import BOXES
from validation.speed.measure import Timing, ratio
from validation.speed.repeated import SHORT
from validation.speed.robots import ROBOTS
from validation.speed.scenes import SCENES

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
            for who, least in (
                *((box, 1.0) for box in BOXES),
                *((scene, 0.2) for scene in (*SCENES, *ROBOTS)),
            )
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
