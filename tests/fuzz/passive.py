"""Bodies of every shape that fall on a floor at rest, with nothing that drives them: their energy never grows.

    PYTHONPATH=.:tests/fuzz python tests/fuzz/passive.py --count 1000 --seed 0

Cans and coins near their ends, boxes and balls; rigid and soft, with restitution, friction and
resistances to rolling and pivoting; any integrator. Of each it says if its run stopped, if its energy grew by more than
a share of what it lost, and if its verdict is good all the same.
"""

import argparse
import time
from collections import Counter
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.mechanics.integrators import ADAPTIVE

SHAPES = ("can", "coin", "box", "ball")
INTEGRATORS = ("rk4", "semi_implicit_euler", "explicit_euler", "dop853", "time_stepping")
# The share of the energy by which it grows at most; and a step so many times finer, of which it is an error or not.
RISE, FINER = 1e-3, 4


def draw(seed: int, shapes: tuple[str, ...] = SHAPES, integrators: tuple[str, ...] = INTEGRATORS) -> dict[str, Any]:
    """Return a scenario."""
    rng = np.random.default_rng(seed)
    kind, integrator = (str(rng.choice(names)) for names in (shapes, integrators))
    turn, body = rng.normal(size=4), {"name": "body", "mass": float(10 ** rng.uniform(-1.5, 0.7))}
    if kind in ("can", "coin"):
        radius = rng.uniform(0.02, 0.08)
        length = radius * (rng.uniform(0.5, 4.0) if kind == "can" else rng.uniform(0.03, 0.3))
        body |= {"shape": "cylinder", "radius": float(radius), "length": float(length)}
        low = float(np.hypot(radius, 0.5 * length))
        if rng.random() < 0.7:  # on its end, or nearly
            tilt, about = (10 ** rng.uniform(-4, 0) if rng.random() < 0.9 else 0.0), rng.uniform(0, 2 * np.pi)
            turn = np.array([np.cos(tilt / 2), *(np.sin(tilt / 2) * np.array([np.cos(about), np.sin(about), 0.0]))])
            low = 0.5 * length * np.cos(tilt) + radius * np.sin(tilt)
    elif kind == "box":
        edges = rng.uniform(0.03, 0.15, 3)
        body, low = body | {"shape": "box", "edges": edges.tolist()}, 0.5 * float(np.linalg.norm(edges))
    else:
        radius = float(rng.uniform(0.02, 0.08))
        body, low = body | {"shape": "ball", "radius": radius}, radius
    body["quaternion"] = (turn / np.linalg.norm(turn)).tolist()
    body["position"] = [0.0, 0.0, float(low + 10 ** rng.uniform(-5, -1.3))]
    if rng.random() < 0.6:
        body["spin"] = (rng.normal(size=3) * 10 ** rng.uniform(-2, 1)).tolist()
        body["velocity"] = (rng.normal(size=3) * 10 ** rng.uniform(-2, -0.3)).tolist()
    contact = {"link": "body", "at": "collision", "friction": float(rng.choice([0, 0.1, 0.3, 0.8, 1.5]))}
    contact["restitution"] = float(rng.choice([0, 0, 0, 0.3, 0.7]))
    if rng.random() < 0.2:
        stiffness, damping = float(10 ** rng.uniform(3, 4.5)), float(10 ** rng.uniform(0, 1.3))
        contact["compliance"] = {"kind": "kelvin_voigt", "stiffness": stiffness, "damping": damping}
    for key in ("rolling", "pivoting"):
        if rng.random() < 0.25:
            contact[key] = float(10 ** rng.uniform(-4, -2.3))
    step = float(rng.choice([5e-4, 1e-3, 2e-3])) if integrator != "dop853" else 0.01
    times = {"duration": round(0.5 / step) * step, "step": step, "integrator": integrator}
    stabiliser = {"kind": "baumgarte", "time_constant": 0.01}
    return {"robot": {"model": "none"}, "body": [body], "contact": [contact], "stabiliser": stabiliser, "time": times}


def simulated(scenario: dict[str, Any]) -> tuple[Any, np.ndarray, dict[str, float]]:
    """Return the run of a scenario, or what there is of one that stopped, its energy (N,), J, and whether it did."""
    wrong = {}
    try:
        run = cl.simulate(cl.Scenario.model_validate(scenario), progress=False)
    except cl.SimulationError as error:
        run, wrong["stopped"] = error.run, 1.0
    return run, run.kinetic_energy + run.potential_energy, wrong


def examine(scenario: dict[str, Any]) -> tuple[Any, dict[str, float]]:
    """Return the run of a scenario, and what is wrong with it, by name, and how much.

    Of a good run a rise that is an error of the step, as the verdict's bound allows, becomes less with the step.
    """
    run, energy, wrong = simulated(scenario)
    rise, times = rise_of(scenario, energy), scenario["time"]
    if rise > max(1e-6, RISE * (energy[0] - energy.min())):
        if not run.summary()["verdict"]["good"]:
            wrong["energy, said"] = rise
        elif times["integrator"] in ADAPTIVE or rise_of(
            scenario, simulated(scenario | {"time": times | {"step": times["step"] / FINER}})[1]
        ) > 2.0 * rise / FINER:  # fmt: skip
            wrong["energy"] = rise
        else:
            wrong["energy, by the step"] = rise
    return run, wrong


def rise_of(scenario: dict[str, Any], energy: np.ndarray) -> float:
    """Return by how much the energy (N,) of a run rises, J: above its least before, or, if it is stored, its start."""
    soft = "compliance" in scenario["contact"][0]
    return float(np.max(energy - (energy[0] if soft else np.minimum.accumulate(energy))))


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shapes", nargs="*", default=SHAPES)
    parser.add_argument("--integrators", nargs="*", default=INTEGRATORS)
    args = parser.parse_args()
    counts: Counter[str] = Counter()
    for seed in range(args.seed, args.seed + args.count):
        scenario = draw(seed, tuple(args.shapes), tuple(args.integrators))
        since = time.process_time()
        run, wrong = examine(scenario)
        seconds = time.process_time() - since
        counts.update(list(wrong))
        if wrong or seconds > 20.0:
            times = scenario["time"]
            print(
                f"{seed}: {times['integrator']} {times['step']:g} s, {seconds:.1f} s, {len(run.events)} events", wrong
            )
    print(dict(counts))


if __name__ == "__main__":
    main()
