"""Scenes of many contacts, by time stepping, beside MuJoCo's bare ``mj_step``: stacks, dominoes, a can, a bin of boxes.

Both take steps of a millisecond with the same bodies, friction and start; ours records all columns. Bodies that fall
end elsewhere in each: what they come to is compared by its height alone.
"""

from typing import Any

import numpy as np

import closedloop as cl
from validation.oracle.spatial import Array
from validation.speed.contestants import CONES, Contestant, lap_of, mj_step_with

SCENES = ("stack_3", "dominoes", "can", "bin_4", "bin_8", "bin_20")
STEPS, STEP, FRICTION, WALL = 1500, 1e-3, 0.5, 0.15
FLOOR = ([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
# How far the middle of a body may be from where it is in ours, m: where it falls its end is another.
ANYWHERE = 10.0


def bodies_of(name: str) -> tuple[list[dict[str, Any]], list[tuple[int, int]]]:
    """Return the sections [[body]] of a scene, and which of them may touch each other."""
    if name == "stack_3":
        boxes = [_box(i, (0.1, 0.1, 0.1), [0.0, 0.0, 0.05 + 0.1 * i + 0.002 * (i + 1)]) for i in range(3)]
        return boxes, [(0, 1), (1, 2)]
    if name == "dominoes":
        boxes = [_box(i, (0.024, 0.1, 0.2), [0.06 * i, 0.0, 0.1], mass=0.2) for i in range(5)]
        boxes[0]["spin"] = [0.0, 5.0, 0.0]
        return boxes, [(i, i + 1) for i in range(4)]
    if name == "can":
        can = {"name": "body0", "shape": "cylinder", "radius": 0.033, "length": 0.12, "mass": 0.35}
        turned = [float(np.cos(0.15)), float(np.sin(0.15)), 0.0, 0.0]
        return [can | {"position": [0.0, 0.0, 0.12], "quaternion": turned, "velocity": [0.2, 0.0, 0.0]}], []
    count, rng, boxes = int(name.removeprefix("bin_")), np.random.default_rng(0), []
    for i in range(count):
        turn = rng.normal(size=4)
        place = [*rng.uniform(-0.06, 0.06, size=2).tolist(), 0.12 + 0.13 * i]
        boxes.append(_box(i, (0.06, 0.08, 0.1), place) | {"quaternion": (turn / np.linalg.norm(turn)).tolist()})
    return boxes, [(j, i) for i in range(count) for j in range(i)]


def _box(i: int, edges: tuple[float, ...], position: list[float], mass: float = 1.0) -> dict[str, Any]:
    return {"name": f"body{i}", "shape": "box", "edges": list(edges), "mass": mass, "position": position}


def planes_of(name: str) -> list[tuple[list[float], list[float]]]:
    """Return normal and a point of the floor, and of the walls of a bin."""
    sides = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)) if name.startswith("bin") else ()
    return [FLOOR, *(([x, y, 0.0], [-WALL * x, -WALL * y, 0.0]) for x, y in sides)]


def scenario_of(name: str, integrator: str = "time_stepping") -> cl.Scenario:
    """Return the scenario of a scene."""
    bodies, pairs = bodies_of(name)
    usual = {"at": "collision", "friction": FRICTION}
    contact = [usual | {"link": b["name"], "normal": n, "through": p} for b in bodies for n, p in planes_of(name)]
    for i, j in pairs:
        contact.append(usual | {"link": bodies[j]["name"], "against": bodies[i]["name"], "onto": "collision"})
    return cl.Scenario.model_validate({
        "robot": {"model": "none"}, "body": bodies, "contact": contact,
        "surface": {"kind": "none", "contact": "unilateral"},
        "time": {"duration": STEPS * STEP, "step": STEP, "integrator": integrator},
    })  # fmt: skip


def ours(name: str) -> Contestant:
    """Return time stepping in our compiled engine."""
    problem = cl.prepare(scenario_of(name))

    lap = lap_of(problem)
    return Contestant("compiled", name, problem.robot.n, STEPS, lap, lap()[1], 1e-9, "time stepping")


def bare(name: str, joints: int, cone: str) -> Contestant:
    """Return ``mj_step`` alone, all steps in one call."""
    import mujoco

    made = mujoco.MjModel.from_xml_string(_xml(name, cone))
    data: Any = mujoco.MjData(made)
    v = np.concatenate([[*b.get("velocity", (0, 0, 0)), *b.get("spin", (0, 0, 0))] for b in bodies_of(name)[0]])

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(made, data)
        data.qvel[:] = v
        mujoco.mj_step(made, data, STEPS)
        return None, data.qpos.copy()

    called, what = mj_step_with(cone)
    return Contestant(called, name, joints, STEPS, lap, made.qpos0.copy(), ANYWHERE, what)


def _xml(name: str, cone: str) -> str:
    def words(numbers: Any) -> str:
        return " ".join(f"{x:.17g}" for x in numbers)

    surface, parts = f'condim="3" friction="{FRICTION} 0 0"', []
    for n, p in planes_of(name):
        parts.append(f'<geom type="plane" size="0 0 1" pos="{words(p)}" zaxis="{words(n)}" {surface}/>')
    for b in bodies_of(name)[0]:
        size = [0.5 * x for x in b["edges"]] if b["shape"] == "box" else [b["radius"], 0.5 * b["length"]]
        turned = words(b.get("quaternion", (1, 0, 0, 0)))
        geom = f'<geom type="{b["shape"]}" size="{words(size)}" mass="{b["mass"]}" {surface}/>'
        parts.append(f'<body pos="{words(b["position"])}" quat="{turned}"><freejoint/>{geom}</body>')
    return f'<mujoco><option timestep="{STEP}" cone="{cone}"/><worldbody>{"".join(parts)}</worldbody></mujoco>'


def of_scene(name: str, with_mujoco: bool) -> list[Contestant]:
    """Return everyone who moves the bodies of one of `SCENES`."""
    one = ours(name)
    return [one, *(bare(name, one.joints, cone) for cone in CONES)] if with_mujoco else [one]
