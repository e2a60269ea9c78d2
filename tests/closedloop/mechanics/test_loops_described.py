"""Loops as they are described, by MuJoCo's files and by sidecars: what closes, and what is refused."""

import dataclasses

import mujoco
import numpy as np
import pytest
from falling_loops import falling, free, null_space_acceleration

import closedloop as cl
import robot_models
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.loops import solve
from closedloop.mechanics.loops.assemble import closed_start
from closedloop.mechanics.loops.bind import bound_by_loops, loop_memory
from closedloop.mechanics.loops.memory import IDLE, POSITION
from closedloop.mechanics.loops.reactions import loop_rows as rows_of_loops
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.robot.pinocchio import Robot
from validation.loops.cases import four_bar, loop

MJCF = """<mujoco><compiler angle="radian"/><worldbody>
<body name="crank"><joint name="J1" axis="0 -1 0"/><inertial pos="0.1 0 0" mass="1" diaginertia="0.001 0.0033 0.0033"/>
 <body name="coupler" pos="0.2 0 0"><joint name="J2" axis="0 -1 0"/>
  <inertial pos="0.25 0 0" mass="2" diaginertia="0.001 0.04 0.04"/></body></body>
<body name="rocker" pos="0.5 0 0" euler="0 -1.5707963267948966 0"><joint name="J3" axis="0 -1 0"/>
 <inertial pos="0.2 0 0" mass="1.5" diaginertia="0.001 0.02 0.02"/></body>
</worldbody><equality>{}</equality></mujoco>"""
NO_LAW = {"law.kind": "none", "time.integrator": "rk4", "stabiliser.kind": "none"}
CONNECT = '<connect name="pin" body1="coupler" body2="rocker" anchor="0.3 0 0.4" {}/>'


def from_mjcf(tmp_path, equality):
    """The mechanism of an MJCF with this section."""
    return from_mjcf_text(tmp_path, MJCF.format(equality))


def test_connect_of_mujoco_is_a_point(tmp_path):
    """The harder MuJoCo's force is made, the nearer its acceleration comes to ours."""
    model = from_mjcf(tmp_path, CONNECT.format(""))
    q, v = np.zeros(3), np.zeros(3)
    ours = null_space_acceleration(model, q, v, np.zeros(3))
    off = []
    for hard in (1e6, 1e8):
        text = MJCF.format(CONNECT.format(f'solref="{-hard} {-2 * hard**0.5}" solimp="0.99999 0.99999 0.001"'))
        theirs = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(theirs)
        mujoco.mj_forward(theirs, data)
        off.append(np.max(np.abs(data.qacc - ours)) / np.max(np.abs(ours)))
    run = falling(model, duration=0.01)
    np.testing.assert_allclose(run.acceleration[0], ours, atol=1e-10)
    assert max(off) < 1e-3


CHAIN = (
    '<mujoco><option gravity="1 2 -9"/><worldbody><body><joint name="a" axis="0 1 0" ref=".2"/>{0}<body pos=".3 0 0">'
    '<joint name="b" axis="0 1 0"/>{0}<body pos=".3 0 0"><joint name="c" axis="0 0 1"/>{0}<body pos=".3 0 0">'
    '<joint name="d" axis="0 1 0" type="slide"/>{0}</body></body></body></body></worldbody><tendon><fixed name="s">'
    '<joint joint="a" coef="1"/><joint joint="b" coef="-.5"/><joint joint="c" coef=".7"/></fixed><fixed name="t">'
    '<joint joint="b" coef="1"/><joint joint="d" coef="2"/></fixed></tendon>'
).format('<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>')
SUMS = {
    "one sum": '<tendon name="h" tendon1="s" polycoef=".05 1 0 0 0" {}/>',
    "two sums": '<tendon name="h" tendon1="s" tendon2="t" polycoef=".05 .4 0 0 0" {}/>',
    "a polynomial of a sum": '<tendon name="h" tendon1="s" tendon2="t" polycoef=".05 .4 .3 -.2 .1" {}/>',
}


@pytest.mark.parametrize("equality", SUMS.values(), ids=SUMS)
def test_equalities_of_tendons_over_many_joints_hold(tmp_path, equality):
    """Rows and acceleration are MuJoCo's, the harder its force the nearer; a fall keeps them, and its energy."""
    hard = equality.format('solref="-1e8 -2e4" solimp="0.99999 0.99999 0.001"')
    path = tmp_path / "chain.xml"
    path.write_text(f"{CHAIN}<equality>{hard}</equality></mujoco>")
    model = robot_models.load(path)
    again = robot_models.from_text(
        model.text, "mjcf", name="again", armature=model.armature, tip=model.tip, home=model.home, locked={},
        loops=[each.as_table() for each in model.loops],
    )  # fmt: skip
    assert again.loops == model.loops
    closed, _ = closed_start(Robot(model, model.tip), np.array([0.4, 0.3, -0.2, 0.1]), np.zeros(4), assemble=True)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(theirs)
    data.qpos[:] = closed
    mujoco.mj_forward(theirs, data)
    rows, errors = rows_of_loops(Robot(model, model.tip), closed[None], np.zeros((1, 4)))
    direction = data.efc_J.reshape(-1, 4)[0]
    np.testing.assert_allclose(
        rows[0, 0] / np.linalg.norm(rows[0, 0]), direction / np.linalg.norm(direction), atol=1e-14
    )
    assert max(abs(data.efc_pos[0]), np.abs(errors).max()) < 1e-14
    ours = null_space_acceleration(model, closed, np.zeros(4), np.zeros(4))
    np.testing.assert_allclose(data.qacc, ours, atol=2e-4 * np.abs(ours).max())
    run = falling(model, duration=0.3, start={"q": closed.tolist(), "assemble": True})
    np.testing.assert_allclose(run.acceleration[0], ours, atol=1e-10)
    assert np.max(np.abs(run.q[-1] - closed)) > 0.1
    for q in run.q[::100]:
        data.qpos[:] = q
        mujoco.mj_forward(theirs, data)
        assert abs(data.efc_pos[0]) < 1e-9


def test_a_lock_leaves_the_rest_of_a_sum_bound(tmp_path):
    """The row of the joints that are left, with what the held ones add, is that of all where these are at rest."""
    path = tmp_path / "chain.xml"
    path.write_text(f"{CHAIN}<equality>{SUMS['a polynomial of a sum'].format('')}</equality></mujoco>")
    whole, held = robot_models.load(path), robot_models.load(path, lock={"b": 0.3})
    q = np.array([0.4, -0.2, 0.1])
    few, few_errors = rows_of_loops(Robot(held, held.tip), q[None], np.zeros((1, 3)))
    many, errors = rows_of_loops(Robot(whole, whole.tip), np.insert(q, 1, 0.3)[None], np.zeros((1, 4)))
    np.testing.assert_allclose(few[0], np.delete(many[0], 1, axis=1), atol=1e-14)
    np.testing.assert_allclose(few_errors, errors, atol=1e-14)


def test_welds_and_gears_of_mujoco(tmp_path):
    """A weld at the reference pose locks what it joins; a gear is its polynomial."""
    welded = from_mjcf(tmp_path, '<weld body1="coupler" body2="crank"/>')
    run = falling(welded, duration=0.1)
    assert np.max(np.abs(run.q[:, 1])) < 1e-12
    assert np.max(np.abs(run.q[:, 0])) > 1e-2
    geared = from_mjcf(tmp_path, '<joint joint1="J1" joint2="J3" polycoef="0 1 0.2 0 0"/>')
    run = falling(geared, duration=0.1)
    np.testing.assert_allclose(run.q[:, 0], run.q[:, 2] + 0.2 * run.q[:, 2] ** 2, atol=1e-13)
    assert from_mjcf(tmp_path, '<weld body1="coupler" body2="crank" active="false"/>').loops == ()


BALLS = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="a" pos="0 0 1">{a}<geom type="capsule" fromto="0 0 0 .3 0 -.4" size=".02"/></body>
<body name="b" pos="1 0 1">{b}<geom type="capsule" fromto="0 0 0 -.3 .1 -.4" size=".02"/>
<body name="c" pos="-.3 .1 -.4">{c}<geom type="capsule" fromto="0 0 0 -.4 -.1 0" size=".02" mass=".5"/></body></body>
</worldbody><equality><connect name="k" body1="a" body2="c" anchor=".3 0 -.4"/></equality></mujoco>"""


JOINTS = {
    "balls": '<joint name="{0}" type="ball"/>',
    "hinges": '<joint name="{0}x" axis="1 0 0"/><joint name="{0}y" axis="0 1 0"/><joint name="{0}z" axis="0 0 1"/>',
}


@pytest.mark.parametrize("kind", JOINTS)
def test_a_loop_passes_through_balls_and_through_three_hinges_of_a_body(tmp_path, kind):
    """A chain falls as MuJoCo's own H, C and rows of the connect have it, and the loop stays closed."""
    text = BALLS.format(**{name: JOINTS[kind].format(name) for name in "abc"})
    model, theirs = from_mjcf_text(tmp_path, text), mujoco.MjModel.from_xml_string(text)
    data, n = mujoco.MjData(theirs), theirs.nv
    mujoco.mj_forward(theirs, data)
    H, J = np.zeros((n, n)), data.efc_J.reshape(-1, n)
    mujoco.mj_fullM(theirs, data, H)
    equations = np.block([[H, J.T], [J, np.zeros((3, 3))]])
    wanted = np.linalg.solve(equations, np.append(-data.qfrc_bias, np.zeros(3)))[:n]
    run = falling(model, duration=0.3)
    np.testing.assert_allclose(run.acceleration[0], wanted, atol=1e-9 * np.abs(wanted).max())
    assert run.summary()["max_energy_residual"] < 1e-6
    assert np.abs(run.loops.errors).max() < 1e-12


TREE = """<mujoco><compiler angle="radian"/><worldbody><site name="mark" pos=".3 .2 .1" euler=".1 .2 .3"/>
<body name="a" pos=".1 .2 .3" euler=".1 0 .3"><joint name="J1" axis="0 -1 .2" ref=".3"/><geom size=".1"/>
 <body name="b" pos="0.2 0 .1"><joint name="J2" axis="1 -1 0" pos="0 .1 0"/><joint name="J3" type="slide" ref=".1"/>
  <geom size=".1"/><site name="s" pos=".1 0 .2" euler=".5 0 .2"/></body></body>
<body name="c" pos="0.5 0 0" euler="0 -1 0"><joint name="J4" axis="0 -1 0"/><geom size=".1" pos=".2 0 0"/>
 <body name="d" pos="0 .1 .2"><joint name="J5" axis="1 0 0" ref="-.2"/><geom size=".1"/></body></body>
<body name="m" mocap="true"/></worldbody>
<tendon><fixed name="t"><joint joint="J1" coef=".5"/><joint joint="J4" coef="-2"/></fixed>
<fixed name="u"><joint joint="J5" coef="3"/></fixed><fixed name="w"><joint joint="J2" coef="2"/></fixed></tendon>
<equality>{}</equality></mujoco>"""
EQUALITIES = {
    "connect": '<connect body1="b" body2="d" anchor=".1 .2 .3"/>',
    "connect to the world": '<connect body1="b" anchor=".1 .2 .3"/>',
    "connect from the world": '<connect body1="world" body2="d" anchor=".1 .2 .3"/>',
    "connect of sites": '<connect site1="s" site2="mark"/>',
    "weld": '<weld body1="b" body2="d" anchor=".1 .2 .3"/>',
    "weld with a pose": '<weld body1="b" body2="d" relpose=".1 .2 .3 .5 .5 -.5 .5"/>',
    "weld with a pose and an anchor": '<weld body1="d" body2="b" anchor=".3 0 .1" relpose=".1 .2 .3 .7 .5 -.5 .2"/>',
    "weld to the world": '<weld body1="d"/>',
    "weld from the world": '<weld body1="world" body2="d" relpose=".1 .2 .3 .5 .5 -.5 .5"/>',
    "weld of sites": '<weld site1="s" site2="mark"/>',
    "a polynomial of the fourth degree": '<joint joint1="J1" joint2="J5" polycoef=".1 .5 -.3 .2 .4"/>',
    "a joint that is held": '<joint joint1="J3" polycoef=".1 0 0 0 0"/>',
    "a tendon that is held": '<tendon tendon1="t" polycoef=".1 0 0 0 0"/>',
    "two tendons": '<tendon tendon1="u" tendon2="w" polycoef=".1 .7 0 0 0"/>',
}


@pytest.mark.parametrize("case", EQUALITIES)
def test_equalities_bind_what_they_bind_in_mujoco(tmp_path, case):
    """MuJoCo's rows and ours span the same forces, and both are open by the same, at any posture of a weld's place."""
    text = TREE.format(EQUALITIES[case])
    robot = Robot(from_mjcf_text(tmp_path, text))
    theirs = mujoco.MjModel.from_xml_string(text)
    data, (links, rows) = mujoco.MjData(theirs), loop_memory(robot)
    for q in np.random.default_rng(0).uniform(-1.0, 1.0, size=(3, 5)):
        data.qpos[:] = rows.q[:] = q
        mujoco.mj_forward(theirs, data)
        interpreted(locate_rows)(links, rows)
        their = data.efc_J.reshape(-1, 5)[: data.ne], data.efc_pos[: data.ne]
        assert len(their[1]) == links.m
        points = 0 if robot.model.loops[0].type == "gear" else 3
        assert abs(np.linalg.norm(their[1][:points]) - np.linalg.norm(rows.error[:points])) < 1e-12
        if not points:
            scale = np.linalg.norm(their[0]) / np.linalg.norm(rows.G)
            assert np.linalg.matrix_rank(np.vstack([their[0], rows.G]), tol=1e-12) == 1
            assert abs(abs(their[1][0]) - scale * abs(rows.error[0])) < 1e-12
        elif links.m > 3:  # MuJoCo's error is half the sine of half the angle, times the axis
            loop = robot.model.loops[0]
            first, second = (robot.frame_at(frame, q)[1] for frame in loop.frames)
            apart = second.T @ first @ np.array(loop.turn).T
            half = 0.5 * np.arccos(np.clip(0.5 * (np.trace(apart) - 1.0), -1.0, 1.0))
            assert abs(np.linalg.norm(their[1][3:]) - np.sin(half)) < 1e-7


def test_an_equality_to_a_mocap_body_is_left_out(tmp_path):
    """It is a means of moving a robot, and here a law moves it; one of a sidecar holds it there, as is said."""
    text = TREE.format('<weld name="hold" body1="m" body2="d"/>')
    model = from_mjcf_text(tmp_path, text)
    assert model.loops == ()
    assert any("'hold'" in line and "frames = [..., 'm']" in line for line in model.warnings)
    (tmp_path / "m.toml").write_text('[[closed_loop]]\ntype = "weld"\nframes = ["d", "m"]\n')
    held = Robot(from_mjcf_text(tmp_path, text))
    at_world = Robot(from_mjcf_text(tmp_path, TREE.format('<weld body1="d"/>').replace(' mocap="true"', "")))
    q = np.linspace(-0.4, 0.5, 5)[None]
    theirs = rows_of_loops(at_world, q, q)[0]
    assert np.linalg.matrix_rank(np.concatenate([rows_of_loops(held, q, q)[0], theirs], axis=1)[0]) == 2
    assert np.linalg.matrix_rank(theirs[0]) == 2


def from_mjcf_text(tmp_path, text):
    """The mechanism of an MJCF."""
    (tmp_path / "m.xml").write_text(text, encoding="utf-8")
    return robot_models.load(tmp_path / "m.xml")


BAD = {
    "no such type": ({"type": "rope"}, "'rope': it must be 'point' or"),
    "a type that is no text": ({"type": [1.0]}, "type is [1.0]: it must be 'point' or"),
    "no length": ({"type": "distance", "length": 1e-300}, "must be at least 1e-06 m; a point has none"),
    "no such frame": ({"frames": ["a", "bb"]}, "names no frame 'bb': did you mean 'b'?"),
    "itself": ({"frames": ["a", "a"]}, "binds 'a' to itself"),
    "no axis": ({"axis": [0, 0, 0]}, "has no direction"),
    "one number for an axis": ({"axis": 3}, "axis has 3: it must be three numbers"),
    "three points": ({"points": [[0, 0, 0]]}, "must be 2 vectors"),
    "not for it": ({"length": 2.0}, "length is not for type 'hinge'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_loop_is_refused_in_one_line(case):
    """What is wrong, at which loop, and what would be right."""
    changes, said = BAD[case]
    own = four_bar()
    table = loop("pin", "hinge", "ab", axis=[0, 1, 0]) | changes
    if table["type"] == "distance":
        del table["axis"]
    with pytest.raises(robot_models.ModelError) as told:
        robot_models.from_text(
            own.text, "urdf", name="x", armature=np.zeros(3), tip="a", home=own.home, locked={}, loops=[table]
        )
    assert said in str(told.value)
    assert "'pin'" in str(told.value)
    assert "\n" not in str(told.value)


def test_open_start_is_refused_or_assembled():
    """How far it is from closing, at which loop, and the nearest posture that closes."""
    changes = {"start.q": [1.8, -1.2, 1.6], "start.assemble": False, "time.duration": 0.01}
    with pytest.raises(cl.ScenarioError, match=r"the loops are open, by 0\.0\d+ m \(rad\) at 'pin'; the nearest"):
        cl.simulate(cl.load_scenario("four_bar", changes))
    run = cl.simulate(cl.load_scenario("four_bar", changes | {"start.assemble": True}))
    assert np.max(np.abs(run.loops.errors)) < 1e-14
    with pytest.raises(cl.ScenarioError, match="the loops would open"):
        cl.simulate(cl.load_scenario("four_bar", {"start.v": [1.0, 0.0, 0.0]}))


def test_points_that_lie_in_one_place_have_no_distance(recwarn):
    """A distance between them has no direction: it is said that it is open, and nothing warns of a division."""
    own = four_bar()
    table = {"name": "rope", "type": "distance", "frames": [own.frames[1], "world"], "length": 0.3}
    model = robot_models.from_text(
        own.text, "urdf", name="x", armature=np.zeros(3), tip="a", home=own.home, locked={}, loops=[table]
    )
    with pytest.raises(cl.ScenarioError, match=r"the loops are open, by 0\.3 m \(rad\) at 'rope'"):
        cl.simulate(free(model, 0.01), model=model)
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_loop_that_cannot_close_is_refused():
    """Rows that contradict each other, or links that are too short: what is left open."""
    own = four_bar()
    table = {"name": "rod", "type": "distance", "frames": ["a", "world"], "length": 5.0}
    model = robot_models.from_text(
        own.text, "urdf", name="x", armature=np.zeros(3), tip="a", home=own.home, locked={}, loops=[table]
    )
    with pytest.raises(cl.ScenarioError, match="no posture near it closes them"):
        cl.simulate(free(model, **{"start.assemble": True}), model=model)


@pytest.mark.parametrize("robot", ["five_bar", "stewart"])
def test_a_state_is_closed_with_its_velocity(robot):
    """The error is gone, and is what is returned; the velocity is along the loops; both moved as little as they can."""
    model = Robot(robot_models.load(robot))
    memory, rng = loop_memory(model), np.random.default_rng(3)
    q, v = model.model.home + 1e-4 * rng.normal(size=model.n), rng.normal(size=model.n)
    at, moving = q.copy(), v.copy()
    left = solve.closed_to(memory.address, at, moving)
    for each in (at, moving):
        each.flags.writeable = False  # as the columns of a run are: for other arrays it would be compiled anew
    rows, errors = (found[0] for found in rows_of_loops(model, at[None], moving[None]))
    assert np.max(np.abs(errors)) <= 1e-14
    assert left <= solve.TOLERANCE
    np.testing.assert_allclose(rows @ moving, 0.0, atol=1e-6)  # with the rows before the last step
    onto = np.linalg.pinv(rows, rcond=1e-9) @ rows
    np.testing.assert_allclose(onto @ (v - moving), v - moving, atol=2e-3)
    np.testing.assert_allclose(onto @ (q - at), q - at, atol=1e-6)


def test_rows_that_no_joint_can_move_are_found_beforehand():
    """Three of the five rows of a pin of a planar mechanism; none where the same joint closes a spatial one."""
    pin_of_five = bound_by_loops(Robot(robot_models.load("four_bar"))).sides[:5]
    assert list(pin_of_five) == [POSITION, POSITION, IDLE, IDLE, IDLE]
    assert IDLE not in bound_by_loops(Robot(robot_models.load("delta"))).sides[:18]


def test_a_row_that_no_joint_can_move_is_kept_where_it_is_open():
    """A pin whose sides lie in two planes is refused, with the distance."""
    model = robot_models.load("four_bar")
    (pin,) = model.loops
    points = (pin.points[0], tuple(np.array(pin.points[1]) + 0.01 * np.array(pin.axes[1])))
    apart = dataclasses.replace(model, loops=(dataclasses.replace(pin, points=points),))
    assert list(bound_by_loops(Robot(apart)).sides[:5]).count(IDLE) == 2
    with pytest.raises(cl.ScenarioError, match=r"no posture near it closes them: the remaining error is 0\.01"):
        closed_start(Robot(apart), np.array(model.home), np.zeros(3), True)


@pytest.mark.parametrize(("line", "said"), [
    ("closed_loop = 3", "closed_loop is 3: it must be one table a loop, each headed [[closed_loop]]"),
    ('drives = "J1"', "drives is 'J1': it must be the names of joints in [ ]"),
    ('drives = ["J1", "J1"]', "drives names 'J1' twice"),
    ('drives = ["J9"]', "drives names no joint 'J9'"),
    ('[[closed_loop]]\ntype = "hinge"\nframes = ["nowhere", "rocker"]\naxis = [0, 1, 0]', "no frame 'nowhere'"),
    ('[[closed_loop]]\nname = "a\\nb"\ntype = "hinge"', "it must be a text of one line"),
    ('[[closed_loop]]\ntype = "hinge"\naxis = [0, 0, 1]\naxes = 1.0', "axis and axes are both given"),
])  # fmt: skip
def test_slip_in_a_sidecar_is_named_in_one_line(tmp_path, line, said):
    """The key as it was given, and what it must be."""
    (tmp_path / "own.urdf").write_text(four_bar().text, encoding="utf-8")
    (tmp_path / "own.toml").write_text(line, encoding="utf-8")
    with pytest.raises(robot_models.ModelError) as told:
        robot_models.load(tmp_path / "own.urdf")
    assert said in str(told.value)
    assert "\n" not in str(told.value)
    assert str(told.value).startswith(str(tmp_path / "own.toml")), "the file at fault"


def test_a_closed_posture_at_a_limit_may_be_beyond_it_by_rounding():
    """As far as a start may be open: a file prints its limits and lengths with some digits."""
    model = four_bar()
    for beyond, refused in ((2e-6, False), (2e-3, True)):
        at_limit = dataclasses.replace(model, position_upper=np.array(model.home) - beyond)
        if refused:
            with pytest.raises(cl.ScenarioError, match="is outside its limits"):
                closed_start(Robot(at_limit), np.array(model.home), np.zeros(model.n), True)
        else:
            closed_start(Robot(at_limit), np.array(model.home), np.zeros(model.n), True)


def test_a_free_body_in_the_file_of_a_mechanism_is_beside_it(tmp_path):
    """The loop moves as without it; the order of the file's bodies does not matter."""
    ball = '<body name="ball" pos="3 3 3"><freejoint/><geom type="sphere" size="0.05" mass="2"/></body>'
    alone, runs = from_mjcf(tmp_path, CONNECT.format("")), []
    for at in ("<worldbody>", "</worldbody>"):
        text = MJCF.format(CONNECT.format("")).replace(at, at + ball if at == "<worldbody>" else ball + at)
        (tmp_path / "beside.xml").write_text(text, encoding="utf-8")
        runs.append(robot_models.load(tmp_path / "beside.xml"))
    changes = {"time.duration": 0.05, "surface.gap": 50.0, "start.q": None, "start.v": None, "start.assemble": True}
    moves = [cl.simulate(cl.load_scenario("planar2_drop", changes | NO_LAW), model=model) for model in (alone, *runs)]
    for run in moves[1:]:
        own = [run.model.coordinate_names.index(name) for name in alone.coordinate_names]
        np.testing.assert_allclose(run.q[:, own], moves[0].q, rtol=0, atol=1e-12)
        z = run.q[:, run.model.coordinate_names.index("ball_z")]
        np.testing.assert_allclose(z, 3.0 - 0.5 * 9.81 * run.time**2, atol=1e-12)
