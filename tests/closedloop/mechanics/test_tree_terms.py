"""Our own terms of any tree of joints are those of Pinocchio, robot by robot and state by state."""

import numpy as np
import pinocchio as pin
import pytest
from budget import budget
from tree_cases import Own, assert_equal_terms, close, random_case, random_model

import closedloop as cl
import robot_models
from closedloop.base.errors import ModelError
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.robot.tree import layout, tree_of, tree_potential_energy, tree_turning, work_size
from closedloop.mechanics.robot.tree.kinematics import sines
from robot_models.planar2 import closed_form

# name and tip; solo12 has four legs, ur5 and panda come from example-robot-data
ROBOTS = [
    ("planar2", None), ("pointmass3", None), ("wam4", None), ("panda", None), ("ur5", None), ("solo12", "HR_FOOT"),
]  # fmt: skip
IDS = [name for name, _ in ROBOTS]


@pytest.mark.parametrize(("name", "tip"), ROBOTS, ids=IDS)
def test_terms_equal_pinocchios(name, tip, robot, random_states):
    """H, C, r, J and drift of real robots are those that Pinocchio computes."""
    arm = robot(name, tip)
    own = Own(arm.model, arm.tip)
    for s in random_states(arm, 30, 0):
        assert_equal_terms(own.terms(s.q, s.v), arm.terms(s.q, s.v))


def check_random_tree(seed, states=5):
    """Our terms and potential energy of a random tree are Pinocchio's."""
    own, theirs, rng = random_case(seed)
    for _ in range(states):
        q, v = rng.uniform(-3.0, 3.0, theirs.n), rng.normal(size=theirs.n)
        assert_equal_terms(own.terms(q, v), theirs.terms(q, v))
        assert close(tree_potential_energy(own.tree, q, own.work), theirs.potential_energy(q[None])[0])


@pytest.mark.parametrize("seed", range(12))
def test_terms_of_random_trees_equal_pinocchios(seed):
    """Any topology, every joint type, any direction of gravity, armature, and the tip on any link."""
    check_random_tree(seed)


@pytest.mark.parametrize("seed", range(12))
def test_turning_of_the_tips_link_is_pinocchios(seed):
    """The link's axes turn as the tip's frame does, and J is the angular part of that frame's Jacobian."""
    model, tip, rng = random_model(seed)
    own, theirs = Own(model, tip), model.pinocchio_model()
    data, frame, between = theirs.createData(), theirs.getFrameId(tip), []
    for _ in range(3):
        q, axes, J = rng.uniform(-3.0, 3.0, model.n), np.full((3, 3), 1e300), np.full((3, model.n), 1e300)
        own.kinematics(q, np.zeros(model.n))
        interpreted(tree_turning)(own.tree, own.work, axes, J)
        turned = pin.computeFrameJacobian(theirs, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[3:]
        pin.framesForwardKinematics(theirs, data, q)
        between.append(axes.T @ data.oMf[frame].rotation)
        assert close(J, turned)
        assert close(axes.T @ axes, np.eye(3))
        assert np.linalg.det(axes) > 0.0
        assert close(between[-1], between[0])


@pytest.mark.slow
def test_terms_of_many_random_trees_equal_pinocchios():
    """The same for many trees."""
    for seed in range(100, 100 + budget(100, 300)):
        check_random_tree(seed, states=2)


def test_long_chain_equals_pinocchio():
    """Thirty joints one after the other, eight blocks of four."""
    own, theirs, rng = random_case(5, joints=30, branching=False)
    assert own.tree.serial == 1
    for _ in range(5):
        q, v = rng.uniform(-3.0, 3.0, 30), rng.normal(size=30)
        assert_equal_terms(own.terms(q, v), theirs.terms(q, v))


def test_random_trees_have_every_case():
    """The seeds above draw branches, all joint types, and a tip with an offset, on the base, and off the last link."""
    kinds, branched, on_base, inside, offset = set(), 0, 0, 0, 0
    for seed in range(12):
        model, tip, _ = random_model(seed)
        tree = tree_of(model, tip)
        kinds |= set(model.joint_types)
        branched += tree.serial == 0
        on_base += tree.carrier < 0
        inside += 0 <= tree.carrier < tree.n - 1
        offset += bool(np.any(tree.constants[3:6] != 0.0))
    assert kinds == {"revolute", "continuous", "prismatic"}
    assert min(branched, on_base, inside, offset) >= 1


def test_planar2_has_the_terms_of_the_textbook(robot, random_states):
    """The terms of planar2 are those of the closed form, which no engine took part in."""
    arm = robot("planar2")
    own = Own(arm.model, arm.tip)
    for s in random_states(arm, 30, 1):
        assert_equal_terms(own.terms(s.q, s.v), closed_form.terms(s.q, s.v))


def test_tip_on_the_base_stays():
    """A tip that no joint moves has its place, no Jacobian and no drift."""
    model = robot_models.load("ur5")
    own, theirs = Own(model, "base_link"), cl.Robot(model, "base_link")
    q, v = np.full(6, 0.3), np.ones(6)
    assert_equal_terms(own.terms(q, v), theirs.terms(q, v))
    assert not np.any(own.terms(q, v).jacobian)
    assert not np.any(own.terms(q, v).drift)


def test_locked_joints_and_one_joint():
    """A locked joint is part of its parent's link, down to a robot of one joint."""
    for lock in ({"j2": 0.4}, {"j1": 0.1, "j2": 0.2, "j4": 0.5}):
        names = robot_models.load("wam4").joint_names
        model = robot_models.load("wam4", lock={names[int(key[1]) - 1]: value for key, value in lock.items()})
        own, theirs = Own(model, "tip"), cl.Robot(model, "tip")
        q, v = np.linspace(0.5, 1.0, model.n), np.linspace(-1.0, 1.0, model.n) + 0.1
        assert own.tree.n == 4 - len(lock)
        assert_equal_terms(own.terms(q, v), theirs.terms(q, v))


TWO_JOINTS = """<robot name="two">
  <link name="base"/>
  <joint name="a" type="continuous"><parent link="base"/><child link="one"/><origin xyz="0.1 0.2 0.3" rpy="0.3 0 0"/>
    <axis xyz="0 0 1"/></joint>
  <link name="one"><inertial><origin xyz="0.1 0.05 0.2"/><mass value="2"/>
    <inertia ixx="0.03" ixy="0.001" ixz="0.002" iyy="0.04" iyz="0.003" izz="0.05"/></inertial></link>
  <joint name="b" type="{kind}"><parent link="one"/><child link="two"/><origin xyz="0.4 0.1 -0.2" rpy="{tilt} 0.0 0.7"/>
    <axis xyz="0 0 {sense}"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
  <link name="two"><inertial><origin xyz="0.2 -0.1 0.1"/><mass value="1"/>
    <inertia ixx="0.02" ixy="0.001" ixz="0.002" iyy="0.03" iyz="0.001" izz="0.02"/></inertial></link>
  <joint name="c" type="continuous"><parent link="two"/><child link="tip"/><origin xyz="0.3 0.2 0.1" rpy="0 {tilt} 0"/>
    <axis xyz="0 0 1"/></joint>
  <link name="tip"><inertial><origin xyz="0.1 0.1 0.1"/><mass value="0.5"/>
    <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.02"/></inertial></link>
</robot>"""


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("tilt", [0.0, 1e-17, 1e-15, 1e-13, 1e-9, 1e-5, np.pi / 2])
def test_parallel_and_nearly_parallel_axes(kind, sense, tilt):
    """The common perpendicular of two axes is ill-determined or missing where they are parallel; the terms are not."""
    model = robot_models.from_text(
        TWO_JOINTS.format(kind=kind, sense=sense, tilt=tilt), "urdf", name="two", armature=np.zeros(3), tip="tip",
        home=np.zeros(3), locked={},
    )  # fmt: skip
    own, theirs = Own(model, "tip"), cl.Robot(model, "tip")
    q, v = np.array([0.3, -0.4, 0.8]), np.array([1.0, -2.0, 0.5])
    assert_equal_terms(own.terms(q, v), theirs.terms(q, v))


def test_angles_of_any_size(robot):
    """Terms at q + 2πk are those at q as far as 2πk can be written, also beyond the range of the four-lane sine.

    An angle of size 10⁸ is known to 10⁸ · 1.1e-16 rad, so we ask Pinocchio at the very same angle.
    """
    arm = robot("ur5")
    own = Own(arm.model, arm.tip)
    for size in (1e2, 1e4, 0.999e6, 1.001e6, 1e8, 1e12):
        q, v = size * np.linspace(-1.0, 1.0, 6), np.linspace(-1.0, 1.0, 6)
        assert_equal_terms(own.terms(q, v), arm.terms(q, v))


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="nothing is more accurate here")
def test_sine_and_cosine_are_wrong_in_the_last_place_at_most(robot):
    """Of 40 000 angles, as many at once, against more digits: 1.3 units in the last place."""
    tree, angles = tree_of(robot("planar2").model, robot("planar2").tip), np.linspace(-7.0, 7.0, 40_000)
    work = np.zeros((work_size(2), angles.size))
    interpreted(sines)(tree, np.stack([angles, angles]), work)
    for place, function in ((layout.SINE, np.sin), (layout.COSINE, np.cos)):
        exact = function(angles.astype(np.longdouble))
        off = np.abs(work[tree.links[layout.SCRATCH * 2] + place] - exact) / np.spacing(np.abs(exact.astype(float)))
        assert 0.5 < np.max(off) < 1.4


def test_refuses_what_it_does_not_cover():
    """A joint of another kind is named, and so is an unknown tip."""
    model = robot_models.load("wam4")

    class Puck:
        name, known = "puck on stick", {}

        def require_frame(self, tip):
            return tip

        def pinocchio_model(self):
            built = pin.Model()
            stick = built.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "stick")
            built.addJoint(stick, pin.JointModelPlanar(), pin.SE3.Identity(), "wrist")
            return built

    with pytest.raises(ModelError, match=r"puck on stick: joint 'wrist' is of Pinocchio's kind Planar: .*revolute"):
        tree_of(Puck(), "universe")
    with pytest.raises(ModelError, match=r"no frame 'tipp'.*did you mean 'tip'"):
        tree_of(model, "tipp")


def test_a_load_changes_the_inertia_alone():
    """Trees of a robot with other loads have the numbers of one whose axes were found for it alone."""
    model = robot_models.load("wam4")

    def with_load(mass):
        return tree_of(model.changed(tools=(robot_models.Tool("tip", mass=mass),)), "tip")

    first, bare = with_load(0.3), tree_of(model, "tip")
    model.known.clear()
    again = with_load(0.3)
    for before, after in zip(first, again, strict=True):
        np.testing.assert_array_equal(before, after)
    moved = np.flatnonzero(first.constants != bare.constants)
    assert moved.size
    angles = {layout.ANGLE, layout.COS_TWIST, layout.SIN_TWIST, layout.T0, layout.T1, layout.T2}
    assert not angles & {int(i - layout.HEAD) // layout.LANES * layout.LANES % layout.CONSTANTS for i in moved}
