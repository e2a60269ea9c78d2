"""What is said of a case: by the oracle, by both engines of the loop, and by peers that take a row as it is.

The tables of the harness on contact with surfaces. Faults are planted in each term that a plane at rest does not have.
The loop is compiled: what can be made wrong in it is what it calls and what it is given, which are a surface that
forgets a derivative, a motion that does, a stiffness in another unit, an arm without its tool.

MuJoCo's own soft contact of a mass with a ball, found by its own collision detection, beside Kelvin and Voigt's law.

MuJoCo's constraint is a law of accelerations: with ``solref = (-S, -D)`` and an impedance d that does not depend on the
depth it gives a mass m the force

    f = m (S δ + D δ̇) − d m a₀

a₀ the acceleration along the normal without contact. S = k/m and D = damping/m make it a spring of k N/m, but for the
last term, which no setting removes: d is at least 1e-4. It is the bound of the comparison, and the reason for which
MuJoCo's contact is no second solver of ours: on an arm m is not the tip's mass at the state, but one at its zero pose.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import closedloop as cl
import robot_models
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel
from closedloop.jit.parameters import parameter_block
from closedloop.jit.user_code import function_of
from closedloop.loop.events.locate import DONE
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.contact_force import PRESSED, STUCK
from closedloop.mechanics.surface import geometry
from closedloop.mechanics.surface.compliances.kelvin_voigt import KelvinVoigt
from closedloop.mechanics.surface.contact import FOUND, NO_NORMAL, ask_at
from closedloop.mechanics.surface.kinds.ellipsoid import Ellipsoid
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.motions.none import NoMotion
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import SURFACES, Surface
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.loop_calls import Driver
from validation.engines import Engine, Missing, available
from validation.engines.drake import Drake
from validation.engines.exudyn import Exudyn
from validation.engines.interface import Tolerance, installed, size, worst_of
from validation.engines.loop import as_robot_model
from validation.engines.mujoco import MuJoCo
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.engines.robotics_toolbox import RoboticsToolbox
from validation.oracle.spatial import Array
from validation.oracle.surface import Shape, SurfaceContact, Touch
from validation.plant import Catch, catch_of
from validation.report import Check, Section
from validation.states import random_robot
from validation.surfaces.cases import (
    GAINS,
    MATERIALS,
    SHAPES,
    SMOOTH,
    SOFT,
    Case,
    Tumble,
    contact_of,
    draw_case,
    oracle_with_tool,
)

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
    there = on_surface(base, placed)
    return replace(there, q=case.q, v=case.v, mode=mode, frame=placed.frame, stabiliser=np.array(GAINS))


def on_surface(problem: Problem, placed: PlacedSurface) -> Problem:
    """Return a problem with another surface."""
    return replace(problem, surface=placed, there=placed)


def ask_loop(case: Case, engine: str, fault: Callable[[Problem], Problem] = lambda problem: problem) -> Answer:
    """Return what a loop's engine records in the first row of a run from the case's state, with a fault.

    Raises `LinAlgError` if it does not record a row.
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


def ask_peer(case: Case, engine: Engine) -> Answer:
    """Return what an engine makes of the oracle's row and right side: of a rigid, smooth surface.

    It shows that the row, given, is the same constraint to an engine that knows nothing of surfaces.
    """
    touch = ask_oracle(case)[2]
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
        groups[name] = [draw_case(name, model, str(model.tip), seed, index) for index in range(states)]
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
            why = engine.install if isinstance(engine, Missing) else engine.reason
            yield Check(what, engine.name, math.nan, math.nan, None, why)
        elif "constrained" not in engine.covers:
            yield Check(what, engine.name, math.nan, math.nan, None, engine.cannot["constrained"])
        else:
            own = engine.tolerances.get("constrained")
            bound = max(ON_SURFACES.value, own.value if own else 0.0)
            value, _ = worst_error(smooth, partial(ask_peer, engine=engine))
            yield Check(what, engine.name, value, bound, value <= bound, ENGINES_WITHOUT_SHAPES)


MASS, RADIUS, PROBE = 2.0, 0.3, 0.02
IMPEDANCE = 1e-4
STIFFNESSES = tuple(10.0**power for power in range(2, 8))
# Of what is left when the impedance's share is taken away: its own rounding, and that of the depth.
ROUNDING = 1e-9


def ball(stiffness: float, damping: float) -> str:
    """Return a mass on three slides above a fixed ball as MuJoCo's XML."""
    solve = f'condim="1" solref="{-stiffness / MASS!r} {-damping / MASS!r}" solimp="{IMPEDANCE} {IMPEDANCE} 1"'
    return f"""<mujoco><worldbody><geom type="sphere" size="{RADIUS}" {solve}/><body pos="0 0 0">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{PROBE}" mass="{MASS}" {solve}/></body></worldbody></mujoco>"""


def force_by_mujoco(stiffness: float, damping: float, r: Array, v: Array) -> tuple[float, float]:
    """Return f and a₀ of the mass at r (3,), m, from the ball's centre, that moves with v (3,), m/s."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(ball(stiffness, damping))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = r, v
    mujoco.mj_forward(model, data)
    out = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, out)
    return float(out[0]), float(data.qacc_smooth @ data.contact[0].frame[:3])


def soft_contact_section(seed: int = 0, states: int = 5) -> Section:
    """Compare f of both at random places, depths and velocities, for stiffnesses of 1e2 to 1e7 N/m."""
    section = Section("a mass on a soft ball: MuJoCo's own contact beside Kelvin–Voigt of the same k, relative f")
    if not installed(MuJoCo):
        section.checks.append(Check("f", "mujoco", math.nan, math.nan, None, str(Missing("mujoco", MuJoCo.install))))
        return section
    section.checks += _rows(seed, states)
    return section


def _rows(seed: int, states: int) -> Iterator[Check]:
    surface = PlacedSurface.of(Sphere(radius=RADIUS + PROBE), NoMotion(), np.array([0.0, 0.0, RADIUS + PROBE]))
    for k in STIFFNESSES:
        rng, law = np.random.default_rng(seed), KelvinVoigt(stiffness=k, damping=0.1 * math.sqrt(k * MASS))
        worst, left = 0.0, 0.0
        for _ in range(states):
            n, v = rng.normal(size=3), rng.normal(scale=0.1, size=3)
            r = (RADIUS + PROBE - min(0.01, 50.0 / k)) * n / np.linalg.norm(n)
            v -= max(0.0, float(v @ n)) * n / float(n @ n)  # into the ball: f > 0
            now = surface.touching(r, v)
            ours = law.force(-now.gap, -float(now.frame[0] @ v), law)
            theirs, free = force_by_mujoco(k, law.damping, r, v)
            worst = max(worst, abs(theirs - ours) / ours)
            left = max(left, abs(theirs + IMPEDANCE * MASS * free - ours) / ours)
        note = f"−d m a₀ of its impedance d = {IMPEDANCE:g} taken away; with it they are {worst:.0e} apart"
        yield Check(f"k = {k:.0e} N/m", "mujoco", left, ROUNDING, left <= ROUNDING, note)


# So many cases that have what a fault touches.
CASES = 3
_level = function_of(Ellipsoid, "level")


class NoCurvature(Ellipsoid):
    """An ellipsoid whose ∇∇φ is forgotten."""

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ, and ∇φ alone."""
        value = _level(p, par, gradient, hessian)
        for i in range(3):
            hessian[i, i] = 0.0
        return float(value)


class WrongCurvature(Ellipsoid):
    """An ellipsoid whose ∇∇φ has the wrong sign."""

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return φ, ∇φ and −∇∇φ."""
        value = _level(p, par, gradient, hessian)
        for i in range(3):
            hessian[i, i] = -hessian[i, i]
        return float(value)


_move = function_of(Tumble, "move")


class NoVelocity(Tumble):
    """A motion whose velocity is forgotten."""

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write displacement and acceleration."""
        _move(t, par, m)
        m.rate = 0.0
        for i in range(3):
            m.shift_rate[i] = 0.0


class NoAcceleration(Tumble):
    """A motion whose acceleration is forgotten."""

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write displacement and velocity."""
        _move(t, par, m)
        m.acceleration = 0.0
        for i in range(3):
            m.shift_acceleration[i] = 0.0


_Parameters = parameter_block(Ellipsoid)


@entry_kernel
def _entry_without_turning(address: int, what: int) -> int:
    """Answer as the entry of an ellipsoid, but for a contact frame that is taken not to turn: u̇ = N (r̈ − d/dt v₀)."""
    links, ask = ask_at(address)
    call_at(links.motion, address, 0)
    pose, touch = geometry.Pose(ask.pose), geometry.Touch(ask.touch)
    geometry.into_surface_axes(pose, ask.r, touch)
    touch.level = _level(touch.at, _Parameters(ask.par, links.entries), touch.gradient, touch.hessian)
    if not geometry.contact_geometry(pose, links.motion != 0, ask.r, ask.velocity, ask.frame, touch):
        return NO_NORMAL
    t0, t1, t2 = touch.turning[0], touch.turning[1], touch.turning[2]
    x0, x1, x2 = touch.at[0], touch.at[1], touch.at[2]
    going = touch.at  # scratch: the velocity relative to the surface, in its axes
    for i in range(3):
        going[i] = 0.0
        for k in range(3):
            along = -touch.carried[k]
            for j in range(3):
                along += ask.frame[k, j] * ask.velocity[j]
            going[i] += touch.local[k, i] * along
    geometry.frame_and_turning(going, touch)
    w0 = pose.axes[0, 0] * going[0] + pose.axes[1, 0] * going[1] + pose.axes[2, 0] * going[2]
    w1 = pose.axes[0, 1] * going[0] + pose.axes[1, 1] * going[1] + pose.axes[2, 1] * going[2]
    w2 = pose.axes[0, 2] * going[0] + pose.axes[1, 2] * going[1] + pose.axes[2, 2] * going[2]
    o = pose.spin
    x, y, z = o[1] * w2 - o[2] * w1, o[2] * w0 - o[0] * w2, o[0] * w1 - o[1] * w0
    for i in range(3):
        turned = ask.frame[i, 0] * x + ask.frame[i, 1] * y + ask.frame[i, 2] * z
        touch.turning[i] = (t0 if i == 0 else (t1 if i == 1 else t2)) - touch.turning[i] + turned
    touch.at[0], touch.at[1], touch.at[2] = x0, x1, x2
    return FOUND


class NotTurning(PlacedSurface):
    """A surface with that entry."""

    def entries(self) -> dict[str, Any]:
        """Return what the loop calls."""
        return super().entries() | {"surface": _entry_without_turning}


@dataclass(frozen=True)
class SurfaceFault:
    """A fault in a term that curved, moving or soft surfaces have.

    case, material: number of a case that has the term, and what its surface is made of
    oracle, loop: SurfaceContact or Problem, and the case -> the faulty one
    """

    name: str
    case: int
    material: str
    oracle: Callable[[SurfaceContact, Case], SurfaceContact]
    loop: Callable[[Problem, Case], Problem]


def _bent(factor: float) -> Callable[[SurfaceContact, Case], SurfaceContact]:
    """Return a fault of the oracle: ∇∇φ times a factor."""

    def fault(contact: SurfaceContact, case: Case) -> SurfaceContact:
        sound = contact.shape
        return replace(contact, shape=Shape(sound.level, sound.gradient, lambda p: factor * sound.hessian(p)))

    return fault


def _without(**methods: Callable[..., Array]) -> Callable[[SurfaceContact, Case], SurfaceContact]:
    """Return a fault of the oracle: methods in place of its own."""
    kind = type("FaultyContact", (SurfaceContact,), methods)
    return lambda contact, case: kind(**contact.__dict__)


def _shaped(member: type[Surface]) -> Callable[[Problem, Case], Problem]:
    """Return a fault of the loop: another class of surface, with the same parameters."""

    def fault(problem: Problem, case: Case) -> Problem:
        own = {key: value for key, value in case.section.items() if key != "kind"}
        return on_surface(problem, replace(problem.surface, section=member(**own)))

    return fault


def _moving(member: type[Tumble]) -> Callable[[Problem, Case], Problem]:
    """Return a fault of the loop: another class of motion, with the same parameters."""
    return lambda problem, case: on_surface(
        problem, replace(problem.surface, motion=member(**case.moving.model_dump(exclude={"kind"})))
    )


def _stiffness_per_mm(problem: Problem, case: Case) -> Problem:
    numbers = problem.compliance.numbers * [1e-3, 1.0]
    return replace(problem, compliance=problem.compliance._replace(numbers=numbers))


FAULTS = (
    SurfaceFault("curvature dropped", 4, SMOOTH, _bent(0.0), _shaped(NoCurvature)),
    SurfaceFault("Hessian sign", 4, SMOOTH, _bent(-1.0), _shaped(WrongCurvature)),
    SurfaceFault(
        "Ṅ dropped", 4, SMOOTH, _without(frame_rate=lambda self, *at: np.zeros((3, 3))),
        lambda problem, case: on_surface(problem, NotTurning(**_fields(problem.surface))),
    ),
    SurfaceFault(
        "surface velocity dropped", 4, SMOOTH, _without(surface_velocity=lambda self: np.zeros(6)), _moving(NoVelocity)
    ),
    SurfaceFault(
        "surface acceleration dropped", 4, SMOOTH, _without(surface_acceleration=lambda self: np.zeros(6)),
        _moving(NoAcceleration),
    ),
    SurfaceFault(
        "stiffness per mm", 4, SOFT, lambda contact, case: replace(contact, push=_softer(case)), _stiffness_per_mm
    ),
    SurfaceFault(
        "tool dropped", 14, SMOOTH,
        lambda contact, case: replace(contact, oracle=oracle_with_tool(case.robot, case.tip, {})),
        lambda problem, case: replace(
            problem, robot=problem_of(replace(case, tool={}), problem.surface).robot
        ),
    ),
)  # fmt: skip


def _fields(surface: PlacedSurface) -> dict[str, Any]:
    return {name: getattr(surface, name) for name in ("section", "motion", "frame", "origin", "below_start")}


def _softer(case: Case) -> Callable[[float, float], float]:
    par = MATERIALS[case.material]["compliance"]
    return lambda depth, speed: 1e-3 * par["stiffness"] * depth + par["damping"] * speed


def plant_on_surfaces(robot: str = "panda", seed: int = 0, faults: Sequence[SurfaceFault] = FAULTS) -> list[Catch]:
    """Plant every fault in the oracle and in both engines of the loop, and return what caught it."""
    model = robot_models.load(robot)
    catches = []
    for fault in faults:
        cases = [
            replace(draw_case(robot, model, str(model.tip), seed, fault.case + 30 * k), material=fault.material)
            for k in range(CASES)
        ]
        for carrier in ("oracle", *LOOPS):
            catches.append(_caught(fault, carrier, cases))
    return catches


def _caught(fault: SurfaceFault, carrier: str, cases: list[Case]) -> Catch:
    """Compare the faulty one with a sound one: the oracle, or a loop where the oracle is faulty."""

    def found(case: Case) -> dict[str, float]:
        if carrier == "oracle":
            truth, scales, _ = ask_oracle(case, lambda contact: fault.oracle(contact, case))
            return errors(ask_loop(case, LOOPS[0]), truth, scales)
        truth, scales, _ = ask_oracle(case)
        return errors(ask_loop(case, carrier, lambda problem: fault.loop(problem, case)), truth, scales)

    return catch_of(fault.name, carrier, map(found, cases), ON_SURFACES.value)
