"""What the kernels of a step write, one at a time, in the memory of a loop that is ready to run."""

import numpy as np
import pytest
from random_loop import loop_at_random

import closedloop as cl
from closedloop.control.law import Perceived
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.closed_loops import BIND_LOAD, REACTION, closed_loops, factorise_tip
from closedloop.loop.step.energy_supplied import add_stage_work, commit_work, save_power
from closedloop.loop.step.joint_friction import _delayed, add_joint_friction, hold_joints, stick_or_slip_joints
from closedloop.loop.step.locate import (
    MOTORS_MEASURED,
    apply_model_error,
    locate_tip,
    off_anchor,
    perceive,
    read_joints,
    set_anchor,
)
from closedloop.loop.step.solve_contact import soft_contact_force, spring_energy
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.loops.rows import locate_rows

SHORT, HOLD = {"time.duration": 0.01}, {"reference": {"kind": "hold"}}
STICKING = {"friction.kind": "coulomb", "friction.coefficient": 0.4}
EGG = {
    "surface.kind": "ellipsoid", "surface_motion.kind": "turntable", "surface_motion.axis": [0.2, 0.1, 1.0],
    "surface_motion.speed": 0.7, "surface_motion.centre": [0.1, 0.2, 0.0], "reference": {"kind": "hold"},
    "surface.contact": "unilateral", "time.duration": 0.01,
}  # fmt: skip


def test_the_tip_is_where_the_surface_says():
    """Gap, frame and the surface's motion are its answers for place, velocity and time; where it stuck turns along."""
    surface = cl.prepare(cl.load_scenario("wam_slide", EGG)).surface
    loop, _, rng = loop_at_random("wam_slide", EGG)
    state, constants, w = loop.state, loop.constants, loop.w
    w.J[:], w.drift[:], w.time, state.mode = rng.normal(size=(3, 4)), rng.normal(size=3), 0.3, FREE
    w.r[:] = surface.origin + 0.02 * rng.normal(size=3)
    assert interpreted(locate_tip)(w, constants, state) == 0
    now = surface.touching(w.r, w.J @ w.v, 0.3)
    assert w.tip.gap == now.gap
    assert abs(now.level / now.gap - 1.0) > 1e-6  # φ is no distance
    np.testing.assert_array_equal(w.tip.frame, now.frame)
    np.testing.assert_allclose(w.tip.u, now.frame @ w.J @ w.v - now.carried, atol=1e-14)
    np.testing.assert_allclose(w.tip.drift_c, now.frame @ w.drift + now.turning, atol=1e-13)
    assert w.tip.rate == w.tip.u[0]
    set_here, off = interpreted(set_anchor), interpreted(off_anchor)
    set_here(w, state)
    assert off(w, state, 1) == off(w, state, 2) == 0.0
    frame, step = w.tip.frame.copy(), 1e-7 * rng.normal(size=3)
    w.r += step
    interpreted(locate_tip)(w, constants, state)
    np.testing.assert_allclose([off(w, state, 1), off(w, state, 2)], frame[1:] @ step, atol=1e-12)


def test_the_law_sees_the_surface_that_it_believes_in():
    """A frame that is tilted, with all that is told in it: velocities, the surface's motion and what is desired."""
    loop, H, rng = loop_at_random("wam_slide", SHORT | {"model_error.normal": 0.3, "model_error.normal_towards": 0.8})
    state, constants, w = loop.state, loop.constants, loop.w
    tilt, wanted, seen = constants.tilt, w.reference, Perceived(w.perceived, 4)
    w.tip.frame[:] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for array in (w.J, w.r, w.drift, w.tip.carried, w.tip.turning, wanted.memory):
        array[:] = rng.normal(size=array.shape)
    asked = np.array([wanted.position, wanted.velocity, wanted.acceleration])
    assert interpreted(perceive)(H, rng.normal(size=4), w, constants, state) == 0
    frame = tilt @ w.tip.frame
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(seen.frame, frame, atol=1e-14)
    np.testing.assert_allclose(seen.u, tilt @ (w.tip.frame @ w.J @ w.v - w.tip.carried), atol=1e-13)
    np.testing.assert_allclose(seen.drift_c, tilt @ (w.tip.frame @ w.drift + w.tip.turning), atol=1e-13)
    np.testing.assert_allclose(wanted.position, frame @ asked[0], atol=1e-13)
    np.testing.assert_allclose(wanted.velocity, frame @ asked[1] - tilt @ w.tip.carried, atol=1e-13)
    np.testing.assert_allclose(wanted.acceleration, frame @ asked[2] + tilt @ w.tip.turning, atol=1e-13)


@pytest.mark.parametrize("masses", [1.0, 1.3])
def test_what_the_controller_believes_is_the_arm_without_its_payload(masses):
    """H and C of Pinocchio without the payload, with all masses wrong by a factor, the drives' inertia apart."""
    changes = SHORT | {"model_error.payload": 0.7, "model_error.masses": masses}
    carrying = cl.prepare(cl.load_scenario("wam_slide", changes)).robot
    empty = cl.prepare(cl.load_scenario("wam_slide", SHORT)).robot
    loop, _, rng = loop_at_random("wam_slide", changes)
    constants, w = loop.constants, loop.w
    q, v = rng.normal(size=4), rng.normal(size=4)
    true, believed = carrying.terms(q, v), empty.terms(q, v)
    drives = np.diag(constants.armature)
    assert np.all(constants.armature > 0.0)
    full = np.triu(true.mass_matrix) + np.triu(true.mass_matrix, 1).T
    own = np.triu(believed.mass_matrix) + np.triu(believed.mass_matrix, 1).T
    w.H[:], w.C[:], w.J[:], w.drift[:] = full, true.bias, true.jacobian, true.drift
    interpreted(apply_model_error)(w, constants)
    np.testing.assert_allclose(w.H, masses * (own - drives) + drives, atol=1e-12)
    np.testing.assert_allclose(w.C, masses * believed.bias, atol=1e-11)
    assert np.max(np.abs(full - own)) > 0.01


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_the_work_of_a_substep_is_that_of_all_forces(integrator):
    """Of joints and tip, on a surface that moves; with one stage to second order in its length."""
    loop, _, rng = loop_at_random("wam_slide", SHORT | {"time.integrator": integrator})
    state, w = loop.state, loop.w
    for array in (w.torque, w.joint_friction.torque, w.tip.F, w.tip.drift_c, w.tip.turning, w.qdd):
        array[:] = rng.normal(size=array.shape)
    w.tip.a[:] = w.tip.A @ w.qdd + w.tip.drift_c - w.tip.S @ w.tip.F
    joints = w.torque + w.joint_friction.torque
    power = joints @ w.v + w.tip.F @ (w.tip.A @ w.v)
    rate = joints @ w.qdd + w.tip.F @ (w.tip.A @ w.qdd + w.tip.drift_c - w.tip.turning)
    one = integrator != "rk4"
    interpreted(save_power)(w, state)
    assert w.supply.power == pytest.approx(power, rel=1e-12)
    assert w.supply.power_rate == pytest.approx(rate if one else 0.0, rel=1e-10)
    w.supply.energy, w.supply.work, tau = 5.0, 100.0, 0.1
    interpreted(add_stage_work)(w, state, 0, tau, 0.25)
    work = tau * 0.25 * (power + (0.5 * tau * rate if one else 0.0))
    assert w.supply.work == pytest.approx(work, rel=1e-10)
    w.v[:] = rng.normal(size=4)
    w.tip.u[:] = w.tip.A @ w.v - w.tip.carried
    interpreted(add_stage_work)(w, state, 1, tau, 0.75)
    work += tau * 0.75 * (joints @ w.v + w.tip.F @ (w.tip.A @ w.v))
    interpreted(commit_work)(w)
    assert w.supply.energy == pytest.approx(5.0 + work, rel=1e-10)
    assert w.supply.work == 0.0


@pytest.mark.parametrize(("kind", "power"), [("kelvin_voigt", 1.0), ("hunt_crossley", 1.5)])
def test_energy_of_a_soft_surface_is_the_integral_of_its_force_at_rest(kind, power):
    """k δ^(p + 1)/(p + 1), whatever its damping; and f, depth and rate are as they were."""
    damping = {"damping": 40.0} if power == 1.0 else {"dissipation": 0.5}
    changes = {"compliance": {"kind": kind, "stiffness": 1e4, **damping}, "surface.contact": "unilateral"}
    loop, _, _ = loop_at_random("wam_slide", SHORT | changes)
    state, constants, w = loop.state, loop.constants, loop.w
    w.tip.gap, w.tip.rate, w.tip.F[0] = -0.003, -0.2, 77.0
    stored = interpreted(spring_energy)(w, constants, state)
    assert stored == pytest.approx(1e4 * 0.003 ** (power + 1.0) / (power + 1.0), rel=1e-12)
    assert (w.tip.gap, w.tip.rate, w.tip.F[0]) == (-0.003, -0.2, 77.0)


@pytest.mark.parametrize("mode", [FREE, PRESSED, STUCK])
def test_dry_friction_of_joints_stops_what_it_can(mode):
    """Each joint is at rest at the end of the step, or braked by all of its friction; the tip keeps its contact."""
    changes = {"joint_friction.kind": "coulomb", "joint_friction.kinetic": [0.5, 1.0, 1.5, 0.0]}
    held, braked = 0, 0
    loop, H, rng = loop_at_random("wam_slide", SHORT | changes | STICKING)
    state, constants, w, h = loop.state, loop.constants, loop.w, loop.constants.h
    constants.joint_capture_speed[:], state.mode = 1e3, mode
    for _ in range(20):
        w.v[:], w.qdd[:], w.friction.c[:] = 1e-3 * rng.normal(size=4), rng.normal(size=4), 0.2 * rng.normal(size=2)
        rows = w.tip.A[: {FREE: 0, PRESSED: 1, STUCK: 3}[mode]]
        for motion in (w.v, w.qdd):
            motion -= np.linalg.pinv(rows) @ rows @ motion
        w.joint_friction.torque[:], w.joint_friction.dry[:], w.joint_friction.slip[:], before = (
            0.1,
            0.0,
            w.v,
            w.qdd.copy(),
        )
        w.joint_friction.direction[:], w.joint_friction.lagged[:] = np.sign(w.v), np.abs(w.v)
        w.scratch.numbers[:], w.impact.before[:] = 99.0, 99.0
        assert interpreted(hold_joints)(w, constants, state)
        dry, limit = w.joint_friction.torque - 0.1, [0.5, 1.0, 1.5, 0.0]
        np.testing.assert_allclose(w.joint_friction.limit, limit)
        change, end = w.qdd - before, w.v + h * w.qdd
        for j in range(4):
            if abs(dry[j]) < limit[j] * (1.0 - 1e-9):
                assert abs(end[j]) < 1e-12
                held += 1
            else:
                assert abs(dry[j]) <= limit[j] * (1.0 + 1e-12)
                assert dry[j] * end[j] <= 1e-15
                braked += limit[j] > 0.0
        np.testing.assert_allclose(rows @ change, 0.0, atol=1e-9)
        force = np.linalg.lstsq(w.tip.A.T, H @ change - dry, rcond=None)[0]  # of the contact
        np.testing.assert_allclose(w.tip.A.T @ force, H @ change - dry, atol=1e-9)
        if mode != STUCK:
            wanted = 0.0 if mode == FREE else force[0] * np.array([1.0, *-w.friction.c])
            np.testing.assert_allclose(force, wanted, atol=1e-9)
    assert held > 1
    assert braked > 1


@pytest.mark.parametrize("since", [0.0, 0.3, 1.0])
def test_friction_of_a_joint_that_lags_knows_its_speed_a_while_ago(since):
    """On lines between the rows, and from the latest row to now; before the first it is the first."""
    loop, _, _ = loop_at_random("wam_slide", SHORT)
    state, constants, w, h = loop.state, loop.constants, loop.w, loop.constants.h
    state.row, w.time = 4, (3.0 + since) * h  # rows 0 to 3 are recorded
    speeds, j = np.array([0.4, -0.7, 0.1, -0.9]), 2
    rows, w.v[:] = np.full((8, 12), np.nan), np.nan
    rows[:4, 4 + j], w.v[j] = speeds, 0.5
    at = [0.0, h, 2.0 * h, 3.0 * h] + ([w.time] if since else [])
    known = np.abs([*speeds, 0.5])[: len(at)]
    for delay in (0.1, 0.25, 0.9, 1.0, 1.7, 2.5, 3.0, 9.0):
        constants.joint_lag[j] = delay * h
        wanted = np.interp(w.time - delay * h, at, known)
        assert interpreted(_delayed)(w, constants, state, rows, j) == pytest.approx(wanted, rel=1e-12)
    constants.joint_lag[j] = 0.0
    assert interpreted(_delayed)(w, constants, state, rows, j) == 0.5


@pytest.mark.parametrize("pulls", [False, True])
def test_friction_on_a_soft_surface_is_that_of_its_force(pulls):
    """k δ along the normal, and across it μ|f| in one direction, turned with slow slip, beside the viscous part."""
    changes = STICKING | {"compliance": {"kind": "kelvin_voigt", "stiffness": 1e4, "damping": 0.0}}
    loop, H, rng = loop_at_random("wam_slide", SHORT | changes)
    state, constants, w, turned = loop.state, loop.constants, loop.w, 0
    state.mode, w.tip.rate, w.tip.gap = PRESSED, 0.0, 0.002 if pulls else -0.002
    f = -1e4 * w.tip.gap
    for speed in (1e-6, 1e-5, 1e-4, 1e-3, 1.0):
        ahead = rng.normal(size=2)
        ahead /= np.linalg.norm(ahead)
        w.tip.u[1:], w.friction.c[:], w.friction.viscous[:], w.y[:], w.tip.a[:] = (
            speed * ahead, 0.4 * ahead, rng.normal(size=2), rng.normal(size=4), rng.normal(size=3),
        )  # fmt: skip
        w.friction.direction[:], w.tip.F[:] = ahead, np.nan
        interpreted(soft_contact_force)(w, constants, state)
        assert w.tip.F[0] == pytest.approx(f, rel=1e-14)
        rub = w.tip.F[1:] + w.friction.viscous
        np.testing.assert_allclose(rub, -w.friction.c * f, rtol=1e-9)
        assert np.linalg.norm(rub) == pytest.approx(0.4 * abs(f), rel=1e-9)
        ways = rub @ ahead / np.linalg.norm(rub)
        turned += ways > -1.0 + 1e-6
        assert ways == pytest.approx(-1.0, abs=1e-4) or speed < 1.0
        L = np.tril(w.L, -1) + np.diag(1.0 / np.diag(w.L))  # its diagonal holds reciprocals
        np.testing.assert_allclose(H @ w.qdd, L @ w.y + w.tip.A.T @ w.tip.F, atol=1e-9)
    assert 0 < turned < 5


@pytest.mark.parametrize(("kind", "more"), [("dahl", {"stiffness": 300.0}), ("coulomb_viscous", {})])
def test_friction_of_joints_that_the_state_determines(kind, more):
    """−σ z − b q̇ of bristles; of a law that sticks rigidly the viscous part alone, for the dry one is not known yet."""
    changes = {"joint_friction": {"kind": kind, "kinetic": 0.5, "viscous": 2.0, **more}}
    loop, _, _ = loop_at_random("wam_slide", SHORT | changes)
    state, constants, w = loop.state, loop.constants, loop.w
    bristles = 300.0 * w.z[-4:] if kind == "dahl" else 0.0
    interpreted(add_joint_friction)(w, constants, state, np.zeros((state.settings.steps + 1, 12)))
    np.testing.assert_allclose(w.joint_friction.torque, -bristles - 2.0 * w.v, rtol=1e-12)


def test_joints_stick_where_their_motion_has_turned():
    """From row to row, in the direction in which each came; a joint that moves on slides, one that is drawn slips."""
    law = {
        "kind": "seven_parameter", "kinetic": 0.5, "static_excess": 0.2, "stribeck_speed": 0.1, "stiffness": 300.0,
        "memory_delay": 0.0, "rise_time": 0.1,
    }  # fmt: skip
    loop, _, _ = loop_at_random("wam_slide", SHORT | {"joint_friction": law})
    state, constants, w = loop.state, loop.constants, loop.w
    rows, w.v[:], w.z[:], w.joint_friction.stuck[:], state.row = np.zeros((4, 12)), [0.1, -0.1, 0.1, 0.0], 0.0, 0.0, 2
    rows[1, 4:8] = [0.2, 0.2, -0.2, -0.2]
    interpreted(stick_or_slip_joints)(w, constants, state, rows)
    np.testing.assert_array_equal(w.joint_friction.stuck, [0.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(w.joint_friction.direction, [0.0, 1.0, -1.0, -1.0])


def test_loops_take_what_they_bind_in_the_measure_of_the_mass():
    """Mobility and drift of the tip, what is left of a load, and reactions: by the null space of the rows."""
    loop, H, rng = loop_at_random("five_bar", SHORT | HOLD)
    state, constants, w = loop.state, loop.constants, loop.w
    drift = w.tip.drift_c.copy()
    assert interpreted(factorise_tip)(H, w, constants, state) == 0
    rows = w.kept["loops"].rows
    G = rows.G.copy()
    rank = np.linalg.matrix_rank(G, tol=1e-9)
    N = np.linalg.svd(G)[2][rank:].T
    free = N @ np.linalg.solve(N.T @ H @ N, N.T)  # the inverse of H that the loops leave
    required = np.linalg.lstsq(G @ np.linalg.inv(H) @ G.T, -rows.drift, rcond=1e-9)[0]
    required = np.linalg.solve(H, G.T @ required)
    assert 0 < rank < 4
    assert np.linalg.norm(w.tip.A @ required) > 1e-2
    np.testing.assert_allclose(w.tip.S, w.tip.A @ free @ w.tip.A.T, atol=1e-10)
    np.testing.assert_allclose(w.tip.drift_c, drift + w.tip.A @ required, atol=1e-9)
    L, load, ask = np.linalg.cholesky(H), rng.normal(size=4), interpreted(closed_loops)
    w.y[:] = np.linalg.solve(L, load)
    ask(state.loops.at, BIND_LOAD)
    np.testing.assert_allclose(np.linalg.solve(L.T, w.y), free @ load + required, atol=1e-9)
    w.scratch.column[:] = load
    ask(state.loops.at, REACTION)
    np.testing.assert_allclose(w.scratch.column, load - H @ free @ load, atol=1e-9)
    np.testing.assert_allclose(w.tip.drift_c, drift, atol=1e-12)


@pytest.mark.parametrize("elastic", [1, MOTORS_MEASURED])
def test_encoders_read_the_side_they_are_on(elastic):
    """The motors' where they are measured and a joint has one, else the links'; the true state is kept aside."""
    stiff = {"transmission.stiffness": 1e4, "encoder.seed": 1}
    loop, _, rng = loop_at_random("wam_slide", SHORT | stiff)
    state, constants, w = loop.state, loop.constants, loop.w
    state.settings.elastic, constants.gears.motor_inertia[:], w.q[:] = elastic, [0.1, 0.0, 0.1, 0.1], rng.normal(size=4)
    q, v, motors = w.q.copy(), w.v.copy(), w.z[-8:].copy()
    interpreted(read_joints)(w, constants, state, np.zeros((40, 40)))
    on_motors = (constants.gears.motor_inertia > 0.0) & (elastic == MOTORS_MEASURED)
    np.testing.assert_array_equal([w.q, w.encoders.q], [np.where(on_motors, motors[:4], q)] * 2)
    np.testing.assert_array_equal([w.v, w.encoders.v], [np.where(on_motors, motors[4:], v)] * 2)
    np.testing.assert_array_equal([w.encoders.true_q, w.encoders.true_v], [q, v])


def test_what_encoders_read_of_a_mechanism_is_closed():
    """The law is given the state nearest to the readings at which the loops are closed."""
    problem = cl.prepare(cl.load_scenario("five_bar", SHORT | HOLD | {"encoder.quantisation": 0.01}))
    loop = problem.loop()
    problem.connect(loop, compiled=False)
    state, w = loop.state, loop.w
    w.q[:], w.v[:] = problem.q + 1e-3, 0.1
    interpreted(read_joints)(w, loop.constants, state, problem.table)
    assert np.max(np.abs(w.q - w.encoders.q)) > 1e-4
    links, rows = w.kept["perceived_loops"]
    rows.q[:], rows.v[:] = w.q, w.v
    interpreted(locate_rows)(links, rows)
    np.testing.assert_allclose([rows.error, rows.rate], 0.0, atol=1e-9)
