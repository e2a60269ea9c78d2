"""Bodies that turn freely: terms, motion in closed form, what is conserved, the order of each integrator, columns.

What is compared is MuJoCo's own, another source of terms, a closed form, or a quantity that the motion keeps.
"""

import mujoco
import numpy as np
import pytest
from boxes import no_torque

import closedloop as cl
import robot_models
from closedloop.base.errors import ScenarioError
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.advance import turn_rate
from closedloop.mechanics.robot.tree.layout import turn
from robot_models.coordinates import continuous, with_quaternions, with_rotation_vectors
from tests.closedloop.free_bodies import BODY, TREE, matrices, random_positions, scenario_of, written

MOMENTS = np.array([1.0e-3, 2.0e-3, 2.5e-3])
STILL = [0, 0, 0, 1, 0, 0, 0]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """The model of `TREE`, and its file."""
    path = written(tmp_path_factory.mktemp("tree"), TREE)
    return robot_models.load(path), path


def body(tmp_path, moments=MOMENTS, gravity="0 0 0"):
    """Return the file of one free body."""
    return written(tmp_path, BODY.format(gravity=gravity, mass=0.37, moments=" ".join(map(str, moments))))


def run_of(tmp_path, model, q, v, engine="compiled", **changes):
    """Return the run of bodies without any torque."""
    return cl.simulate(scenario_of(tmp_path, model, q, v, **changes), law=no_torque, engine=engine, progress=False)


def test_quaternions_and_rotation_vectors_are_each_others_inverse(tree):
    """There and back is the same orientation."""
    model, _ = tree
    rng = np.random.default_rng(2)
    q = np.stack([random_positions(model, rng) for _ in range(20)])
    back = with_quaternions(with_rotation_vectors(q, model.joint_types), model.joint_types)
    assert np.abs(continuous(back, model.joint_types, q[0])[0] - q[0]).max() < 4e-16
    turned = np.zeros((3, model.n))
    for k, angle in enumerate((1e-12, np.pi - 1e-9, 6.0)):  # any length, beyond a half turn too
        turned[k, 3] = angle
    assert np.allclose(with_quaternions(turned, model.joint_types)[:, 4], np.sin(turned[:, 3] / 2), rtol=1e-15)


def test_half_a_turn_is_a_rotation_vector_too():
    """About any axis: of such a quaternion w is 0."""
    for axis in np.vstack([np.eye(3), [0.6, 0.0, 0.8]]):
        theta = with_rotation_vectors(np.array([0.0, *axis]), ("ball",) * 3)
        np.testing.assert_allclose(np.pi * axis, theta, rtol=1e-15)


def test_a_turn_upon_a_turn_is_the_product_of_rotations():
    """θ ∘ u is what the matrices' product says."""
    rng = np.random.default_rng(3)
    for size in (1e-9, 0.3, 3.0, 6.0):
        a, b, out = size * rng.normal(size=3) / 2, rng.normal(size=3), np.zeros(3)
        interpreted(turn)(out, 0, a, 0, *b)
        R = [matrices(with_quaternions(x, ("ball",) * 3)) for x in (a, b, out)]
        assert np.abs(R[0] @ R[1] - R[2]).max() < 2e-15
        assert np.linalg.norm(out) <= np.pi * (1 + 1e-15)


@pytest.mark.parametrize("size", [1e-3, 0.09999, 0.10001, 2.0, 6.0])
def test_the_rate_of_a_rotation_vector_is_that_of_the_angular_velocity(size):
    """dexp⁻¹ moves the rotation by ω in the body's axes."""
    u, omega, rate, h = np.array([0.6, -0.48, 0.64]) * size, np.array([0.3, 2.0, -1.0]), np.zeros(3), 1e-5
    interpreted(turn_rate)(*u, omega, 0, rate, 0)
    R = matrices(with_quaternions(np.stack([u - h * rate, u, u + h * rate]), ("ball",) * 3))
    skew = R[1].T @ (R[2] - R[0]) / (2 * h)
    found = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    assert np.abs(found - omega).max() < 1e-8 * (1.0 + np.linalg.norm(rate) ** 3)


def top(t, w0, moments):
    """Return the angular velocity in the body of a symmetric top, whose third axis is its own, without torque."""
    a, c = moments[0], moments[2]
    rate = (c - a) / a * w0[2]
    return np.stack([
        w0[0] * np.cos(rate * t) - w0[1] * np.sin(rate * t), w0[1] * np.cos(rate * t) + w0[0] * np.sin(rate * t),
        np.full_like(t, w0[2]),
    ], axis=1)  # fmt: skip


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit_euler", 1), ("explicit_euler", 1), ("rk4", 4)])
def test_the_order_of_each_integrator_on_a_symmetric_top(tmp_path, integrator, order):
    """Errors of ω and of the angular momentum fall with the scheme's order."""
    moments, w0 = np.array([2e-3, 2e-3, 1e-3]), np.array([3.0, 1.0, 20.0])
    model, errors = body(tmp_path, moments), []
    for step in (0.004, 0.002):
        run = run_of(
            tmp_path, model, [0, 0, 0, 1, 0.2, 0, 0], [0, 0, 0, *w0], time__step=step, time__integrator=integrator
        )
        L = matrices(run.q[:, 3:]) @ (moments * run.v[:, 3:])[:, :, None]
        errors.append(
            [np.abs(run.v[:, 3:] - top(run.time, w0, moments)).max(), np.abs(L - L[0]).max() / np.linalg.norm(L[0])]
        )
        assert np.abs(np.linalg.norm(run.q[:, 3:], axis=1) - 1.0).max() < 1e-15
    falls = np.log2(np.array(errors[0]) / errors[1])
    assert np.all(np.abs(falls - order) < 0.35), falls


def test_a_tennis_racket_turns_over_and_keeps_energy_and_angular_momentum(tmp_path):
    """Rotation about the middle axis is unstable, and conservative."""
    run = run_of(tmp_path, body(tmp_path), STILL, [0, 0, 0, 1e-3, 20.0, 1e-3], time__duration=2.0)
    w = run.v[:, 3:]
    assert w[:, 1].min() < -19.9  # about its middle axis, to and fro
    assert w[:, 1].max() > 19.9
    L = (matrices(run.q[:, 3:]) @ (MOMENTS * w)[:, :, None])[:, :, 0]
    assert np.abs(L - L[0]).max() < 1e-9 * np.linalg.norm(L[0])
    assert np.ptp(run.kinetic_energy) < 1e-9 * run.kinetic_energy[0]
    assert np.abs(np.linalg.norm(run.q[:, 3:], axis=1) - 1.0).max() < 1e-15
    assert np.abs(np.diff(run.q[:, 3:], axis=0)).max() < 0.02  # no sign jumps


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
def test_a_thrown_body_flies_along_its_parabola(tmp_path, engine):
    """The centre of mass does not know that the body turns."""
    v0 = np.array([1.0, 2.0, 3.0])
    run = run_of(tmp_path, body(tmp_path, gravity="0 0 -9.81"), None, [*v0, 5.0, 1.0, 9.0], engine)
    t = run.time[:, None]
    assert np.abs(run.q[:, :3] - (v0 * t + 0.5 * np.array([0, 0, -9.81]) * t * t)).max() < 1e-13
    assert np.abs(run.v[:, :3] - (v0 + np.array([0, 0, -9.81]) * t)).max() < 1e-13
    assert run.summary()["max_energy_residual"] < 1e-10
    assert run.summary()["verdict"]["good"]


def momenta(model, run):
    """Return linear momentum and angular momentum about the origin of all free bodies in each row, by Pinocchio."""
    import pinocchio as pin

    robot = cl.Robot(model)
    mechanism = model.pinocchio_model()
    data, found = mechanism.createData(), []
    for q, v in zip(robot.pinocchios(run.q), run.v, strict=True):
        h = pin.computeCentroidalMomentum(mechanism, data, np.ascontiguousarray(q), np.ascontiguousarray(v))
        found.append([*h.linear, *(h.angular + np.cross(data.com[0], h.linear))])
    return np.array(found)


def test_a_floating_arm_keeps_its_momenta_while_its_joints_move(tmp_path):
    """Without gravity nothing from outside acts."""
    text = TREE.split('<body name="ball"')[0].replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>')
    path = written(tmp_path, text + "</worldbody></mujoco>")
    model, rng = robot_models.load(path), np.random.default_rng(4)
    q, v = random_positions(model, rng), 3.0 * rng.normal(size=model.n)
    q[11] = 0.3
    runs = [run_of(tmp_path, path, q, v, engine, tip="tip", time__duration=0.3) for engine in ("compiled", "pinocchio")]
    assert np.abs(runs[0].q - runs[1].q).max() < 1e-11
    kept = momenta(model, runs[0])
    assert np.abs(kept - kept[0]).max() < 1e-8 * np.abs(kept[0]).max()
    assert np.abs(np.diff(runs[0].v[:, 9])).max() > 1e-3  # the hand does move
    assert runs[0].summary()["max_energy_residual"] < 1e-7


def test_the_motion_is_mujocos(tree, tmp_path):
    """A tree of free bodies moves as MuJoCo says."""
    model, path = tree
    theirs = mujoco.MjModel.from_xml_path(path)
    theirs.opt.integrator, theirs.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 2e-4
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, rng = mujoco.MjData(theirs), np.random.default_rng(5)
    q, v = random_positions(model, rng), rng.normal(size=model.n)
    q[11] = 0.2
    data.qpos[:], data.qvel[:] = q, v
    run = run_of(tmp_path, path, q, v, tip="tip", time__duration=0.1)
    for _ in range(500):
        mujoco.mj_step(theirs, data)
    assert np.abs(run.q[-1] - data.qpos).max() < 2e-6  # MuJoCo's RK4 does not follow the manifold within a step
    assert np.abs(run.v[-1] - data.qvel).max() < 2e-5


@pytest.mark.slow
def test_the_adaptive_integrator_turns_any_number_of_times(tmp_path):
    """The rotation vector comes back before it has no rates."""
    moments, w0 = np.array([2e-3, 2e-3, 1e-3]), np.array([3.0, 1.0, 40.0])
    run = run_of(
        tmp_path, body(tmp_path, moments), STILL, [0, 0, 0, *w0], "pinocchio", time__integrator="dop853",
        time__duration=1.0, time__step=0.01,
    )  # fmt: skip
    assert np.abs(run.v[:, 3:] - top(run.time, w0, moments)).max() < 1e-8
    L = (matrices(run.q[:, 3:]) @ (moments * run.v[:, 3:])[:, :, None])[:, :, 0]
    assert np.abs(L - L[0]).max() < 1e-8 * np.linalg.norm(L[0])


HALF = np.array([0.06, 0.05, 0.04])
FEET = [{"link": "body", "at": list(map(float, HALF * s)), "friction": 0.4, "restitution": 0.1}
        for s in ([1, 1, -1], [1, -1, -1], [-1, 1, -1], [-1, -1, -1])]  # fmt: skip


@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
def test_a_box_dropped_on_four_feet_comes_to_rest(tmp_path, integrator):
    """It lies level, carried by its weight."""
    tilt = [1.0, 0.05, 0.03, 0.0]
    run = run_of(
        tmp_path, body(tmp_path, gravity="0 0 -9.81"), [0, 0, 0.06, *tilt], [0.3, 0, 0, 0, 0, 1.0], contacts=FEET,
        time__duration=0.8, time__integrator=integrator,
    )  # fmt: skip
    assert np.abs(run.v[-1]).max() < 1e-9
    assert run.q[-1, 2] == pytest.approx(HALF[2], abs=1e-6)
    assert np.linalg.norm(run.q[-1, 4:6]) < 1e-5  # level
    assert run.link_forces[-1].sum() == pytest.approx(0.37 * 9.81, rel=1e-6)
    assert run.link_gaps.min() > (-1e-9 if integrator == "rk4" else -1e-4)
    assert run.summary()["verdict"]["good"]


def test_a_run_is_read_back_and_said_in_its_own_units(tree, tmp_path):
    """File, table and repetition have the positions as they are."""
    model, path = tree
    q, v = random_positions(model, np.random.default_rng(6)), np.ones(model.n)
    q[11] = 0.1
    run = run_of(tmp_path, path, q, v, tip="tip", time__duration=0.02)
    assert run.q.shape == (21, len(model.coordinate_names))
    assert run.v.shape == (21, model.n)
    assert np.abs(run.q[0] - q).max() < 1e-15
    assert run.units("q") == "m | 1 | rad"
    read = cl.load_run(run.save(tmp_path / "run.nc"))
    assert np.array_equal(read.q, run.q)
    assert read.model.coordinate_names == model.coordinate_names
    assert np.array_equal(read.model.home, model.home)
    assert list(run.to_pandas().filter(regex=r"^q\[")) == [f"q[{name}]" for name in model.coordinate_names]
    assert run.to_xarray()["q"].dims == ("time", "coordinate")
    again = cl.simulate(read.scenario, model=read.model, law=no_torque, engine="compiled", progress=False)
    assert np.array_equal(again.q, run.q)


def test_the_scene_is_the_same_mechanism_in_mujoco(tree, tmp_path):
    """The exported free joint has MuJoCo's place and bias."""
    from closedloop.figures.export.mjcf import write_mjcf

    model, path = tree
    q = random_positions(model, np.random.default_rng(7))
    q[11] = 0.1
    run = run_of(tmp_path, path, q, np.ones(model.n), tip="tip", time__duration=0.01)
    (scene,) = write_mjcf(run, tmp_path / "scene.xml")
    theirs = mujoco.MjModel.from_xml_path(str(scene))
    data = mujoco.MjData(theirs)
    mujoco.mj_resetDataKeyframe(theirs, data, 1)
    mujoco.mj_forward(theirs, data)
    assert np.abs(data.qpos - run.q[-1]).max() < 1e-15
    assert np.abs(data.site("tip").xpos - run.position[-1]).max() < 1e-12
    assert np.abs(data.qfrc_bias - cl.Robot(model, "tip").terms(run.q[-1], run.v[-1]).bias).max() < 1e-10


def test_stepped_from_outside_it_is_the_same_run(tmp_path):
    """The stepper and the run agree."""
    scenario = scenario_of(tmp_path, body(tmp_path), STILL, [0, 0, 0, 1, 2, 3], time__duration=0.05)
    run, simulator = cl.simulate(scenario, engine="compiled", progress=False), cl.Simulator(scenario, engine="compiled")
    simulator.reset()
    for _ in range(50):
        state = simulator.step()
    assert np.array_equal(state.q, run.q[-1])
    assert np.array_equal(state.v, run.v[-1])


@pytest.mark.parametrize(
    ("q", "says"),
    [
        ([0, 0, 0, 0, 0, 0, 0], "a quaternion w, x, y, z of length zero is no rotation"),
        (
            [0, 0, 0, 1, 0, 0],
            "start.q has 6 entries: for bodies it has 7, in the order body_x, body_y, body_z, body_qw",
        ),
    ],
)
def test_a_start_that_is_none_is_refused(tmp_path, q, says):
    """One line says what and where."""
    with pytest.raises(ScenarioError) as caught:
        run_of(tmp_path, body(tmp_path), q, [0] * 6)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_path_of_a_tip_that_no_drive_leads_is_refused(tmp_path):
    """A floating tip has no path."""
    scenario = scenario_of(
        tmp_path, body(tmp_path), STILL, [0] * 6,
        reference__kind="line", reference__direction=[0.0, 1.0, 0.0], reference__speed=0.1, reference__stop=0.9,
    )  # fmt: skip
    with pytest.raises(ScenarioError, match="depends on a ball joint, which has no drive"):
        cl.simulate(scenario, progress=False)


def test_no_torque_acts_on_a_free_body(tmp_path):
    """A law may ask; there is no drive."""
    scenario = scenario_of(tmp_path, body(tmp_path), STILL, [0, 0, 0, 1, 2, 3], law__kp=100.0, law__kd=10.0)
    assert not np.any(cl.simulate(scenario, engine="compiled", progress=False).torque)


def test_runs_of_a_batch_are_the_runs_themselves(tree, tmp_path):
    """The lanes have no bodies that turn freely: a batch takes the loop of one run."""
    model, path = tree
    scenario = scenario_of(tmp_path, path, tip="tip", time__duration=0.02)
    starts = [[0.1 * k] * model.n for k in range(1, 10)]
    table = cl.simulate_batch(scenario, {"start.v": starts}, keep=["q"])
    assert set(table["verdict"].to_pylist()) == {"good"}
    run = cl.simulate(
        scenario_of(tmp_path, path, v=starts[3], tip="tip", time__duration=0.02), engine="compiled", progress=False
    )
    assert np.array_equal(np.array(table["q"][3].as_py()), run.q)


def test_an_encoder_of_what_turns_freely_is_refused(tmp_path):
    """An encoder reads joints, not orientations."""
    scenario = scenario_of(tmp_path, body(tmp_path), STILL, [0] * 6, encoder__noise=1e-4)
    with pytest.raises(ScenarioError, match="encoder: bodies has joints that turn freely"):
        cl.simulate(scenario, progress=False)


def test_a_box_that_is_dropped_comes_to_rest_on_the_command_line(command_line, tmp_path):
    """Without surface, law or reference: gravity and eight corners, given as one list, are all that there is."""
    written(tmp_path, BODY.format(gravity="0 0 -9.81", mass=0.37, moments="8.1e-4 8.1e-4 8.1e-4"), "box")
    corners = [[0.05 * x, 0.05 * y, 0.05 * z] for x in (1, -1) for y in (1, -1) for z in (1, -1)]
    (tmp_path / "drop.toml").write_text(
        '[robot]\nmodel = "box.xml"\ntip = "body"\n[start]\nq = [0, 0, 0.12, 0.9, 0.3, 0.2, 0.1]\n'
        "v = [0.3, 0, 0, 3, 2, 1]\n[time]\nduration = 0.6\nstep = 0.001\n"
        f'[[contact]]\nname = "floor"\nlink = "body"\nat = {corners}\nfriction = 0.2\nrestitution = 0.1\n'
    )
    outcome = command_line("drop.toml", "--strict", "--no-figures", "--contact.floor.friction", "0.3")
    assert (outcome.status, outcome.err) == (0, "")
    run = cl.load_run(tmp_path / "out" / "drop" / "run.nc")
    assert run.q.shape == (601, 7)
    assert run.q[-1, 2] == pytest.approx(0.05, abs=1e-9)  # on a face
    assert np.abs(run.v[-1]).max() < 1e-9
    weight = 0.37 * 9.81
    assert run.link_forces[-1].sum() == pytest.approx(weight, rel=1e-9)
    assert {contact.friction for contact in run.scenario.contact} == {0.3}
