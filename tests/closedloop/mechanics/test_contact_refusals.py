"""Bad input of a surface that the tip may leave: one clear line, exit status 2; a run that stops: 3, and its file."""

import json
import re

import numpy as np
import pytest

import closedloop as cl
from closedloop.simulation.prepare import START_RATE

REFUSED = [
    ("wam_bounce", {"impact.restitution": 1.2}, r"impact\.restitution = 1\.2.*1"),
    ("wam_bounce", {"impact.restitution": -0.1}, r"impact\.restitution = -0\.1: must not be negative"),
    ("wam_bounce", {"impact.restitution": float("nan")}, r"impact\.restitution"),
    ("wam_bounce", {"impact.rest_speed": 0.0}, r"impact\.rest_speed = 0.*0"),
    ("wam_bounce", {"impact.rest_speed": -1e-4}, r"impact\.rest_speed = -0\.0001"),
    ("wam_bounce", {"impact.law": "hertz"}, r"impact\.law = 'hertz'.*newton.*poisson.*stronge"),
    ("wam_bounce", {"impact.bounce": 0.5}, r"impact\.bounce"),
    ("wam_bounce", {"surface.gap": -0.01}, r"surface\.gap = -0\.01: must not be negative"),
    ("wam_bounce", {"surface.offset": 0.3}, r"surface\.gap.*start"),
    ("wam_bounce", {"surface.contact": "sticky"}, r"surface\.contact = 'sticky'.*bilateral.*unilateral"),
    ("wam_slide", {"surface.gap": 0.05}, r"surface\.gap = 0\.05.*0\.05 m off the surface.*unilateral"),
    (
        "wam_bounce",
        {"surface.gap": 0.0, "surface.offset": 2.0},
        r"surface\.offset = 2: the tip starts .* m inside the surface: surface\.offset may be at most",
    ),
    (
        "wam_liftoff",
        {"start.v": [0.0, -0.5, 0.0, 0.0]},
        r"start\.v: the tip starts on the surface and leaves it at 0\.\d+ m/s.*surface\.gap",
    ),
]


@pytest.mark.parametrize("v", [[0.0, 0.1, 0.0, 0.2], [0.3, 0.0, -0.5, 1.0], [0.0, -1e-3, 0.0, 0.0]])
def test_held_tip_does_not_start_through_its_closure(v):
    """A bilateral start with velocity along the normal is refused with the rate, and with velocities that would do.

    It ran before: at 0.12 m/s the tip was 0.23 m off in the end, without a word. Those velocities along the surface are
    accepted, and the run starts with them.
    """
    slide = {"time.duration": 0.01, "start.v": v}
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", slide))
    said = re.search(
        r"starts through it at (\S+) m/s, where 0\.0001 m/s is the most; .* is (\[.*\]), or", str(caught.value)
    )
    problem = cl.prepare(cl.load_scenario("wam_slide", slide | {"start.v": json.loads(said[2])}))
    A = problem.plane.normal @ problem.robot.terms(problem.q, problem.v).jacobian
    assert float(said[1]) == pytest.approx(A @ v, rel=1e-3)
    assert abs(A @ problem.v) < 1e-8
    assert np.linalg.norm(problem.v - v) <= abs(A @ v) / np.linalg.norm(A) * (1 + 1e-6)
    cl.prepare(
        cl.load_scenario("wam_slide", slide | {"surface.contact": "unilateral", "start.v": [0.0, 0.1, 0.0, 0.2]})
    )


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_rate_of_a_held_start_from_both_sides(factor, robot):
    """The tolerance is `START_RATE`: a little below it a start is accepted, a little above refused."""
    q = np.array(cl.load_scenario("wam_slide").start.q)
    A = robot("wam4").position_and_jacobian(q)[1][2]
    v = (factor * START_RATE * A / (A @ A)).tolist()
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.01, "start.v": v})
    if factor < 1.0:
        cl.prepare(scenario)
    else:
        with pytest.raises(cl.ScenarioError, match=r"start\.v: the tip is held"):
            cl.prepare(scenario)


def ident(case):
    """Return the name of a parameter."""
    return "-".join(f"{key}={value}" for key, value in case.items()) if isinstance(case, dict) else ""


@pytest.mark.parametrize(("name", "changes", "line"), REFUSED, ids=ident)
def test_bad_contact_is_refused_in_one_line(name, changes, line):
    """The line names the key, the value and what would be right; nothing is simulated."""
    with pytest.raises(cl.ScenarioError, match=line) as caught:
        cl.simulate(cl.load_scenario(name, changes))
    assert "\n" not in str(caught.value)
    assert "Traceback" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "changes", "line"), REFUSED[:2] + REFUSED[3:4] + REFUSED[5:6] + REFUSED[8:], ids=ident
)
def test_bad_contact_ends_the_command_line_with_status_2(name, changes, line, command_line, short, tmp_path):
    """On the command line the same is one line on standard error, exit status 2, and no file."""
    options = [x for key, value in changes.items() for x in (f"--{key}", str(value))]
    outcome = command_line(name, *options, "--no-figures", "--json")
    assert outcome.refusal(2)
    assert not list(tmp_path.rglob("*.nc"))


def test_the_largest_offset_named_is_one_that_runs():
    """The offset that the refusal of a start inside the surface names puts the tip on the surface or off it."""
    changes = {"surface.gap": 0.0, "surface.offset": 2.0, "time.duration": 0.01}
    with pytest.raises(cl.ScenarioError) as caught:
        cl.simulate(cl.load_scenario("wam_bounce", changes))
    named = float(str(caught.value).split("at most ")[1].split(" ")[0])
    run = cl.simulate(cl.load_scenario("wam_bounce", changes | {"surface.offset": named - 1e-8}))
    assert 0.0 <= run.closure_error[0] < 1e-7


def test_a_run_that_stops_on_the_way_has_status_3_and_is_saved(command_line, tmp_path):
    """A drop whose damping drives it apart ends with status 3; the line says when, and the run until then is there."""
    options = ["--law.kd", "-40", "--time.duration", "2.0", "--no-figures", "--json", "--out", str(tmp_path / "o")]
    outcome = command_line("wam_bounce", *options)
    assert outcome.status == 3
    assert "stopped at t = " in outcome.err
    run = cl.load_run(tmp_path / "o" / "run.nc")
    assert run.stopped is not None
    assert run.stopped in outcome.err
    assert 10 < len(run) < 2001
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["stopped"] == run.stopped
    assert sum(summary["events"].values()) == len(run.events)
