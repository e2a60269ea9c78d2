"""The desired motion: on the line, least in joint motion, and refused where the arm cannot follow."""

import re

import numpy as np
import pytest
from rounding import within
from scipy.linalg import null_space

import closedloop as cl
from closedloop.control.reference.desired import follow
from closedloop.control.reference.inverse_kinematics import JointPath
from closedloop.control.reference.paths.line import Line

START, STOP = 0.5, 6.5  # s

# robot, start (home if None), direction, speed
LINES = {
    "wam4": ([0.0, 1.0, 0.0], 0.018),
    "wam4 aslant": ([0.6, 0.0, 0.8], -0.02),
    "panda": ([0.0, 1.0, 0.0], 0.02),
    "planar2": ([1.0, 0.0, 0.0], -0.02),
}


def follow_line(arm, q, direction, speed, start, stop):
    """Return the joint path of a straight line at constant speed, on any surface that the direction lies in."""
    section = Line(direction=tuple(direction), speed=speed, start=start, stop=stop)
    normal = null_space(direction[None, :])[:, 0]
    return follow(arm, q, section.tip_path(arm.position(q), normal))


@pytest.fixture(scope="module", params=LINES)
def line(request, robot):
    """Return (arm, start, direction, speed, path) of a line that the arm can follow."""
    arm = robot(request.param.split()[0])
    direction, speed = LINES[request.param]
    q = np.array(arm.model.home)
    return arm, q, np.array(direction), speed, follow_line(arm, q, np.array(direction), speed, START, STOP)


def test_fast_motion_has_as_many_knots_as_it_needs(robot):
    """A tip at 1 m/s follows the line to a nanometre too, which a knot every 25 ms could not."""
    arm = robot("planar2")
    q, direction = np.array(arm.model.home), np.array([1.0, 0.0, 0.0])
    path = follow_line(arm, q, direction, -1.0, START, START + 0.2)
    assert path.times.size > 20
    instants = np.random.default_rng(2).uniform(START, START + 0.2, 300)
    for t, q_des in zip(instants, path.sample(instants)[0], strict=True):
        assert np.max(np.abs(arm.position(q_des) - arm.position(q) + (t - START) * direction)) < 1e-9


def test_velocity_begins_and_ends_with_a_step(line):
    """At the start instant the velocity is that of the motion; at the stop it is zero, and the place is the last."""
    *_, path = line
    q_des, v_des, _ = path.sample(np.array([START, STOP]))
    assert within(16, v_des[0], path.v[0])
    assert np.array_equal(q_des[0], path.q[0])
    assert np.all(v_des[1] == 0.0)
    assert np.array_equal(q_des[1], path.q[-1])


def test_instants_that_rounding_moved_count_as_the_instant_itself(line):
    """A sample of i·h that rounding put an ulp before the start already moves, and one before the stop stands."""
    *_, path = line
    _, v_des, _ = path.sample(np.array([np.nextafter(START, 0), np.nextafter(STOP, 0)]))
    assert np.any(v_des[0] != 0.0)
    assert np.all(v_des[1] == 0.0)


def test_hold_stays():
    """The path of `hold` is one place, at rest, for ever."""
    path = JointPath.hold(np.array([0.1, 0.2]))
    q_des, v_des, _ = path.sample(np.array([0.0, 1.0, 1e6]))
    assert np.array_equal(q_des, np.tile([0.1, 0.2], (3, 1)))
    assert np.all(v_des == 0.0)


def refusal(**reference):
    """Return the message with which planar2 refuses a line along x, and the instant that it names."""
    changes = {f"reference.{key}": value for key, value in reference.items()}
    with pytest.raises(cl.ScenarioError, match="unreachable") as caught:
        cl.prepare(cl.load_scenario("planar2_slide", changes | {"time.duration": 0.1}))
    message = str(caught.value)
    assert "\n" not in message
    return message, float(re.search(r"t = ([0-9.]+) s", message).group(1))


def test_a_path_that_only_just_stays_inside_is_accepted():
    """The same line that is refused a little further out is followed when it stops a little before."""
    _, named = refusal(speed=0.05, stop=60.5)
    cl.prepare(cl.load_scenario("planar2_slide", {"reference.speed": 0.05, "reference.stop": named - 0.05}))


def test_a_direction_that_the_arm_cannot_move_in_is_refused():
    """planar2 cannot leave its plane: a line along y is refused at once."""
    message, named = refusal(direction=[0, 1, 0])
    assert named == pytest.approx(START, abs=1e-3)
    assert "cannot get there" in message
    assert "no joint moves the tip along [0.0, 1.0, 0.0]" in message


def test_direction_is_a_direction_whatever_its_length():
    """A direction of any length but zero, huge and tiny included, means the same path."""
    paths = [
        cl.prepare(cl.load_scenario("planar2_slide", {"reference.direction": [x, 0, 0], "time.duration": 1.0})).path
        for x in (1.0, 4.0, 1e200, 1e-200)
    ]
    assert all(np.array_equal(path, paths[0]) for path in paths[1:])


def test_speed_and_direction_change_sign_together():
    """Backwards along -x is forwards along x."""
    ahead, back = (
        cl.prepare(
            cl.load_scenario("planar2_slide", {"reference.direction": [x, 0, 0], "reference.speed": -0.02 * x})
        ).path
        for x in (1, -1)
    )
    assert np.array_equal(ahead, back)


def test_reference_does_not_depend_on_the_step():
    """The desired motion is a function of time: the same at the same instants for any step and integrator."""
    coarse = cl.simulate(cl.load_scenario("wam_slide", {"time.step": 0.001, "time.duration": 2.0}))
    fine = cl.simulate(
        cl.load_scenario("wam_slide", {"time.step": 0.0005, "time.duration": 2.0, "time.integrator": "rk4"})
    )
    for column in ("reference_position", "reference_velocity"):
        assert within(64, getattr(fine, column)[::2], getattr(coarse, column))
