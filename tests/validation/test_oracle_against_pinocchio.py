"""The oracle against Pinocchio, with which it shares no line: neither parser nor algorithm nor frames."""

import numpy as np
import pinocchio as pin
import pytest
from budget import seeds
from pinocchio_reference import PinocchioEngine

import robot_models
from validation.oracle import Oracle, closure, kinematics
from validation.oracle.closure import point_fixed, point_on_plane, solve_bordered, weld
from validation.oracle.tree import MOVING
from validation.states import random_robot, random_state

# Both engines sum some hundred products a joint over at most a dozen joints, in a different order: the worst
# of 900 states of 300 random robots is 2e-14 of the largest term. The rest is for what was not seen.
AGREEMENT = 1e-12


def compare(oracle, reference, q, v, a):
    """Yield name, difference and natural scale of every quantity that both engines have."""
    H, C, J = reference.mass_matrix(q), reference.bias(q, v), reference.jacobian(q)
    size_v, size_H, size_J = np.abs(v).max(), np.abs(H).max(), np.abs(J).max()
    torque = size_H * np.abs(a).max() + np.abs(C).max() + size_H * size_v**2
    yield "mass_matrix", oracle.mass_matrix(q) - H, size_H
    yield "bias", oracle.bias(q, v) - C, np.abs(C).max() + size_H * size_v**2
    gravity = reference.gravity_term(q)
    yield "gravity_term", oracle.gravity_term(q) - gravity, np.abs(C).max() + np.abs(gravity).max()
    yield "inverse_dynamics", oracle.inverse_dynamics(q, v, a) - reference.inverse_dynamics(q, v, a), torque
    pushed = [engine.pushed_inverse_dynamics(q, v, a, np.array([1.0, -2.0, 3.0])) for engine in (oracle, reference)]
    yield "pushed_inverse_dynamics", pushed[0] - pushed[1], torque + 3.0 * size_J
    coriolis = oracle.coriolis_matrix(q, v) - reference.coriolis_matrix(q, v)
    yield "coriolis_matrix", coriolis, size_H * size_v
    # q̈ is compared as the torque that it takes, which does not depend on the conditioning of H.
    accelerations = [engine.forward_dynamics(q, v, a) for engine in (oracle, reference)]
    effort = size_H * np.abs(accelerations[1]).max() + np.abs(C).max() + np.abs(a).max()
    yield "forward_dynamics", H @ (accelerations[0] - accelerations[1]), effort
    yield "position", oracle.position(q) - reference.position(q), 1.0
    yield "jacobian", oracle.jacobian(q) - J, size_J
    size_spatial = np.abs(reference.spatial_jacobian(q)).max()
    yield "spatial_jacobian", oracle.spatial_jacobian(q) - reference.spatial_jacobian(q), size_spatial
    yield "drift", oracle.drift(q, v) - reference.drift(q, v), size_J * size_v**2
    pose, body = oracle.pose(q), oracle.tree.frame(oracle.tip).body
    spatial = kinematics.spatial_drift(oracle.tree, pose, v, body)
    yield "spatial_drift", spatial - reference.spatial_drift(q, v), size_spatial * size_v**2
    yield "rotation", kinematics.tip_rotation(oracle.tree, pose, oracle.tip) - reference.rotation(q), 1.0
    U = reference.potential_energy(q)
    yield "potential_energy", oracle.potential_energy(q) - U, abs(U) + np.abs(gravity).max()


def assert_agree(oracle, reference, q, v, a):
    """Compare every quantity at one state."""
    for name, difference, scale in compare(oracle, reference, q, v, a):
        error = np.abs(difference).max() / scale if scale > 0.0 else np.abs(difference).max()
        assert error < AGREEMENT, f"{name}: {error:.1e}"


@pytest.mark.parametrize("seed", seeds(20, 50))
def test_random_robot(seed):
    """Every quantity agrees on a random robot, read from the same text by two parsers."""
    robot = random_robot(seed)
    rng = np.random.default_rng(seed)
    oracle, reference = Oracle.from_model(robot), PinocchioEngine(robot, robot.tip)
    for _ in range(2):
        q, v = random_state(robot, rng)
        assert_agree(oracle, reference, q, v, rng.normal(size=len(q)))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("planar2", {}),
        ("pointmass3", {}),
        ("wam4", {}),
        ("wam4", {"drive_inertia": False}),
        ("panda", {}),
        ("ur5", {}),
        ("kinova", {}),
    ],
    ids=lambda value: value if isinstance(value, str) else ("bare" if value else ""),
)
def test_real_robot(name, options):
    """Every quantity agrees on a robot that people use."""
    robot = robot_models.load(name, **options)
    oracle, reference = Oracle.from_model(robot), PinocchioEngine(robot, robot.tip)
    low, high = np.maximum(robot.position_lower, -np.pi), np.minimum(robot.position_upper, np.pi)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        q, v, a = rng.uniform(low, high), *rng.normal(size=(2, len(low)))
        assert_agree(oracle, reference, q, v, a)


@pytest.mark.parametrize("seed", seeds(10, 20))
def test_kinetic_energy_without_drives(seed):
    """The kinetic energy of the bodies agrees."""
    robot = random_robot(seed, drive_inertia=False)
    q, v = random_state(robot, np.random.default_rng(seed))
    expected = PinocchioEngine(robot, "tip").kinetic_energy(q, v)
    assert Oracle.from_model(robot).kinetic_energy(q, v) == pytest.approx(expected, rel=AGREEMENT)


@pytest.mark.xfail(
    strict=True,
    reason="Pinocchio 4.1 computeKineticEnergy leaves out the armature of JointModelRevoluteUnaligned, a "
    "revolute joint about any axis but +x, +y, +z; its crba does not. Every other joint type agrees.",
)
def test_pinocchio_counts_every_drive_in_the_kinetic_energy():
    """½ q̇ᵀHq̇, with H of Pinocchio itself, should be its own kinetic energy."""
    for seed in range(10):
        robot = random_robot(seed)
        q, v = random_state(robot, np.random.default_rng(seed))
        engine = PinocchioEngine(robot, "tip")
        assert engine.kinetic_energy(q, v) == pytest.approx(v @ engine.mass_matrix(q) @ v / 2, rel=AGREEMENT)


def contact(engine, seed):
    """Return a state, a torque and a normal."""
    rng = np.random.default_rng(seed)
    n, normal = len(engine.columns), rng.normal(size=3)
    return rng.normal(size=n), 10.0 * rng.normal(size=n), normal / np.linalg.norm(normal)


@pytest.mark.parametrize("seed", seeds(10, 20))
def test_plane_against_forward_dynamics(seed):
    """Eq. 24 gives the acceleration and the multiplier of Pinocchio's forwardDynamics, sign included."""
    robot = random_robot(seed)
    oracle, engine = Oracle.from_model(robot), PinocchioEngine(robot, "tip")
    q, _ = random_state(robot, np.random.default_rng(seed))
    v, torque, normal = contact(engine, seed)
    H, A = oracle.mass_matrix(q), normal @ oracle.jacobian(q)
    a, f = solve_bordered(H, torque - oracle.bias(q, v), A, -normal @ oracle.drift(q, v))
    row = np.zeros((1, len(q)))
    row[0, engine.columns] = normal @ engine.jacobian(q)
    drift = np.array([normal @ engine.drift(q, v)])
    args = (engine._q(q), engine._v(v), engine._v(torque), row, drift, 0.0)
    expected = pin.forwardDynamics(engine.model, engine.data, *args)[engine.columns]
    size = np.abs(H).max() * np.abs(expected).max()
    assert np.abs(H @ (a - expected)).max() < AGREEMENT * size
    # The force is as exact as A H⁻¹ Aᵀ is well scaled: compare the torque that it makes.
    assert np.abs(A).max() * abs(f[0] - engine.data.lambda_c[0]) < AGREEMENT * size
    after, p = closure.impulse(H, v, A, 0.3)
    args = (engine._q(q), engine._v(v), row, 0.3, 0.0)
    expected = pin.impulseDynamics(engine.model, engine.data, *args)[engine.columns]
    size = np.abs(H).max() * np.abs(expected).max()
    assert np.abs(H @ (after - expected)).max() < AGREEMENT * size
    assert np.abs(A).max() * abs(p[0] - engine.data.impulse_c[0]) < AGREEMENT * size


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("kind", ["point", "weld"])
def test_general_closure_against_rigid_contacts(kind, seed):
    """The loop joints of three and six rows move the arm as Pinocchio's 3-D and 6-D contacts do."""
    kinds = MOVING if kind == "point" else MOVING[:2]  # joints that slide cannot hold an orientation
    robot = random_robot(seed, joints=9, branching=False, kinds=kinds)
    oracle, engine = Oracle.from_model(robot), PinocchioEngine(robot, "tip")
    q, _ = random_state(robot, np.random.default_rng(seed))
    v, torque, _ = contact(engine, seed)
    pose, r = oracle.pose(q), oracle.position(q)
    held = kinematics.tip_rotation(oracle.tree, pose, "tip")
    joint = point_fixed("tip", r) if kind == "point" else weld("tip", r, held)
    rows = closure.loop_rows(oracle.tree, pose, v, joint)
    if kind == "weld":
        # Pinocchio stops the spatial acceleration of a 6-D contact, not that of the point: the two are the
        # same only once the contact is at rest.
        v = v - np.linalg.pinv(rows.A) @ rows.rate
        rows = closure.loop_rows(oracle.tree, pose, v, joint)
    a, _ = solve_bordered(oracle.mass_matrix(q), torque - oracle.bias(q, v), rows.A, -rows.drift)
    frame = engine.model.frames[engine.frame]
    contacts = {"point": pin.ContactType.CONTACT_3D, "weld": pin.ContactType.CONTACT_6D}
    local = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED if kind == "point" else pin.ReferenceFrame.LOCAL
    model = pin.RigidConstraintModel(contacts[kind], engine.model, frame.parentJoint, frame.placement, local)
    models, datas = [model], [model.createData()]
    pin.initConstraintDynamics(engine.model, engine.data, models, datas)
    args = (engine._q(q), engine._v(v), engine._v(torque), models, datas, pin.ProximalSettings(1e-12, 0.0, 1))
    expected = pin.constraintDynamics(engine.model, engine.data, *args)[engine.columns]
    H = oracle.mass_matrix(q)
    condition = np.linalg.cond(rows.A)  # nearly dependent rows pass the rounding of the force on to q̈
    assert np.abs(H @ (a - expected)).max() < AGREEMENT * condition * np.abs(H).max() * np.abs(expected).max()


def test_plane_is_one_row_of_the_general_closure():
    """`point_on_plane` gives nᵀJᵣ, nᵀJ̇ᵣq̇ and n·r − d."""
    robot = random_robot(3)
    oracle = Oracle.from_model(robot)
    q, v = random_state(robot, np.random.default_rng(3))
    normal = np.array([0.6, 0.0, 0.8])
    rows = closure.loop_rows(oracle.tree, oracle.pose(q), v, point_on_plane("tip", normal, 0.1))
    np.testing.assert_allclose(rows.A[0], normal @ oracle.jacobian(q), atol=1e-14)
    np.testing.assert_allclose(rows.drift[0], normal @ oracle.drift(q, v), atol=1e-13)
    assert rows.error[0] == pytest.approx(normal @ oracle.position(q) - 0.1, abs=1e-15)
