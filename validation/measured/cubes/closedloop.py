"""This package: a free cube whose eight corners touch the board, rigid, with Coulomb's friction and a restitution.

A ball on a plane is its centre on a plane that is higher by the radius; friction then acts at the centre, 2 mm above
the board, instead of on it.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.scenario.scenario import Scenario
from validation.measured.cubes.engine import CUBE, STEPS, CubeEngine, Parameter, corners, gravity, moment
from validation.measured.cubes.tosses import MASS, RATE, Toss

MODEL = """<mujoco><option gravity="0 0 {g!r}"/><worldbody><body name="cube"><freejoint/>
<inertial mass="{mass!r}" pos="0 0 0" diaginertia="{moment!r} {moment!r} {moment!r}"/>
<geom type="box" size="{half!r} {half!r} {half!r}"/></body></worldbody></mujoco>"""

SCENARIO = """[robot]
model = "{model}"
[time]
duration = 1.0
step = {step!r}
integrator = "semi_implicit_euler"
[[contact]]
name = "corner"
link = "cube"
at = {corners}
through = [0, 0, {radius!r}]
"""

FRICTION = Parameter("friction", "1", 0.18, 0.02, 1.0)


class ClosedLoopCube(CubeEngine):
    """Fitted: friction and restitution."""

    name: ClassVar = "closedloop"
    what: ClassVar = "closedloop, eight rigid corners"
    parameters: ClassVar = (FRICTION, Parameter("restitution", "1", 0.28, 0.01, 0.9), *CUBE)

    def __init__(self, law: str = "newton") -> None:
        self.law = law

    def scenario(self, values: Sequence[float], folder: Path, toss: Mapping[str, Any] | None = None) -> Scenario:
        """Return the scenario of a toss, written into a folder; `toss` has the keys of its start and its end."""
        inertia, radius, side = map(float, values[-len(CUBE) :])
        robot = folder / "cube.xml"
        model = MODEL.format(g=-gravity(side), mass=MASS, moment=moment(inertia, side), half=side / 2.0)
        robot.write_text(model, encoding="utf-8")
        points = corners(side, radius)
        text = SCENARIO.format(model=robot.as_posix(), step=1.0 / (RATE * STEPS), corners=points, radius=radius)
        path = folder / "toss.toml"
        path.write_text(text, encoding="utf-8")
        return cl.load_scenario(str(path), {**self.contact(values), **(toss or {})})

    def contact(self, values: Sequence[float]) -> Mapping[str, Any]:
        """Return the keys of the contact that the parameters set."""
        return {
            "contact.*.friction": float(values[0]),
            "contact.*.restitution": float(values[1]),
            "impact.law": self.law,
        }

    def simulate(self, values: Sequence[float], starts: Sequence[Array], tosses: Sequence[Toss]) -> list[Array]:
        """Return position and quaternion (rows, 7) of each toss."""
        with tempfile.TemporaryDirectory() as folder:
            scenario = self.scenario(values, Path(folder))
            table = cl.simulate_batch(
                scenario,
                {
                    "start.q": [np.concatenate([x[4:7], x[:4]]).tolist() for x in starts],
                    "start.v": [np.concatenate([x[10:13], x[7:10]]).tolist() for x in starts],
                    "time.duration": [(len(each.states) - 1) / RATE for each in tosses],
                },
                keep=["q"],
            )
        paths = []
        for kept, toss in zip(table.column("q"), tosses, strict=True):
            q: Array = np.zeros((0, 7)) if kept.as_py() is None else np.asarray(kept.as_py()).reshape(-1, 7)
            paths.append(q[::STEPS][: len(toss.states)])
        return paths
