"""What is said of a case: by the oracle, and by both engines of the loop."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.jit.calls import callback, interpreted_address
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import jit_disabled
from closedloop.loop.events.locate import DONE
from closedloop.loop.step.closed_loops import DRIVE, closed_loops
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import FREE, PRESSED
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.factor import factor
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.reactions import loop_reactions
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Driver
from robot_models.loop_joint import BINDS
from validation.loops.cases import AWAY, FRICTION, SLIDES, Case, oracle_of
from validation.oracle.loops import LoopOracle, Motion
from validation.oracle.spatial import Array

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
