"""MuJoCo on the same slide: driven from Python with the same law; bare, at rest under one contact; many at once.

The tip is a sphere of a micrometre on a frictionless plane, its contact answers within two steps; the arm is as
`validation.engines.mujoco` builds it: rigid bodies and nothing more. The solver has MuJoCo's defaults (Newton's method,
its tolerance, warm start), bodies that are fixed to each other are one, and islands are off, of which a single arm has
one: that is the quickest of what was tried. MuJoCo's contact is soft, so its numbers are near ours and not the same.
"""

from typing import Any

import numpy as np

from closedloop.control.laws.paper import paper_law
from closedloop.jit.kernel import entry_kernel
from closedloop.loop.step.evaluate import PaperParameters
from closedloop.simulation.engines.problem import Problem
from validation.engines.mujoco import TIP, build_spec, columns, compile_spec, disable, solve_to_rounding
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final

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
