"""How fast a step is, beside a peer that does the same work: ``python -m validation.speed``.

Rules of the comparison: the same slide, the same step, the same law (compiled, driven from Python once a step), the
same columns recorded, everything warm, all contestants interleaved in one run, the median over the repeats, and the
result a ratio. Absolute times belong to the machine they were measured on; a ratio travels.

MuJoCo solves a softened contact with an iterative solver, so it does not compute the same numbers; it is the fastest
engine that people drive from Python, which is why it is the yardstick.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import closedloop as cl
from closedloop.compiled import kernel
from closedloop.control import paper_law
from closedloop.problem import Problem
from closedloop.simulation import run_loop

Array = NDArray[np.float64]
SCENARIO = "wam_slide"


def closed_loop(problem: Problem) -> float:
    """Return the seconds a step of our own loop takes: law, terms, Eq. 24, integration and recording."""
    rows, _, failure, seconds = run_loop(problem)
    if failure is not None:
        raise failure
    return seconds / (len(rows) - 1)


def bare_calls(problem: Problem) -> float:
    """Return the seconds a step's two calls into Pinocchio take by themselves: the floor of our loop."""
    evaluate = problem.robot.evaluator(problem.q.copy(), problem.v.copy())
    began = time.perf_counter()
    for _ in range(problem.steps):
        evaluate()
    return (time.perf_counter() - began) / problem.steps


@kernel
def _drive(
    i: int, h: float, plane: Array, settings: Array, gains: Array, path: Array, q: Array, v: Array, bias: Array,
    jacobian: Array, tip: Array, qacc: Array, contact: Array, torque: Array, A: Array, rows: Array,
) -> None:  # fmt: skip
    """Record what MuJoCo computed and write the torque of Eq. 33.

    The acceleration and the contact force of a state are known only after its step, so they go into the row before.
    """
    n = q.shape[0]
    if i > 0:
        push, size = 0.0, 0.0
        for j in range(n):
            push += A[0, j] * contact[j]
            size += A[0, j] * A[0, j]
            rows[i - 1, 2 * n + j] = qacc[j]
        rows[i - 1, 4 * n + 6] = push / size  # contact = Aᵀf
    for j in range(n):
        A[0, j] = plane[0] * jacobian[0, j] + plane[1] * jacobian[1, j] + plane[2] * jacobian[2, j]
    paper_law(i * h, settings, gains, path[i], q, v, bias, A, torque)
    row = rows[i]
    rate = 0.0
    for j in range(n):
        row[j] = q[j]
        row[n + j] = v[j]
        row[3 * n + j] = torque[j]
        rate += A[0, j] * v[j]
    for k in range(3):
        row[4 * n + k] = tip[k]
        speed = 0.0
        for j in range(n):
            speed += jacobian[k, j] * v[j]
        row[4 * n + 3 + k] = speed
    row[4 * n + 7] = plane[0] * tip[0] + plane[1] * tip[1] + plane[2] * tip[2] - plane[3]
    row[4 * n + 8] = rate


def mujoco_loop(problem: Problem) -> Callable[[], tuple[float, Array]]:
    """Return a function that runs the slide in MuJoCo and gives the seconds a step and the rows.

    The tip is a sphere of a micrometre on a frictionless plane; MuJoCo's defaults otherwise.
    """
    import mujoco

    model, plane = problem.robot.model, problem.plane
    spec = mujoco.MjSpec.from_string(model.text)
    spec.option.timestep = problem.h
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    radius = 1e-6
    tip = next(body for body in spec.bodies if body.name == problem.robot.tip)
    tip.add_site(name="contact_point")
    tip.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], contype=1, conaffinity=2, condim=1, mass=0)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], zaxis=plane.normal,
        pos=(plane.offset - radius) * plane.normal, contype=2, conaffinity=1, condim=1,
    )  # fmt: skip
    for joint, inertia in zip(spec.joints, model.armature, strict=True):
        joint.armature = inertia
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    site = compiled.site("contact_point").id
    n, steps, h = model.n, problem.steps, problem.h
    surface = np.array([*plane.normal, plane.offset])
    first, jacobian_of, second = mujoco.mj_step1, mujoco.mj_jacSite, mujoco.mj_step2

    def run() -> tuple[float, Array]:
        mujoco.mj_resetData(compiled, data)
        data.qpos[:], data.qvel[:] = problem.q, problem.v
        rows, jacobian, A = np.zeros((steps, 4 * n + 9)), np.zeros((3, n)), np.zeros((1, n))
        fixed = (
            h, surface, problem.settings, problem.gains, problem.path, data.qpos, data.qvel, data.qfrc_bias,
            jacobian, data.site_xpos[site], data.qacc, data.qfrc_constraint, data.qfrc_applied, A, rows,
        )  # fmt: skip
        began = time.perf_counter()
        for i in range(steps):
            first(compiled, data)
            jacobian_of(compiled, data, jacobian, None, site)
            _drive(i, *fixed)
            second(compiled, data)
        return (time.perf_counter() - began) / steps, rows

    return run


def cold_start(arguments: list[str], repeats: int) -> float:
    """Return the median seconds of ``python -m closedloop.run`` with these arguments, process start included."""
    seconds = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "closedloop.run", SCENARIO, "--out", folder, *arguments]
            began = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=Path.cwd())
            seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def measure(repeats: int, cold: bool) -> dict[str, Any]:
    """Run every contestant `repeats` times, interleaved, and return medians, seconds, and ratios."""
    problem = cl.prepare(cl.load_scenario(SCENARIO))
    contestants: dict[str, Callable[[], float]] = {
        "closedloop": lambda: closed_loop(problem),
        "pinocchio_calls": lambda: bare_calls(problem),
    }
    missing = {}
    checks: dict[str, float] = {}
    if find_spec("mujoco") is None:
        missing["mujoco"] = 'not installed: pip install "closedloop[peers]"'
    else:
        slide = mujoco_loop(problem)
        _, rows = slide()  # compiles the driver
        checks["mujoco_force_at_end"] = float(rows[-2, 4 * problem.robot.n + 6])
        contestants["mujoco"] = lambda: slide()[0]
    closed_loop(problem)
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(repeats):
        for name, contestant in contestants.items():
            times[name].append(contestant())
    medians = {name: statistics.median(values) for name, values in times.items()}
    ratios = {"closedloop/pinocchio_calls": medians["closedloop"] / medians["pinocchio_calls"]}
    if "mujoco" in medians:
        ratios["closedloop/mujoco"] = medians["closedloop"] / medians["mujoco"]
    result: dict[str, Any] = {
        "scenario": SCENARIO,
        "repeats": repeats,
        "seconds_per_step": medians,
        "ratios": ratios,
        "missing": missing,
        "checks": checks,
    }
    if cold:
        result["cold_start_seconds"] = {
            "no_figures": cold_start(["--no-figures"], 3),
            "with_figures": cold_start([], 3),
        }
    return result


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print a table, or JSON with --json."""
    parser = argparse.ArgumentParser(prog="python -m validation.speed", description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9, help="runs of each contestant, interleaved (default 9)")
    parser.add_argument("--no-cold-start", action="store_true", help="leave out the start of whole processes")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args(arguments)
    if options.repeats < 1:
        parser.error("--repeats must be at least 1")
    result = measure(options.repeats, not options.no_cold_start)
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        _print_table(result)
    return 0


def _print_table(result: dict[str, Any]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    titles = {
        "closedloop": "closedloop: law, terms, Eq. 24, integration, recording",
        "mujoco": "MuJoCo, same slide and law, driven from Python, recording",
        "pinocchio_calls": "Pinocchio's calls of a closedloop step alone",
    }
    ours = result["seconds_per_step"]["closedloop"]
    table = Table(box=box.SIMPLE_HEAD, title=f"one step of {result['scenario']}, median of {result['repeats']}")
    for column, justify in (("what", "left"), ("µs a step", "right"), ("closedloop / this", "right")):
        table.add_column(column, justify=justify)  # type: ignore[arg-type]
    for name, seconds in sorted(result["seconds_per_step"].items(), key=lambda item: item[1]):
        table.add_row(titles[name], f"{1e6 * seconds:.2f}", f"{ours / seconds:.2f}")
    console = Console(highlight=False)
    console.print(table)
    for name, reason in result["missing"].items():
        console.print(f"{name}: {reason}")
    for name, seconds in result.get("cold_start_seconds", {}).items():
        command = f"python -m closedloop.run {result['scenario']}"
        console.print(f"{command}, {name.replace('_', ' ')}: {seconds:.2f} s from a cold start")


if __name__ == "__main__":
    sys.exit(main())
