"""What is said of a case: by the oracle, by both engines of the loop, and by peers that take a row as it is.

The tables of the harness on contact with surfaces.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import closedloop as cl
import robot_models
from closedloop.loop.events.locate import DONE
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import SURFACES
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Driver
from validation.engines import Engine, Missing, Refused, available
from validation.engines.drake import Drake
from validation.engines.exudyn import Exudyn
from validation.engines.loop import as_robot_model
from validation.engines.mujoco import MuJoCo
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.engines.robotics_toolbox import RoboticsToolbox
from validation.oracle.spatial import Array
from validation.oracle.surface import SurfaceContact, Touch
from validation.random_trees import random_robot
from validation.report import Check, Section
from validation.surfaces.cases import GAINS, MATERIALS, SHAPES, SMOOTH, Case, contact_of, draw_case
from validation.tolerances import Tolerance, size, worst_of

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


ON_SURFACES = Tolerance(
    "surfaces",
    1e-10,
    "Eq. 24 at a pose that magnifies its entries' rounding by 1e4 at most, and the entries known to some thousand "
    "roundings; relative to what q̈ and F are summed from",
)
LOOPS = ("pinocchio", "compiled")
ARMS = ("planar2", "wam4", "panda", "ur5", "kinova")
# Those that take A q̈ = b as a row of their own, and one that takes none.
PEERS = (PinocchioCpp, MuJoCo, Exudyn, Drake, RoboticsToolbox)
ENGINES_WITHOUT_SHAPES = (
    "takes n and the right side of Eq. 24, which is where the curvature and the surface's motion stand; no peer has "
    "the row itself: they know pairs of shapes or tendons, whose Ṙ they do not give away"
)


def errors(answer: Answer, truth: Answer, scales: Scales) -> dict[str, float]:
    """Return how far an answer is from the truth, relative to the scales; e, ė and n in m, m/s and 1."""
    return {
        "q̈": size(answer.acceleration - truth.acceleration) / scales.acceleration,
        "F": size(answer.force - truth.force) / scales.force,
        "e": abs(answer.error - truth.error),
        "ė": abs(answer.rate - truth.rate),
        "n": size(answer.normal - truth.normal),
    }


def worst_error(cases: Sequence[Case], ask: Callable[[Case], Answer]) -> tuple[float, str]:
    """Return the worst error over cases, and which quantity of which case it is."""
    return worst_of(cases, ask_oracle, lambda case, truth: errors(ask(case), *truth[:2]))


def draw_cases(name: str, robot: Any, tip: str, seed: int, count: int) -> list[Case]:
    """Draw the first `count` cases of a seed on a robot."""
    return [draw_case(name, robot, tip, seed, index) for index in range(count)]


def compare_on_surfaces(states: int, trees: int, seed: int = 0) -> Section:
    """Compare both engines of the loop with the oracle: on the shipped arms and on random trees.

    states: cases an arm: shapes, materials and motions take turns, so that 30 have every pair of shape and material
    trees, seed: random trees, of 5 cases each; seed of the cases
    """
    title = f"curved, moving, rubbing and soft surfaces ({len(SHAPES)} shapes, {len(MATERIALS)} materials, 5 motions)"
    section = Section(f"{title}: worst relative error against Eqs. 2–3 by hand")
    groups = {}
    for name in ARMS:
        model = robot_models.load(name)
        groups[name] = draw_cases(name, model, str(model.tip), seed, states)
    drawn = []
    for k in range(trees):
        robot = random_robot(k)
        drawn += [
            draw_case(f"random:{k}", as_robot_model(robot, robot.tip), robot.tip, seed + 1, 5 * k + i) for i in range(5)
        ]
    if drawn:
        groups[f"{trees} random trees of 2 to 12 joints"] = drawn
    for name, cases in groups.items():
        for engine in LOOPS:
            value, where = worst_error(cases, partial(ask_loop, engine=engine))
            passed = value <= ON_SURFACES.value
            section.checks.append(Check(f"{name}, {len(cases)} cases", engine, value, ON_SURFACES.value, passed, where))
    section.checks += _peers(groups["panda"])
    return section


def _peers(cases: Sequence[Case]) -> Iterator[Check]:
    """Compare the peers at the cases whose row they can be given."""
    smooth = [case for case in cases if case.material == SMOOTH and not case.tool]
    model, tip = smooth[0].robot, smooth[0].tip
    what = f"the row given, panda, {len(smooth)} cases"
    for engine in available(model, tip, PEERS):
        if not isinstance(engine, Engine):
            yield Check(what, engine.name, math.nan, math.nan, None, _why_not(engine))
        elif "constrained" not in engine.covers:
            yield Check(what, engine.name, math.nan, math.nan, None, engine.cannot["constrained"])
        else:
            own = engine.tolerances.get("constrained")
            bound = max(ON_SURFACES.value, own.value if own else 0.0)
            value, _ = worst_error(smooth, partial(_ask_peer, engine))
            yield Check(what, engine.name, value, bound, value <= bound, ENGINES_WITHOUT_SHAPES)


def _ask_peer(engine: Engine, case: Case) -> Answer:
    return ask_peer(case, engine, ask_oracle(case)[2])


def _why_not(engine: Missing | Refused) -> str:
    return engine.install if isinstance(engine, Missing) else engine.reason
