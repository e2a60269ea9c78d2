"""The joints' path along any path of the tip: on it between knots, least in joint motion, refused where unreachable."""

import itertools
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import null_space
from scipy.optimize import brentq

import closedloop as cl
from closedloop.control.reference.desired import follow
from closedloop.control.reference.inverse_kinematics import KNOT_TOLERANCE, PATH_TOLERANCE
from closedloop.control.reference.path import tip_path
from closedloop.control.reference.paths.circle import Circle
from closedloop.control.reference.paths.figure_eight import FigureEight
from closedloop.control.reference.paths.line import Line
from closedloop.control.reference.paths.raster import Raster
from closedloop.control.reference.paths.waypoints import Waypoints
from closedloop.control.reference.tip_path import minimum_jerk
from robot_models.model import AT_LIMIT
from robot_models.planar2 import closed_form

UP = np.array([0.0, 0.0, 1.0])
TILTED = np.array([-0.6, 0.0, 0.8])
START, STOP = 0.5, 7.5  # s
ASIDE = {"direction": (0.0, 1.0, 0.0), "start": START, "stop": STOP}  # in both surfaces

PATHS = {
    "line": Line(speed=0.015, timing="minimum_jerk", **ASIDE),
    "circle": Circle(radius=0.03, **ASIDE),
    "eight": FigureEight(width=0.08, height=0.04, **ASIDE),
    "raster": Raster(length=0.04, pitch=0.01, passes=2, **ASIDE),
    "waypoints": Waypoints(
        times=(0.5, 2.0, 3.0, 7.5), points=((0, 0, 0), (0, 0, -0.02), (0, 0, -0.02), (0.02, 0.03, 0.02))
    ),
    "linear": Waypoints(
        times=(0.5, 2.0, 3.0, 7.5),
        points=((0, 0, 0), (0, 0, -0.02), (0, 0, -0.02), (0.02, 0.03, 0.02)),
        timing="linear",
    ),
}
IN_ITS_PLANE = {
    "line": Line(direction=(1.0, 0.0, 0.0), speed=-0.015, start=START, stop=STOP, timing="minimum_jerk"),
    "waypoints": Waypoints(times=(0.5, 2.0, 7.5), points=((0, 0, 0), (0, 0, -0.02), (-0.05, 0, 0.05))),
}  # fmt: skip
CASES = [(arm, name) for arm in ("wam4", "panda", "ur5") for name in PATHS] + [
    ("planar2", name) for name in IN_ITS_PLANE
]
WAM_START = np.array([1.5707963267948966, 1.0, 0.0, 2.0])


def follow_section(arm, q, section, normal=UP):
    """Return the tip's path of a section from q, and the joints' along it."""
    path = tip_path(section, arm.position(q), normal)
    return path, follow(arm, q, path)


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def followed(request, robot):
    """Return (arm, tip's path, joints' path) of a path that the arm can follow."""
    name, shape = request.param
    arm = robot(name)
    section = IN_ITS_PLANE[shape] if name == "planar2" else PATHS[shape]
    q = WAM_START if name == "wam4" else np.array(arm.model.home)
    return arm, *follow_section(arm, q, section, TILTED if name == "panda" else UP)


def test_tip_is_on_the_path_between_knots(followed):
    """At random instants the tip of the interpolated path is where it shall be, to the stated tolerance.

    Three percent more than the tolerance is allowed for: it is checked midway between knots, and the error of a cubic
    is largest a little aside when its fifth derivative is not zero.
    """
    arm, path, joints = followed
    t = np.random.default_rng(0).uniform(0.0, STOP + 0.5, 300)
    reached = np.array([arm.position(q) for q in joints.sample(t)[0]])
    assert np.max(np.abs(reached - path.sample(t)[0])) < 1.03 * PATH_TOLERANCE


def test_tip_is_on_the_path_at_the_knots_to_rounding(followed):
    """At every knot the tip, by Pinocchio, is where the kernel has put it by its own terms: to 1e-12 m."""
    arm, path, joints = followed
    reached = np.array([arm.position(q) for q in joints.q])
    assert np.max(np.abs(reached - path.sample(joints.times)[0])) < 1e-12 < KNOT_TOLERANCE


def test_path_between_knots_is_the_cubic_of_hermite(followed):
    """At times in any order q_des, q̇_des and q̈_des are those of scipy's spline; at rest before and after."""
    _, _, joints = followed
    if np.any(np.diff(joints.times) == 0.0):
        pytest.skip("a knot that is there twice is none of scipy's")
    spline = CubicHermiteSpline(joints.times, joints.q, joints.v)
    t = np.random.default_rng(4).uniform(START + 1e-6, STOP - 1e-6, 200)
    found = joints.sample(t)
    spacing = np.min(np.diff(joints.times))
    for order, x in enumerate(found):
        assert np.max(np.abs(x - spline(t, order))) < 1e-13 / spacing**order * 10**order
    outside = joints.sample(np.array([STOP + 1.0, START - 1.0]))
    assert np.array_equal(outside[0], joints.q[[-1, 0]])
    assert not np.any(outside[1:])


def test_joint_velocity_and_acceleration_are_the_derivatives(followed):
    """q̇_des is the derivative of q_des and q̈_des of q̇_des, away from knots; central differences over 2e-6 s.

    Rounding: 1e-16 · π / 1e-6 for q̇_des, and the spline's (3 · 1e-16)/h² of knots 1.5 ms apart for q̈_des.
    """
    _, _, joints = followed
    h = 1e-6
    t = np.random.default_rng(1).uniform(0.0, STOP + 0.5, 300)
    t = t[np.min(np.abs(t[:, None] - joints.times), axis=1) > 2 * h]
    (q0, v0, _), (_, v, a), (q1, v1, _) = joints.sample(t - h), joints.sample(t), joints.sample(t + h)
    assert np.max(np.abs((q1 - q0) / (2 * h) - v)) < 2e-9
    assert np.max(np.abs((v1 - v0) / (2 * h) - a)) < 1e-6
    assert np.max(np.abs(v)) > 1e-3


def test_joint_motion_gives_the_tip_its_velocity_and_acceleration(followed):
    """Jᵣq̇_des is the tip's velocity and Jᵣq̈_des + J̇ᵣq̇_des its acceleration, as closely as a cubic between knots
    gives.

    A cubic that is off by 1e-10 m has a slope off by some 1e-10/h and a second derivative by 1e-10 · 40/h², h the
    spacing of knots.
    """
    arm, path, joints = followed
    spacing = np.diff(joints.times)
    t = np.random.default_rng(2).uniform(START, STOP, 100)
    h = spacing[np.clip(np.searchsorted(joints.times, t, side="right") - 1, 0, spacing.size - 1)]
    (q, v, a), (_, velocity, acceleration) = joints.sample(t), path.sample(t)
    for k in range(t.size):
        terms = arm.terms(q[k], v[k])
        assert np.max(np.abs(terms.jacobian @ v[k] - velocity[k])) < 10 * PATH_TOLERANCE / h[k]
        missing = terms.jacobian @ a[k] + terms.drift - acceleration[k]
        assert np.max(np.abs(missing)) < 100 * PATH_TOLERANCE / h[k] ** 2


def test_knots_take_the_least_joint_motion(followed):
    """At every knot q̇ has no part in the null space of Jᵣ: nothing moves that need not."""
    arm, _, joints = followed
    for q, v in zip(joints.q[::7], joints.v[::7], strict=True):
        idle = null_space(arm.terms(q, np.zeros(arm.n)).jacobian, rcond=1e-6)
        assert np.max(np.abs(idle.T @ v), initial=0.0) < 1e-12


def test_knots_are_there_twice_only_where_the_velocity_jumps(followed):
    """Knots increase; only at a linear waypoint is one there twice, with the velocity before and after."""
    _, path, joints = followed
    twice = np.flatnonzero(np.diff(joints.times) == 0.0)
    assert np.all(np.diff(joints.times) >= 0.0)
    jumps = {
        b.start
        for a, b in itertools.pairwise(path.segments)
        if np.max(np.abs(a.sample(np.array([a.stop]))[1] - b.sample(np.array([b.start]))[1])) > 0.0
    }
    assert set(joints.times[twice]) == jumps
    for k in twice:
        assert np.array_equal(joints.q[k], joints.q[k + 1])
        assert np.any(joints.v[k] != joints.v[k + 1])
        assert np.allclose(joints.sample(joints.times[k : k + 1])[1][0], joints.v[k + 1], rtol=1e-15, atol=1e-18)


@pytest.mark.parametrize("name", ["circle", "linear"])
def test_path_is_the_solution_of_least_joint_motion(name, robot):
    """The whole path is the solution of q̇ = Jᵣ⁺ṙ_des, segment by segment: compared with DOP853."""
    arm = robot("wam4")
    path, joints = follow_section(arm, WAM_START, PATHS[name])
    q = WAM_START
    for segment in path.segments:

        def velocity(t, x, segment=segment):
            J = arm.terms(x, np.zeros(arm.n)).jacobian
            return np.linalg.pinv(J, rcond=1e-6) @ segment.sample(np.array([t]))[1][0]

        q = solve_ivp(velocity, (segment.start, segment.stop), q, method="DOP853", rtol=1e-10, atol=1e-11).y[:, -1]
    assert np.max(np.abs(joints.q[-1] - q)) < 1e-8


def test_a_path_and_its_mirror_image_are_followed_alike(robot):
    """An arm in its plane of symmetry follows a circle to the left as the mirror image of one to the right."""
    arm = robot("wam4")
    mirror = np.array([-1.0, 1.0, -1.0, 1.0])
    home = np.array([0.0, 1.0, 0.0, 2.0])
    paths = []
    for turns in (1.0, -1.0):
        section = Circle(direction=(1.0, 0.0, 0.0), radius=0.03, turns=turns, start=START, stop=STOP)
        paths.append(follow_section(arm, home, section)[1])
    t = np.linspace(0.0, 8.0, 200)
    assert np.max(np.abs(paths[0].sample(t)[0] - mirror * paths[1].sample(t)[0])) < 1e-12


def test_same_path_twice_is_the_same_to_the_last_bit(robot):
    """Nothing in the path depends on what was computed before."""
    arm = robot("panda")
    q = np.array(arm.model.home)
    first = follow_section(arm, q, PATHS["eight"])[1]
    arm.position(q + 0.3)
    second = follow_section(arm, q, PATHS["eight"])[1]
    assert np.array_equal(first.q, second.q)
    assert np.array_equal(first.v, second.v)


def refusal(arm, section, q=None):
    """Return the message with which an arm refuses a path, and the instant that it names."""
    q = np.array(arm.model.home) if q is None else q
    with pytest.raises(cl.ScenarioError, match="unreachable") as caught:
        follow_section(arm, q, section)
    message = str(caught.value)
    assert "\n" not in message
    return message, float(re.search(r"t = ([0-9.]+) s", message).group(1))


def test_circle_of_a_planar_arm_is_refused_as_unreachable(robot):
    """An arm that moves in one plane cannot go round in another; the refusal says which way it cannot move."""
    section = Circle(direction=(1.0, 0.0, 0.0), radius=0.03, start=START, stop=STOP)
    message, named = refusal(robot("planar2"), section)
    assert START <= named < START + 0.1  # where the path has left the plane by 1e-11 m
    assert "no joint moves the tip along [0.0, 1.0, 0.0]" in message
    assert "reference.radius" in message


def instant_of(place, length, duration):
    """Return when a least-jerk motion of this length has come this far, s after its start."""
    return brentq(lambda t: length / duration * minimum_jerk(np.array([t]), duration)[0][0] - place, 0.0, duration)


def test_leaving_the_workspace_is_refused_with_its_first_instant(robot):
    """A least-jerk line out of the workspace is refused from the instant at which both links are stretched.

    1e-3 s, as for the constant speed: so near the stretched arm Newton's last micrometres are slow.
    """
    x, _, z = closed_form.terms([0.6, -1.4], [0, 0]).position
    reach = sum(closed_form.LENGTH)
    section = Line(direction=(1.0, 0.0, 0.0), speed=0.2, start=START, stop=STOP, timing="minimum_jerk")
    instant = START + instant_of(np.sqrt(reach**2 - z**2) - x, 0.2 * (STOP - START), STOP - START)
    message, named = refusal(robot("planar2"), section)
    assert named == pytest.approx(instant, abs=1e-3)
    assert "workspace" in message
    assert "no joint" not in message


def test_a_path_from_a_rounding_beyond_a_limit_is_followed(robot):
    """A joint that starts beyond its limit by less than the tolerance of all limits may move inwards from there."""
    arm, section = (
        robot("planar2"),
        Line(direction=(1.0, 0.0, 0.0), speed=0.01, start=START, stop=STOP, timing="minimum_jerk"),
    )
    follow_section(arm, np.array([0.6, -3.0 - 0.5 * AT_LIMIT]), section)
    assert "joint J2 would leave its limits [-3, 3]" in refusal(arm, section, np.array([0.6, -3.0 - 5 * AT_LIMIT]))[0]


def test_leaving_the_limits_is_refused_with_the_joint_and_the_instant_of_the_waypoint(robot):
    """In the third segment of a path towards the base the elbow meets its limit of 3 rad: by name, at its instant."""
    x, _, z = closed_form.terms([0.6, -1.4], [0, 0]).position
    l1, l2 = closed_form.LENGTH
    nearest = l1**2 + l2**2 + 2 * l1 * l2 * np.cos(3.0)
    way = x - np.sqrt(nearest - z**2)
    section = Waypoints(
        times=(0.5, 1.0, 2.0, 6.0), points=((0, 0, 0), (0.02, 0, 0), (0, 0, 0), (-1.25 * way, 0, 0)), timing="linear"
    )
    message, named = refusal(robot("planar2"), section)
    assert named == pytest.approx(2.0 + 4.0 / 1.25, abs=1e-3)
    assert "J2" in message
    assert "[-3, 3]" in message
    assert "reference.points" in message


@pytest.mark.parametrize(
    "section",
    [
        Circle(direction=(0, 1, 0), radius=0.02, turns=1e6, stop=4.0),
        Circle(direction=(0, 1, 0), radius=0.02, stop=0.5 + 1e-14),
        Line(direction=(0, 1, 0), speed=1e-309, stop=1.7e308, timing="minimum_jerk"),
        Line(direction=(0, 1, 0), speed=1e4, stop=1.7e308),
        FigureEight(direction=(0, 1, 0), width=1e6, height=1e-9, stop=1.0),
        Raster(direction=(0, 1, 0), length=1e-9, pitch=1e-9, passes=2, stop=1.0),
        Waypoints(times=(0.0, 5e-324), points=((0, 0, 0), (1e6, 0, 0))),
    ],
    ids=lambda section: section.kind,
)
def test_extreme_paths_are_followed_or_refused(section, robot, capfd):
    """What the bounds allow is followed or refused in one line: no warning, all finite, no word of LAPACK's."""
    arm, refused, values = robot("wam4"), "reference: ", (np.zeros(1),)
    try:
        values = follow_section(arm, WAM_START, section)[1].sample(np.array([0.0, 0.5, 1.0, 1e3]))
    except cl.ScenarioError as error:
        refused = str(error)
    assert all(np.all(np.isfinite(x)) for x in values)
    assert refused.startswith("reference: ")
    assert "\n" not in refused
    assert capfd.readouterr() == ("", "")
