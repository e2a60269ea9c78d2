"""The desired motion: on the line, least in joint motion, and refused where the arm cannot follow."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rounding import within
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

import closedloop as cl
from closedloop.control.reference.desired import follow
from closedloop.control.reference.inverse_kinematics import JointPath
from closedloop.control.reference.paths.line import Line
from robot_models.planar2 import closed_form

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


def test_tip_follows_the_line_at_any_instant(line):
    """At random instants the tip of the path is on the straight line, at its place, to a nanometre."""
    arm, q, direction, speed, path = line
    instants = np.random.default_rng(0).uniform(0.0, STOP + 1.5, 300)
    q_des, *_ = path.sample(instants)
    travel = speed * (np.clip(instants, START, STOP) - START)
    for t_q, s in zip(q_des, travel, strict=True):
        assert np.max(np.abs(arm.position(t_q) - arm.position(q) - s * direction)) < 1e-9


def test_fast_motion_has_as_many_knots_as_it_needs(robot):
    """A tip at 1 m/s follows the line to a nanometre too, which a knot every 25 ms could not."""
    arm = robot("planar2")
    q, direction = np.array(arm.model.home), np.array([1.0, 0.0, 0.0])
    path = follow_line(arm, q, direction, -1.0, START, START + 0.2)
    assert path.times.size > 20
    instants = np.random.default_rng(2).uniform(START, START + 0.2, 300)
    for t, q_des in zip(instants, path.sample(instants)[0], strict=True):
        assert np.max(np.abs(arm.position(q_des) - arm.position(q) + (t - START) * direction)) < 1e-9


def test_desired_velocity_is_the_derivative_of_the_desired_position(line):
    """q̇_des is the derivative of q_des, at random instants within and at rest outside.

    Central differences over 2e-4 s of a cubic: truncation h²/6 of a third derivative below 1 rad/s³.
    """
    *_, path = line
    h = 1e-4
    instants = np.random.default_rng(1).uniform(START + h, STOP - h, 300)
    ahead, *_ = path.sample(instants + h)
    back, *_ = path.sample(instants - h)
    _, v_des, _ = path.sample(instants)
    assert np.max(np.abs((ahead - back) / (2 * h) - v_des)) < 1e-8
    assert np.max(np.abs(v_des)) > 1e-3
    outside = np.array([0.0, START - 1e-6, STOP, STOP + 1.0])
    assert np.all(path.sample(outside)[1] == 0.0)


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


def test_knots_take_the_least_joint_motion(line):
    """At every knot q̇ moves the tip as told, and has no part in the null space of Jᵣ."""
    arm, _, direction, speed, path = line
    for q, v in zip(path.q, path.v, strict=True):
        J = arm.terms(q, np.zeros(arm.n)).jacobian
        assert np.max(np.abs(J @ v - speed * direction)) < 1e-12
        idle = null_space(J, rcond=1e-6)
        assert np.max(np.abs(idle.T @ v), initial=0.0) < 1e-12
    if arm.n > 3:
        assert idle.shape[1] == arm.n - 3


def test_path_is_the_solution_of_least_joint_motion(line):
    """The whole path is the solution of q̇ = Jᵣ⁺ṙ_des, not only each knot's velocity: compared with DOP853."""
    arm, q, direction, speed, path = line

    def velocity(t, x):
        return np.linalg.pinv(arm.terms(x, np.zeros(arm.n)).jacobian, rcond=1e-6) @ (speed * direction)

    exact = solve_ivp(velocity, (START, STOP), q, method="DOP853", rtol=1e-11, atol=1e-12)
    assert np.max(np.abs(path.q[-1] - exact.y[:, -1])) < 1e-8


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


@pytest.mark.parametrize("speed", [0.02, 0.05, 0.3])
def test_leaving_the_workspace_is_refused_with_its_first_instant(speed):
    """A line out of the workspace is refused from the instant at which it is as far as both links reach.

    1e-3 s: the message has four decimals, and so near the stretched arm Newton's last micrometres are slow.
    """
    x, _, z = closed_form.terms([0.6, -1.4], [0, 0]).position
    reach = sum(closed_form.LENGTH)
    instant = START + (np.sqrt(reach**2 - z**2) - x) / speed
    message, named = refusal(speed=speed, stop=60.5)
    assert named == pytest.approx(instant, abs=1e-3)
    assert "workspace" in message
    assert "reference.stop" in message


def test_leaving_the_joint_limits_is_refused_with_the_joint_and_the_instant():
    """A line towards the base is refused from the instant at which the elbow is at its limit of 3 rad, by name."""
    x, _, z = closed_form.terms([0.6, -1.4], [0, 0]).position
    l1, l2 = closed_form.LENGTH
    nearest = l1**2 + l2**2 + 2 * l1 * l2 * np.cos(3.0)
    instant = START + (x - np.sqrt(nearest - z**2)) / 0.05
    message, named = refusal(speed=-0.05, stop=60.5)
    assert named == pytest.approx(instant, abs=1e-3)
    assert "J2" in message
    assert "[-3, 3]" in message


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


@pytest.mark.slow
def test_a_motion_of_any_length_is_prepared_or_refused_soon():
    """A path that lasts hours or ages is prepared or refused within seconds: it must not run out of time or memory.

    In a process of its own, which can be given up; the run itself lasts 10 ms.
    """
    code = (
        "import closedloop as cl\n"
        "for stop in (1e4, 1e6, 1e10, 1e300):\n"
        "    try:\n"
        "        changes = {'reference.stop': stop, 'reference.speed': 0.1 / stop, 'time.duration': 0.01}\n"
        "        cl.prepare(cl.load_scenario('wam_slide', changes))\n"
        "        print('prepared')\n"
        "    except cl.ScenarioError as error:\n"
        "        print(error)\n"
    )
    root = Path(cl.__file__).parent.parent
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr[-300:]
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert all(line == "prepared" or "reference" in line for line in lines)


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
