"""The table of what is desired, against the robot, the frame and the profile; the sections of a scenario."""

import tomllib

import numpy as np
import pytest
from rounding import within

import closedloop as cl
from closedloop.control.reference.desired import Desired, desired
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.messages import keys

CIRCLE = {"kind": "circle", "direction": [0, 1, 0], "radius": 0.03, "start": 0.2, "stop": 2.0}
EIGHT = {"kind": "figure_eight", "direction": [0, 1, 0], "width": 0.06, "height": 0.03, "start": 0.2, "stop": 2.0}
RASTER = {
    "kind": "raster",
    "direction": [0, 1, 0],
    "length": 0.03,
    "pitch": 0.01,
    "passes": 2,
    "start": 0.2,
    "stop": 2.0,
}
WAYPOINTS = {"kind": "waypoints", "times": [0.2, 1.0, 2.0], "points": [[0, 0, 0], [0, 0, -0.01], [0, 0.02, 0.01]]}
LINE = {"kind": "line", "direction": [0, 1, 0], "speed": 0.02, "start": 0.2, "stop": 2.0, "timing": "minimum_jerk"}
SECTIONS = {s["kind"]: s for s in (LINE, CIRCLE, EIGHT, RASTER, WAYPOINTS, {"kind": "hold"})}
INSTANTS = 0.01 * np.arange(241)


def wanted(reference, scenario="panda_slide", **changes):
    """Return the robot, the plane and what is desired of a shipped scenario with another reference."""
    problem = cl.prepare(cl.load_scenario(scenario, {"reference": reference, "time.duration": 0.01} | changes))
    motion = desired(problem.scenario.reference, problem.robot, problem.surface, problem.q)
    made = Desired(motion.tip, motion.joints, problem.scenario.force_profile, problem.scenario.law.force)
    return problem.robot, problem.plane, made


@pytest.mark.parametrize("kind", SECTIONS)
def test_table_is_the_motion_of_the_tip(kind):
    """On a tilted surface the tip's columns, in the base frame, are those of the robot at q_des, q̇_des.

    Position to the path's tolerance, velocity to that over the spacing of knots.
    """
    robot, plane, made = wanted(SECTIONS[kind])
    table, n = made.table(INSTANTS), robot.n
    assert table.shape == (INSTANTS.size, 2 * n + 10)
    q, v, p, u, a, f = np.split(table, [n, 2 * n, 2 * n + 3, 2 * n + 6, 2 * n + 9], axis=1)
    for k in range(INSTANTS.size):
        terms = robot.terms(q[k], v[k])
        assert np.max(np.abs(p[k] - terms.position)) < 2e-10
        assert np.max(np.abs(u[k] - terms.jacobian @ v[k])) < 2e-7
    assert within(16, made.tip.sample(INSTANTS)[2], a)
    assert np.all(f == 10.0)
    if kind == "waypoints":
        assert np.ptp(p @ plane.normal) > 0.009  # it leaves the surface
    else:
        assert within(16, p @ plane.normal, plane.offset, p)
        assert np.max(np.abs(u @ plane.normal)) < 1e-16
    if kind != "hold":
        assert np.ptp(p - np.outer(p @ plane.normal, plane.normal), axis=0).max() > 0.01


def test_table_has_later_values_in_the_row_of_a_jump():
    """Joint and tip velocity of a line jump in the rows of its start and stop, the force in that of its step."""
    h = 0.001
    line = {"kind": "line", "direction": [0, 1, 0], "speed": 0.02, "start": 0.3, "stop": 1.1}
    robot, _, made = wanted(line, "wam_slide", force_profile={"kind": "step", "at": 0.7, "to": 12.0})
    table = made.table(h * np.arange(1501))
    moving = (np.arange(1501) >= 300) & (np.arange(1501) < 1100)
    n = robot.n
    assert np.array_equal(np.any(table[:, n : 2 * n] != 0.0, axis=1), moving)
    assert np.array_equal(np.linalg.norm(table[:, 2 * n + 3 : 2 * n + 6], axis=1) > 0.01, moving)
    assert np.array_equal(table[:, -1], np.where(np.arange(1501) >= 700, 12.0, 10.0))


@pytest.mark.parametrize("kind", ["circle", "raster"])
def test_table_does_not_depend_on_the_step(kind):
    """What is desired is a function of time: any step and integrator reads the same numbers at the same instants."""
    changes = {"reference": SECTIONS[kind], "time.duration": 2.4}
    coarse = cl.prepare(cl.load_scenario("wam_slide", changes | {"time.step": 0.001}))
    fine = cl.prepare(cl.load_scenario("wam_slide", changes | {"time.step": 0.0005, "time.integrator": "rk4"}))
    assert within(64, fine.table[:: 2 * fine.nodes], coarse.table)


@pytest.mark.parametrize(("kind", "start"), [("circle", 0.2), ("waypoints", 0.2), ("line", 0.2), ("hold", 0.0)])
def test_pd_part_begins_with_the_motion(kind, start):
    """Unless told otherwise the PD part of the law acts from the instant at which the tip is to move."""
    problem = cl.prepare(cl.load_scenario("wam_slide", {"reference": SECTIONS[kind], "time.duration": 0.01}))
    assert problem.pd_start == pytest.approx(start, abs=1e-9)


@pytest.mark.parametrize("kind", SECTIONS)
def test_section_survives_toml(kind):
    """Each kind is written as TOML and read back to an equal scenario, defaults and nested lists included."""
    scenario = cl.load_scenario("wam_slide", {"reference": SECTIONS[kind]})
    text = scenario.to_toml()
    assert parse_scenario(text) == scenario
    assert tomllib.loads(text)["reference"]["kind"] == kind


def test_every_kind_is_described():
    """The help of [reference] has the keys of every kind, with the kinds that have each."""
    for kind, section in SECTIONS.items():
        described = {key.name for key in keys("reference") if kind in key.kinds}
        assert {f"reference.{key}" for key in section if key != "kind"} <= described


NAN = float("nan")
REFUSED = {
    "circle without radius": (CIRCLE | {"radius": None}, ["reference.radius", "number"]),
    "radius zero": (CIRCLE | {"radius": 0.0}, ["reference.radius", "greater than 0"]),
    "negative radius": (CIRCLE | {"radius": -0.1}, ["reference.radius", "-0.1", "greater than 0"]),
    "no turns": (CIRCLE | {"turns": 0}, ["reference.turns", "zero"]),
    "circle that stops first": (CIRCLE | {"stop": 0.1}, ["reference.stop", "0.1", "reference.start", "0.2"]),
    "circle out of the surface": (CIRCLE | {"direction": [0, 1, 1]}, ["reference.direction", "[0.0, 1.0, 0.0]"]),
    "circle without direction": (CIRCLE | {"direction": [0, 0, 0]}, ["reference.direction", "no direction"]),
    "speed of a circle": (CIRCLE | {"speed": 0.1}, ["reference.speed", "unknown"]),
    "eight without width": (EIGHT | {"width": 0.0}, ["reference.width", "greater than 0"]),
    "eight without height": (EIGHT | {"height": -1.0}, ["reference.height", "greater than 0"]),
    "eight backwards": (EIGHT | {"turns": -1.0}, ["reference.turns", "greater than 0"]),
    "eight out of the surface": (EIGHT | {"direction": [0, 0, 1]}, ["reference.direction", "surface"]),
    "eight that stops first": (EIGHT | {"stop": 0.2}, ["reference.stop", "reference.start"]),
    "raster without pitch": (RASTER | {"pitch": 0.0}, ["reference.pitch", "zero"]),
    "raster without length": (RASTER | {"length": 0.0}, ["reference.length", "greater than 0"]),
    "no passes": (RASTER | {"passes": 0}, ["reference.passes", "between 1 and 1000"]),
    "half a pass": (RASTER | {"passes": 1.5}, ["reference.passes", "whole number"]),
    "true passes": (RASTER | {"passes": True}, ["reference.passes", "whole number"]),
    "too many passes": (RASTER | {"passes": 10**30}, ["reference.passes", "between 1 and 1000"]),
    "raster that stops first": (RASTER | {"stop": 0.0}, ["reference.stop", "reference.start"]),
    "raster out of the surface": (RASTER | {"direction": [0, 1, 1]}, ["reference.direction", "surface"]),
    "unknown timing": (LINE | {"timing": "linear"}, ["reference.timing", "'constant'", "'minimum_jerk'"]),
    "unknown timing of points": (WAYPOINTS | {"timing": "constant"}, ["reference.timing", "'linear'"]),
    "times that stand": (WAYPOINTS | {"times": [0.2, 1.0, 1.0]}, ["reference.times", "entry 2", "later than entry 1"]),
    "times that go back": (WAYPOINTS | {"times": [0.2, 1.0, 0.5]}, ["reference.times", "entry 2 is 0.5", "later"]),
    "times before the start": (WAYPOINTS | {"times": [-0.2, 1.0, 2.0]}, ["reference.times", "negative"]),
    "one time": (WAYPOINTS | {"times": [0.2], "points": [[0, 0, 0]]}, ["reference.times", "at least two"]),
    "NaN in times": (WAYPOINTS | {"times": [0.2, NAN, 2.0]}, ["reference.times", "entry 1", "finite"]),
    "text in times": (WAYPOINTS | {"times": [0.2, "one", 2.0]}, ["reference.times", "entry 1 is 'one'", "number"]),
    "a number for times": (WAYPOINTS | {"times": 1.0}, ["reference.times", "list of instants"]),
    "a point too few": (WAYPOINTS | {"points": [[0, 0, 0], [0, 0, 1]]}, ["points has 2", "3 reference.times"]),
    "points that begin elsewhere": (
        WAYPOINTS | {"points": [[0, 0, 1e-9], [0, 0, 0], [0, 0, 0]]},
        ["reference.points[0]", "[0.0, 0.0, 1e-09]", "[0, 0, 0]"],
    ),
    "a point of two numbers": (WAYPOINTS | {"points": [[0, 0, 0], [0, 0], [0, 0, 0]]}, ["point 1 has 2", "three"]),
    "a number for a point": (WAYPOINTS | {"points": [[0, 0, 0], 1.0, [0, 0, 0]]}, ["point 1", "three numbers"]),
    "a number for points": (WAYPOINTS | {"points": 1.0}, ["reference.points", "list of points"]),
    "NaN in a point": (WAYPOINTS | {"points": [[0, 0, 0], [0, NAN, 0], [0, 0, 0]]}, ["point 1", "entry 1", "finite"]),
    "true in a point": (WAYPOINTS | {"points": [[0, 0, 0], [0, 0, True], [0, 0, 0]]}, ["point 1", "entry 2 is True"]),
    "a huge point": (WAYPOINTS | {"points": [[0, 0, 0], [0, 0, 10**400], [0, 0, 0]]}, ["point 1", "1e308"]),
    "unknown kind": ({"kind": "spiral"}, ["reference.kind", "'spiral'", "'circle'", "'raster'", "'waypoints'"]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_reference_is_refused_in_one_line(case):
    """Each bad section is refused with one line that has the key, the value or the reason, and what would be right."""
    reference, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", {"reference": reference, "time.duration": 0.01}))
    line = str(caught.value)
    assert "\n" not in line
    assert all(word in line for word in words), line
