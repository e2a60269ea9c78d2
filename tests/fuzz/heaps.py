"""Boxes, balls and cylinders dropped on each other and a floor: whether they come to rest.

    PYTHONPATH=.:tests/fuzz python tests/fuzz/heaps.py --count 200 --seed 0 [--integrator rk4]

Of each heap it says if its run stopped, if its energy grew by more than a share of what is lost, how deep something
sank, as a share of the smallest body's size, and what still moves at the end though it does not roll.
Cylinders touch the floor alone.
"""

import argparse
import time
from collections import Counter
from typing import Any

import numpy as np
from passive import simulated

# The share of the lost energy by which it grows at most; of a body's size it sinks at most; m/s at rest.
RISE, SUNK, REST = 1e-3, 1e-2, 1e-3


def draw(seed: int, duration: float = 2.0, integrator: str = "time_stepping") -> dict[str, Any]:
    """Return a scenario."""
    rng = np.random.default_rng(seed)
    bodies: list[dict[str, Any]] = []
    common = {"at": "collision", "friction": float(rng.uniform(0.1, 1.0)), "restitution": float(rng.choice([0.0, 0.3]))}
    height, contacts = 0.0, []
    for i in range(int(rng.integers(2, 7))):
        kind, turn = str(rng.choice(["box", "ball", "cylinder"])), rng.normal(size=4)
        body: dict[str, Any] = {"name": f"b{i}", "shape": kind, "mass": float(10 ** rng.uniform(-1, 0.5))}
        size = rng.uniform(0.04, 0.1, 3)
        if kind == "box":
            body["edges"], reach = size.tolist(), 0.5 * float(np.linalg.norm(size))
        elif kind == "ball":
            body["radius"] = reach = 0.5 * float(size[0])
        else:
            body |= {"radius": 0.5 * float(size[0]), "length": float(size[1])}
            reach = 0.5 * float(np.hypot(size[0], size[1]))
        body["quaternion"] = (turn / np.linalg.norm(turn)).tolist()
        body["position"] = [*rng.uniform(-0.04, 0.04, 2).tolist(), height + reach + 0.01]
        height += 2.0 * reach + 0.01
        contacts.append(common | {"link": body["name"]})
        for other in bodies if kind != "cylinder" else []:
            if other["shape"] != "cylinder":
                contacts.append(common | {"link": body["name"], "against": other["name"], "onto": "collision"})
        bodies.append(body)
    step = float(rng.choice([5e-4, 1e-3, 2e-3, 5e-3]))
    times = {"duration": round(duration / step) * step, "step": step, "integrator": integrator}
    return {
        "robot": {"model": "none"}, "body": bodies, "contact": contacts,
        "surface": {"kind": "none", "contact": "unilateral"}, "time": times,
    }  # fmt: skip


def smallest(body: dict[str, Any]) -> float:
    """Return the smallest size of a body, m."""
    return float(min([*body.get("edges", []), 2.0 * body.get("radius", np.inf), body.get("length", np.inf)]))


def examine(scenario: dict[str, Any]) -> tuple[Any, dict[str, float]]:
    """Return the run of a scenario, and what is wrong with it, by name, and how much."""
    run, energy, wrong = simulated(scenario)
    share = float(np.max(energy - np.minimum.accumulate(energy)) / max(energy[0] - energy.min(), 1e-9))
    low = [np.inf if body["shape"] != "ball" else body["radius"] for body in scenario["body"]]
    size = min(smallest(body) for body in scenario["body"])
    # Only a contact that presses says how deep bodies are in each other: others may be beside their surface.
    deep = float(np.max(np.where(run.link_forces > 0.0, -run.link_gaps, 0.0), initial=0.0)) / size
    for j, radius in enumerate(low):
        if radius < np.inf:
            deep = max(deep, float(np.max(radius - run.q[:, 7 * j + 2])) / size)
    v = run.v[-1].reshape(-1, 6)
    moving = [
        float(np.max(np.abs(each))) for each, body in zip(v, scenario["body"], strict=True) if body["shape"] == "box"
    ]
    for name, value, most in (
        ("energy", share, RISE), ("sunk", deep, SUNK), ("a box moves", max(moving, default=0.0), REST),
    ):  # fmt: skip
        if value > most:
            wrong[name] = value
    return run, wrong


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--integrator", default="time_stepping")
    args = parser.parse_args()
    counts: Counter[str] = Counter()
    for seed in range(args.seed, args.seed + args.count):
        scenario, since = draw(seed, integrator=args.integrator), time.process_time()
        _, wrong = examine(scenario)
        counts.update(list(wrong))
        if wrong:
            times, contact = scenario["time"], scenario["contact"][0]
            shapes = " ".join(body["shape"] for body in scenario["body"])
            said = {name: f"{value:.2g}" for name, value in wrong.items()}
            what = f"{times['step']:g} s, mu {contact['friction']:.2f}, e {contact['restitution']:g}"
            print(f"{seed}: {shapes}, {what}, {time.process_time() - since:.1f} s", said, flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
