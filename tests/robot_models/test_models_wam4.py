"""wam4 is the arm that Barrett describes."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_models

PI = np.pi
ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4)

# Barrett's printed listings in the axes of the DH frames (AC-02): mass, centre of mass, "L" about the centre
# of mass and "I" about the frame origin, as xx, yy, zz, xy, xz, yz. The last three are products +∫xy dm, not
# tensor entries.
PRINTED = {
    "link1": (
        *(10.76768767, (-0.00443422, 0.12189039, -0.00066489)),
        (0.13488033, 0.11328369, 0.09046330, -0.00213041, -0.00012485, 0.00068555),
        (0.29486350, 0.11350017, 0.25065343, -0.00795023, -0.00009311, -0.00018711),
    ),
    "link2": (
        *(3.87493756, (-0.00236983, 0.03105614, 0.01542114)),
        (0.02140958, 0.01377875, 0.01558906, 0.00027172, 0.00002461, -0.00181920),
        (0.02606840, 0.01472202, 0.01934814, -0.00001346, -0.00011701, 0.00003659),
    ),
    "link3": (
        *(1.80228141, (-0.03825858, 0.20750770, 0.00003309)),
        (0.05911077, 0.00324550, 0.05927043, -0.00249612, 0.00000738, -0.00001767),
        (0.13671601, 0.00588354, 0.13951371, -0.01680434, 0.00000510, -0.00000530),
    ),
    "link4": (
        *(1.06513649, (0.01095471, -0.00002567, 0.14053900)),
        (0.01848577, 0.01891658, 0.00197517, 0.00000219, -0.00160868, 0.00000515),
        (0.03952350, 0.04008214, 0.00210299, 0.00000189, 0.00003117, 0.00000131),
    ),
}

# DH frame of each link seen from the URDF's: axes as columns, and origin. Frames 1 and 3 have y down.
TURNED = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
DH_FRAME = {
    "link1": (TURNED, (0.0, 0, 0)),
    "link2": (np.eye(3), (0.0, 0, 0)),
    "link3": (TURNED, (0.045, 0, 0.55)),
    "link4": (np.eye(3), (-0.045, 0, 0)),
}

MOMENTS = {
    "link1": (0.090442, 0.113097, 0.135089),
    "link2": (0.012647, 0.016710, 0.021421),
    "link3": (0.003134, 0.059221, 0.059271),
    "link4": (0.001820, 0.018641, 0.018917),
}


@pytest.fixture(scope="module")
def model():
    """Return Pinocchio's model of the arm."""
    return robot_models.load("wam4").pinocchio_model()


def body(model, link):
    """Return the inertia of a moving link in its URDF frame, which is the joint's."""
    return model.inertias[model.frames[model.getFrameId(link)].parentJoint]


def tip(model, q):
    """Return the tip's placement in the base frame."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.asarray(q, dtype=float))
    return data.oMf[model.getFrameId("tip")]


@pytest.mark.parametrize(
    ("q", "expected"),
    [
        ((0, 0, 0, 0), (0, 0, 1.246)),
        ((0, 0, 0, PI / 2), (0.395, 0, 0.941)),
        ((0, PI / 2, 0, 0), (0.9, 0, 0.346)),
        ((PI / 2, PI / 2, 0, 0), (0, 0.9, 0.346)),
        ((0, 0, 0, PI), (0.09, 0, 0.546)),
    ],
)
def test_tip_at_known_postures(model, q, expected):
    """The tip is where the manual's dimensions put it."""
    np.testing.assert_allclose(tip(model, q).translation, expected, atol=1e-15)


@given(q=ANGLES)
def test_tip_equals_the_denavit_hartenberg_chain(model, q):
    """The URDF chain is Table 4 of the user's manual (standard convention), wherever the arm is."""
    chain = pin.SE3(np.eye(3), np.array([0, 0, 0.346]))
    rows = [(0, -PI / 2, 0), (0, PI / 2, 0), (0.045, -PI / 2, 0.55), (-0.045, PI / 2, 0)]
    for (a, alpha, d), theta in zip(rows, q, strict=True):
        turn = pin.SE3(pin.utils.rotate("z", theta), np.array([0, 0, d]))
        chain = chain * turn * pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0, 0]))
    chain = chain * pin.SE3(np.eye(3), np.array([0, 0, 0.35]))
    np.testing.assert_allclose(tip(model, q).homogeneous, chain.homogeneous, atol=4e-15)


def symmetric(six, sign=1.0):
    """Return the matrix of xx, yy, zz, xy, xz, yz with the off-diagonals times `sign`."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, sign * xy, sign * xz], [sign * xy, yy, sign * yz], [sign * xz, sign * yz, zz]])


def shifted(tensor, mass, com):
    """Return the tensor about a point from which the centre of mass is at `com`."""
    c = np.array(com)
    return tensor + mass * (c @ c * np.eye(3) - np.outer(c, c))


@pytest.mark.parametrize("link", PRINTED)
def test_printed_off_diagonals_are_products(link):
    """Only as products +∫xy dm do Barrett's two listings agree through the parallel-axis theorem."""
    mass, com, about_com, about_origin = PRINTED[link]
    off = ~np.eye(3, dtype=bool)
    as_products = shifted(symmetric(about_com, -1), mass, com) - symmetric(about_origin, -1)
    as_entries = shifted(symmetric(about_com, +1), mass, com) - symmetric(about_origin, +1)
    assert np.abs(as_products).max() < 3e-8  # eight printed decimals
    assert np.abs(as_entries[off]).max() > 3e-3


@pytest.mark.parametrize("link", PRINTED)
def test_inertia_is_the_printed_one(model, link):
    """The URDF's numbers are the printed ones, turned into the link's frame, with the tensor's sign."""
    mass, com, about_com, _ = PRINTED[link]
    R, origin = DH_FRAME[link]
    assert body(model, link).mass == mass
    np.testing.assert_allclose(body(model, link).lever, R @ np.array(com) + origin, atol=1e-15)
    np.testing.assert_allclose(body(model, link).inertia, R @ symmetric(about_com, -1) @ R.T, atol=1e-15)


@pytest.mark.parametrize("link", MOMENTS)
def test_principal_moments(model, link):
    """The principal moments are those worked out from the published values, and belong to a possible body."""
    low, mid, high = np.linalg.eigvalsh(body(model, link).inertia)
    np.testing.assert_allclose((low, mid, high), MOMENTS[link], atol=6e-7)
    assert low > 0
    assert low + mid > high


def test_moving_mass(model):
    """The moving links weigh 17.51004 kg together."""
    assert sum(inertia.mass for inertia in list(model.inertias)[1:]) == pytest.approx(17.51004313, abs=1e-8)


def test_gravity_moment_of_the_shoulder(model):
    """Held level, the arm hangs on J2 with a first moment of 1.4125 kg m."""
    level = pin.computeGeneralizedGravity(model, model.createData(), np.array([0, PI / 2, 0, 0]))
    heights = {"link2": 0.01542114, "link3": 0.34249230, "link4": 0.55 + 0.14053900}
    moment = sum(PRINTED[link][0] * z for link, z in heights.items())
    assert -level[1] / 9.81 == pytest.approx(moment, rel=1e-12)
    assert moment == pytest.approx(1.4125, abs=5e-5)


def test_drive_inertia_is_derived_from_the_printed_values():
    """Armature is TᵀJT with the exact ratios, and the differential's coupling cancels."""
    rotor = np.diag([1.1631e-4, 1.1831e-4, 1.1831e-4, 1.0686e-4])
    n1, n2, n4, n3 = 42.0013, 28.2510, 18.0016, 1.68
    T = np.array([[-n1, 0, 0, 0], [0, n2, -n2 / n3, 0], [0, -n2, -n2 / n3, 0], [0, 0, 0, -n4]])
    seen = T.T @ rotor @ T
    armature = robot_models.load("wam4").armature
    np.testing.assert_allclose(seen - np.diag(np.diag(seen)), 0, atol=1e-16)
    np.testing.assert_allclose(armature, np.diag(seen), rtol=5e-6)
    np.testing.assert_allclose(armature, [0.2052, 0.18885, 0.06691, 0.03463], rtol=1e-4)


def test_drive_inertia_is_on_the_diagonal_only(model):
    """The switch changes the mass matrix by the armature and nothing else."""
    bare = robot_models.load("wam4", drive_inertia=False)
    assert not bare.armature.any()
    without = bare.pinocchio_model()
    q = np.array([0.3, 1.0, -0.4, 1.7])
    difference = np.triu(pin.crba(model, model.createData(), q) - pin.crba(without, without.createData(), q))
    np.testing.assert_allclose(difference, np.diag(robot_models.load("wam4").armature), atol=1e-15)
    v = np.array([1.0, -2.0, 0.5, 3.0])
    bias = [pin.nonLinearEffects(m, m.createData(), q, v) for m in (model, without)]
    np.testing.assert_array_equal(*bias)


def test_limits_are_the_manuals_degrees():
    """Barrett's degrees, which are the tighter of the two sets that the manual prints."""
    robot = robot_models.load("wam4")
    np.testing.assert_allclose(np.degrees(robot.position_lower), [-150, -113, -157, -50], rtol=1e-14)
    np.testing.assert_allclose(np.degrees(robot.position_upper), [150, 113, 157, 180], rtol=1e-14)
    ratio = np.array([42.0013, 28.2510, 28.2510 / 1.68, 18.0016])
    np.testing.assert_allclose(robot.velocity_limit, 100.218 / ratio, rtol=2e-3)
    np.testing.assert_allclose(robot.effort_limit, 1.490 * ratio * [1, 2, 2, 1], rtol=3e-3)
