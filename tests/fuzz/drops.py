"""A box on four, five or eight feet dropped on a floor with any pose and spin: whether it ends, and how.

    PYTHONPATH=.:tests/closedloop:tests/fuzz python tests/fuzz/drops.py --count 1000 --seed 0 --integrator rk4

Any pose: its feet may be above it, and two of its three revolute joints nearly parallel. Of each drop it says what is
wrong: a run that stopped, a gap below −1e-9 m, a force outside its cone, energy that grew, and a box that has not come
to rest though there is friction and the bounces have had their time.
"""

import argparse
import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from boxes import G, drop_in_any_pose, simulate

import closedloop as cl

# What is wrong: a gap below this, m; force outside the cone, of the largest, or a pull, N; energy that grows in a step,
# of that which there is; speed at rest, rad/s (m/s).
GAP, CONE, RISE, REST = -1e-9, 1e-9, 1e-9, 1e-6
# With a coefficient of friction below this a box may slide on for long.
SLIPPERY = 0.04
# What the error of the integrator makes wrong too, and steps at which it is to be less, s: the second is shorter than
# those into which the first is divided where joints turn fast.
BY_STEP, FINER = {"gap", "energy", "energy of a gap"}, (2.5e-4, 2e-5)


def examine(run: Any, mu: Any, rests: bool = True) -> dict[str, float]:
    """Return what is wrong with a run, by name, and how much; μ of all contacts, or of each."""
    wrong = {}
    f = run.link_forces
    if not len(f):
        return {"no rows": 0.0}
    rub = np.hypot(*np.moveaxis(run.link_frictions.reshape(*f.shape, 2), -1, 0))
    size = np.maximum(1.0, f.max(axis=1, initial=0.0))[:, None]
    energy = run.kinetic_energy + run.potential_energy
    highest = max(1.0, float(np.max(np.abs(energy))))
    rise = float(np.max(np.diff(energy), initial=0.0)) / highest
    closing = -GAP * float(np.max(f.sum(axis=1))) / highest  # what the forces do where they close such a gap
    for name, value, bad in (
        ("gap", float(np.min(run.link_gaps)), lambda x: x < GAP),
        ("pull", float(np.min(f)), lambda x: x < -CONE),
        ("cone", float(np.max((rub - mu * f) / size)), lambda x: x > CONE),
        ("energy", rise, lambda x: x > max(RISE, closing)),
        ("energy of a gap", rise, lambda x: RISE < x <= closing),
        ("impact energy", float(np.max(-run.event_energy_lost, initial=0.0)), lambda x: x > 1e-12),
    ):
        if bad(value):
            wrong[name] = value
    if rests and run.stopped is None and mu > SLIPPERY:
        speed = float(np.max(np.abs(run.v[-1])))
        if speed > REST:
            wrong["moves"] = speed
    return wrong


def ran(simulate: Callable[..., Any], *args: Any, **changes: Any) -> tuple[Any, str]:
    """Return a run, or what there is of one that stopped, and why it did."""
    try:
        return simulate(*args, **changes), ""
    except cl.SimulationError as error:
        return error.run, f"{type(error).__name__}: {error}"


def judge(wrong: dict[str, float], again: Callable[[dict[str, float]], Any], mu: Any) -> dict[str, float]:
    """Return what is wrong, with a gap or energy named "truncation" if a finer step leaves less than half of it.

    That is the integrator's own error, which falls with its order between events, and at least with the step where one
    lies in it. What does not fall is a fault of the method: an event missed, or a mode that is wrong. `again` returns
    the run with changes of the scenario.
    """
    for step in FINER:
        if wrong.keys() & BY_STEP:
            finer = examine(again({"time.step": step}), mu, rests=False)
            small = {name for name in wrong.keys() & BY_STEP if abs(finer.get(name, 0.0)) <= 0.5 * abs(wrong[name])}
            wrong = {f"truncation {name}" if name in small else name: value for name, value in wrong.items()}
    return wrong


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after so many")
    parser.add_argument("--duration", type=float, default=4.0)
    parser.add_argument("--integrator", default="rk4")
    parser.add_argument("--feet", type=int, nargs="*", default=[4, 5, 8])
    args = parser.parse_args()
    counts: Counter[str] = Counter()
    begin, done = time.time(), 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(args.seed, args.seed + args.count):
            if time.time() - begin > args.seconds:
                break
            feet = args.feet[k % len(args.feet)]
            half, at, start, mu, e = drop_in_any_pose(feet, k)
            # Friction takes μ g of the speed in each second, be it of sliding or, at the feet, of turning.
            fastest = float(np.linalg.norm(start[1][:3]) + np.linalg.norm(start[1][3:]) * np.linalg.norm(half))
            slides = math.ceil(1.0 + fastest / (mu * G)) if mu > SLIPPERY else 0
            changes = {"time.duration": max(args.duration, slides), "time.integrator": args.integrator}
            drop, since = (Path(folder), half, at, start, mu, e), time.process_time()
            run, failure = ran(simulate, *drop, **changes)
            seconds, done = time.process_time() - since, done + 1
            wrong = examine(run, mu)
            if "moves" in wrong:  # it may rock on
                changes["time.duration"] *= 2
                run, failure = ran(simulate, *drop, **changes)
                wrong = examine(run, mu)
            wrong = judge(wrong, lambda finer, d=drop, c=changes: ran(simulate, *d, **c, **finer)[0], mu)
            counts.update(list(wrong))
            if failure:
                counts[failure.split(":")[0]] += 1
            if wrong or failure:
                said = " ".join(f"{name} {value:.2g}" for name, value in wrong.items())
                what = f"{k} feet {feet} mu {mu:.3f} e {e:.3f} events {len(run.events)} {seconds:.2f} s"
                print(f"{what}: {said} {failure[:140]}", flush=True)
    print(f"{done} drops, {time.time() - begin:.0f} s:", dict(counts))


if __name__ == "__main__":
    main()
