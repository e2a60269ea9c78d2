"""Who takes the steps: our two engines, Pinocchio's own constrained dynamics in a Python loop, and its bare calls.

A contestant is prepared once and then runs laps. A lap gives the seconds that its steps took, if it knows them apart
from setting out, and where the arm ended: those that do the whole work must end at the same q.

They race on slides: one law, one step, on arms of two to thirty joints.

The mass matrix is computed in two ways: composite bodies, and a Newton–Euler pass a column. The paper takes
Featherstone's composite-rigid-body algorithm for H and calls the double recursion of Walker and Orin (1982) easy to
implement but computationally expensive. Both here by Pinocchio, so that nothing but the method differs.

MuJoCo on the same slide: driven from Python with the same law; bare, at rest under one contact; many at once.

The tip is a sphere of a micrometre on a frictionless plane, its contact answers within two steps; the arm is as
`validation.engines.mujoco` builds it: rigid bodies and nothing more. The solver has MuJoCo's defaults (Newton's method,
its tolerance, warm start), bodies that are fixed to each other are one, and islands are off, of which a single arm has
one: that is the quickest of what was tried. MuJoCo's contact is soft, so its numbers are near ours and not the same.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
import pinocchio as pin

import closedloop as cl
import robot_models
from closedloop.control.laws.paper import paper_law
from closedloop.jit.kernel import entry_kernel
from closedloop.loop.step.evaluate import PaperParameters
from closedloop.mechanics.robot.pinocchio import Terms
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.simulate import run_loop
from robot_models import RobotModel
from validation.engines.mujoco import TIP, build_spec, columns, compile_spec, disable, solve_to_rounding
from validation.oracle.spatial import Array

# MuJoCo's cones of friction: of Coulomb's law, and its default of four faces, which is quicker.
CONES = ("elliptic", "pyramidal")

Lap = Callable[[], tuple[float | None, Array | None]]
"""Runs a lap -> seconds of the steps alone, or None for all of it; what it came to, or None if it moves nothing."""


@dataclass(frozen=True)
class Contestant:
    """One row of the table.

    name, arm: who, and on which arm
    joints, steps: joints of the arm, and steps of a lap
    lap: see `Lap`
    wanted: what it must come to, if it does the whole work: q (n,), rad, at the end
    tolerance: how far from there it may be
    converged: what a lap comes to with a rigid contact and endlessly short steps, where that is known: its error is
        counted from there
    """

    name: str
    arm: str
    joints: int
    steps: int
    lap: Lap = field(repr=False)
    wanted: Array | None = field(default=None, repr=False)
    tolerance: float = 0.0
    what: str = ""
    converged: Array | None = field(default=None, repr=False)


def lap_of(problem: Problem, law: Any = None, engine: str = COMPILED, entries: int | None = None) -> Lap:
    """Return a lap of a loop of ours, which comes to q (n,) at the end, or its first entries."""
    count = problem.robot.n if entries is None else entries

    def lap() -> tuple[float | None, Array | None]:
        rows, _, failure, seconds = run_loop(problem, law, engine=engine)
        if failure is not None:
            raise failure
        return seconds, np.array(rows[-1, :count])

    return lap


def final(problem: Problem, law: Any = None) -> Array:
    """Return where the arm ends, q (n,): what every loop that does the whole work must come to."""
    end = lap_of(problem, law)()[1]
    assert end is not None
    return end


def converged(problem: Problem, law: Any = None) -> Array:
    """Return q (n,) at the end, of the fourth-order scheme with steps of a tenth: no error that would count here."""
    fine = problem.scenario.replace({"time.integrator": "rk4", "time.step": problem.h / 10.0})
    return final(cl.prepare(fine, problem.robot.model), law)


def with_errors(racing: Sequence[Contestant], problem: Problem, law: Any = None) -> list[Contestant]:
    """Return contestants with the converged answer of a problem, those that do its whole work."""
    exact = converged(problem, law)
    return [c if c.wanted is None or c.converged is not None else replace(c, converged=exact) for c in racing]


def our_engine(arm: str, problem: Problem, engine: str) -> Contestant:
    """Return a loop of our own: law, terms, Eq. 24, integration and recording."""
    what = "compiled engine" if engine == "compiled" else "Pinocchio engine"
    return Contestant(
        engine, arm, problem.robot.n, problem.steps, lap_of(problem, engine=engine), final(problem), 1e-11, what
    )


def whole_call(arm: str, problem: Problem) -> tuple[Contestant, Contestant]:
    """Return `cl.simulate` of a problem's scenario with the compiled engine, from call to Run, and its steps alone.

    The robot and the table of the path are those of the call before; the loop's memory and the columns are new.
    """

    def call() -> tuple[float, Array]:
        run = cl.simulate(problem.scenario, engine=COMPILED)
        return run.wall_seconds, run.q[-1]

    def whole() -> tuple[float | None, Array | None]:
        return None, call()[1]

    both = Contestant("call", arm, problem.robot.n, problem.steps, whole, final(problem), 1e-11, "cl.simulate, whole")
    return both, replace(both, name="call_steps", lap=call, what="cl.simulate, its steps")


def user_law(arm: str, problem: Problem) -> Contestant:
    """Return the compiled engine with Eq. 33 as a law of a user's own, compiled by numba."""
    (press, pd_start), (kp, kd), path = problem.settings, problem.gains, problem.path
    normal, h = problem.plane.normal, problem.h

    @numba.njit
    def law(t: float, q: Array, v: Array, terms: Terms, torque: Array) -> None:
        i = int(t / h + 0.5)
        for j in range(q.size):
            along = 0.0
            for k in range(3):
                along += normal[k] * terms.jacobian[k, j]
            torque[j] = terms.bias[j] - along * press
            if t >= pd_start:
                torque[j] -= kp[j] * (q[j] - path[i, 0, j]) + kd[j] * (v[j] - path[i, 1, j])

    compiled: Any = law
    what = "compiled, a user's law"
    return Contestant(
        "own_law", arm, problem.robot.n, problem.steps, lap_of(problem, compiled), final(problem), 1e-11, what
    )


def bare_calls(arm: str, problem: Problem) -> Contestant:
    """Return the calls into Pinocchio that a step of our Pinocchio engine makes, by themselves: its floor."""
    evaluate = problem.robot.evaluator(problem.q.copy(), problem.v.copy())
    steps = problem.steps

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(steps):
            evaluate()
        return None, None

    return Contestant("calls", arm, problem.robot.n, steps, lap, what="its bare calls")


def bare_algorithms(arm: str, problem: Problem) -> Contestant:
    """Return Pinocchio's own crba, rnea and Cholesky decomposition: what our growth with the joints is held against."""
    model = problem.robot.model.pinocchio_model()
    data, n, steps = model.createData(), problem.robot.n, problem.steps
    q, v, a = problem.q.copy(), problem.v.copy(), np.zeros(n)
    crba, rnea, decompose = pin.crba, pin.rnea, pin.cholesky.decompose

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(steps):
            crba(model, data, q)
            rnea(model, data, q, v, a)
            decompose(model, data)
        return None, None

    return Contestant("algorithms", arm, n, steps, lap, what="crba, rnea, Cholesky")


def pinocchio_loop(arm: str, problem: Problem) -> Contestant:
    """Return a loop in Python around `pinocchio.forwardDynamics` with the closure's row: how one would write it."""
    model = problem.robot.model.pinocchio_model()
    data, n, steps, h = model.createData(), problem.robot.n, problem.steps, problem.h
    frame, aligned = model.getFrameId(problem.robot.tip), pin.LOCAL_WORLD_ALIGNED
    surface = np.array([*problem.plane.normal, problem.plane.offset, *problem.stabiliser])
    rest, settings, law, path = np.zeros(n), problem.settings, problem.law.numbers, problem.path

    def lap() -> tuple[float | None, Array | None]:
        q, v = problem.q.copy(), problem.v.copy()
        torque, A, drift = np.zeros(n), np.zeros((1, n)), np.zeros(1)
        for i in range(steps):
            pin.computeAllTerms(model, data, q, v)
            pin.forwardKinematics(model, data, q, v, rest)
            pin.updateFramePlacement(model, data, frame)
            J = pin.getFrameJacobian(model, data, frame, aligned)
            acceleration = pin.getFrameClassicalAcceleration(model, data, frame, aligned).linear
            r = data.oMf[frame].translation
            _close(i, h, surface, settings, law, path, q, v, data.nle, J, r, acceleration, A, drift, torque)
            pin.forwardDynamics(model, data, torque, A, drift)
            _step(h, data.ddq, q, v)
        return None, q

    what = "forwardDynamics loop"
    return Contestant("forward_dynamics", arm, n, steps, lap, final(problem), 1e-11, what)


@entry_kernel
def _close(
    i: int, h: float, surface: Array, settings: Array, law: Array, path: Array, q: Array, v: Array, bias: Array,
    jacobian: Array, r: Array, acceleration: Array, A: Array, drift: Array, torque: Array,
) -> None:  # fmt: skip
    """Write the closure's row, its drift with Baumgarte's terms, and the torque of Eq. 33."""
    e, rate, along = -surface[3], 0.0, 0.0
    for k in range(3):
        e += surface[k] * r[k]
        along += surface[k] * acceleration[k]
    for j in range(q.shape[0]):
        A[0, j] = surface[0] * jacobian[0, j] + surface[1] * jacobian[1, j] + surface[2] * jacobian[2, j]
        rate += A[0, j] * v[j]
    drift[0] = along + surface[4] * rate + surface[5] * e
    par = PaperParameters(law, q.shape[0])
    paper_law(i * h, settings[0], par, (path[i, 0], path[i, 1]), (q, v), bias, A, torque)


@entry_kernel
def _step(h: float, qdd: Array, q: Array, v: Array) -> None:
    """Step by semi-implicit Euler."""
    for j in range(q.shape[0]):
        v[j] += h * qdd[j]
        q[j] += h * v[j]


def drake_loop(arm: str, problem: Problem) -> Contestant:
    """Return Drake's discrete plant with a nearly rigid contact, driven from Python with the same law."""
    from validation.engines.drake import slide_drake

    def lap() -> tuple[float | None, Array | None]:
        run = slide_drake(problem)
        # It takes one step more than there are, after the last row.
        return run.seconds * problem.steps / (problem.steps + 1), run.q[-1]

    what = "Drake from Python"
    return Contestant("drake", arm, problem.robot.n, problem.steps, lap, final(problem), 1e-4, what)


# The reach of a chain, its mass, and the drive inertia of each joint: those of an arm, whatever the number of joints.
REACH, MASS, ARMATURE = 1.2, 4.0, 0.1

SHIPPED = {"planar2": "planar2_slide", "wam4": "wam_slide", "panda": "panda_slide"}
CHAINS = {"chain12": 12, "chain30": 30}
ARMS = (*SHIPPED, *CHAINS)
"""The arms, by growing number of joints."""

START = 0.01
"""When the tip begins to move, s."""


def slide(arm: str, steps: int) -> Problem:
    """Return the slide of one of `ARMS` as numbers: `steps` steps of a millisecond, in motion from 10 ms on."""
    changes: dict[str, Any] = {
        "time.duration": steps * 1e-3, "reference.start": START, "reference.stop": 1e-3 * steps + 0.1,
    }  # fmt: skip
    if arm in SHIPPED:
        return cl.prepare(cl.load_scenario(SHIPPED[arm], changes))
    model = chain(CHAINS[arm])
    changes |= {
        "robot.model": arm, "start.q": model.home.tolist(), "start.v": [0.0] * model.n,
        "law.kp": 400.0, "law.kd": 40.0,
    }  # fmt: skip
    return cl.prepare(cl.load_scenario("wam_slide", changes), model)


def chain(n: int) -> RobotModel:
    """Return an arm of n equal links one after the other, its axes in turn across and along the vertical, bent."""
    length, mass = REACH / n, MASS / n
    side = mass * length**2 / 12
    parts = ['<robot name="chain">', '<link name="base"/>']
    for i in range(n):
        axis = "0 0 1" if i % 3 == 0 else "0 1 0"
        parts.append(
            f'<joint name="j{i}" type="revolute"><parent link="{f"l{i - 1}" if i else "base"}"/><child link="l{i}"/>'
            f'<origin xyz="{length if i else 0.0} 0 0"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
            f'<link name="l{i}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="{side / 10}" iyy="{side}" izz="{side}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
    parts.append(
        f'<joint name="mount" type="fixed"><parent link="l{n - 1}"/><child link="tip"/><origin xyz="{length} 0 0"/>'
        '</joint><link name="tip"/></robot>'
    )
    home = np.array([0.0 if i % 3 == 0 else (0.9 if i % 3 == 1 else 0.3) * 4.0 / n for i in range(n)])
    return robot_models.from_text(
        "\n".join(parts), "urdf", name=f"chain{n}", armature=np.full(n, ARMATURE), tip="tip", home=home, locked={}
    )


def composite_bodies(arm: str, problem: Problem) -> Contestant:
    """Return `pinocchio.crba`: H in one sweep over composite bodies."""
    model = problem.robot.model.pinocchio_model()
    data, q, steps = model.createData(), problem.q.copy(), problem.steps

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(steps):
            pin.crba(model, data, q)
        return None, np.triu(data.M).ravel()

    return Contestant("crba", arm, problem.robot.n, steps, lap, what="H by composite bodies")


def newton_euler_columns(arm: str, problem: Problem) -> Contestant:
    """Return H column by column from `pinocchio.rnea`: rest, no weight, and one unit acceleration a pass."""
    model = problem.robot.model.pinocchio_model().copy()
    model.gravity.linear = np.zeros(3)
    data, q, n, steps = model.createData(), problem.q.copy(), problem.robot.n, problem.steps
    rest, units, H = np.zeros(n), list(np.eye(n)), np.empty((n, n))

    def lap() -> tuple[float | None, Array | None]:
        for _ in range(steps):
            for j in range(n):
                H[:, j] = pin.rnea(model, data, q, rest, units[j])
        return None, np.triu(H).ravel()

    theirs = composite_bodies(arm, problem).lap()[1]
    assert theirs is not None
    scale = float(np.max(np.abs(theirs)))
    return Contestant("rnea_columns", arm, n, steps, lap, theirs, 1e-12 * scale, "H by Newton–Euler columns")


RADIUS = 1e-6
# How far an arm that should rest may move on its soft contact, rad.
AT_REST = 1e-4
REST_STEPS = 1000
"""Of an arm at rest under a constant torque, which is no stable state: after a second it has not moved yet."""


def slide_model(problem: Problem, exact: bool = False) -> Any:
    """Return the arm of a problem on its surface as MuJoCo's model, at its quickest, or `exact`: solved to rounding."""
    import mujoco

    spec, n = build_spec(problem.robot.model, problem.robot.tip), problem.plane.normal
    spec.option.timestep = problem.h
    if exact:
        solve_to_rounding(spec)
    spec.compiler.fusestatic = True
    disable(spec, "ISLAND")
    site = spec.site(TIP)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    quick: dict[str, Any] = {"solref": [2.0 * problem.h, 1.0], "condim": 1}
    site.parent.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=site.pos, mass=0.0, contype=1, conaffinity=2,
        **quick,
    )  # fmt: skip
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 1], zaxis=n, pos=n * (problem.plane.offset - RADIUS),
        contype=2, conaffinity=1, **quick,
    )  # fmt: skip
    model = compile_spec(spec)
    if not np.array_equal(columns(model, problem.robot.model), np.arange(problem.robot.n)):
        raise ValueError(f"MuJoCo has the joints of {problem.robot.model.name} in another order")
    return model


def driven(arm: str, problem: Problem) -> Contestant:
    """Return MuJoCo with the law of Eq. 33, compiled, between its two half steps, and the same columns recorded."""
    import mujoco

    model = slide_model(problem)
    data, site = mujoco.MjData(model), model.site(TIP).id
    n, steps, h = problem.robot.n, problem.steps, problem.h
    surface = np.array([*problem.plane.normal, problem.plane.offset])
    first, jacobian_of, second = mujoco.mj_step1, mujoco.mj_jacSite, mujoco.mj_step2

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = problem.q, problem.v
        rows, jacobian, A = np.zeros((steps, 4 * n + 9)), np.zeros((3, n)), np.zeros((1, n))
        fixed = (
            h, surface, problem.settings, problem.law.numbers, problem.path, data.qpos, data.qvel, data.qfrc_bias,
            jacobian, data.site_xpos[site], data.qacc, data.qfrc_constraint, data.qfrc_applied, A, rows,
        )  # fmt: skip
        for i in range(steps):
            first(model, data)
            jacobian_of(model, data, jacobian, None, site)
            _drive(i, *fixed)
            second(model, data)
        return None, data.qpos.copy()

    return Contestant("mujoco", arm, n, steps, lap, final(problem), 1e-4, "MuJoCo from Python")


def at_rest(problem: Problem) -> Array:
    """Return the torque (n,) that presses with f_des at the start and moves nothing."""
    terms = problem.robot.terms(problem.q, problem.v)
    return np.asarray(terms.bias - problem.settings[0] * (problem.plane.normal @ terms.jacobian))


def bare(arm: str, problem: Problem, exact: bool = False) -> Contestant:
    """Return ``mj_step`` alone, many steps a call, of an arm at rest that presses on the surface: one contact."""
    import mujoco

    model, torque = slide_model(problem, exact), at_rest(problem)
    data = mujoco.MjData(model)
    steps = min(problem.steps, REST_STEPS)

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qfrc_applied[:] = problem.q, torque
        mujoco.mj_step(model, data, steps)
        if data.ncon != 1:
            raise RuntimeError(f"MuJoCo ended with {data.ncon} contacts, where one is wanted")
        return None, data.qpos.copy()

    name, what = ("mj_step_exact", ", solved to rounding") if exact else ("mj_step", "")
    what = "MuJoCo: bare mj_step" + what
    return Contestant(name, arm, problem.robot.n, steps, lap, problem.q, AT_REST, what, problem.q)


def rollout(arm: str, problem: Problem, runs: int, threads: int) -> Contestant:
    """Return ``mujoco.rollout`` of many arms at rest, without a law, on some threads; states are recorded."""
    import mujoco
    from mujoco import rollout as rollouts

    model, n = slide_model(problem), problem.robot.n
    steps = min(problem.steps, REST_STEPS)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    datas[0].qpos[:] = problem.q
    full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, datas[0], start, full)
    state = np.zeros((runs, steps, start.size))
    torques = np.tile(at_rest(problem), (runs, steps, 1))
    starts = np.tile(start, (runs, 1))
    pool = rollouts.Rollout(nthread=threads if threads > 1 else 0)

    def lap() -> tuple[float | None, Array | None]:
        pool.rollout(
            model, datas, starts, torques, control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED), nstep=steps,
            state=state,
        )  # fmt: skip
        return None, state[-1, -1, 1 : 1 + n].copy()

    what = f"MuJoCo rollout, {threads} thread{'s' * (threads > 1)}"
    return Contestant(f"rollout_{threads}", arm, n, steps * runs, lap, problem.q, AT_REST, what, problem.q)


@entry_kernel
def _drive(
    i: int, h: float, plane: Array, settings: Array, law: Array, path: Array, q: Array, v: Array, bias: Array,
    jacobian: Array, tip: Array, qacc: Array, contact: Array, torque: Array, A: Array, rows: Array,
) -> None:  # fmt: skip
    """Record what MuJoCo computed and write the torque of Eq. 33.

    The acceleration and the contact force of a state are known only after its step, so they go into the row before.
    """
    n = q.shape[0]
    if i > 0:
        push, size = 0.0, 0.0
        for j in range(n):
            push += A[0, j] * contact[j]
            size += A[0, j] * A[0, j]
            rows[i - 1, 2 * n + j] = qacc[j]
        rows[i - 1, 4 * n + 6] = push / size  # contact = Aᵀf
    for j in range(n):
        A[0, j] = plane[0] * jacobian[0, j] + plane[1] * jacobian[1, j] + plane[2] * jacobian[2, j]
    par = PaperParameters(law, q.shape[0])
    paper_law(i * h, settings[0], par, (path[i, 0], path[i, 1]), (q, v), bias, A, torque)
    row = rows[i]
    rate = 0.0
    for j in range(n):
        row[j] = q[j]
        row[n + j] = v[j]
        row[3 * n + j] = torque[j]
        rate += A[0, j] * v[j]
    for k in range(3):
        row[4 * n + k] = tip[k]
        speed = 0.0
        for j in range(n):
            speed += jacobian[k, j] * v[j]
        row[4 * n + 3 + k] = speed
    row[4 * n + 7] = plane[0] * tip[0] + plane[1] * tip[1] + plane[2] * tip[2] - plane[3]
    row[4 * n + 8] = rate
