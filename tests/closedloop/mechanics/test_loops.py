"""Loop joints: rows, rank, motion and reactions of closed mechanisms, against independent solutions."""

import numpy as np
import pinocchio as pin
import pytest
from budget import budget
from falling_loops import falling, free, no_torque, null_space_acceleration, rows_at

import closedloop as cl
import robot_models
from closedloop.mechanics.closure.solve import solve_closure
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.loops.reactions import loop_reactions
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.report.tables import report_rows
from validation.loops.cases import MECHANISMS, bar, change_point, joint, loop, mechanism, point
from validation.oracle.closure import LoopJoint, loop_rows
from validation.oracle.kinematics import forward_kinematics
from validation.oracle.tree import read_urdf

# Mechanism to how many of its rows are independent.
RANKS = {
    "four_bar": 2, "four_bar_point": 2, "doubled_four_bar": 3, "slider_crank": 2, "distance": 1, "six_bar": 4,
    "bennett": 2, "bricard": 4, "cardan": 1, "gears": 3, "spatial_slider": 4, "cut_coupler": 3, "plate": 3,
    "five_bar": 2, "delta": 18, "stewart": 18,
}  # fmt: skip


@pytest.fixture(scope="module")
def mechanisms():
    """Each mechanism, made once."""
    return {name: make() for name, make in MECHANISMS.items()}


@pytest.mark.parametrize("name", MECHANISMS)
def test_rows_are_the_derivatives_of_their_errors(mechanisms, name):
    """Along any motion ė = G q̇ and ë = G q̈ + drift, whether the loops are closed or not."""
    model, rng = mechanisms[name], np.random.default_rng(3)
    q = np.array(model.home) + 0.1 * rng.normal(size=model.n)
    v, a = rng.normal(size=(2, model.n))
    _, G, drift, _, _ = rows_at(model, q, v)

    def at(t):
        return np.array(rows_at(model, q + t * v + 0.5 * t * t * a, v + t * a)[3:])

    slopes = [(at(h) - at(-h)) / (2 * h) for h in (1e-3, 2e-3)]
    error_rate, rate_rate = (4.0 * slopes[0] - slopes[1]) / 3.0  # the error of order h² taken out
    np.testing.assert_allclose(error_rate, G @ v, atol=1e-9 * (1 + np.abs(G).max()))
    np.testing.assert_allclose(rate_rate, G @ a + drift, atol=1e-8 * (1 + np.abs(drift).max()))


def test_rows_of_a_point_are_those_of_the_paper(mechanisms):
    """R, Ṙ and both Jacobians of Eqs. 2-6 by hand, for a ball between two links of the delta robot."""
    model, rng = mechanisms["delta"], np.random.default_rng(5)
    q, v = np.array(model.home) + 0.1 * rng.normal(size=model.n), rng.normal(size=model.n)
    _, G, drift, error, _ = rows_at(model, q, v)
    tree = read_urdf(model)
    ball = model.loops[3]
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    at = np.array(ball.points[1])
    hand = loop_rows(tree, forward_kinematics(tree, q), v, LoopJoint(ball.frames[0], axes, axes @ at, ball.frames[1]))
    span = slice(9, 12)
    turn = G[span] @ np.linalg.pinv(hand.A)  # which way round the axes are is nobody's business
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(G[span], turn @ hand.A, atol=1e-12)
    np.testing.assert_allclose(drift[span], turn @ hand.drift, atol=1e-11)
    np.testing.assert_allclose(error[span], turn @ hand.error, atol=1e-12)


@pytest.mark.parametrize("name", ["bennett", "bricard"])
def test_couples_act_about_the_axes_that_they_are_called_by(mechanisms, name):
    """On the first side, along x and y of a hinge on its second side: by Pinocchio's Jacobians of both frames."""
    model = mechanisms[name]
    (hinge,) = model.loops
    robot, G, _, _, _ = rows_at(model, model.home, np.zeros(model.n))
    built = model.pinocchio_model()
    data = built.createData()
    turning = [
        np.zeros((3, model.n)) if frame == "world" else
        pin.computeFrameJacobian(
            built, data, np.array(model.home), built.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED
        ).reshape(6, model.n)[3:]
        for frame in hinge.frames
    ]  # fmt: skip
    axis = np.array(hinge.axes[1])
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    second = robot.frame_at(hinge.frames[1], np.array(model.home))[1]
    for row, direction in ((4, x), (3, np.cross(axis, x))):
        np.testing.assert_allclose((second @ direction) @ (turning[0] - turning[1]), G[row], atol=1e-9)


@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanism_falls_as_its_null_space_does(mechanisms, name):
    """q̈ at every row, the loops closed to rounding, the rank that it has, no force unexplained, and energy kept."""
    model = mechanisms[name]
    run = falling(model, duration=0.05 if model.n > 10 else 0.1)
    found = run.loops
    assert np.max(np.abs(found.errors)) < 1e-14
    assert set(found.rank) == {RANKS[name]}
    assert np.max(found.unexplained) < 1e-11
    assert np.max(run.residual_motion) < 1e-14
    assert np.max(np.abs(run.v)) > 1e-3
    for k in range(0, len(run), 10):
        truth = null_space_acceleration(model, run.q[k], run.v[k], run.torque[k])
        np.testing.assert_allclose(run.acceleration[k], truth, atol=1e-9 * (1 + np.abs(truth).max()))
    energy = run.kinetic_energy + run.potential_energy
    assert np.ptp(energy) < 1e-7 * (np.max(run.kinetic_energy) + 1.0)


@pytest.mark.parametrize("name", ["bricard", "bennett"])
def test_order_of_the_integrator_is_kept(mechanisms, name):
    """With a quarter of the step the energy error of rk4 is less by 4⁴, redundant rows or not."""
    lost = []
    for step in (0.008, 0.002):
        run = falling(mechanisms[name], duration=0.2, step=step)
        lost.append(abs(np.ptp(run.kinetic_energy + run.potential_energy)))
    assert np.log(lost[0] / lost[1]) / np.log(4.0) > 3.6


@pytest.mark.parametrize("speed", [5.03, 5.0])  # with the latter a step ends in the pose itself
@pytest.mark.parametrize("name", ["parallelogram", "change_point"])
def test_a_flat_mechanism_passes_at_speed(name, speed):
    """Where the rows lose rank the motion goes on as it came: bars of equal length stay parallel, energy is kept."""
    model = change_point(0.5, 0.2) if name == "parallelogram" else change_point(0.3, 0.4)
    free_motion = np.linalg.svd(rows_at(model, model.home, np.zeros(model.n))[1])[2][-1]
    start = {"start.v": (speed * free_motion / free_motion[0]).tolist(), "robot.gravity": [0, 0, 0]}
    run = falling(model, duration=0.12, **start)
    assert run.q[0, 0] < -0.2 < 0.2 < run.q[-1, 0]
    assert np.ptp(run.kinetic_energy) < 1e-7 * run.kinetic_energy[0]
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    if name == "parallelogram":
        np.testing.assert_allclose(run.q[:, 2], run.q[:, 0], atol=1e-11)


@pytest.mark.parametrize("turn", [0.0, 0.7])
@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
@pytest.mark.parametrize("beside", [1e-4, -1e-5, 1e-6, 1e-7, -1e-8, 1e-9, 1e-10])
def test_a_step_may_end_beside_the_flat_pose(beside, integrator, turn):
    """A row that is nearly lost says nothing of the way on: within 1e-8 rad the mechanism flew apart by it."""
    crank = -0.05 + beside  # ten steps of 5 mrad before the pose
    start = {"start.q": [crank, -crank, crank], "start.v": [5.0, -5.0, 5.0], "robot.gravity": [0, 0, 0]}
    run = falling(change_point(0.5, 0.2, turn), duration=0.02, **start, **{"time.integrator": integrator})
    assert run.q[10, 0] == pytest.approx(beside, rel=0.1)
    assert np.ptp(run.kinetic_energy) < 1e-7 * run.kinetic_energy[0]
    assert abs(run.kinetic_energy[-1] - run.kinetic_energy[0]) < 1e-9 * run.kinetic_energy[0]
    np.testing.assert_allclose(run.q[:, 2], run.q[:, 0], atol=1e-11)


def peaucellier():
    """Peaucellier's linkage, eight bars: it lies flat wherever it turns round."""
    body = bar("crank", 0.25) + bar("upper", 0.5) + bar("lower", 0.5) + "".join(bar(f"side{k}", 0.2) for k in range(4))
    body += joint("J1", "base", "crank", "0.25 0 0") + joint("J2", "base", "upper") + joint("J3", "base", "lower")
    body += joint("J4", "crank", "side0", "0.25 0 0") + joint("J5", "crank", "side1", "0.25 0 0")
    body += joint("J6", "upper", "side2", "0.5 0 0") + joint("J7", "lower", "side3", "0.5 0 0")
    body += point("upper_end", "upper", "0.5 0 0") + point("lower_end", "lower", "0.5 0 0")
    body += "".join(point(f"end{k}", f"side{k}", "0.2 0 0") for k in range(4))
    pairs = ["end0", "upper_end"], ["end1", "lower_end"], ["end2", "end3"]
    loops = [loop(f"pin{k}", "point", pair) for k, pair in enumerate(pairs)]
    home = [0.6, 0.71, -0.11, 1.366, -1.966, -2.076, 2.076]
    return mechanism("peaucellier", body, loops, home, tip="end2")


@pytest.mark.slow
def test_energy_is_kept_through_many_flat_poses():
    """Near such a pose what the rows require is a small number over a small one: by rounding alone 3e-3 J were lost."""
    model = peaucellier()
    run = falling(model, duration=3.0)
    sixth = np.array([np.linalg.svd(rows_at(model, run.q[k], run.v[k])[1])[1][5] for k in range(0, len(run), 5)])
    assert np.sum(np.diff(np.sign(np.diff(sixth))) > 0) > 4  # minima: flat poses passed
    assert np.ptp(run.kinetic_energy + run.potential_energy) < 1e-6
    assert np.max(np.abs(run.loops.errors)) < 1e-14


@pytest.mark.parametrize("name", ["four_bar", "bricard", "delta"])
def test_engines_agree(mechanisms, name):
    """Terms of Pinocchio or of our own: the same motion."""
    model = mechanisms[name]
    runs = [
        cl.simulate(free(model, 0.05, **{"law.kd": 0.01}), model=model, engine=engine)
        for engine in ("pinocchio", "compiled")
    ]
    np.testing.assert_allclose(runs[0].q, runs[1].q, atol=1e-11)
    np.testing.assert_allclose(runs[0].acceleration, runs[1].acceleration, atol=1e-8)


@pytest.mark.parametrize("name", ["delta", "stewart"])
def test_pinocchio_solves_the_same(mechanisms, name):
    """`constraintDynamics` with the same balls: where the rows are independent its answer is right."""
    model, rng = mechanisms[name], np.random.default_rng(2)
    robot, G, _, _, _ = rows_at(model, model.home, np.zeros(model.n))
    _, v = closed_start(robot, np.array(model.home), np.zeros(model.n), True)
    null = np.linalg.svd(G)[2][np.linalg.matrix_rank(G) :]
    v = null.T @ rng.normal(size=len(null))
    torque = rng.normal(size=model.n)
    built = model.pinocchio_model()
    balls = []
    for ball in model.loops:
        sides = []
        for frame, at in zip(ball.frames, ball.points, strict=True):
            found = built.frames[built.getFrameId(frame)]
            sides += [found.parentJoint, found.placement * pin.SE3(np.eye(3), np.array(at))]
        balls.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, built, *sides, pin.LOCAL))
    data, these = built.createData(), pin.StdVec_RigidConstraintModel()
    datas = pin.StdVec_RigidConstraintData()
    for ball in balls:
        these.append(ball)
        datas.append(ball.createData())
    pin.initConstraintDynamics(built, data, these, datas)
    proximal = pin.ProximalSettings(1e-14, 1e-12, 50)
    theirs = pin.constraintDynamics(built, data, np.array(model.home), v, torque, these, datas, proximal)
    ours = null_space_acceleration(model, np.array(model.home), v, torque)
    run = cl.simulate(free(model, 0.001, **{"start.v": v.tolist()}), model=model, law=lambda x: torque)
    np.testing.assert_allclose(run.acceleration[0], ours, atol=1e-9 * np.abs(ours).max())
    np.testing.assert_allclose(theirs, ours, atol=1e-6 * np.abs(ours).max())


def test_drives_move_the_mechanism_as_the_law_asks(mechanisms):
    """A torque that passive joints cannot give goes through the loops: the same motion, and none in those joints."""
    own = mechanisms["five_bar"]
    everywhere = robot_models.from_text(
        own.text, "urdf", name="five_bar", armature=own.armature, tip=own.tip, home=own.home, locked={},
        loops=[each.as_table() for each in own.loops],
    )  # fmt: skip
    changes = {"surface.gap": 50.0, "surface.contact": "unilateral", "time.duration": 0.2, "law.kp": 50, "law.kd": 2,
               "reference.kind": "hold", "start.v": [0.0] * 4}  # fmt: skip
    scenario = cl.load_scenario("five_bar", changes | {"start.q": [float(x) for x in own.home]})
    asked = lambda x: np.array([1.0, -2.0, 0.5, 3.0]) - 2.0 * x.v  # noqa: E731
    driven, all_of_them = (cl.simulate(scenario, model=model, law=asked) for model in (own, everywhere))
    passive = [own.joint_names.index(name) for name in ("P1", "P2")]
    assert np.all(driven.torque[:, passive] == 0.0)
    assert np.max(np.abs(all_of_them.torque[:, passive])) > 1.0
    np.testing.assert_allclose(driven.q, all_of_them.q, atol=1e-11)
    (said,) = [row for row in report_rows(driven) if row[0] == "joints without a drive"]
    assert said[1:] == ("2", "", "torque asked there is given by the drives, through the loops: P1, P2")
    assert all(row[0] != "joints without a drive" for row in report_rows(all_of_them))
    stepped = cl.Simulator(scenario, model=own)
    for k in range(3):  # and a torque from outside
        stepped.step(torque=all_of_them.torque[k])
    np.testing.assert_allclose(stepped.run().torque[:3], driven.torque[:3], atol=1e-11)
    np.testing.assert_allclose(stepped.run().q, driven.q[:4], atol=1e-13)


def test_tip_of_a_five_bar_presses_and_slides():
    """The paper's experiment on a closed mechanism: 10 N at rest, the path followed, loops and closure held."""
    run = cl.simulate(cl.load_scenario("five_bar", {"time.duration": 2.0}))
    assert np.allclose(run.contact_force[:400], 10.0, atol=1e-9)
    assert abs(run.contact_force[-1] - 10.0) < 0.05
    assert np.max(np.abs(run.closure_error)) < 1e-6
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    assert np.max(run.residual_closure) < 1e-14
    for k in (100, 1500):  # Eq. 24 with the rows of the loop beside that of the tip
        robot, G, drift, _, _ = rows_at(run.model, run.q[k], run.v[k])
        terms, normal = robot.terms(run.q[k], run.v[k]), run.surface_normal[k]
        H, A = terms.mass_matrix, np.vstack([normal @ terms.jacobian, G[:2]])  # two rows of the hinge suffice
        b = -np.array([normal @ terms.drift, *drift[:2]])
        b[0] += -1414.0 * run.closure_rate[k] - 1e6 * run.closure_error[k]
        qdd, force = solve_closure(H, run.torque[k] - terms.bias, A, b)
        np.testing.assert_allclose(run.acceleration[k], qdd, atol=1e-8)
        assert run.contact_force[k] == pytest.approx(force[0], abs=1e-6)


def test_impact_is_felt_by_the_loop():
    """The mechanism as a whole is struck: the tip's mass is what its null space says, and the loops stay closed."""
    run = cl.simulate(cl.load_scenario("four_bar", {"time.duration": 0.3}))
    first = next(event for event in run.events if event.kind == "impact")
    assert first.rate_after == pytest.approx(-0.5 * first.rate_before, rel=1e-12)
    k = int(first.time / 0.001)
    robot, G, _, _, _ = rows_at(run.model, run.q[k], run.v[k])
    null = np.linalg.svd(G)[2][2:].T
    terms = robot.terms(run.q[k], run.v[k])
    lever = run.surface_normal[k] @ terms.jacobian @ null
    mass = 1.0 / float(lever @ np.linalg.solve(null.T @ terms.mass_matrix @ null, lever))
    assert first.compression == pytest.approx(-mass * first.rate_before, rel=1e-3)  # of the row before it
    assert first.energy_lost == pytest.approx(0.5 * mass * first.rate_before**2 * 0.75, rel=1e-3)
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    assert run.summary()["verdict"]["good"]


def test_reaction_of_dependent_rows_is_of_least_norm(mechanisms):
    """Of all reactions that explain the motion, those of least norm; a lone point carries what the hinge does."""
    runs = [falling(mechanisms[name], duration=0.05) for name in ("four_bar", "four_bar_point")]
    hinge, lone = (run.loops.reactions for run in runs)
    np.testing.assert_allclose(np.linalg.norm(hinge[:, :3], axis=1), np.linalg.norm(lone, axis=1), rtol=1e-8)
    np.testing.assert_allclose(hinge[:, 3:], 0.0, atol=1e-9)  # couples that the pins share are not asked for


@pytest.mark.parametrize("stopped", [False, True])
def test_what_loops_and_stops_cannot_explain_is_told(mechanisms, stopped):
    """Of any motion: reactions and stops of least norm, and the largest torque that is left over."""
    model, rng = mechanisms["five_bar"], np.random.default_rng(4)
    q, v, acceleration, torque = (rng.normal(size=(3, model.n)) for _ in range(4))
    force, at_stop = rng.normal(size=(3, 3)), np.arange(model.n) == np.array([[0], [1], [3]])
    robot = Robot(model)
    found = loop_reactions(robot, np.zeros(len(q)), q, v, acceleration, torque, force, at_stop if stopped else None)
    for k in range(3):
        G, terms = rows_at(model, q[k], v[k])[1], robot.terms(q[k], v[k])
        H = np.triu(terms.mass_matrix) + np.triu(terms.mass_matrix, 1).T
        missing = H @ acceleration[k] + terms.bias - torque[k] - terms.jacobian.T @ force[k]
        rows = np.vstack([G, np.eye(model.n)[at_stop[k]]]) if stopped else G
        given = np.linalg.lstsq(rows.T, missing, rcond=1e-9)[0]
        np.testing.assert_allclose(found.multipliers[k], given[: len(G)], atol=1e-8)
        assert found.unexplained[k] == pytest.approx(np.max(np.abs(missing - rows.T @ given)), rel=1e-8)
        assert found.unexplained[k] > 1e-3
        assert found.rank[k] == np.linalg.matrix_rank(G, tol=1e-9)


def test_friction_in_joints_acts_through_the_loop(mechanisms):
    """Coulomb's friction in the joints holds the mechanism still where it is enough, and takes energy where not."""
    model, friction = mechanisms["four_bar"], {"joint_friction.kind": "coulomb"}
    stuck, slides = (
        cl.simulate(free(model, 0.1, **{**friction, "joint_friction.kinetic": level}), model=model, law=no_torque)
        for level in (20.0, 0.2)
    )
    assert np.max(np.abs(stuck.v)) < 1e-9
    energy = slides.kinetic_energy + slides.potential_energy
    assert np.max(np.abs(slides.v)) > 0.1
    assert np.all(np.diff(energy) <= 1e-6)


def test_run_file_keeps_the_loops(tmp_path, mechanisms):
    """A run is repeated from its file to the last bit, loops and drives included."""
    run = cl.simulate(cl.load_scenario("five_bar", {"time.duration": 0.05}))
    kept = cl.load_run(run.save(tmp_path / "run.nc"))
    assert (kept.model.loops, kept.model.drives) == (run.model.loops, run.model.drives)
    again = cl.simulate(kept.scenario, model=kept.model)
    np.testing.assert_array_equal(again.acceleration, run.acceleration)
    np.testing.assert_array_equal(kept.loops.reactions, run.loops.reactions)


def test_batch_and_simulator_give_the_same():
    """In a batch, and stepped from outside."""
    scenario = cl.load_scenario("five_bar", {"time.duration": 0.05})
    run = cl.simulate(scenario)
    table = cl.simulate_batch(scenario, {"law.force": [10.0, 12.0]}, engine="pinocchio")
    assert table["final_contact_force"][0].as_py() == run.summary()["final_contact_force"]
    simulator = cl.Simulator(scenario)
    state = simulator.run_until(0.05)
    np.testing.assert_array_equal(state.q, run.q[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["four_bar", "six_bar", "slider_crank"])
def test_loops_hold_for_a_minute(mechanisms, name):
    """Closed to 1e-12 m after 60 s of motion, with the full budget, and energy to the order of the integrator."""
    run = falling(mechanisms[name], engine="pinocchio", duration=budget(8.0, 60.0))
    assert run.stopped is None
    assert np.max(np.abs(run.loops.errors)) < 1e-12
    assert np.ptp(run.kinetic_energy + run.potential_energy) < 1e-4 * np.max(run.kinetic_energy)
