"""A learned policy beside the six laws as tuned: ``python -m validation.learning``.

The cross-entropy method learns to press with 10 N on surfaces of unknown stiffness and friction
(`validation.policy`). The gains of each law are found by `closedloop.tune`, for the worst of soft and stiff,
smooth and rough. All are then tried on the same held-out surfaces, which neither has met.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.base.files import write_whole
from closedloop.gym import TASKS
from validation.policy import Episodes, LinearPolicy, learn_to_press

PRESS = str(TASKS["press"].scenario)
SECONDS, SETTLED = 1.5, 0.5
# The first seed of a held-out surface: far from those of learning.
HELD_OUT = 1_000_000
# What the gains of the laws are tuned for, every value with every other.
OVER = {"compliance.stiffness": [3e3, 1e5], "friction.coefficient": [0.0, 0.6]}
PAYLOAD = 0.25  # kg, in the middle of what is drawn
FEEDBACK = {"law.force_integral": (0.0, 60.0), "law.force_feedback": (0.0, 0.8)}
JOINTS = {"kp": 900.0, "kd": 60.0}
# Of each law, what the press scenario has in place of its own law, and which numbers are tuned in which ranges.
LAWS: dict[str, tuple[dict[str, Any], dict[str, tuple[float, float]]]] = {
    "impedance": ({"stiffness": 600.0, "damping": 80.0}, {"law.normal_damping": (50.0, 800.0)}),
    "admittance": ({}, {"law.admittance_damping": (50.0, 800.0), "law.admittance_inertia": (0.5, 10.0)}),
    "operational_space": ({}, {"law.approach_speed": (0.01, 0.1)}),
    "dynamic_hybrid": ({}, {"law.approach_speed": (0.01, 0.1)}),
    "hybrid": (JOINTS, {"law.approach_speed": (0.01, 0.1), "law.approach_damping": (10.0, 100.0)}),
    "paper": (JOINTS, {"law.kp": (0.0, 900.0), "law.kd": (5.0, 100.0)}),
}


def rms(run: cl.Run) -> float:
    """Return the RMS error of the force from `SETTLED` on, N."""
    late = run.time > SETTLED
    return float(np.sqrt(np.mean((run.contact_force[late] - 10.0) ** 2)))


def on_surfaces(changes: dict[str, Any], parameters: list[dict[str, Any]]) -> Array:
    """Return the RMS errors of a law on surfaces (k,), N; infinite where the run stops."""
    found = []
    for each in parameters:
        scenario = cl.load_scenario(PRESS, {**each, "time.duration": SECONDS, **changes})
        try:
            found.append(rms(cl.simulate(scenario, progress=False)))
        except cl.SimulationError:
            found.append(np.inf)
    return np.array(found)


def tuned(kind: str, starts: int) -> tuple[dict[str, Any], float]:
    """Return the gains of a law by dotted key, as tuned, and how long that took, s."""
    own, vary = LAWS[kind]
    law = {"kind": kind, "force": 10.0, "sample_period": 0.001, **own}
    scenario = cl.load_scenario(PRESS, {"law": law, "time.duration": SECONDS, "model_error.payload": PAYLOAD})
    begun = time.perf_counter()
    tuning = cl.tune(scenario, {**vary, **FEEDBACK}, "rms_force_error", over=OVER, starts=starts, iterations=15)
    return {"law": tuning.scenario.law.model_dump(exclude_none=True)}, time.perf_counter() - begun


def line_of(name: str, row: dict[str, Any]) -> str:
    """Return a line of the table."""
    each, took = np.array(row["rms"]), row.get("seconds", 0.0)
    gains = ", ".join(f"{key} {value:.4g}" for key, value in row.get("law", {}).items() if isinstance(value, float))
    return f"{name:36} {np.mean(each):8.3f} {np.max(each):9.3f} {took:12.0f}  {gains}"


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and return 0."""
    parser = argparse.ArgumentParser(prog="python -m validation.learning", description=__doc__.splitlines()[0])
    parser.add_argument("--generations", type=int, default=12, help="of the cross-entropy method")
    parser.add_argument("--surfaces", type=int, default=24, help="held-out surfaces")
    parser.add_argument("--starts", type=int, default=1, help="searches for the gains of each law")
    parser.add_argument("--threads", type=int, default=None, help="one a core if left out")
    parser.add_argument("--laws", nargs="*", default=list(LAWS), choices=list(LAWS), help="which are tuned")
    parser.add_argument("--json", help="file for the figures")
    given = parser.parse_args(arguments)
    begun = time.perf_counter()
    policy, learned = learn_to_press(seconds=SECONDS, generations=given.generations, threads=given.threads)
    spent = time.perf_counter() - begun
    weights = np.asarray(policy.weights)
    print(f"learned in {spent:.0f} s: weights {', '.join(f'{w:.2f}' for w in weights)}")
    print(f"mean square of each generation, N²: {', '.join(f'{cost:.3g}' for cost in learned.costs)}")

    task = TASKS["press"].changed({"overrides": {"time.duration": SECONDS}})
    held_out = Episodes(task, policies=1, worlds=given.surfaces, settled=SETTLED, threads=given.threads)
    errors = held_out.errors(weights[None, :], range(HELD_OUT, HELD_OUT + given.surfaces))[0]
    parameters = [dict(each) for each in held_out.core.parameters]
    with tempfile.TemporaryDirectory() as folder:
        LinearPolicy(policy.names, weights).write_law(Path(folder) / "learned_policy.py", held_out.core)
        sys.path.append(folder)  # where a user's module is looked for
        as_law = on_surfaces({"law.kind": "learned_policy:Policy"}, parameters)
        sys.path.remove(folder)
    rows: dict[str, Any] = {
        "learned policy, in the environment": {"rms": errors.tolist(), "seconds": spent},
        "learned policy, as a law": {"rms": as_law.tolist()},
    }
    print(f"{'controller':36} {'mean, N':>8} {'worst, N':>9} {'found in, s':>12}")
    for name, row in rows.items():
        print(line_of(name, row), flush=True)
    for name in given.laws:
        changes, took = tuned(name, given.starts)
        rows[name] = {"rms": on_surfaces(changes, parameters).tolist(), "seconds": took, "law": changes["law"]}
        print(line_of(name, rows[name]), flush=True)
    if given.json:
        write_whole(given.json, f"{json.dumps(rows, indent=2)}\n".encode())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
