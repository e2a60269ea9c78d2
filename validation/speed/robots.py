"""Robots that are put down, by time stepping, beside MuJoCo's bare ``mj_step``: a car, and a quadruped.

The car coasts on four cylinders. The quadruped is the shipped one with springs and dampers in its joints; a ball lies
beside it. Both engines read one MJCF file and take steps of a millisecond; ours records all columns.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import closedloop as cl
import robot_models
from closedloop.scenario.load import SHIPPED
from validation.oracle.spatial import Array
from validation.speed.contestants import CONES, Contestant, lap_of, mj_step_with

ROBOTS = ("car", "quadruped")
STEPS, STEP, FRICTION, ABOVE = 1000, 1e-3, 0.6, 0.02
# How far apart the engines may end, m: MuJoCo's contacts give way, and let the car roll on a little farther.
GIVES_WAY = 0.02
TOUCHES = f'contype="1" condim="3" friction="{FRICTION} 0 0"'
WHEELS = {"rear_left": (-0.25, 0.2), "rear_right": (-0.25, -0.2), "left": (0.25, 0.2), "right": (0.25, -0.2)}
LEGS = ("front_left", "front_right", "hind_left", "hind_right")
BENT = (0.0, -0.7091, 1.6)  # abduction, hip and knee of a leg, rad


def xml_of(name: str) -> str:
    """Return a robot as MJCF: only wheels, feet and the ball touch."""
    if name == "quadruped":
        text = (SHIPPED / "bodies" / "quadruped.xml").read_text()
        for joint, bent in zip(("60 60", "180 180", "160 160"), BENT, strict=True):
            spring = f'stiffness="60" damping="2" springref="{np.degrees(bent):.17g}"'
            text = text.replace(f'range="-{joint}"', f'range="-{joint}" {spring}')
        text = text.replace("<default>", '<default><geom contype="0" conaffinity="0"/>', 1)
        return text.replace('type="sphere"', f'type="sphere" {TOUCHES}')
    wheels = "".join(
        f'<body name="{wheel}" pos="{x} {y} 0"><joint name="{wheel}" type="hinge" axis="0 1 0"/>'
        f'<geom type="cylinder" euler="90 0 0" size="0.1 0.025" mass="0.5" {TOUCHES} conaffinity="0"/></body>'
        for wheel, (x, y) in WHEELS.items()
    )
    body = '<inertial pos="0 0 0.05" mass="10" diaginertia="0.2 0.4 0.5"/>'
    car = f'<body name="car" pos="0 0 {0.1 + ABOVE}"><freejoint name="car"/>{body}{wheels}</body>'
    return f'<mujoco model="car"><default/><worldbody>{car}</worldbody></mujoco>'


def start_of(name: str) -> tuple[list[float], Array]:
    """Return q of the joints that turn, rad, and v of all, m/s and rad/s."""
    if name == "quadruped":
        return [*BENT * 4], np.zeros(24)
    v = np.zeros(10)
    v[0], v[6:] = 2.0, 20.0
    return [0.0] * 4, v


def scenario_of(name: str) -> cl.Scenario:
    """Return the scenario of a robot, whose model comes from `xml_of`."""
    foot = {"at": [0.0, 0.0, -0.175], "radius": 0.0175}
    touch: list[dict[str, Any]] = [{"link": wheel, "at": "collision"} for wheel in WHEELS]
    if name == "quadruped":
        touch = [{"link": f"{leg}_shank"} | foot for leg in LEGS]
        touch.append({"link": "ball", "at": [0.0, 0.0, 0.0], "radius": 0.05})
    return cl.Scenario.model_validate({
        "robot": {"model": "planar2", "friction": name == "quadruped"},  # another model takes its place
        "contact": [each | {"friction": FRICTION} for each in touch],
        "surface": {"kind": "none"}, "start": {"q": start_of(name)[0], "v": start_of(name)[1].tolist()},
        "time": {"duration": STEPS * STEP, "step": STEP, "integrator": "time_stepping"},
    })  # fmt: skip


def ours(name: str) -> Contestant:
    """Return time stepping in our compiled engine."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.xml"
        file.write_text(xml_of(name))
        problem = cl.prepare(scenario_of(name), robot_models.load(file))

    lap = lap_of(problem, entries=3)
    return Contestant("compiled", name, problem.robot.n, STEPS, lap, lap()[1], 1e-9, "time stepping")


def bare(name: str, joints: int, cone: str, ends: Array | None) -> Contestant:
    """Return ``mj_step`` alone, all steps in one call; it ends near where ours does."""
    import mujoco

    floor = f'<worldbody><geom type="plane" size="0 0 1" {TOUCHES} conaffinity="1"/>'
    option = f'<option timestep="{STEP}" cone="{cone}"/>'
    text = xml_of(name).replace("<worldbody>", floor).replace("<default>", f"{option}<default>", 1)
    made = mujoco.MjModel.from_xml_string(text.replace("<default/>", option))
    data: Any = mujoco.MjData(made)
    turned, v = start_of(name)

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(made, data)
        data.qpos[7 : 7 + len(turned)], data.qvel[:] = turned, v
        mujoco.mj_step(made, data, STEPS)
        return None, data.qpos[:3].copy()

    called, what = mj_step_with(cone)
    return Contestant(called, name, joints, STEPS, lap, ends, GIVES_WAY, what)


def of_robot(name: str, with_mujoco: bool) -> list[Contestant]:
    """Return everyone who puts down one of `ROBOTS`."""
    one = ours(name)
    return [one, *(bare(name, one.joints, cone, one.wanted) for cone in CONES if with_mujoco)]
