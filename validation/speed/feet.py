"""A box on four feet that slides and turns on a floor, or stands on it: ours beside MuJoCo's bare ``mj_step``.

The box is a body on three prismatic and three revolute joints, the feet are points of it; in MuJoCo they are spheres
of a millimetre with elliptic cones. Both take steps of a millisecond of their first-order scheme. Ours records all
columns, and its contacts are rigid; MuJoCo's give way: sliding, its box hops on them, and most of its steps have one
contact or none.
"""

from typing import Any

import numba
import numpy as np

import closedloop as cl
import robot_models
from closedloop.scenario.load import parse_scenario
from closedloop.simulation.engines.problem import Problem
from validation.oracle.spatial import Array
from validation.speed.contestants import CONES, Contestant, lap_of, mj_step_with, with_errors

BOXES = ("box_slides", "box_stands")
SLIDES, STANDS = BOXES
STEPS, STEP, RADIUS, FRICTION = 1000, 1e-3, 1e-3, 0.2
# How far apart may they end, m or rad: a soft contact creeps.
GIVES_WAY = 0.02
# Friction of a pyramid is not against the slip: the box slides along another line.
TURNED = 0.5
HALF = (0.1, 0.075, 0.05)
FEET = tuple((x * HALF[0], y * HALF[1], -HALF[2]) for x in (1, -1) for y in (1, -1))
INERTIA = tuple((sum(a * a for a in HALF) - a * a) / 3.0 for a in HALF)
START = {SLIDES: (3.0, 0.0, 0.0, 0.0, 0.0, 0.5), STANDS: (0.0,) * 6}


@numba.njit
def no_torque(x: Any, Q: Array) -> None:
    """Leave the joints to gravity and contact."""
    for j in range(Q.shape[0]):
        Q[j] = 0.0


def box_urdf() -> str:
    """Return the box of 1 kg on six joints, as URDF."""
    parts, parent = ['<link name="base"/>'], "base"
    limit = '<limit lower="-1000" upper="1000" velocity="1e4" effort="1e6"/>'
    moves = [(kind, axis) for kind in ("prismatic", "continuous") for axis in ("1 0 0", "0 1 0", "0 0 1")]
    x, y, z = INERTIA
    heavy = f'<inertial><mass value="1"/><inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>'
    for i, (kind, axis) in enumerate(moves):
        child = "box" if i == 5 else f"c{i}"
        parts.append(f'<link name="{child}">{heavy if i == 5 else ""}</link>')
        parts.append(
            f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
            f"{limit if i < 3 else ''}</joint>"
        )
        parent = child
    return f'<robot name="box">{"".join(parts)}</robot>'


def boxed(name: str) -> Problem:
    """Return the box of one of `BOXES`, for a second."""
    model = robot_models.from_text(
        box_urdf(), "urdf", name="box", armature=np.zeros(6), tip="box", home=np.zeros(6), locked={}
    )
    text = [
        "[robot]", 'model = "planar2"', 'tip = "box"', "[surface]", "gap = 100.0", 'contact = "unilateral"', "[law]",
        "kp = 0", "kd = 0", "force = 0", "[stabiliser]", "time_constant = 0.01", "[time]", f"duration = {STEPS * STEP}",
        f"step = {STEP}", 'integrator = "semi_implicit_euler"', "[start]", f"q = {[0.0, 0.0, HALF[2], 0.0, 0.0, 0.0]}",
        f"v = {list(START[name])}",
    ]  # fmt: skip
    for at in FEET:
        text += ["[[contact]]", 'link = "box"', f"at = {list(at)}", f"friction = {FRICTION}"]
    return cl.prepare(parse_scenario("\n".join(text)), model)


def ours(name: str, problem: Problem) -> Contestant:
    """Return our compiled engine, without torque in the joints."""

    lap = lap_of(problem, no_torque, entries=6)
    wanted = lap()[1]
    return Contestant("compiled", name, 6, STEPS, lap, wanted, 1e-11, "compiled engine")


def bare(name: str, wanted: Array, cone: str) -> Contestant:
    """Return ``mj_step`` alone, all steps in one call, with elliptic or pyramidal cones of friction."""
    import mujoco

    spheres = "".join(
        f'<geom type="sphere" size="{RADIUS}" pos="{x} {y} {z + RADIUS}" condim="3" friction="{FRICTION} 0 0"/>'
        for x, y, z in FEET
    )
    joints = "".join(
        f'<joint type="{kind}" axis="{axis}"/>' for kind in ("slide", "hinge") for axis in ("1 0 0", "0 1 0", "0 0 1")
    )
    made = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" cone="{cone}"/><worldbody>'
        f'<geom type="plane" size="0 0 1" condim="3" friction="{FRICTION} 0 0"/><body>{joints}'
        f'<inertial pos="0 0 0" mass="1" diaginertia="{" ".join(map(str, INERTIA))}"/>{spheres}</body>'
        "</worldbody></mujoco>"
    )
    data: Any = mujoco.MjData(made)

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(made, data)
        data.qpos[2], data.qvel[:] = HALF[2], START[name]
        mujoco.mj_step(made, data, STEPS)
        if name == STANDS and data.ncon != 4:
            raise RuntimeError(f"MuJoCo ended with {data.ncon} contacts, where four are wanted")
        return None, data.qpos.copy()

    called, what = mj_step_with(cone)
    apart = GIVES_WAY if cone == CONES[0] else TURNED
    return Contestant(called, name, 6, STEPS, lap, wanted, apart, what)


def on_feet(name: str, with_mujoco: bool) -> list[Contestant]:
    """Return everyone who moves a box, one of `BOXES`."""
    problem = boxed(name)
    one = ours(name, problem)
    others = [bare(name, np.asarray(one.wanted), cone) for cone in CONES] if with_mujoco else []
    return with_errors([one, *others], problem, no_torque)
