"""What a run records: every column against its definition, in every shipped scenario."""

import numpy as np
import pytest
from rounding import within
from slides import SLIDES

import closedloop as cl
from robot_models.planar2 import closed_form

EVERY = pytest.mark.parametrize("name", SLIDES)


@pytest.fixture(params=SLIDES)
def run(request, shipped_run):
    """Return the run of each shipped scenario."""
    return shipped_run(request.param)


@pytest.fixture
def on(run):
    """Return the surface in closed form: of rows its normals (N, 3), gaps (N,), and n's part of ë without r̈ (N,)."""
    section, r, v = run.scenario.surface, run.position, run.velocity
    n = np.array(section.normal) / np.linalg.norm(section.normal)
    if section.kind == "plane":
        return np.tile(n, (len(run), 1)), r @ n - n @ r[0], np.zeros(len(run))
    assert section.kind == "sphere"
    out = r - (r[0] - section.radius * n)
    size = np.linalg.norm(out, axis=1)
    normals = out / size[:, None]
    along = v - np.sum(v * normals, axis=1)[:, None] * normals
    return normals, size - section.radius, np.sum(along**2, axis=1) / size


@pytest.fixture
def arm(run):
    """Return the run's robot."""
    return cl.Robot(run.model, run.scenario.robot.tip)


def some(run):
    """Return rows spread over the run, those of the velocity steps among them."""
    return sorted({*range(0, len(run), 101), 499, 500, 501, 6499, 6500, 6501, len(run) - 1})


def test_every_shipped_scenario_runs_to_its_end(run):
    """A shipped scenario runs from 0 to its duration in its own steps, and every number in it is finite."""
    time = run.scenario.time
    assert run.stopped is None
    assert len(run) == round(time.duration / time.step) + 1
    assert run.time[0] == 0.0
    assert run.time[-1] == pytest.approx(time.duration)
    assert np.allclose(np.diff(run.time), time.step, rtol=0, atol=1e-12)
    assert all(np.all(np.isfinite(column)) for column in run.columns.values())
    assert np.all(run.mode == 1)


def test_reported_residual_is_rounding(run):
    """Eq. 24 is solved to 1e-12 relative at every row of every shipped scenario."""
    assert max(run.residual_motion.max(), run.residual_closure.max()) <= 1e-12


def test_rows_meet_eq_24(run, arm, on):
    """Both block rows of Eq. 24 hold for the recorded columns, with terms computed anew from q and q̇.

    The surface pushes along +n, so the sign of f is tested here. b_s is -J̇q̇ -s_v ė -s_p e from the recorded e and ė,
    and on a ball its curvature.
    1e-12 of the summands, which are some 10 N m and, with e = 1e-10 m times 1e6, some 0.01 m/s².
    """
    stabiliser, (normals, _, turning) = run.scenario.stabiliser, on
    s_v, s_p = 0.0, 0.0
    if stabiliser.kind == "baumgarte":
        T = stabiliser.time_constant or run.scenario.time.step
        s_v, s_p = 2 * stabiliser.damping_ratio / T, T**-2
    for k in some(run):
        terms = arm.terms(run.q[k], run.v[k])
        normal = normals[k]
        A = normal @ terms.jacobian
        inertial = terms.mass_matrix @ run.acceleration[k]
        left = inertial + terms.bias
        right = run.torque[k] + A * run.contact_force[k]
        assert np.max(np.abs(left - right)) < 1e-12 * (1 + np.max(np.abs(run.torque[k])) + abs(run.contact_force[k]))
        b = -(normal @ terms.drift) - turning[k] - s_v * run.closure_rate[k] - s_p * run.closure_error[k]
        assert abs(A @ run.acceleration[k] - b) < 1e-12 * (1 + np.sum(np.abs(A * run.acceleration[k])))


def test_tip_columns_are_kinematics(run, arm, on):
    """Position, velocity, closure error and rate are those of the tip in the row's state."""
    normals, gap, _ = on
    for k in some(run):
        terms = arm.terms(run.q[k], run.v[k])
        assert within(64, run.position[k], terms.position)
        assert within(64, run.velocity[k], terms.jacobian @ run.v[k])
    assert within(16, run.closure_error, gap, run.position)
    assert within(16, run.closure_rate, np.sum(run.velocity * normals, axis=1), run.velocity)
    assert within(64, run.surface_normal, normals)
    along = run.velocity - run.closure_rate[:, None] * normals
    assert within(64, run.slip_velocity, along, run.velocity)


def test_energy_columns_are_energies(run, arm):
    """Kinetic energy is ½ q̇ᵀH q̇, and potential energy changes by the work against the bias at rest."""
    for k in some(run)[::5]:
        H = arm.terms(run.q[k], run.v[k]).mass_matrix
        assert run.kinetic_energy[k] == pytest.approx(0.5 * run.v[k] @ H @ run.v[k], rel=1e-12, abs=1e-18)
    mean = 0.5 * (run.q[1:] + run.q[:-1])
    rest = np.zeros(arm.n)
    for k in some(run)[1:-1:7]:
        work = arm.terms(mean[k], rest).bias @ (run.q[k + 1] - run.q[k])
        assert run.potential_energy[k + 1] - run.potential_energy[k] == pytest.approx(work, abs=1e-11)


def test_condition_column_is_the_condition(run, arm, on):
    """The recorded condition is that of the matrix of Eq. 24 in the 1-norm."""
    for k in some(run)[::11]:
        terms = arm.terms(run.q[k], run.v[k])
        A = (on[0][k] @ terms.jacobian)[None]
        K = np.block([[terms.mass_matrix, A.T], [A, np.zeros((1, 1))]])
        assert run.kkt_condition[k] == pytest.approx(np.linalg.cond(K, 1), rel=1e-9)


def test_every_row_has_its_own_condition(robot):
    """Also where rows are taken together, thirty-two at a time, and at the end of a run."""
    moving = {"time.duration": 0.069, "reference.start": 0.0, "law.pd_start": 0.0}
    run, arm = cl.simulate(cl.load_scenario("planar2_slide", moving)), robot("planar2")
    for k in range(len(run)):
        terms = arm.terms(run.q[k], run.v[k])
        K = np.block([[terms.mass_matrix, terms.jacobian[2][:, None]], [terms.jacobian[2], 0.0]])
        assert run.kkt_condition[k] == pytest.approx(np.linalg.cond(K, 1), rel=1e-9)
    assert len(np.unique(run.kkt_condition)) > 60


@pytest.mark.parametrize("contact", ["pressed", "free"])
def test_columns_of_a_slip_on_a_slope(contact, robot):
    """Each column, with friction on a slope and in the joints and a biased sensor, from H, C, J and its neighbours."""
    arm, normal, q = robot("wam4"), np.array([0.3, -0.2, 1.0]) / np.sqrt(1.13), [1.57, 1.9, 0.1, -0.85]
    A = normal @ arm.terms(q, np.zeros(4)).jacobian
    v = np.array([0.3, 0.2, 0.5, -0.3])
    changes = {
        "surface.normal": normal, "start.q": q, "start.v": v - A * (A @ v) / (A @ A), "time.duration": 0.002,
        "friction.kind": "coulomb", "friction.coefficient": 0.3, "joint_friction.kind": "coulomb_viscous",
        "joint_friction.kinetic": 0.1, "joint_friction.viscous": 0.4, "sensor.bias": 0.7, "reference": {"kind": "hold"},
    }  # fmt: skip
    if contact == "free":
        changes |= {"surface.contact": "unilateral", "surface.gap": 0.05}
    run, pressed = cl.simulate(cl.load_scenario("wam_slide", changes)), contact == "pressed"
    assert np.all(run.mode == pressed)
    assert np.all(run.stabiliser_force == 0.0) != pressed
    for k in range(len(run)):
        terms = arm.terms(run.q[k], run.v[k])
        H, J, f = terms.mass_matrix, terms.jacobian, run.contact_force[k]
        A, u = normal @ J, J @ run.v[k]
        slip, mobility = u - normal * (normal @ u), J @ np.linalg.solve(H, J.T)
        assert within(16, run.surface_normal[k], normal)
        assert within(64, run.velocity[k], u)
        assert within(64, run.slip_velocity[k], slip, u)
        assert run.friction_force[k] == pytest.approx(-0.3 * f * slip / np.linalg.norm(slip), abs=1e-12)
        joints = -0.1 * np.sign(run.v[k]) - 0.4 * run.v[k]
        assert run.joint_friction[k] == pytest.approx(joints, abs=1e-12)
        push = run.torque[k] + joints + J.T @ (f * normal + run.friction_force[k])
        assert H @ run.acceleration[k] + terms.bias == pytest.approx(push, abs=1e-11)
        assert run.measured_force[k] == f + 0.7
        assert run.normal_mobility[k] == pytest.approx(normal @ mobility @ normal / np.trace(mobility), rel=1e-12)
        assert run.kinetic_energy[k] == pytest.approx(0.5 * run.v[k] @ H @ run.v[k], rel=1e-13)
        K = np.block([[H, A[:, None]], [A[None], 0.0]]) if pressed else H
        assert run.kkt_condition[k] == pytest.approx(np.linalg.cond(K, 1), rel=1e-9)
    assert 0.0 < max(run.residual_motion.max(), run.residual_closure.max()) < 1e-14
    assert np.ptp(run.residual_motion) > 0.0  # it is of the row
    force = run.contact_force[:, None] * normal + run.friction_force
    power = np.sum(force * run.velocity, axis=1) + np.sum((run.torque + run.joint_friction) * run.v, axis=1)
    work = 0.0005 * (power[1:] + power[:-1])
    assert np.diff(run.energy_supplied) == pytest.approx(work, rel=0.15)  # of first order


def test_planar2_slide_is_the_textbooks(shipped_run):
    """On planar2 every row meets Eq. 24 with the terms of the closed form, which no engine took part in."""
    run = shipped_run("planar2_slide")
    for k in some(run):
        terms = closed_form.terms(run.q[k], run.v[k])
        A = terms.jacobian[2]
        left = terms.mass_matrix @ run.acceleration[k] + terms.bias
        assert np.max(np.abs(left - run.torque[k] - A * run.contact_force[k])) < 1e-11
        assert within(16, run.position[k, 2], terms.position[2], terms.position)


@EVERY
def test_contact_settles_at_the_commanded_force(name, shipped_run):
    """Every shipped scenario presses with its 10 N before and after the motion, and keeps the contact between."""
    run = shipped_run(name)
    tolerance = 1e-6 if run.scenario.stabiliser.kind == "baumgarte" else 0.01
    assert np.max(np.abs(run.contact_force[:500] - 10.0)) < 1e-9
    assert abs(run.contact_force[-1] - 10.0) < tolerance
    assert run.contact_force.min() > 0.0


def test_progress_is_reported_up_to_the_end():
    """A progress function hears steps that grow from zero up to the number of steps."""
    heard = []
    cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 1.0}), progress=lambda *x: heard.append(x))
    done, totals = zip(*heard, strict=True)
    assert done[0] == 0
    assert done[-1] == 1000
    assert list(done) == sorted(done)
    assert len(done) >= 2
    assert set(totals) == {1000}


def test_library_prints_nothing(capsys):
    """Simulating from Python prints nothing, on either stream, also with a bar where there is no terminal."""
    for progress in (False, True):
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), progress=progress)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.strip() == ""


def test_problem_can_be_looked_at_before_it_runs():
    """`prepare` gives the numbers of the loop: state, plane through the tip, gains, path."""
    problem = cl.prepare(cl.load_scenario("wam_slide"))
    assert problem.steps == 8000
    assert problem.path.shape == (8001, 2, 4)
    assert np.array_equal(problem.q, [1.5707963267948966, 1.9, 0.0, -0.85])
    assert problem.plane.gap(problem.robot.position(problem.q)) == 0.0
    assert problem.stabiliser == pytest.approx([1414.0, 1e6])
    assert np.array_equal(problem.gains, [[900, 900, 400, 300], [60, 60, 30, 20]])
    half_steps = cl.prepare(cl.load_scenario("wam_slide", {"time.integrator": "rk4", "time.duration": 1.0}))
    assert half_steps.path.shape == (2001, 2, 4)
    assert half_steps.nodes == 2


def test_start_pose_defaults_to_the_robots_home():
    """A scenario without [start] starts at rest in the robot's home posture."""
    problem = cl.prepare(cl.load_scenario("planar2_slide", {"start.q": None, "start.v": None}))
    assert np.array_equal(problem.q, problem.robot.model.home)
    assert np.all(problem.v == 0.0)


def straight(**changes):
    """Return planar2 pressing along its own line: A = nᵀJᵣ is zero there."""
    scenario = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold", "time.duration": 0.1}
    return cl.load_scenario("planar2_slide", scenario | changes)


def test_singular_start_is_said_and_not_computed():
    """A straight arm that presses along its own line stops at t = 0 with no row, saying why and what to do."""
    with pytest.raises(cl.SingularClosureError, match=r"t = 0 s.*singular.*normal") as caught:
        cl.simulate(straight())
    assert caught.value.time == 0.0
    assert len(caught.value.run) == 0
    assert caught.value.run.stopped == str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("angle", [1e-5, 1e-4, 1e-3])
def test_near_a_singular_pose_the_force_is_still_right(angle):
    """A bent arm that is only nearly singular is simulated, and its force at rest is the commanded one.

    Rounding of some 20 N m acts over a lever of angle × 0.1 m: 1e-16 × 20 / 1e-6 is 1e-9 N, at the smallest angle.
    """
    run = cl.simulate(straight(**{"start.q": [-angle, 2 * angle], "time.duration": 0.001}))
    assert run.contact_force[0] == pytest.approx(10.0, abs=1e-6)


def test_singular_begins_well_below_what_arithmetic_can_tell():
    """At an angle of 1e-7 rad, where f has lost half of its digits, the pose counts as singular."""
    with pytest.raises(cl.SingularClosureError, match="singular"):
        cl.simulate(straight(**{"start.q": [-1e-7, 2e-7], "time.duration": 0.001}))


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_running_into_a_singular_pose_stops_there(integrator, monkeypatch):
    """An arm that straightens along the normal stops as singular, and what ran until then is kept and finite."""
    # Only a tip that starts through its closure gets there: such a start is refused otherwise.
    monkeypatch.setattr("closedloop.simulation.prepare.START_RATE", 1.0)
    stretch = {"start.q": [-0.1, 0.2], "start.v": [1.0, -2.0], "stabiliser.kind": "none"}
    with pytest.raises(cl.SimulationError) as caught:
        cl.simulate(straight(**stretch, **{"time.duration": 0.5, "time.integrator": integrator, "law.pd_start": 9.0}))
    run = caught.value.run
    assert 0 < len(run) < 501
    assert run.time[-1] < caught.value.time <= run.time[-1] + 0.001 + 1e-9  # in the step after the last row
    assert all(np.all(np.isfinite(column)) for column in run.columns.values())


def test_divergence_names_the_joint_and_keeps_what_ran():
    """A negative K_d shakes the arm apart; the run stops with the joint's name, and its rows are finite."""
    with pytest.raises(cl.DivergenceError, match=r"J\d") as caught:
        cl.simulate(cl.load_scenario("wam_slide", {"law.kd": -300.0}))
    error = caught.value
    assert 0.5 < error.time < 1.0
    assert error.run.time[-1] == pytest.approx(error.time - 0.001)
    assert all(np.all(np.isfinite(column)) for column in error.run.columns.values())
    assert "law.kd" in str(error)


def test_a_damper_that_a_step_cannot_carry_is_named():
    """A K_d whose step is over twice the joint's inertia makes the motion diverge; the line says which and how much."""
    gains = {"law.kp": 400.0, "law.kd": 40.0, "start.v": None, "start.q": [0, -1.2, 1.6, -1.9, -1.57, 0]}
    scenario = cl.load_scenario("wam_slide", gains | {"robot.model": "ur5", "robot.tip": "tool0", "time.duration": 1.0})
    with pytest.raises(cl.DivergenceError, match=r"law.kd\[5\] \(joint wrist_3_joint\) times time.step is 2.3\d times"):
        cl.simulate(scenario)
