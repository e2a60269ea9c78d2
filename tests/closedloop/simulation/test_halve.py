"""A run and the same at half the step: what differs, in its summary, report, file and verdict."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.record.report import report_rows
from closedloop.record.report.halved import MOVES, NOT_HALVED, _away_from_changes, _events, halved_comparison
from closedloop.record.report.verdict import STEP_SHARE

SHORT = {"time.duration": 0.04, "reference.start": 0.0, "reference.stop": 0.2, "law.pd_start": 0.0}


@pytest.fixture(scope="module")
def halved():
    """Return a slide with rk4 and its comparison, and the run at half the step."""
    changes = SHORT | {"time.integrator": "rk4"}
    run = cl.halve(cl.load_scenario("planar2_slide", changes))
    return run, cl.simulate(cl.load_scenario("planar2_slide", changes | {"time.step": 0.5 * run.scenario.time.step}))


def test_the_comparison_is_that_of_two_runs(halved):
    """Columns at common instants, values of the summary, and the error of the step, of a scheme of order four too."""
    run, other = halved
    found = run.summary()["halved"]
    assert found["step"] == other.scenario.time.step
    assert found["rows"] == len(run) == (len(other) + 1) // 2
    off = np.abs(run.contact_force - other.contact_force[::2])
    assert off.max() > 0.0
    assert found["columns"]["contact_force"] == {
        "max": off.max(), "rms": pytest.approx(np.sqrt(np.mean(off**2))), "unit": "N", "at": run.time[np.argmax(off)],
    }  # fmt: skip
    assert found["columns"]["q"]["max"] == np.max(np.abs(run.q - other.q[::2]))
    assert found["columns"]["position"]["max"] == np.max(np.linalg.norm(run.position - other.position[::2], axis=1))
    theirs = other.summary()
    for name, each in found["values"].items():
        assert (each["value"], each["at_half"]) == (run.summary()[name], theirs[name])
        if None not in (each["value"], each["at_half"]):
            assert each["difference"] == abs(each["value"] - each["at_half"])
    measured = {"force": off.max(), "position": found["columns"]["position"]["max"]}
    assert run.summary()["step_error"] == {**measured, "why_not": None}
    assert run.step_error() == measured
    assert theirs["halved"] is None
    assert theirs["step_error"] == {"force": None, "position": None, "why_not": NOT_HALVED}


def test_a_run_measures_its_own_error_in_either_engine():
    """To rounding the same as by `halve`, whichever engine runs the second; a law of one's own is needed again."""
    run, engines = cl.simulate(cl.load_scenario("planar2_slide", SHORT)), ("compiled", "pinocchio")
    assert run.halved is None
    found = [run.step_error(), *(cl.halve(run.scenario, engine=engine).step_error() for engine in engines)]
    assert all(each == pytest.approx(found[0], rel=1e-6) for each in found)
    assert found[0]["force"] > 1e-3

    def law(x):
        return x.C - 5.0 * x.A[0] - 1.0 * x.v

    own = cl.simulate(run.scenario, law=law)
    assert own.step_error(law=law)["force"] >= 0.0
    with pytest.raises(cl.ScenarioError, match="pass it, as run"):
        own.step_error()
    adaptive = cl.simulate(cl.load_scenario("planar2_slide", SHORT | {"time.integrator": "dop853"}))
    assert "time.tolerance" in adaptive.summary()["step_error"]["why_not"]
    with pytest.raises(cl.ScenarioError, match="chooses its steps"):
        adaptive.step_error()


@pytest.mark.parametrize("name", ["planar2_slide", "soft_table", "joint_friction"])
def test_the_error_stated_is_that_of_order_one(name):
    """The true error, of a run at a sixteenth of the step, is between one and three times the difference at half.

    Of a scheme of order p it is 2ᵖ/(2ᵖ − 1) times that in the limit of short steps: twice for order one, once for more.
    """
    scenario = cl.load_scenario(name, {"time.duration": 0.8})
    run = cl.halve(scenario)
    fine = cl.simulate(cl.load_scenario(name, {"time.duration": 0.8, "time.step": scenario.time.step / 16}))
    true = np.max(np.linalg.norm(run.position - fine.position[::16], axis=1))
    assert 1.0 < true / run.step_error()["position"] < 3.0


def test_the_verdict_is_judged_by_what_was_measured(halved):
    """Just beyond the bound it is BAD, just within good; and BAD where the other run could not go on."""
    run, _ = halved
    bound = STEP_SHARE * run.summary()["largest_reference_force"]
    for changed, bad in (
        ({"force": 0.99 * bound}, False),
        ({"force": 1.01 * bound}, True),
        ({"stopped": "it diverged"}, True),
    ):
        verdict = dataclasses.replace(run, halved=run.halved | changed).summary()["verdict"]
        assert ("step" in {problem["name"] for problem in verdict["problems"]}) == bad


def test_a_file_has_the_comparison(halved, tmp_path):
    """To the bit."""
    run, _ = halved
    again = cl.load_run(run.save(tmp_path / "run.nc"))
    assert again.summary() == run.summary()
    assert again.halved == json.loads(json.dumps(run.halved))


def test_rows_beside_a_change_of_mode_do_not_count_and_long_differences_do():
    """The same change, a few rows later, is no error of the force; a contact that one of them does not have is."""
    mode, later, never = (1 * (np.arange(100) >= k) for k in (30, 33, 100))
    kept = _away_from_changes(mode, later)
    assert np.array_equal(np.flatnonzero(~kept), np.arange(28, 35))
    assert np.all(_away_from_changes(mode, mode)[[27, 32]])
    assert np.all(_away_from_changes(mode, never)[40:])
    assert MOVES < 100 - 30


def test_a_contact_that_one_run_has_alone_counts_with_its_whole_force(halved):
    """Where the other run is in flight throughout, f differs by all of it."""
    run, other = halved
    free = {"mode": np.full(len(other), FREE), "contact_force": np.zeros(len(other))}
    found = halved_comparison(run, dataclasses.replace(other, columns={**other.columns, **free}))
    assert found["force"] == np.max(np.abs(run.contact_force)) > 1.0
    assert found["modes_differ"] == len(run) > MOVES


def test_events_are_compared_with_those_of_their_own_contact():
    """Of two feet that strike in another order no instant has moved by more than each has."""
    times = {1: (0.10, 0.30), 2: (0.20, 0.25)}

    def struck(late):
        events = [SimpleNamespace(kind="impact", contact=k, time=t + late * k) for k in times for t in times[k]]
        return SimpleNamespace(events=sorted(events, key=lambda event: event.time))

    (found,) = _events(struck(0.0), struck(0.08)).values()
    assert found == {"count": 4, "at_half": 4, "max_time_difference": pytest.approx(0.16), "at": pytest.approx(0.25)}


def test_the_command_runs_it_twice_and_says_what_differs(command_line):
    """Its error of the step, and with --halve a block of the report; dop853 is then refused before anything is run."""
    keys = [word for key, value in SHORT.items() for word in (f"--{key}", value)]
    said = command_line("planar2_slide", *keys, "--no-figures", "--halve")
    assert said.status == 0
    assert said.out.count("at half the step, 0.0005 s, by how much it differs") == 1
    with open("out/planar2_slide/summary.json", encoding="utf-8") as file:
        summary = json.load(file)
    assert summary["halved"]["step"] == 0.0005
    shown = f"{summary['step_error']['force']:.2g}"
    for flag, measured in (("--halve", True), (None, True), ("--no-halve", False)):
        said = command_line("planar2_slide", *keys, "--no-figures", "--overwrite", *([flag] if flag else []))
        (line,) = (line for line in said.out.splitlines() if "f differs by" in line or "error of the step" in line)
        assert (shown in line) == measured
        assert ("not known" in line) != measured
        assert ("by how much it differs" in said.out) == (flag == "--halve")
    own_steps = "planar2_slide", *keys, "--time.integrator", "dop853", "--no-figures", "--out", "own"
    assert command_line(*own_steps).status == 0
    refusal = command_line(*own_steps, "--halve").refusal()
    assert "--halve: time.integrator = 'dop853'" in refusal
    assert "time.tolerance" in refusal


def test_without_a_surface_there_is_no_force_that_could_differ():
    """A thrown cube: 0 N were stated of the tip's f; where it is differs."""
    run = cl.halve(cl.load_scenario("cube_toss", {"time.duration": 0.45}))
    found = run.step_error()
    assert found["force"] is None
    assert found["position"] > 0.0
    told = [row[0] for row in report_rows(run)]
    assert "tip differs by" in told
    assert "f differs by" not in told
