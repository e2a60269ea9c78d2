"""Free bodies: a tossed cube, and towers of two to ten boxes at rest, ours beside MuJoCo's bare ``mj_step``.

All take steps of a millisecond, with the same bodies, friction and start; ours records all columns, once with located
events, and once by time stepping, which is a scheme like MuJoCo's. In MuJoCo the bodies are boxes, in ours their
corners. MuJoCo's contacts give way and have no restitution: its cube ends elsewhere, at rest on the floor as ours does.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import closedloop as cl
import robot_models
from closedloop.scenario.load import load_scenario, parse_scenario
from closedloop.simulation.engines.problem import Problem
from validation.oracle.spatial import Array
from validation.speed.contestants import CONES, Contestant, lap_of, mj_step_with

CUBE, HEIGHTS = "cube_toss", (2, 5, 10)
TOWERS = tuple(f"tower_{n}" for n in HEIGHTS)
BODIES = (CUBE, *TOWERS)
STEPS, STEP, HALF, FRICTION = 1000, 1e-3, 0.05, 0.5
# How far from where it stood a tower of soft contacts may be, m, and from where the cube ended another cube.
GIVES_WAY, ANYWHERE = 0.01, 10.0
CHANGES = {"time.integrator": "semi_implicit_euler", "time.step": STEP, "time.duration": STEPS * STEP}
SURFACE = f'condim="3" friction="{FRICTION} 0 0"'


def boxes_xml(n: int) -> str:
    """Return n boxes of 1 kg, one upon the other, as MJCF."""
    geom = f'<freejoint/><geom type="box" size="{HALF} {HALF} {HALF}" mass="1" {SURFACE}/>'
    return "".join(f'<body name="box{i + 1}" pos="0 0 {HALF * (1 + 2 * i)}">{geom}</body>' for i in range(n))


def world_xml(bodies: str, surface: str, cone: str) -> str:
    """Return a model of MuJoCo: a floor and bodies, and which cones of friction they have."""
    return (
        f'<mujoco><option timestep="{STEP}" cone="{cone}"/><worldbody><geom type="plane" size="0 0 1" {surface}/>'
        f"{bodies}</worldbody></mujoco>"
    )


def tower(n: int) -> Problem:
    """Return a tower of n boxes at rest, for a second: each stands on the one below by four corners."""
    xml = f'<mujoco model="tower"><worldbody>{boxes_xml(n)}</worldbody></mujoco>'
    with TemporaryDirectory() as folder:
        file = Path(folder) / "tower.xml"
        file.write_text(xml)
        model = robot_models.load(file)
    corners = [[x * HALF, y * HALF, -HALF] for x in (-1, 1) for y in (-1, 1)]
    text = ["[robot]", 'model = "planar2"', "[stabiliser]", "time_constant = 0.01", "[time]"]
    text += [f"duration = {STEPS * STEP}", f"step = {STEP}", 'integrator = "semi_implicit_euler"']
    for i in range(n):
        text += ["[[contact]]", f'link = "box{i + 1}"', f"at = {corners}", f"friction = {FRICTION}"]
        text += [f'against = "{f"box{i}" if i else "world"}"', f"through = {[0.0, 0.0, HALF if i else 0.0]}"]
    return cl.prepare(parse_scenario("\n".join(text)), model)


def problem_of(name: str) -> Problem:
    """Return the problem of one of `BODIES`."""
    return cl.prepare(load_scenario(CUBE, CHANGES)) if name == CUBE else tower(int(name.removeprefix("tower_")))


def ours(name: str, by: str) -> Contestant:
    """Return our compiled engine, "compiled" with events or by "time_stepping"."""
    problem = problem_of(name)
    if by != "compiled":
        problem = cl.prepare(problem.scenario.replace({"time.integrator": by}), problem.robot.model)

    lap = lap_of(problem)
    end = lap()[1]
    rests = None if name == CUBE else problem.q
    what = "compiled engine" if by == "compiled" else "time stepping"
    return Contestant(by, name, problem.robot.n, STEPS, lap, end, 1e-9, what, rests)


def bare(name: str, joints: int, cone: str) -> Contestant:
    """Return ``mj_step`` alone, all steps in one call."""
    import mujoco

    if name == CUBE:
        scenario = load_scenario(CUBE)
        assert scenario.contact is not None  # a cube whose corners touch
        mu = scenario.contact[0].friction
        cube = '<body><freejoint/><inertial pos="0 0 0" mass="0.37" diaginertia="8.1e-4 8.1e-4 8.1e-4"/>'
        surface = f'condim="3" friction="{mu} 0 0"'
        cube += f'<geom type="box" size="0.0524 0.0524 0.0524" {surface}/></body>'
        made = mujoco.MjModel.from_xml_string(world_xml(cube, surface, cone))
        q, v = np.array(scenario.start.q), np.array(scenario.start.v)
        q[3:] /= np.linalg.norm(q[3:])
    else:
        made = mujoco.MjModel.from_xml_string(world_xml(boxes_xml(int(name.removeprefix("tower_"))), SURFACE, cone))
        q, v = made.qpos0.copy(), np.zeros(made.nv)
    data: Any = mujoco.MjData(made)

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(made, data)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_step(made, data, STEPS)
        height = 4 if name == CUBE else 4 * (len(q) // 7)
        if data.ncon != height:
            raise RuntimeError(f"MuJoCo ended with {data.ncon} contacts, where {height} are wanted")
        return None, data.qpos.copy()

    apart = ANYWHERE if name == CUBE else GIVES_WAY
    called, what = mj_step_with(cone)
    return Contestant(called, name, joints, STEPS, lap, q, apart, what, None if name == CUBE else q)


def of_bodies(name: str, with_mujoco: bool) -> list[Contestant]:
    """Return everyone who moves the bodies of one of `BODIES`."""
    own = [ours(name, by) for by in ("compiled", "time_stepping")]
    return [*own, *(bare(name, own[0].joints, cone) for cone in CONES if with_mujoco)]
