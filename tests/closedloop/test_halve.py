"""A run and the same at half the step: what differs, in its summary, report, file and verdict."""

import dataclasses
import json

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report.halved import MOVES, _away_from_changes, checked_comparison
from closedloop.record.report.verdict import MEASURED_SHARE

SHORT = {"time.duration": 0.04, "reference.start": 0.0, "reference.stop": 0.2, "law.pd_start": 0.0}


@pytest.fixture(scope="module")
def halved():
    """Return a slide with rk4, whose error is not estimated, and its comparison; and the run at half the step."""
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
    stated = run.summary()["step_error"]
    assert stated == {
        "contact_force": off.max(), "position": found["columns"]["position"]["max"], "measured": True, "why_not": None,
        "extremes": max(off.max(), *(found["values"][name]["difference"] for name in (
            "final_contact_force", "peak_contact_force", "min_contact_force"))),
    }  # fmt: skip
    assert theirs["halved"] is None
    assert theirs["step_error"]["contact_force"] > 0.0
    assert not theirs["step_error"]["measured"]


def test_the_verdict_is_judged_by_what_was_measured(halved):
    """Just beyond the bound it is BAD, just within good; and BAD where the other run could not go on."""
    run, _ = halved
    bound = MEASURED_SHARE * run.summary()["largest_reference_force"]
    for changed, bad in (
        ({"force": 0.99 * bound}, False),
        ({"force": 1.01 * bound}, True),
        ({"stopped": "it diverged"}, True),
    ):
        verdict = dataclasses.replace(run, halved=run.halved | changed).summary()["verdict"]
        assert ("step" in {problem["name"] for problem in verdict["problems"]}) == bad


def test_a_file_has_the_comparison_and_a_wrong_one_is_refused(halved, tmp_path):
    """To the bit; and no number is taken that is none, nor text where one belongs."""
    run, _ = halved
    again = cl.load_run(run.save(tmp_path / "run.nc"))
    assert again.summary() == run.summary()
    good = json.loads(json.dumps(run.halved))
    assert checked_comparison(good) == run.halved
    for spoil in (
        lambda d: d.pop("rows"),
        lambda d: d.update(rows="7"),
        lambda d: d.update(force=float("nan")),
        lambda d: d.update(position=-1.0),
        lambda d: d["columns"].update(nothing={}),
        lambda d: d["columns"]["q"].update(unit=3),
        lambda d: d["values"]["min_contact_force"].pop("unit"),
        lambda d: d.update(events=[]),
    ):
        bad = json.loads(json.dumps(good))
        spoil(bad)
        with pytest.raises(cl.RunFileError, match="halved"):
            checked_comparison(bad)
    with pytest.raises(cl.RunFileError, match="halved"):
        checked_comparison([])


def test_rows_beside_a_change_of_mode_do_not_count_and_long_differences_do():
    """The same change, a few rows later, is no error of the force; a contact that one of them does not have is."""
    mode, later, never = (1 * (np.arange(100) >= k) for k in (30, 33, 100))
    kept = _away_from_changes(mode, later)
    assert np.array_equal(np.flatnonzero(~kept), np.arange(28, 35))
    assert np.all(_away_from_changes(mode, mode)[[27, 32]])
    assert np.all(_away_from_changes(mode, never)[40:])
    assert MOVES < 100 - 30


def test_the_command_runs_it_twice_and_says_what_differs(command_line):
    """One block of the report, `halved` in summary.json; and dop853 is refused before anything is run."""
    keys = [word for key, value in SHORT.items() for word in (f"--{key}", value)]
    said = command_line("planar2_slide", *keys, "--no-figures", "--halve")
    assert said.status == 0
    assert said.out.count("at half the step, 0.0005 s, by how much it differs") == 1
    assert "measured" in said.out
    with open("out/planar2_slide/summary.json", encoding="utf-8") as file:
        assert json.load(file)["halved"]["step"] == 0.0005
    refusal = command_line("planar2_slide", "--time.integrator", "dop853", "--halve", "--out", "no").refusal()
    assert "--halve: time.integrator = 'dop853'" in refusal
    assert "time.tolerance" in refusal
