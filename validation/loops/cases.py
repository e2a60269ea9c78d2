"""Random states of mechanisms: posture and velocity that close the loops, a torque, and what the tip touches."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from closedloop.base.errors import ScenarioError
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.robot.pinocchio import Robot
from validation.loops.mechanisms import MECHANISMS
from validation.oracle.engine import Oracle
from validation.oracle.loops import LoopOracle
from validation.oracle.spatial import Array

AWAY, PRESSES, SLIDES = "tip away", "tip presses", "tip slides"
TOUCHES = (AWAY, PRESSES, SLIDES)
# Coulomb's μ of a tip that slides.
FRICTION = 0.3
# How far a mechanism is moved from home, rad (m) along what is free; and how small a part of the largest singular value
# of its rows, joints and rows to scale, a posture may have: nearer to dependent rows rounding is magnified.
TURNED, WORST = 0.4, 0.02
# Below this share of the largest a singular value is that of rows that depend on others.
NONE = 1e-11
# A tip that moves less than this, m/s, does not slide.
SLOW = 1e-3


@dataclass(frozen=True)
class Case:
    """One state of a mechanism.

    name, index: of the mechanism, and the case's number within its seed
    q, v, torque: (n,), what the law asks of all joints, with a drive or without, N m (N)
    touch: of `TOUCHES`
    normal: (3,), of the plane through the tip, base frame
    """

    name: str
    index: int
    robot: Any
    q: Array
    v: Array
    torque: Array
    touch: str
    normal: Array

    def __str__(self) -> str:
        return f"{self.name}, case {self.index}: {self.touch}"


@lru_cache(maxsize=64)
def mechanism_called(name: str) -> Any:
    """Return a mechanism, made once."""
    return MECHANISMS[name]()


@lru_cache(maxsize=64)
def _robot_of(name: str) -> Robot:
    return Robot(mechanism_called(name))


@lru_cache(maxsize=64)
def oracle_of(name: str) -> LoopOracle:
    """Return the mechanism as the paper's equations have it."""
    model = mechanism_called(name)
    return LoopOracle(Oracle.from_model(model), model.loops, model.drives)


def draw_case(name: str, seed: int, index: int) -> Case:
    """Draw a state of a mechanism that is well away from poses at which its rows lose rank.

    Raises `RuntimeError` if a hundred are not.
    """
    for attempt in range(100):
        rng = np.random.default_rng([seed, index, attempt])
        if (made := _draw(name, index, rng)) is not None:
            return made
    raise RuntimeError(f"no well-posed state of {name} was drawn")


def _draw(name: str, index: int, rng: np.random.Generator) -> Case | None:
    model, oracle, touch = mechanism_called(name), oracle_of(name), TOUCHES[index % len(TOUCHES)]
    n, home = model.n, np.array(model.home)
    ways = _free(np.concatenate([rows.A for rows in oracle.all_rows(home, np.zeros(n))]))
    if ways is None:
        raise ValueError(f"{name} is at home where its rows lose rank")
    # Along what is free: rows that depend on each other do so only where the loops are closed.
    start = home + TURNED * ways @ rng.normal(size=ways.shape[1])
    try:
        q, _ = closed_start(_robot_of(name), start, np.zeros(n), True)
    except ScenarioError:
        return None
    G = np.concatenate([rows.A for rows in oracle.all_rows(q, np.zeros(n))])
    free = _free(G)
    if free is None or oracle.apart(q) > 1e-12:
        return None
    torque, normal = rng.normal(scale=5.0, size=n), np.array([0.0, 0.0, 1.0])
    J = oracle.oracle.jacobian(q) @ free
    if float(np.linalg.norm(J)) < 0.05:
        touch = AWAY  # of a tip that the loops hold there is nothing to press
    if touch != AWAY:
        normal = J @ rng.normal(size=free.shape[1]) + 0.1 * float(np.linalg.norm(J)) * rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        held = _free(np.vstack([G, normal @ oracle.oracle.jacobian(q)]))
        if held is None or held.shape[1] == free.shape[1]:
            return None
        free = held
    v = free @ rng.normal(size=free.shape[1]) if free.shape[1] else np.zeros(n)
    slip = oracle.oracle.jacobian(q) @ v
    if touch == SLIDES and float(np.linalg.norm(slip - normal * (normal @ slip))) < SLOW:
        touch = PRESSES  # the loops hold the tip
    made = Case(name, index, model, q, v, torque, touch, normal)
    return made if touch != SLIDES or _does_not_jam(made) else None


def _free(G: Array) -> Array | None:
    """Return an orthonormal basis (n, k) of the motions that rows leave, None near a pose where they lose rank."""
    size = np.linalg.norm(G, axis=1, keepdims=True)
    rows = np.divide(G, size, out=np.zeros_like(G), where=size > NONE)
    _, s, Vt = np.linalg.svd(rows)
    kept = s > NONE * s[0]
    if np.any(s[kept] < WORST * s[0]):
        return None
    return np.asarray(Vt[int(np.count_nonzero(kept)) :].T)


def _does_not_jam(case: Case) -> bool:
    """Whether friction leaves the push of the surface effective, by far (Painlevé)."""
    oracle = oracle_of(case.name)
    rows = oracle.all_rows(case.q, case.v)
    free = _free(np.concatenate([each.A for each in rows]))
    if free is None:
        return False
    J = oracle.oracle.jacobian(case.q) @ free
    S = J @ np.linalg.solve(free.T @ oracle.oracle.mass_matrix(case.q) @ free, J.T)
    across = S @ case.normal
    normal = float(case.normal @ across)
    return normal > 2.0 * FRICTION * float(np.linalg.norm(across - normal * case.normal))
