"""Tosses of a cube, as measured, and as an engine simulates them with parameters that may be fitted.

A state is the quaternion w x y z, the position of the centre, m, the angular velocity in the cube's axes, rad/s, and
the velocity in the world's, m/s. The board is the plane z = 0. Source: S. Pfrommer, M. Halm, M. Posa, ContactNets,
Conference on Robot Learning, 2020; data of DAIRLab, dair_pll, BSD-3.

This package: a free cube whose eight corners touch the board, rigid, with Coulomb's friction and a restitution.

A ball on a plane is its centre on a plane that is higher by the radius; friction then acts at the centre, 2 mm above
the board, instead of on it.

MuJoCo: the corners of a cube as balls on a plane, soft contacts with elliptic friction cones.

Drake: the eight corners of a cube as balls on a half-space, Hunt and Crossley's contact.

A box touches a half-space at one point only, so that it could not rest.
"""

import logging
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.scenario.scenario import Scenario
from validation.measured.judged import columns

RATE = 148.0  # Hz
SIDE = 0.1048  # m, as published; so is what follows
MASS = 0.37  # kg
GRAVITY = 9.81  # m/s²
FALL = 9.61  # m/s², of the log: its lengths are 2 % short
FEWEST_ROWS = 3
# The norm of a measured quaternion, and a speed no toss by hand has, m/s: other values are of another unit or order.
NORM, FASTEST = 1e-3, 50.0


@dataclass(frozen=True)
class Toss:
    """One toss: its number, and its states (rows, 13)."""

    number: int
    states: Array


def read(given: Path | None = None) -> list[Toss]:
    """Return the tosses that come with the package, or those of a file in the same format.

    Raises `ModelError` if it cannot be read, or has something that is no toss.
    """
    name = "cube_tosses.npz" if given is None else str(given)
    states = columns("cube_tosses.npz", {"state": 13}, given)["state"]
    listed = columns("cube_tosses.npz", {"rows": 0, "toss": 0}, given)
    rows = listed["rows"]
    if not len(rows) or (rows != np.floor(rows)).any() or (rows < FEWEST_ROWS).any() or rows.sum() != len(states):
        raise ModelError(
            f"{name}: rows must have the number of rows of each toss, at least {FEWEST_ROWS}, and their sum must be "
            f"{len(states)}, as state has"
        )
    norms = np.linalg.norm(states[:, :4], axis=1)
    if not np.isfinite(states).all():
        raise ModelError(f"{name}: state has a value that is not finite")
    if (np.abs(norms - 1.0) > NORM).any():
        raise ModelError(f"{name}: the first four columns of state must be a unit quaternion w x y z")
    if (np.abs(states[:, 10:]) > FASTEST).any():
        raise ModelError(f"{name}: the last three columns of state, the velocity, are above {FASTEST:g} m/s")
    states[:, :4] /= norms[:, None]
    ends = np.cumsum(rows).astype(int)
    return [
        Toss(int(number), states[end - int(count) : end])
        for number, count, end in zip(listed["toss"], rows, ends, strict=True)
    ]


def first_row(toss: Toss) -> Array:
    """Return the state (13,) that a toss begins with, its velocity taken for what it is.

    The velocities of the log are differences of a row and the one before it, so that of the first row is half a row
    old: on average it is 0.031 m/s above the slope of the following rows, where gravity takes 0.033 m/s in this time.
    """
    start: Array = toss.states[0].copy()
    start[12] -= FALL * 0.5 / RATE
    return start


def errors(toss: Toss, simulated: Array) -> tuple[Array, Array]:
    """Return the position error, in % of the side, and the rotation error, degrees, of each row that was simulated.

    simulated: (rows or fewer, 7), position of the centre and quaternion, at the instants of the toss, from the first on
    """
    measured = toss.states[: len(simulated)]
    position: Array = np.linalg.norm(simulated[:, :3] - measured[:, 4:7], axis=1) * (100.0 / SIDE)
    cosine = np.abs(np.einsum("ij,ij->i", simulated[:, 3:7], measured[:, :4]))
    return position, np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0)))


def mean_errors(tosses: Sequence[Toss], simulated: Sequence[Array]) -> Array:
    """Return the mean errors of each toss after its first row, (tosses, 2); NaN of one that was not completed."""
    means = np.full((len(tosses), 2), np.nan)
    for mean, toss, path in zip(means, tosses, simulated, strict=True):
        if len(path) == len(toss.states) and np.isfinite(path).all():
            mean[:] = [each[1:].mean() for each in errors(toss, path)]
    return means


# Steps between two rows.
STEPS = 8


@dataclass(frozen=True)
class Parameter:
    """A parameter that is fitted: where the search starts, and between which values; all are positive."""

    name: str
    unit: str
    start: float
    low: float
    high: float


# Of the cube, the same for every engine; the last parameters of each. The lengths of the log are some 2 % short: it
# rests at 0.978 of half its side, and falls with 9.61 m/s². So the side scales gravity and inertia too. The published
# inertia, 8.1e-4 kg m², is between that of a solid cube and that of a thin box, 1.13e-3 kg m²; the tosses ask for the
# latter. A corner that strikes is 2 mm lower than a sharp one would be: corners are round.
CUBE = (
    Parameter("inertia", "kg m²", 1.1e-3, 6.7e-4, 2e-3),
    Parameter("corner_radius", "m", 0.002, 1e-4, 0.01),
    Parameter("side", "m", 0.1026, 0.098, 0.11),
)


class CubeEngine(ABC):
    """An engine that simulates tosses of a cube.

    `name` and `what` say which, `parameters` what is fitted.
    """

    name: ClassVar[str]
    what: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]

    @abstractmethod
    def simulate(self, values: Sequence[float], starts: Sequence[Array], tosses: Sequence[Toss]) -> list[Array]:
        """Return position and quaternion (rows, 7) of each toss at its instants; fewer rows if it was not completed.

        values: of the parameters, in their order
        starts: (13,), the state that each begins with
        tosses: which say how many rows there are
        """


def gravity(side: float) -> float:
    """Return g in the lengths of the log, m/s², if the cube's side in them is this, m."""
    return GRAVITY * side / SIDE


def moment(inertia: float, side: float) -> float:
    """Return a moment of inertia, kg m², in the lengths of the log."""
    return inertia * (side / SIDE) ** 2


def corners(side: float, radius: float) -> list[list[float]]:
    """Return the centres of the balls (8, 3) that round the corners, m, axes of the cube."""
    return [[x * (side / 2.0 - radius) for x in at] for at in product((-1.0, 1.0), repeat=3)]


BARE_CUBE = """<mujoco><option gravity="0 0 {g!r}"/><worldbody><body name="cube"><freejoint/>
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
        model = BARE_CUBE.format(g=-gravity(side), mass=MASS, moment=moment(inertia, side), half=side / 2.0)
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


class DrakeCube(CubeEngine):
    """Fitted: friction, stiffness and dissipation of each corner."""

    name: ClassVar = "drake"
    what: ClassVar = "Drake, point contact of eight corners, discrete, lagged"
    parameters: ClassVar = (
        Parameter("friction", "1", 0.18, 0.02, 1.0),
        Parameter("stiffness", "N/m", 4e4, 5e2, 1e6),
        Parameter("dissipation", "s/m", 0.9, 0.01, 20.0),
        *CUBE,
    )

    def simulate(self, values: Sequence[float], starts: Sequence[Array], tosses: Sequence[Toss]) -> list[Array]:
        """Return position and quaternion (rows, 7) of each toss."""
        from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
        from pydrake.math import RigidTransform
        from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
        from pydrake.multibody.tree import SpatialInertia, UnitInertia
        from pydrake.systems.analysis import Simulator
        from pydrake.systems.framework import DiagramBuilder

        mu, stiffness, dissipation, inertia, radius, side = map(float, values)
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, 1.0 / (RATE * STEPS))
        unit = moment(inertia, side) / MASS
        centre: Any = np.zeros(3)  # its signatures name the dtype in the place of the shape
        body = plant.AddRigidBody("cube", SpatialInertia(MASS, centre, UnitInertia(unit, unit, unit)))
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity(side)])
        friction = CoulombFriction(mu, mu)
        ground = ProximityProperties()
        AddContactMaterial(1e-6, 1e12, friction, ground)  # all that gives way is the corner
        log = logging.getLogger("drake")
        usual = log.level
        log.setLevel(logging.ERROR)  # it warns that deformable bodies, of which there are none, do not see a half-space
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
        log.setLevel(usual)
        corner = ProximityProperties()
        AddContactMaterial(dissipation, stiffness, friction, corner)
        at: Any
        for number, at in enumerate(corners(side, radius)):
            plant.RegisterCollisionGeometry(body, RigidTransform(at), Sphere(radius), f"corner{number}", corner)
        plant.Finalize()
        simulator = Simulator(builder.Build())
        context = simulator.get_mutable_context()
        inside = plant.GetMyMutableContextFromRoot(context)
        paths = []
        for start, toss in zip(starts, tosses, strict=True):
            context.SetTime(0.0)
            turned = np.empty(3)
            turned[:] = _rotation(start[:4]) @ start[7:10]
            plant.SetPositions(inside, np.concatenate([start[:4], start[4:7]]))
            plant.SetVelocities(inside, np.concatenate([turned, start[10:13]]))
            simulator.Initialize()
            path = np.empty((len(toss.states), 7))
            path[0] = np.concatenate([start[4:7], start[:4]])
            for i in range(1, len(path)):
                simulator.AdvanceTo(i / RATE)
                q = plant.GetPositions(inside)
                path[i] = np.concatenate([q[4:7], q[:4] / np.linalg.norm(q[:4])])  # which drifts from length one
            paths.append(path)
        return paths


def _rotation(quaternion: Array) -> Array:
    """Return the rotation matrix of a unit quaternion w x y z."""
    from pydrake.common.eigen_geometry import Quaternion

    return np.asarray(Quaternion(quaternion / np.linalg.norm(quaternion)).rotation())
