"""The slides on which engines race: one law, one step, on arms of two to thirty joints."""

from typing import Any

import numpy as np

import closedloop as cl
import robot_models
from closedloop.simulation.engines.problem import Problem
from robot_models import RobotModel

# The reach of a chain, its mass, and the drive inertia of each joint: those of an arm, whatever the number of joints.
REACH, MASS, ARMATURE = 1.2, 4.0, 0.1

SHIPPED = {"planar2": "planar2_slide", "wam4": "wam_slide", "panda": "panda_slide"}
CHAINS = {"chain12": 12, "chain30": 30}
ARMS = (*SHIPPED, *CHAINS)
"""The arms, by growing number of joints."""

START = 0.01
"""When the tip begins to move, s."""


def slide(arm: str, steps: int) -> Problem:
    """Return the slide of an arm as numbers: `steps` steps of a millisecond, in motion from 10 ms on.

    arm: one of `ARMS`
    steps: how many steps of 1 ms to take
    """
    changes: dict[str, Any] = {
        "time.duration": steps * 1e-3, "reference.start": START, "reference.stop": 1e-3 * steps + 0.1,
    }  # fmt: skip
    if arm in SHIPPED:
        return cl.prepare(cl.load_scenario(SHIPPED[arm], changes))
    model = chain(CHAINS[arm])
    changes |= {
        "robot.model": arm, "start.q": model.home.tolist(), "start.v": [0.0] * model.n,
        "law.kp": 400.0, "law.kd": 40.0,
    }  # fmt: skip
    return cl.prepare(cl.load_scenario("wam_slide", changes), model)


def chain(n: int) -> RobotModel:
    """Return an arm of n equal links one after the other, its axes in turn across and along the vertical, bent."""
    length, mass = REACH / n, MASS / n
    side = mass * length**2 / 12
    parts = ['<robot name="chain">', '<link name="base"/>']
    for i in range(n):
        axis = "0 0 1" if i % 3 == 0 else "0 1 0"
        parts.append(
            f'<joint name="j{i}" type="revolute"><parent link="{f"l{i - 1}" if i else "base"}"/><child link="l{i}"/>'
            f'<origin xyz="{length if i else 0.0} 0 0"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
            f'<link name="l{i}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="{side / 10}" iyy="{side}" izz="{side}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
    parts.append(
        f'<joint name="mount" type="fixed"><parent link="l{n - 1}"/><child link="tip"/><origin xyz="{length} 0 0"/>'
        '</joint><link name="tip"/></robot>'
    )
    home = np.array([0.0 if i % 3 == 0 else (0.9 if i % 3 == 1 else 0.3) * 4.0 / n for i in range(n)])
    return robot_models.from_text(
        "\n".join(parts), "urdf", name=f"chain{n}", armature=np.full(n, ARMATURE), tip="tip", home=home, locked={}
    )
