"""Mechanisms with loops: a four-bar beside MuJoCo's `connect`, a delta robot beside Pinocchio's `constraintDynamics`.

The mechanism coasts: the law takes weight and Coriolis terms away, and the tip touches nothing. Ours keeps the loops
closed to rounding and records all columns; MuJoCo's are soft, and Pinocchio's loop has no stabiliser.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

import closedloop as cl
import robot_models
from closedloop.mechanics.loops.assemble import closed_start, errors_at
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.simulation.engines.problem import Problem
from validation.engines.mujoco import build_spec, compile_spec
from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant, final, our_engine

MECHANISMS = ("four_bar", "delta")
FOUR_BAR, DELTA = MECHANISMS
# So far apart may they end, rad: a soft connection gives way, and a loop without stabiliser drifts, in half a second.
GIVES_WAY = 5e-3
STEPS = 500
# Runs of them in a lap.
RUNS = 16


def coasting(name: str) -> Problem:
    """Return a mechanism that coasts for half a second."""
    model = robot_models.load(name)
    robot = Robot(model)
    q, _ = closed_start(robot, np.array(model.home), np.zeros(model.n), True)
    memory = loop_memory(robot)
    errors_at(robot, memory, q, np.zeros(model.n))
    wanted = np.cos(np.arange(model.n))
    v = wanted - np.linalg.pinv(memory.rows.G, rcond=1e-8) @ (memory.rows.G @ wanted)
    changes: dict[str, Any] = {
        "surface.gap": 50.0, "surface.contact": "unilateral", "law.kp": 0, "law.kd": 0, "law.force": 0,
        "reference": {"kind": "hold"}, "stabiliser": {"kind": "none"}, "time.integrator": "semi_implicit_euler",
        "start.q": q.tolist(), "start.v": v.tolist(), "time.step": 1e-3, "time.duration": STEPS * 1e-3,
    }  # fmt: skip
    return cl.prepare(cl.load_scenario(name, changes))


def connect_model(problem: Problem) -> Any:
    """Return the four-bar with a `connect`, as MuJoCo's model."""
    import mujoco

    model = problem.robot.model
    spec = build_spec(model, problem.robot.tip)
    spec.option.timestep = problem.h
    for k, (frame, at) in enumerate(zip(model.loops[0].frames, model.loops[0].points, strict=True)):
        spec.body(frame).add_site(name=f"pin{k}", pos=at)
    pin = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1="pin0", name2="pin1"
    )
    pin.solref = [2.0 * problem.h, 1.0]
    return compile_spec(spec)


def connected(problem: Problem, driven: bool) -> Contestant:
    """Return MuJoCo's four-bar with a `connect`: the law between its half steps, or ``mj_step`` alone as it falls."""
    import mujoco

    made = connect_model(problem)
    data: Any = mujoco.MjData(made)
    first, second, steps = mujoco.mj_step1, mujoco.mj_step2, problem.steps

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(made, data)
        data.qpos[:], data.qvel[:] = problem.q, problem.v
        if not driven:
            mujoco.mj_step(made, data, steps)
            return None, None
        bias, torque = data.qfrc_bias, data.qfrc_applied
        for _ in range(steps):
            first(made, data)
            torque[:] = bias
            second(made, data)
        return None, data.qpos.copy()

    wanted = final(problem) if driven else None
    what = "MuJoCo from Python, connect" if driven else "MuJoCo: bare mj_step, connect"
    name = "mujoco" if driven else "mj_step"
    return Contestant(name, FOUR_BAR, problem.robot.n, steps, lap, wanted, GIVES_WAY, what)


def constrained(problem: Problem) -> Contestant:
    """Return a loop in Python around `pinocchio.constraintDynamics` with a contact of three rows for each ball."""
    import pinocchio as pin

    model, robot = problem.robot.model.pinocchio_model(), problem.robot.model
    data, h, steps = model.createData(), problem.h, problem.steps
    balls: Any = pin.StdVec_RigidConstraintModel()
    datas: Any = pin.StdVec_RigidConstraintData()
    for joint in robot.loops:
        sides: list[Any] = []
        for name, at in zip(joint.frames, joint.points, strict=True):
            frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
            sides += [frame.parentJoint, frame.placement * pin.SE3(np.eye(3), np.array(at))]
        balls.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *sides, pin.LOCAL))
        datas.append(balls[len(balls) - 1].createData())
    pin.initConstraintDynamics(model, data, balls, datas)
    solve, bias, other = pin.constraintDynamics, pin.nonLinearEffects, model.createData()

    def lap() -> tuple[float | None, Array | None]:
        q, v = problem.q.copy(), problem.v.copy()
        for _ in range(steps):
            torque = bias(model, other, q, v)
            proximal = pin.ProximalSettings(1e-14, 1e-8, 50)  # at a μ of 0 it is wrong where rows come near to others
            v += h * solve(model, data, q, v, torque, balls, datas, proximal)
            q += h * v
        return None, q

    what = "constraintDynamics loop"
    return Contestant("constraint_dynamics", DELTA, robot.n, steps, lap, final(problem), GIVES_WAY, what)


def racing(name: str, with_mujoco: bool) -> list[Contestant]:
    """Return everyone who moves a mechanism, one of `MECHANISMS`."""
    problem = coasting(name)
    everyone = [our_engine(name, problem, "compiled")]
    if name == DELTA:
        everyone.append(constrained(problem))
    elif with_mujoco:
        everyone += [connected(problem, True), connected(problem, False)]
    return [again_and_again(one) for one in everyone]


def again_and_again(one: Contestant) -> Contestant:
    """Return a contestant whose lap is `RUNS` of another's: one takes a millisecond, less than a turn of the computer.

    On a computer that is shared, all of a shorter lap may fall to others, or none.
    """

    def lap() -> tuple[float | None, Array | None]:
        total, end = 0.0, None
        for _ in range(RUNS):
            seconds, end = one.lap()
            total = math.nan if seconds is None else total + seconds
        return None if math.isnan(total) else total, end

    return replace(one, steps=RUNS * one.steps, lap=lap)
