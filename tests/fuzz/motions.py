"""Random bodies on random joints fall on a floor and on each other: whether the motion goes on, and keeps its laws.

    PYTHONPATH=.:tests/closedloop:tests/fuzz python tests/fuzz/motions.py --count 1000 --seed 0

Two to six bodies in a tree, which hangs on the world by a revolute joint or moves on three prismatic and three revolute
ones, with two to twenty contacts of their points against the floor, and of some against planes of other bodies.
"""

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from boxes import any_rotation, no_torque
from drops import examine, judge, ran

import closedloop as cl
import robot_models


def inertia_text(rng: np.random.Generator, mass: float, size: float) -> str:
    """Return the inertial of a body of this size, m: a box of random sides, its centre anywhere within."""
    sides = size * rng.uniform(0.3, 1.0, size=3)
    xx, yy, zz = (mass / 12.0 * (np.sum(sides * sides) - side * side) for side in sides)
    x, y, z = rng.uniform(-0.3, 0.3, size=3) * size
    return (
        f'<inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def joint_text(name: str, kind: str, parent: str, child: str, at: Any, axis: Any) -> str:
    """Return a joint as URDF."""
    limit = '<limit lower="-1000" upper="1000" velocity="1e4" effort="1e6"/>' if kind == "prismatic" else ""
    place, along = (" ".join(f"{x:.17g}" for x in numbers) for numbers in (at, axis))
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}"/><axis xyz="{along}"/>{limit}</joint>'
    )


def draw(seed: int, folder: Path) -> tuple[str, dict[str, Any]]:
    """Write the URDF of a motion; return the text of its scenario, and what else is known of it."""
    rng = np.random.default_rng(seed)
    bodies, floats = int(rng.integers(2, 7)), bool(rng.random() < 0.5)
    parts, q, parents = ['<link name="base"/>'], [], []
    before = "base"
    if floats:
        moves = [("prismatic", axis) for axis in np.eye(3)] + [("continuous", axis) for axis in np.eye(3)[:2]]
        for i, (kind, axis) in enumerate(moves):
            parts += [f'<link name="m{i}"/>', joint_text(f"f{i}", kind, before, f"m{i}", (0, 0, 0), axis)]
            before = f"m{i}"
        x, y, z = any_rotation(rng)
        q += [0.0, 0.0, 0.0, x, float(np.clip(y, -1.2, 1.2)), z]
    for i in range(bodies):
        parent = before if i == 0 else f"b{int(rng.integers(max(0, i - 2), i))}"
        axis = np.eye(3)[2] if i == 0 and floats else rng.normal(size=3)
        kind = "prismatic" if i > 0 and rng.random() < 0.15 else "continuous"
        at = np.zeros(3) if i == 0 else rng.uniform(-0.2, 0.2, size=3)
        parts.append(f'<link name="b{i}">{inertia_text(rng, float(10 ** rng.uniform(-0.7, 0.7)), 0.3)}</link>')
        parts.append(joint_text(f"j{i}", kind, parent, f"b{i}", at, axis / np.linalg.norm(axis)))
        parents.append(parent)
        if not (i == 0 and floats):
            q.append(float(rng.uniform(-1.5, 1.5)) if kind == "continuous" else float(rng.uniform(-0.05, 0.05)))
    parts.append('<link name="tip"/><joint name="t" type="fixed"><parent link="b0"/><child link="tip"/></joint>')
    (folder / "motion.urdf").write_text(f'<robot name="motion">{"".join(parts)}</robot>')
    contacts = []
    for _ in range(int(rng.integers(2, 21))):
        link = int(rng.integers(0, bodies))
        other, normal, against = int(rng.integers(0, bodies)), (0.0, 0.0, 1.0), "world"
        if other != link and rng.random() < 0.25:
            drawn = rng.normal(size=3)
            against, normal = f"b{other}", tuple((drawn / np.linalg.norm(drawn)).tolist())
        contacts.append((link, rng.uniform(-0.15, 0.15, size=3), against, normal))
    mu = rng.choice([0.0, 0.3, 1.0, rng.uniform()], size=len(contacts))
    e = rng.choice([0.0, 0.0, rng.uniform(0.0, 0.9)]) * np.ones(len(contacts))
    model = str(folder / "motion.urdf")
    text = ["[robot]", f'model = "{model}"', 'tip = "tip"', "[surface]", "gap = 100.0", 'contact = "unilateral"']
    text += ["[law]", "kp = 0", "kd = 0", "force = 0", "[stabiliser]", "time_constant = 0.01"]
    text += ["[time]", "duration = 1.0", "step = 0.001", 'integrator = "rk4"']
    # The floor is as far below the lowest point as a random drop, or one point of it touches.
    robot = cl.Robot(robot_models.load(model), tip="tip")
    lowest = min(float(place_of(robot, np.array(q), f"b{link}", at)[2]) for link, at, *_ in contacts)
    floor = lowest - (float(10 ** rng.uniform(-4, -0.7)) if rng.random() < 0.8 else 0.0)
    v = rng.normal(size=len(q)) * rng.choice([0.0, 0.3, 1.0, 2.0])
    text += ["[start]", f"q = {q}", f"v = {v.tolist()}"]
    for (link, at, against, normal), rub, bounce in zip(contacts, mu, e, strict=True):
        text += ["[[contact]]", f'link = "b{link}"', f"at = {at.tolist()}", f'against = "{against}"']
        through = (
            [0.0, 0.0, floor]
            if against == "world"
            else beyond(robot, np.array(q), f"b{link}", at, against, normal, rng)
        )
        text += [f"normal = {list(normal)}", f"through = {through}"]
        text += [f"friction = {float(rub)}", f"restitution = {float(bounce)}"]
    return "\n".join(text) + "\n", {"mu": mu, "bodies": bodies, "floats": floats, "contacts": len(contacts)}


def place_of(robot: Any, q: np.ndarray, frame: str, at: np.ndarray) -> np.ndarray:
    """Return where a point of a frame is, m, base axes."""
    _, rotation, origin = robot.frame_at(frame, q)
    return np.asarray(origin + rotation @ at)


def beyond(robot: Any, q: np.ndarray, frame: str, at: np.ndarray, other: str, normal: Any, rng: Any) -> list[float]:
    """Return a point of a plane of another frame with this normal, which a point of a frame is a random way off."""
    _, rotation, origin = robot.frame_at(other, q)
    within = rotation.T @ (place_of(robot, q, frame, at) - origin)
    return list(map(float, within - np.array(normal) * 10 ** rng.uniform(-3, -0.7)))


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after so many")
    parser.add_argument("--integrator", default="rk4")
    args = parser.parse_args()
    counts: Counter[str] = Counter()
    begin, done = time.time(), 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(args.seed, args.seed + args.count):
            if time.time() - begin > args.seconds:
                break
            text, known = draw(seed, Path(folder))
            (Path(folder) / "scenario.toml").write_text(text)
            path = str(Path(folder) / "scenario.toml")
            since, how = time.process_time(), {"law": no_torque, "engine": "compiled"}

            def simulate(finer: dict[str, Any], path: str = path, how: Any = how) -> tuple[Any, str]:
                return ran(cl.simulate, cl.load_scenario(path, {"time.integrator": args.integrator} | finer), **how)

            run, failure = simulate({})
            seconds, done = time.process_time() - since, done + 1
            wrong = judge(examine(run, known["mu"], rests=False), lambda finer: simulate(finer)[0], known["mu"])
            counts.update([*wrong, *([failure.split(":")[0]] if failure else [])])
            steps = sum(event.kind == "time_step" for event in run.events)
            counts["time steps"] += steps
            if wrong or failure:
                said = " ".join(f"{name} {value:.2g}" for name, value in wrong.items())
                what = f"bodies {known['bodies']} contacts {known['contacts']} floats {known['floats']}"
                print(
                    f"{seed} {what} events {len(run.events)} steps {steps} {seconds:.2f} s: {said} {failure[:140]}",
                    flush=True,
                )
    print(f"{done} motions, {time.time() - begin:.0f} s:", dict(counts))


if __name__ == "__main__":
    main()
