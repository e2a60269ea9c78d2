"""What is said of a case: by the oracle, by both engines of the loop, and by peers that take a row as it is."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import closedloop as cl
from closedloop.loop.events.locate import DONE
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import SURFACES
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Driver
from validation.engines import Engine
from validation.oracle.spatial import Array
from validation.oracle.surface import SurfaceContact, Touch
from validation.surfaces.cases import GAINS, MATERIALS, Case, contact_of

# Of a soft surface the loop is asked for a row only; the scenario's check of its step is not to be in the way.
SHORT, USUAL = 1e-6, 1e-3


@dataclass(frozen=True)
class Answer:
    """q̈ (n,); the force on the tip F (3,), base axes, N; e, m; ė, m/s; the normal (3,), base axes."""

    acceleration: Array
    force: Array
    error: float
    rate: float
    normal: Array


@dataclass(frozen=True)
class Scales:
    """What errors are relative to: that which q̈ and F are summed from."""

    acceleration: float
    force: float


def ask_oracle(
    case: Case, fault: Callable[[SurfaceContact], SurfaceContact] = lambda contact: contact
) -> tuple[Answer, Scales, Touch]:
    """Return the oracle's answer, `fault` done to it before; with the scales, and the rows that it is from."""
    contact = fault(contact_of(case))
    acceleration, F, touch = contact.answer(case.q, case.v, case.torque, case.anchor if case.sticks else None)
    H = contact.oracle.mass_matrix(case.q)
    free = np.linalg.solve(H, case.torque - contact.oracle.bias(case.q, case.v))
    X = np.linalg.solve(H, touch.A.T)
    mass = 1.0 / float(touch.A[0] @ X[:, 0])
    size = float(np.max(np.abs(free)))
    wanted = (
        float(np.linalg.norm(touch.drift)) + GAINS[0] * float(np.linalg.norm(touch.u)) + GAINS[1] * abs(touch.error)
    )
    force = max(float(np.linalg.norm(F)), mass * (wanted + float(np.abs(touch.A[0]) @ np.abs(free))))
    answer = Answer(acceleration, touch.frame.T @ F, touch.error, float(touch.u[0]), touch.frame[0])
    return answer, Scales(size + float(np.max(np.abs(X))) * force, force), touch


def placed_surface(case: Case) -> PlacedSurface:
    """Return the surface of a case as the loop has it, in its place at t = 0."""
    section = SURFACES[case.section["kind"]](**{key: value for key, value in case.section.items() if key != "kind"})
    return PlacedSurface(section, case.moving, case.axes[[2, 0, 1]], case.origin, False)


def problem_of(case: Case, placed: PlacedSurface) -> Problem:
    """Return a case as the loop is given it."""
    material = MATERIALS[case.material]
    step = SHORT if "compliance" in material else USUAL
    changes: dict[str, Any] = {
        "robot": {"model": "wam4", "tip": case.tip}, "start": {}, "reference": {"kind": "hold"},
        "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 0.0}, "stabiliser": {"kind": "none"},
        "time.duration": 2.0 * step, "time.step": step, **material,
    }  # fmt: skip
    if case.tool:
        changes["tool"] = case.tool
    base = cl.prepare(cl.load_scenario("wam_slide", changes), case.robot)
    mode = STUCK if case.sticks else PRESSED
    return replace(base, q=case.q, v=case.v, mode=mode, surface=placed, frame=placed.frame, stabiliser=np.array(GAINS))


def ask_loop(case: Case, engine: str, fault: Callable[[Problem], Problem] = lambda problem: problem) -> Answer:
    """Return what one of the loop's engines records in the first row of a run from the case's state.

    engine: "pinocchio" or "compiled"
    fault: what is done to the problem before
    Raises `LinAlgError` if the loop does not record a row.
    """
    problem = fault(problem_of(case, placed_surface(case)))
    n = problem.robot.n
    rows = np.zeros((1, Row.count(n)))
    driver = Driver(problem, rows, engine)
    state, _, w = driver.loop
    state.sampled, state.settings.steps = 0, 0  # the torque is given, and one row is all
    w.time, w.torque[:] = case.t, case.torque
    terms = problem.robot.terms(case.q, case.v)
    now = problem.surface.touching(terms.position, terms.jacobian @ case.v, case.t)
    u = now.frame @ terms.jacobian @ case.v - now.carried
    w.friction.direction[:] = u[1:] / np.linalg.norm(u[1:])
    w.tip.anchor[:] = case.anchor
    if problem.surface.fixed_plane:  # there a place on the surface is in the contact frame
        w.tip.anchor[:] = now.frame @ (case.axes.T @ case.anchor + case.origin)
    if driver.many() != DONE:
        raise np.linalg.LinAlgError(f"the loop stopped with status {int(state.status)}")
    row = Row(rows[0], n)
    normal = np.array(row.surface_normal)
    force = row.contact_force * normal + row.friction_force
    return Answer(np.array(row.acceleration), force, float(row.closure_error), float(row.closure_rate), normal)


def ask_peer(case: Case, engine: Engine, touch: Touch) -> Answer:
    """Return what an engine makes of the oracle's row and right side: of a rigid, smooth surface.

    It shows that the row, given, is the same constraint to an engine that knows nothing of surfaces.
    """
    b = float(-touch.drift[0] - GAINS[0] * touch.u[0] - GAINS[1] * touch.error)
    # `constrained` is asked for A q̈ = b with A = nᵀJᵣ: what R turns with is in b.
    acceleration, f = engine.constrained(case.q, case.v, case.torque, touch.frame[0], b)
    return Answer(acceleration, f * touch.frame[0], touch.error, float(touch.u[0]), touch.frame[0])
