"""wam7 is wam4's arm with the wrist that Barrett describes."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_models

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7)
TURNED = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
# Mass, centre of mass and printed products and moments xx, yy, zz, xy, xz, yz about it, axes of the DH frames; the
# frame's axes and origin in the URDF's. Of libbarrett, and of the earlier set.
WRIST = {
    "link4": (
        2.17266212,
        (0.00553408, 0.00006822, 0.11927695),
        (0.01067491, 0.01058659, 0.00282036, 0.00004503, -0.00135557, -0.00011002),
        np.eye(3),
        (-0.045, 0, 0),
    ),
    "link5": (
        0.35655692,
        (0.00005483, 0.02886286, 0.00148493),
        (0.00037112, 0.00019434, 0.00038209, -0.00000008, -0.00000003, -0.00001613),
        TURNED,
        (0, 0, 0),
    ),
    "link6": (
        0.40915886,
        (-0.00005923, -0.01686123, 0.02419052),
        (0.00054889, 0.00023846, 0.00045133, 0.00000019, -0.00000010, -0.00004430),
        np.eye(3),
        (0, 0, 0),
    ),
    "link7": (
        0.07548270,
        (0.00014836, 0.00007252, -0.00335185),
        (0.00003911, 0.00003877, 0.00007614, 0.00000019, 0.0, 0.0),
        np.eye(3),
        (0, 0, 0),
    ),
}
EARLIER = {
    "link4": (2.40016804, (0.00498512, -0.00022942, 0.13271662)),
    "link5": (0.12376019, (0.00008921, 0.00511217, 0.00435824)),
    "link6": (0.41797364, (-0.00012262, -0.01703194, 0.02468336)),
    "link7": (0.06864753, (-0.00007974, 0.00016313, -0.00323552)),
}


@pytest.fixture(scope="module")
def model():
    """Return Pinocchio's model of the arm."""
    return robot_models.load("wam7").pinocchio_model()


def number(model, link):
    """Return the joint that a link hangs on."""
    return model.frames[model.getFrameId(link)].parentJoint


@given(q=ANGLES)
def test_tip_equals_the_denavit_hartenberg_chain(q):
    """The manual's table, standard convention, wherever the arm is."""
    model = robot_models.load("wam7").pinocchio_model()
    chain = pin.SE3(np.eye(3), np.array([0, 0, 0.346]))
    half = np.pi / 2
    rows = [
        (0, -half, 0),
        (0, half, 0),
        (0.045, -half, 0.55),
        (-0.045, half, 0),
        (0, -half, 0.3),
        (0, half, 0),
        (0, 0, 0.06),
    ]
    for (a, alpha, d), theta in zip(rows, q, strict=True):
        turn = pin.SE3(pin.utils.rotate("z", theta), np.array([0, 0, d]))
        chain = chain * turn * pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0, 0]))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array(q))
    np.testing.assert_allclose(data.oMf[model.getFrameId("tip")].homogeneous, chain.homogeneous, atol=1e-14)


@pytest.mark.parametrize("link", WRIST)
def test_inertia_is_the_printed_one(model, link):
    """Turned into the link's frame, with the tensor's sign, and of a body that can be."""
    mass, com, (xx, yy, zz, xy, xz, yz), R, origin = WRIST[link]
    body = model.inertias[number(model, link)]
    tensor = np.array([[xx, -xy, -xz], [-xy, yy, -yz], [-xz, -yz, zz]])
    assert body.mass == mass
    np.testing.assert_allclose(body.lever, R @ np.array(com) + origin, atol=1e-14)
    np.testing.assert_allclose(body.inertia, R @ tensor @ R.T, atol=1e-14)
    low, mid, high = np.linalg.eigvalsh(body.inertia)
    assert low > 0
    assert low + mid > high


def test_the_arm_before_the_wrist_is_wam4s(model):
    """Base, links 1 to 3, J1 to J4 and their drives."""
    other = robot_models.load("wam4")
    theirs = other.pinocchio_model()
    for joint in range(1, 4):
        assert model.inertias[joint] == theirs.inertias[joint]
    for joint in range(1, 5):
        assert model.jointPlacements[joint] == theirs.jointPlacements[joint]
    np.testing.assert_array_equal(robot_models.load("wam7").armature[:4], other.armature)


def test_both_sets_of_the_wrist_pull_alike(model):
    """Their masses together, and the gravity torques of J1 to J4, as SOURCES.md says."""
    assert abs(sum(x[0] for x in WRIST.values()) - sum(x[0] for x in EARLIER.values())) < 0.004
    earlier = robot_models.load("wam7").pinocchio_model()
    for link, (mass, com) in EARLIER.items():
        *_, R, origin = WRIST[link]
        earlier.inertias[number(earlier, link)] = pin.Inertia(mass, R @ np.array(com) + origin, np.eye(3) * 1e-3)
    rng = np.random.default_rng(0)
    worst = 0.0
    for q in rng.uniform(-3, 3, (300, 7)):
        ours, theirs = (pin.computeGeneralizedGravity(m, m.createData(), q) for m in (model, earlier))
        worst = max(worst, np.abs(ours - theirs)[:4].max())
    assert worst < 0.4
