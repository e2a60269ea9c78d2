"""Random states of mechanisms: posture and velocity that close the loops, a torque, and what the tip touches.

What is said of a case: by the oracle, and by both engines of the loop.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.jit.calls import callback, interpreted_address
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import jit_disabled
from closedloop.loop.events.locate import DONE
from closedloop.loop.step.closed_loops import DRIVE, closed_loops
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.factor import factor
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.reactions import loop_reactions
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Driver
from robot_models.loop_joint import BINDS
from validation.loops.mechanisms import MECHANISMS
from validation.oracle.engine import Oracle
from validation.oracle.loops import LoopOracle, Motion
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


# The step, s: so short that friction turns no slip within it, since the oracle has friction against the slip as it is.
STEP = 1e-6

Entry = Callable[[int, int], int]


@dataclass(frozen=True)
class LoopFault:
    """What is done to the loop before it is asked: nothing.

    entry: what answers for the loops, an entry as `closedloop.loop.step.closed_loops.closed_loops` -> the faulty one
    bound: changes the memory of what the loop joints bind, in place
    reactions: reactions (N, m) -> the faulty ones
    """

    entry: Callable[[Entry], Entry] = lambda sound: sound
    bound: Callable[[LoopMemory], None] = lambda memory: None
    reactions: Callable[[Array], Array] = lambda found: found


SOUND = LoopFault()


def ask_oracle(case: Case, oracle: LoopOracle | None = None) -> Motion:
    """Return what the equations by hand say of a case, or a faulty copy of them."""
    oracle = oracle or oracle_of(case.name)
    normal = None if case.touch == AWAY else case.normal
    return oracle.answer(case.q, case.v, case.torque, normal, FRICTION if case.touch == SLIDES else 0.0)


def problem_of(case: Case) -> Problem:
    """Return a case as the loop is given it."""
    changes: dict[str, Any] = {
        "start.q": case.q.tolist(), "start.v": case.v.tolist(), "reference": {"kind": "hold"},
        "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 0.0}, "stabiliser": {"kind": "none"},
        "surface": {"kind": "plane", "normal": case.normal.tolist(), "offset": "start"},
        "time.duration": 2.0 * STEP, "time.step": STEP,
    }  # fmt: skip
    if case.touch == AWAY:
        changes["surface"] |= {"gap": 1.0, "contact": "unilateral"}
    if case.touch == SLIDES:
        changes["friction"] = {"kind": "coulomb", "coefficient": FRICTION}
    base = cl.prepare(cl.load_scenario("planar2_slide", changes), case.robot)
    return replace(base, q=case.q, v=case.v, mode=FREE if case.touch == AWAY else PRESSED)


def ask_loop(case: Case, engine: str, fault: LoopFault = SOUND) -> Motion:
    """Return what one of the loop's engines records in the first row of a run from the case's state.

    engine: "pinocchio" or "compiled"
    fault: what is made wrong before
    Raises `LinAlgError` if the loop does not record a row.
    """
    problem = problem_of(case)
    n = problem.robot.n
    rows = np.zeros((1, Row.count(n)))
    driver = Driver(problem, rows, engine)
    state, _, w = driver.loop
    memory: LoopMemory = w.kept["loops"]
    fault.bound(memory)
    sound: Entry = interpreted(closed_loops)
    entry, kept = sound, None
    if fault is not SOUND:
        entry = fault.entry(sound)
        state.loops.entry, kept = (interpreted_address(entry), None) if jit_disabled() else callback(entry)
    state.sampled, state.settings.steps = 0, 0  # the torque is given, and one row is all
    w.torque[:] = case.torque
    memory.rows.q[:], memory.rows.v[:] = case.q, case.v
    interpreted(locate_rows)(memory.links, memory.rows)
    interpreted(factor)(memory.links, memory.rows, memory.rows.drift, int(memory.links.m))
    entry(memory.address, DRIVE)  # as after a law
    u = problem.frame @ problem.robot.terms(case.q, case.v).jacobian @ case.v
    w.friction.direction[:] = u[1:] / max(float(np.linalg.norm(u[1:])), 1e-300)
    if driver.many() != DONE:
        raise np.linalg.LinAlgError(f"the loop stopped with status {int(state.status)}")
    del kept  # what is called by its address lives until here
    return _motion(case, problem, Row(rows[0], n), fault)


def _motion(case: Case, problem: Problem, row: Any, fault: LoopFault) -> Motion:
    """Return what a row says, and the reactions that a run would give for it."""
    q, v, a, torque = (np.array(x)[None, :] for x in (row.q, row.v, row.acceleration, row.torque))
    F = (row.contact_force * np.array(row.surface_normal) + row.friction_force)[None, :]
    found = loop_reactions(problem.robot, np.zeros(1), q, v, a, torque, F)
    forces = fault.reactions(found.multipliers)[0]
    memory = loop_memory(problem.robot)  # with the rows that no joint can move
    memory.rows.q[:], memory.rows.v[:] = case.q, case.v
    interpreted(locate_rows)(memory.links, memory.rows)
    pulls, force, couple, at = [], [], [], 0
    for joint in problem.robot.model.loops:
        span = range(at, at + joint.rows)
        pulls.append(memory.rows.G[at : at + joint.rows].T @ forces[at : at + joint.rows])
        positions = {"distance": 1, "gear": 0}.get(joint.type, len(BINDS.get(joint.type, ((),))[0]))
        is_force = [k - at < positions for k in span]
        force.append(float(np.linalg.norm([forces[k] for k, yes in zip(span, is_force, strict=True) if yes])))
        couple.append(float(np.linalg.norm([forces[k] for k, yes in zip(span, is_force, strict=True) if not yes])))
        at += joint.rows
    return Motion(a[0], np.array(pulls), np.array(force), np.array(couple), float(row.contact_force))
