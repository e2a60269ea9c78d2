"""Free bodies, and what rolls: runs against laws written by hand, and faults planted in each term of theirs.

The laws are of the recorded rows alone, with the tensor I and the radius that the model was written with:

    I ω̇ + ω × I ω = 0,   q̇ = ½ q (0, ω),   R(q) I ω = const,   ẍ = g
    a ball that rolls: ẍ = −5/7 g ρ/R,   and one that pivots: ω̇_n = −5/2 g σ/R²
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.base.arrays import Array
from closedloop.loop.step.memory import Loop
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.prepare import prepare
from validation.plant import Catch, catch_of

MOMENTS, SPIN, G = np.array([2e-3, 3e-3, 4.5e-3]), (1.0, 6.0, -2.0), 9.81
RADIUS, ROLLING, PIVOTING, SPEED, TURN = 0.1, 0.002, 0.001, 0.3, 2.0
STEP, ROWS = 1e-3, 60
# The largest error of sound runs, relative: of the differences of rows, h²/6 of the third derivative.
TOLERANCE = 1e-4

TUMBLING = f"""
[robot]
model = "none"
[[body]]
name = "body"
shape = "box"
edges = [0.1, 0.1, 0.1]
mass = 1.0
inertia = [{MOMENTS[0]}, {MOMENTS[1]}, {MOMENTS[2]}, 0, 0, 0]
velocity = [0.3, -0.2, 2.0]
spin = {list(SPIN)}
[time]
duration = {ROWS * STEP}
step = {STEP}
integrator = "rk4"
"""
ROLLS = f"""
[robot]
model = "none"
[[body]]
name = "ball"
shape = "ball"
radius = {RADIUS}
mass = 1.0
position = [0, 0, {RADIUS}]
velocity = [{SPEED}, 0, 0]
spin = [0, {SPEED / RADIUS}, {TURN}]
[[contact]]
link = "ball"
at = "collision"
friction = 0.5
rolling = {ROLLING}
pivoting = {PIVOTING}
[time]
duration = {ROWS * STEP}
step = {STEP}
integrator = "rk4"
"""


@dataclass(frozen=True)
class Rows:
    """Rows of both runs: time (N,), then positions, quaternions, velocities and accelerations of the body that tumbles,
    and velocities of the ball in base axes, the angular ones too: the body's axes turn with it.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    rolled: Array


@dataclass(frozen=True)
class Fault:
    """A fault: in the bias of the terms, in the numbers of the contacts, or in what the runs answer."""

    name: str
    bias: Callable[[Array, Array], None] = lambda v, C: None
    spoil: Callable[[Any], None] = lambda contacts: None
    answer: Callable[[Rows], Rows] = lambda rows: rows


def rows_with(fault: Fault) -> Rows:
    """Return the rows of both runs on Pinocchio's terms, with a fault."""
    tumbled, rolled = (_run(text, fault) for text in (TUMBLING, ROLLS))
    rows = Rows(tumbled.time, tumbled.q, tumbled.v, tumbled.acceleration, _in_base(rolled.q, rolled.v))
    return fault.answer(rows)


def _run(text: str, fault: Fault) -> cl.Run:
    """Return a run on Pinocchio's terms, whose bias and contacts have the fault."""
    sound_passes, sound_begin = Robot.passes, Problem.begin

    def passes(robot: Robot) -> Any:
        crba, bias, *others = sound_passes.__get__(robot, Robot)

        def faulty(model: Any, data: Any, q: Array, v: Array) -> Any:
            found = bias(model, data, q, v)
            fault.bias(v, data.nle)
            return found

        return (crba, faulty, *others)

    def begin(problem: Problem, loop: Loop) -> None:
        sound_begin(problem, loop)
        if "contacts" in loop.w.kept:
            fault.spoil(loop.w.kept["contacts"].contacts)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bodies.toml"
        path.write_text(text, encoding="utf-8")
        scenario = cl.load_scenario(path)
    try:
        Robot.passes, Problem.begin = property(passes), begin  # type: ignore[assignment, method-assign]
        return prepare(scenario).run(engine="pinocchio", progress=False)  # by nothing that an earlier run has kept
    finally:
        Robot.passes, Problem.begin = sound_passes, sound_begin  # type: ignore[method-assign]


def errors(rows: Rows) -> dict[str, float]:
    """Return what the laws are off, relative."""
    w, q, t = rows.v[:, 3:], rows.q[:, 3:], rows.time
    rate, gyroscopic = rows.a[:, 3:] * MOMENTS, np.cross(w, MOMENTS * w)
    quaternion_rate = (q[2:] - q[:-2]) / (2.0 * STEP)
    half = 0.5 * np.stack([_times(q[k], np.concatenate([[0.0], w[k]])) for k in range(1, len(q) - 1)])
    momentum = np.stack([_turn(q[k]) @ (MOMENTS * w[k]) for k in range(len(q))])
    slowed = 5.0 / 7.0 * G * ROLLING / RADIUS
    stopped = 2.5 * G * PIVOTING / RADIUS**2
    return {
        "Euler's equations": _largest(rate + gyroscopic) / _largest(gyroscopic),
        "quaternion's rate": _largest(quaternion_rate - half) / _largest(half),
        "angular momentum": _largest(momentum - momentum[0]) / _largest(momentum),
        "acceleration of free fall": _largest(rows.a[:, :3] - [0.0, 0.0, -G]) / G,
        "rolling": _largest(rows.rolled[:, 0] - SPEED + slowed * t) / (slowed * t[-1]),
        "pivoting": _largest(rows.rolled[:, 5] - TURN + stopped * t) / (stopped * t[-1]),
    }


def _largest(x: Array) -> float:
    found = float(np.max(np.abs(x)))
    return found if np.isfinite(found) else np.inf


def _times(a: Array, b: Array) -> Array:
    """Return the product of two quaternions w, x, y, z."""
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def _turn(q: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion."""
    w, x = q[0], q[1:]
    cross = np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])
    return np.eye(3) + 2.0 * (w * cross + cross @ cross)


def _in_base(q: Array, v: Array) -> Array:
    """Return velocities (N, 6) of a free body whose angular part is in base axes, from one in the body's."""
    found = v.copy()
    found[:, 3:] = [_turn(turned) @ w for turned, w in zip(q[:, 3:], v[:, 3:], strict=True)]
    return found


def _wider(arm: str) -> Callable[[Any], None]:
    def spoil(contacts: Any) -> None:
        turns = contacts.friction.resistance
        turns.arm[int(getattr(turns, arm)[1])] *= 1.001

    return spoil


FAULTS = (
    Fault("the gyroscopic torque is left out", bias=lambda v, C: np.copyto(C[3:6], 0.0)),
    Fault("the gyroscopic torque has the other sign", bias=lambda v, C: np.copyto(C[3:6], -C[3:6])),
    Fault("the angular velocity is in base axes", answer=lambda rows: replace(rows, v=_in_base(rows.q, rows.v))),
    Fault(
        "the quaternion is that of the inverse", answer=lambda rows: replace(rows, q=rows.q * [1, 1, 1, 1, -1, -1, -1])
    ),
    Fault("resistance to rolling +0.1 %", spoil=_wider("rolling")),
    Fault("resistance to pivoting +0.1 %", spoil=_wider("pivoting")),
)


def plant_on_bodies() -> list[Catch]:
    """Plant every fault of free bodies and of what rolls, in turn, and return what the laws say of it."""
    return [
        catch_of(fault.name, "the loop", [errors(rows_with(fault))], TOLERANCE, by="laws written by hand")
        for fault in FAULTS
    ]
