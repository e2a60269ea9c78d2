"""The reader: what a URDF says is what the tree holds, and what it leaves unsaid is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
import yourdfpy  # noqa: F401 - it takes a second, which no single test should be billed for

from validation.oracle import Joint, Link, Oracle, UnsupportedModel, build_tree, read_urdf
from validation.oracle.spatial import rotation_from_rpy
from validation.oracle.tree import joint_motion, parse_urdf
from validation.states import random_robot, random_state

BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def one_joint(*, body=BODY, kind="revolute", inside='<axis xyz="0 0 1"/>', fmt="urdf"):
    """Return a robot of one joint, with a description to be spoilt."""
    text = (
        f'<robot name="one"><link name="base"/><link name="arm">{body}</link><joint name="j" type="{kind}">'
        f'<parent link="base"/><child link="arm"/>{inside}{LIMIT}</joint></robot>'
    )
    return SimpleNamespace(
        format=fmt,
        text=text,
        joint_names=("j",),
        armature=np.zeros(1),
        locked={},
        gravity=np.array([0, 0, -9.81]),
    )


@pytest.mark.parametrize("seed", range(20))
def test_text_and_numbers_make_the_same_tree(seed):
    """Written to 17 digits and read back, a random robot is the tree that its numbers make."""
    robot = random_robot(seed)
    read = read_urdf(robot)
    assert read.parent == robot.tree.parent
    assert read.kinds == robot.tree.kinds
    for name in ("axis", "rotation", "translation", "inertia"):
        # Two ways to multiply the same three rotations, a few roundings apart.
        np.testing.assert_allclose(getattr(read, name), getattr(robot.tree, name), atol=2e-15, err_msg=name)
    assert read.frames.keys() == robot.tree.frames.keys()
    for name, frame in read.frames.items():
        assert frame.body == robot.tree.frames[name].body
        np.testing.assert_allclose(frame.translation, robot.tree.frames[name].translation, atol=2e-15)


def test_rpy_of_the_parser_is_ours():
    """The parser's placement matrix is R_z R_y R_x to the last digits."""
    for seed in range(10):
        rpy = np.random.default_rng(seed).uniform(-np.pi, np.pi, 3)
        inside = f'<origin xyz="1 2 3" rpy="{" ".join(map(repr, rpy.tolist()))}"/>'
        joint = parse_urdf(one_joint(inside=inside).text)[1][0]
        np.testing.assert_allclose(joint.rotation, rotation_from_rpy(rpy), atol=4e-16)
        np.testing.assert_array_equal(joint.translation, [1, 2, 3])


def test_absent_origin_and_axis_are_the_defaults_of_urdf():
    """No origin is the identity, no axis is x."""
    tree = read_urdf(one_joint(inside=""))
    np.testing.assert_array_equal(tree.rotation[0], np.eye(3))
    np.testing.assert_array_equal(tree.axis[0], [1, 0, 0])


def test_axis_is_normalised():
    """The length of an axis means nothing."""
    tree = read_urdf(one_joint(inside='<axis xyz="0 3 4"/>'))
    np.testing.assert_allclose(tree.axis[0], [0, 0.6, 0.8], rtol=1e-15)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (one_joint(fmt="mjcf"), "mjcf"),
        (one_joint(inside='<axis xyz="0 0 0"/>'), "no direction"),
        (one_joint(kind="floating"), "floating"),
        (one_joint(body=BODY.replace('izz="1"', "")), "izz"),
        (one_joint(body=BODY.replace('value="1"', "")), "value"),
        (one_joint(body="<inertial><mass value='1'/></inertial>"), "inertia"),
        (one_joint(body=BODY.replace('value="1"', 'value="nan"')), "mass nan"),
        (one_joint(body=BODY.replace('value="1"', 'value="-1"')), "mass -1"),
        (one_joint(body="<oops>"), "not XML"),
        (one_joint(kind="fixed"), "fixed"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_not_understood_is_refused(robot, message):
    """Everything that the parser would fill in or wave through is an error that names it."""
    with pytest.raises(UnsupportedModel, match=message):
        read_urdf(robot)


def test_moving_joints_must_be_accounted_for():
    """A joint that is neither a column nor locked, or both, is an error, and so is an unknown one."""
    robot = one_joint()
    for names, locked in (((), {}), (("j",), {"j": 0.0}), (("j", "k"), {})):
        robot.joint_names, robot.locked, robot.armature = names, locked, np.zeros(len(names))
        with pytest.raises(UnsupportedModel, match=r"'[jk]'"):
            read_urdf(robot)


def test_a_parent_comes_before_its_children():
    """The recursions rely on λ(i) < i, so another column order is refused."""
    links = [Link("base"), Link("one", 1.0), Link("two", 1.0)]
    joints = [Joint("a", "revolute", "base", "one"), Joint("b", "revolute", "one", "two")]
    with pytest.raises(ValueError, match="before the joint that carries it"):
        build_tree(links, joints, joint_names=["b", "a"])


def test_two_trees_are_not_one():
    """A description that does not hang together is refused."""
    with pytest.raises(UnsupportedModel, match="one tree"):
        build_tree([Link("a"), Link("b")], [], joint_names=[])


@pytest.mark.parametrize("seed", range(10))
def test_a_locked_joint_is_one_that_does_not_move(seed):
    """Locking a joint leaves the H and C of the whole robot without its row and column, the joint at rest."""
    robot = random_robot(seed, drive_inertia=False)
    rng = np.random.default_rng(seed)
    q, v = random_state(robot, rng)
    held = int(rng.integers(len(q)))
    v[held] = 0.0
    others = [i for i in range(len(q)) if i != held]
    less = SimpleNamespace(
        format="urdf",
        text=robot.text,
        joint_names=tuple(robot.joint_names[i] for i in others),
        armature=np.zeros(len(others)),
        locked={robot.joint_names[held]: q[held]},
        gravity=robot.gravity,
    )
    full, locked = Oracle(robot.tree, "tip"), Oracle(read_urdf(less), "tip")
    H = full.mass_matrix(q)
    atol = 1e-14 * np.abs(H).max()
    np.testing.assert_allclose(locked.mass_matrix(q[others]), H[np.ix_(others, others)], atol=atol)
    C = full.bias(q, v)
    atol = 1e-13 * max(1.0, np.abs(C).max())
    np.testing.assert_allclose(locked.bias(q[others], v[others]), C[others], atol=atol)
    np.testing.assert_allclose(locked.position(q[others]), full.position(q), atol=1e-14)


def test_joint_motion_turns_and_slides():
    """A quarter turn about z takes x to y; a slide moves along the axis."""
    turn, still = joint_motion("revolute", np.array([0.0, 0.0, 1.0]), np.pi / 2)
    np.testing.assert_allclose(turn @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_array_equal(still, 0.0)
    turn, slide = joint_motion("prismatic", np.array([0.0, 1.0, 0.0]), 0.5)
    np.testing.assert_array_equal(turn, np.eye(3))
    np.testing.assert_array_equal(slide, [0.0, 0.5, 0.0])


def test_random_robots_are_the_same_again_and_possible():
    """A seed is one robot; tensors satisfy the triangle inequality; all joint types and branches appear."""
    assert random_robot(5).text == random_robot(5).text
    kinds, branched = set(), False
    for seed in range(20):
        robot = random_robot(seed)
        kinds |= set(robot.joint_types)
        moved = [parent for parent in robot.tree.parent if parent >= 0]
        branched |= len(moved) > len(set(moved))
        for link in parse_urdf(robot.text)[0]:
            low, middle, high = np.linalg.eigvalsh(link.inertia)
            assert low >= 0.0
            assert low + middle >= high * (1 - 1e-12)
    assert kinds == {"revolute", "continuous", "prismatic"}
    assert branched


def test_unknown_links_are_named():
    """Asking for a link that is not there lists those that are."""
    with pytest.raises(KeyError, match="the links are"):
        Oracle(random_robot(0).tree, "nowhere")
