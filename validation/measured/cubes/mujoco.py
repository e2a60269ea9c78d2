"""MuJoCo: the corners of a cube as balls on a plane, soft contacts with elliptic friction cones."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from closedloop.base.arrays import Array
from validation.measured.cubes.engine import CUBE, STEPS, CubeEngine, Parameter, corners, gravity, moment
from validation.measured.cubes.tosses import MASS, RATE, Toss

MODEL = """<mujoco><option timestep="{step!r}" gravity="0 0 {g!r}" cone="elliptic" impratio="10"/>
<default><geom friction="{mu!r} 0 0" solref="{time!r} {ratio!r}" condim="3"/></default>
<worldbody><geom type="plane" size="5 5 1"/>
<body><freejoint/><inertial mass="{mass!r}" pos="0 0 0" diaginertia="{moment!r} {moment!r} {moment!r}"/>
{corners}</body></worldbody></mujoco>"""
CORNER = """<geom type="sphere" size="{radius!r}" pos="{at[0]!r} {at[1]!r} {at[2]!r}" contype="2" conaffinity="1"/>"""


class MuJoCoCube(CubeEngine):
    """Fitted: friction, and time constant and damping ratio of the contact (solref)."""

    name: ClassVar = "mujoco"
    what: ClassVar = "MuJoCo, elliptic cone, impratio 10"
    parameters: ClassVar = (
        Parameter("friction", "1", 0.18, 0.02, 1.0),
        Parameter("time_constant", "s", 0.01, 2.5e-3, 0.1),
        Parameter("damping_ratio", "1", 0.7, 0.05, 3.0),
        *CUBE,
    )

    def simulate(self, values: Sequence[float], starts: Sequence[Array], tosses: Sequence[Toss]) -> list[Array]:
        """Return position and quaternion (rows, 7) of each toss."""
        import mujoco

        mu, time, ratio, inertia, radius, side = map(float, values)
        balls = "\n".join(CORNER.format(radius=radius, at=at) for at in corners(side, radius))
        text = MODEL.format(
            step=1.0 / (RATE * STEPS), g=-gravity(side), mu=mu, time=time, ratio=ratio, mass=MASS,
            moment=moment(inertia, side), corners=balls,
        )  # fmt: skip
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        paths = []
        for start, toss in zip(starts, tosses, strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = np.concatenate([start[4:7], start[:4]])
            data.qvel[:] = np.concatenate([start[10:13], start[7:10]])
            path = np.empty((len(toss.states), 7))
            path[0] = data.qpos
            for row in path[1:]:
                mujoco.mj_step(model, data, STEPS)
                row[:] = data.qpos
            paths.append(path)
        return paths
