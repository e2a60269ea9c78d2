"""The tip's paths in closed form: their shapes, their timing, their derivatives."""

import numpy as np
import pytest
from rounding import within
from scipy.integrate import quad

import closedloop as cl
from closedloop.control.reference.path import tip_path
from closedloop.control.reference.paths.circle import Circle
from closedloop.control.reference.paths.figure_eight import FigureEight
from closedloop.control.reference.paths.hold import Hold
from closedloop.control.reference.paths.line import Line
from closedloop.control.reference.paths.raster import Raster
from closedloop.control.reference.paths.waypoints import Waypoints
from closedloop.control.reference.tip_path import minimum_jerk

ORIGIN = np.array([0.4, -0.1, 0.25])
NORMAL = np.array([2.0, -1.0, 2.0]) / 3.0
ALONG = np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)  # in the surface
ACROSS = np.cross(NORMAL, ALONG)
BETWEEN = {"direction": tuple(ALONG), "start": 0.5, "stop": 6.5}
POINTS = ((0.0, 0.0, 0.0), (0.01, 0.0, -0.03), (0.01, 0.0, -0.03), (0.05, -0.02, 0.04))

SECTIONS = {
    "line": Line(speed=-0.02, timing="minimum_jerk", **BETWEEN),
    "line, constant": Line(speed=-0.02, **BETWEEN),
    "circle": Circle(radius=0.04, **BETWEEN),
    "circle, clockwise": Circle(radius=0.04, turns=-2.25, **BETWEEN),
    "eight": FigureEight(width=0.1, height=0.06, **BETWEEN),
    "raster": Raster(length=0.05, pitch=-0.01, passes=4, **BETWEEN),
    "waypoints": Waypoints(times=(0.5, 1.5, 2.0, 6.5), points=POINTS),
    "waypoints, linear": Waypoints(times=(0.5, 1.5, 2.0, 6.5), points=POINTS, timing="linear"),
}
SMOOTH = [name for name in SECTIONS if name not in ("line, constant", "waypoints, linear")]
IN_SURFACE = [name for name in SECTIONS if not name.startswith("waypoints")]
START, STOP = 0.5, 6.5  # s


def path_of(name):
    """Return the path of one of the sections above."""
    return tip_path(SECTIONS[name], ORIGIN, NORMAL)


def plane_coordinates(r):
    """Return the displacement from the origin along, across and out of the surface, each (N,)."""
    return ((r - ORIGIN) @ np.array([ALONG, ACROSS, NORMAL]).T).T


@pytest.mark.parametrize("name", SECTIONS)
def test_velocity_and_acceleration_are_the_derivatives(name):
    """ṙ and r̈ are the derivatives of r and ṙ, at random instants away from the jumps.

    Central differences over 2e-5 s: truncation below h²/6 · 500 m/s⁴ (in the raster's steps), rounding below 1e-16/h.
    """
    path, h = path_of(name), 1e-5
    ends = np.array([path.start, *(segment.stop for segment in path.segments)])
    t = np.random.default_rng(0).uniform(0.0, STOP + 0.5, 400)
    t = t[np.min(np.abs(t[:, None] - ends), axis=1) > h]
    (r0, v0, _), (_, v, a), (r1, v1, _) = path.sample(t - h), path.sample(t), path.sample(t + h)
    assert np.max(np.abs((r1 - r0) / (2 * h) - v)) < 1e-8
    assert np.max(np.abs((v1 - v0) / (2 * h) - a)) < 1e-8
    assert np.max(np.abs(v)) > 1e-3


@pytest.mark.parametrize("name", SMOOTH)
def test_least_jerk_motion_is_at_rest_at_both_ends_of_every_segment(name):
    """Velocity and acceleration are zero at the ends of each segment, from both sides: the path is C2."""
    path = path_of(name)
    for segment in path.segments:
        _, v, a = segment.sample(np.array([segment.start, segment.stop]))
        assert np.max(np.abs(v)) == 0.0
        assert np.max(np.abs(a)) == 0.0
    ends = np.array([segment.stop for segment in path.segments])
    for side in (-1e-6, 0.0, 1e-6):
        _, v, a = path.sample(ends + side)
        assert np.max(np.abs(v)) < 1e-9
        assert np.max(np.abs(a)) < 1e-4  # the jerk at an end is below 60 L/T³ = 30 m/s³


@pytest.mark.parametrize("name", SECTIONS)
def test_segments_join(name):
    """Each segment begins when and where the one before ends; before and after them all the tip is at rest."""
    path = path_of(name)
    where, when = ORIGIN, START
    for segment in path.segments:
        r, _, _ = segment.sample(np.array([segment.start, segment.stop]))
        assert segment.start == when
        assert within(16, r[0], where)
        where, when = r[1], segment.stop
    assert when == STOP
    r, v, a = path.sample(np.array([0.0, START - 1e-6, STOP, STOP + 1e-6, 1e6]))
    assert within(16, r, [ORIGIN, ORIGIN, where, where, where])
    assert np.all(v == 0.0)
    assert np.all(a == 0.0)


@pytest.mark.parametrize("name", IN_SURFACE)
def test_path_stays_in_the_tangent_plane(name):
    """Circles, eights, rasters and lines lie in the surface through the tip's start."""
    r, v, a = path_of(name).sample(np.linspace(0.0, STOP + 1.0, 500))
    assert np.max(np.abs((r - ORIGIN) @ NORMAL)) < 1e-16
    assert np.max(np.abs(v @ NORMAL)) < 1e-16
    assert np.max(np.abs(a @ NORMAL)) < 1e-15


@pytest.mark.parametrize(
    ("name", "length"),
    [
        ("line", 0.02 * 6.0),
        ("line, constant", 0.02 * 6.0),
        ("circle", 2 * np.pi * 0.04),
        ("circle, clockwise", 2.25 * 2 * np.pi * 0.04),
        ("eight", 4 * quad(lambda x: np.hypot(0.05 * np.cos(x), 0.06 * np.cos(2 * x)), 0.0, np.pi / 2)[0]),
        ("raster", 4 * 0.05 + 3 * 0.01),
        ("waypoints", np.hypot(0.01, 0.03) + np.linalg.norm([0.04, 0.02, 0.07])),
        ("waypoints, linear", np.hypot(0.01, 0.03) + np.linalg.norm([0.04, 0.02, 0.07])),
    ],
)
def test_length_is_that_of_the_shape(name, length):
    """The length agrees with the shape's closed form and with the integral of the tip's speed."""
    path = path_of(name)
    assert path.length == pytest.approx(length, rel=1e-12)
    total = 0.0
    for segment in path.segments:
        nodes, weights = np.polynomial.legendre.leggauss(200)
        half = 0.5 * (segment.stop - segment.start)
        _, v, _ = segment.sample(segment.start + half * (nodes + 1.0))
        total += half * float(weights @ np.linalg.norm(v, axis=1))
    assert total == pytest.approx(length, rel=1e-9)


@pytest.mark.parametrize("name", ["line", "circle", "circle, clockwise"])
def test_peak_speed_is_fifteen_eighths_of_the_mean(name):
    """With least jerk the tip is fastest in the middle: 1.875 L/T; on a line the acceleration peaks at 10/√3 L/T²."""
    path = path_of(name)
    mean = path.length / (STOP - START)
    _, v, a = path.sample(np.linspace(START, STOP, 6001))
    speed = np.linalg.norm(v, axis=1)
    assert np.argmax(speed) == 3000
    assert np.max(speed) == pytest.approx(1.875 * mean, rel=1e-12)
    if name == "line":
        highest = 10.0 / np.sqrt(3.0) * mean / (STOP - START)
        assert np.max(np.linalg.norm(a, axis=1)) == pytest.approx(highest, rel=1e-6)


def test_jerk_is_the_least():
    """The squared jerk of a unit motion in unit time is 720, and any change that keeps its ends makes it larger.

    720 is the closed form of ∫(60 − 360 τ + 360 τ²)² dτ. Changes are x³(1 − x)³ times a polynomial.
    """

    def squared_jerk(place):
        return (place.deriv(3) ** 2).integ()(1.0) - (place.deriv(3) ** 2).integ()(0.0)

    t = np.linspace(0.0, 1.0, 8)
    least = np.polynomial.Polynomial.fit(t, minimum_jerk(t, 1.0)[0], 5).convert()
    assert squared_jerk(least) == pytest.approx(720.0, rel=1e-9)
    x = np.polynomial.Polynomial([0.0, 1.0])
    for change in (x**3 * (1 - x) ** 3, x**4 * (1 - x) ** 3, x**3 * (1 - x) ** 3 * (1 - 2 * x)):
        for size in (-1.0, 1.0):
            assert squared_jerk(least + size * change) > 720.0 + 0.1


def test_constant_and_least_jerk_lines_end_at_the_same_place():
    """Either timing covers speed · (stop − start), backwards for a negative speed."""
    ends = [path_of(name).sample(np.array([STOP]))[0][0] for name in ("line", "line, constant")]
    assert within(16, ends[0], ends[1])
    assert within(16, ends[0], ORIGIN - 0.12 * ALONG)


@pytest.mark.parametrize(("name", "turns"), [("circle", 1.0), ("circle, clockwise", -2.25)])
def test_circle_goes_round_its_centre(name, turns):
    """The tip keeps its distance from the centre, and turns about it by 2π · turns, positive about the normal."""
    r, v, _ = path_of(name).sample(np.linspace(START, STOP, 2001))
    arm = r - (ORIGIN + 0.04 * ALONG)
    assert within(16, np.linalg.norm(arm, axis=1), 0.04, ORIGIN)
    assert np.all(np.sign(turns) * (np.cross(arm, v) @ NORMAL)[1:-1] > 0.0)
    angle = np.unwrap(np.arctan2(arm @ ACROSS, arm @ ALONG))
    assert angle[-1] - angle[0] == pytest.approx(2 * np.pi * turns, abs=1e-12)


def test_eight_is_the_lissajous_figure():
    """With X = 2x/width and Y = 2y/height the eight is Y² = 4 X² (1 − X²); it is as wide and high as told."""
    r, v, _ = path_of("eight").sample(np.linspace(START, STOP, 4000))
    x, y, _ = plane_coordinates(r)
    X, Y = x / 0.05, y / 0.03
    assert within(64, Y**2, 4 * X**2 * (1 - X**2), 1.0)
    assert np.ptp(x) == pytest.approx(0.1, rel=1e-5)
    assert np.ptp(y) == pytest.approx(0.06, rel=1e-5)
    assert within(16, r[-1], ORIGIN)
    assert np.sum(np.diff(np.sign(x[1:-1])) != 0) == 1  # it crosses itself once
    first = plane_coordinates(ORIGIN + v[1])
    assert first[0] > 0.0
    assert first[1] > 0.0


def test_raster_runs_to_and_fro():
    """Passes alternate in direction, one pitch apart (negative: to the right), with rests at the corners."""
    path = path_of("raster")
    assert len(path.segments) == 7
    corners = plane_coordinates(
        np.array([path.segments[0].origin] + [p.sample(np.array([p.stop]))[0][0] for p in path.segments])
    )
    assert within(16, corners[0], [0.0, 0.05, 0.05, 0.0, 0.0, 0.05, 0.05, 0.0], ORIGIN)
    assert within(16, corners[1], [0.0, 0.0, -0.01, -0.01, -0.02, -0.02, -0.03, -0.03], ORIGIN)


def test_raster_shares_its_time_by_equal_peak_acceleration():
    """Long passes and short steps accelerate as hard as each other."""
    peaks = []
    for segment in path_of("raster").segments:
        _, _, a = segment.sample(np.linspace(segment.start, segment.stop, 5001))
        peaks.append(np.max(np.linalg.norm(a, axis=1)))
    assert np.ptp(peaks) < 1e-6 * max(peaks)


@pytest.mark.parametrize("name", ["waypoints", "waypoints, linear"])
def test_waypoints_are_reached_at_their_instants(name):
    """The tip is at each point at its instant, on the straight between, and rests where two points are the same."""
    path, section = path_of(name), SECTIONS[name]
    r, _, _ = path.sample(np.array(section.times))
    assert within(16, r - ORIGIN, section.points, ORIGIN)
    r, v, _ = path.sample(np.linspace(1.5, 2.0 - 1e-6, 50))
    assert within(16, r - ORIGIN, section.points[1], ORIGIN)
    assert np.all(v == 0.0)
    way = np.array(section.points[3]) - section.points[2]
    r, _, _ = path.sample(np.linspace(2.0, 6.5, 50))
    assert np.max(np.abs(np.cross(r - ORIGIN - section.points[2], way))) < 1e-17


def test_velocity_that_jumps_has_its_later_value():
    """At a linear waypoint the velocity is that of the way ahead, also where rounding put the instant an ulp before."""
    path = path_of("waypoints, linear")
    for t in (1.5, np.nextafter(1.5, 0.0)):
        assert np.all(path.sample(np.array([t]))[1] == 0.0)
    for t in (2.0, np.nextafter(2.0, 0.0)):
        assert within(16, path.sample(np.array([t]))[1][0] * 4.5, [0.04, -0.02, 0.07])
    assert np.all(path.sample(np.array([6.5, np.nextafter(6.5, 0.0)]))[1] == 0.0)


def test_hold_stays_where_it_is():
    """A path without segments is its origin, at rest."""
    path = tip_path(Hold(), ORIGIN, NORMAL)
    r, v, a = path.sample(np.array([0.0, 1.0, 1e9]))
    assert np.array_equal(r, np.tile(ORIGIN, (3, 1)))
    assert not np.any(v)
    assert not np.any(a)
    assert path.start == 0.0
    assert path.length == 0.0


def test_hint_for_a_direction_out_of_the_surface_is_accepted():
    """What a refusal names as the nearest direction along the surface is one, digits and all."""
    with pytest.raises(cl.ScenarioError, match="nearest direction") as caught:
        tip_path(Circle(radius=0.1, stop=1.0, direction=(0.3, 0.5, 0.7)), ORIGIN, NORMAL)
    near = tuple(map(float, str(caught.value).split("[")[-1].rstrip("]").split(",")))
    assert tip_path(Circle(radius=0.1, stop=1.0, direction=near), ORIGIN, NORMAL).length > 0.0
