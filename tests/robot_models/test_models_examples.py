"""Every robot of example-robot-data loads, or is refused for a reason that is true."""

import numpy as np
import pinocchio as pin
import pytest
from budget import others

import robot_models
from robot_models import example_robots

# The reasons that are true of version 5.0.0, by a word of the message.
REFUSED = {
    "described in SDF": {"cassie"},
    "not its file alone": {"human", "talos_legs"},
}
#: Those in which nothing moves.
STILL = {"hector", "iris"}
LOADED = set(example_robots.example_names()) - set().union(*REFUSED.values()) - STILL


def test_the_table_is_covered():
    """All 72 are accounted for: 67 move, two have no joint, three are refused."""
    assert (len(example_robots.example_names()), len(LOADED)) == (72, 67)
    assert all(robot_models.load(name).n == 0 for name in STILL)


#: What is said of robots that are not as they should be, by a word of a warning.
WARNED = {
    "alex_psyonic_hands": "mimics 'index_q1', which is not in the file",
    "allegro_left_hand": "'link_11.0': its inertia tensor breaks the triangle inequality",
    "bravo7_gripper": "'bravo_finger1_joint' moves no mass: it is held at 0.2",
    "bolt": "'FL_FOOT' has a rotational inertia and a mass of 0 kg",
}


@pytest.mark.parametrize("name", WARNED)
def test_what_is_odd_is_named(name):
    """It runs all the same, where the mass matrix is positive definite."""
    assert any(WARNED[name] in line for line in robot_models.load(name).warnings)


QUICK = {"panda", "ur5", "kinova", "tiago", *sorted(LOADED)[::4]}  # the others are loaded with the longer tests


@pytest.mark.parametrize("name", [*sorted(QUICK), *others(sorted(LOADED - QUICK))])
def test_loads(name):
    """On a fixed base, one variable a joint, home inside the limits, a tip that is in the robot."""
    robot = robot_models.load(name)
    model = robot.pinocchio_model()
    assert model.nq == model.nv == robot.n > 0
    assert robot.tip in robot.frames
    assert np.all((robot.position_lower <= robot.home) & (robot.home <= robot.position_upper))
    assert robot.source.startswith("example-robot-data")
    assert robot.description


@pytest.mark.parametrize(("reason", "name"), [(r, n) for r, names in REFUSED.items() for n in sorted(names)])
def test_refused(reason, name):
    """The message names the robot and the reason."""
    with pytest.raises(robot_models.ModelError) as caught:
        robot_models.load(name)
    assert name in str(caught.value)
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("name", "n", "tip"),
    [("panda", 7, "panda_hand_tcp"), ("ur5", 6, "tool0"), ("kinova", 6, "j2s6s200_end_effector")],
)
def test_arms_are_ready_for_contact(name, n, tip):
    """The well-known arms have their tool as tip, and a home from which it can move in every direction."""
    robot = robot_models.load(name)
    assert (robot.n, robot.tip) == (n, tip)
    model = robot.pinocchio_model()
    J = pin.computeFrameJacobian(
        model, model.createData(), np.array(robot.home), model.getFrameId(tip), pin.LOCAL_WORLD_ALIGNED
    )
    assert np.linalg.svd(J[:3])[1].min() > 0.1


def test_same_dynamics_as_the_packages_own_loader():
    """Without meshes, but with the same mass matrix and bias as example_robot_data.load gives."""
    from example_robot_data import robots_loader

    for name in ("ur5", "kinova", "xarm7"):
        robot = robot_models.load(name)
        loader = robots_loader.ROBOTS[name]
        path = f"{loader.path}/{loader.urdf_subpath}/{loader.urdf_filename}"
        theirs = pin.buildModelFromUrdf(f"{robots_loader.getModelPath(path)}/{path}")
        q, v = np.random.default_rng(0).uniform(-1, 1, (2, robot.n))
        configuration = pin.integrate(theirs, pin.neutral(theirs), q)
        for function in (
            lambda m, x: np.triu(pin.crba(m, m.createData(), x)),
            lambda m, x: pin.nonLinearEffects(m, m.createData(), x, v),  # noqa: B023
        ):
            np.testing.assert_allclose(
                function(robot.pinocchio_model(), q), function(theirs, configuration), atol=1e-11
            )


def test_panda_fingers():
    """Locked by default, both; one can be set free, and then the one that mimics it is bound to it."""
    assert set(robot_models.load("panda").locked) == {"panda_finger_joint1", "panda_finger_joint2"}
    one = robot_models.load("panda", lock={"panda_finger_joint2": 0.0})
    assert one.joint_names[-1] == "panda_finger_joint1"
    assert one.joint_types[-1] == "prismatic"
    assert (one.loops, one.drives) == ((), None)
    both = robot_models.load("panda", lock=["panda_joint7"])
    assert [loop.joints for loop in both.loops] == [("panda_finger_joint2", "panda_finger_joint1")]
    assert both.driven.tolist() == [name != "panda_finger_joint2" for name in both.joint_names]


def test_ur3_is_a_ur3():
    """The table of version 5.0.0 has the UR5's loader under "ur3"; the upper arms differ in length."""
    assert "ur3_robot.urdf" in robot_models.load("ur3").source
    assert robot_models.load("ur3").text != robot_models.load("ur5").text


def test_rotor_parameters_are_drive_inertia():
    """Rotor parameters of an SRDF, where the package says that it has them, are the armature."""
    from example_robot_data import robots_loader

    robot = robot_models.load("talos_arm")
    loader = robots_loader.ROBOTS["talos_arm"]
    srdf = f"{loader.path}/{loader.srdf_subpath}/{loader.srdf_filename}"
    model = pin.buildModelFromXML(robot.text)
    pin.loadRotorParameters(model, f"{robots_loader.getModelPath(srdf)}/{srdf}", False)
    assert robot.armature.any()
    np.testing.assert_allclose(robot.armature, model.rotorInertia * model.rotorGearRatio**2, rtol=1e-15)
    assert not robot_models.load("talos_arm", drive_inertia=False).armature.any()
