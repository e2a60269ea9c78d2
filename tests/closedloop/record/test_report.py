"""What a run says of itself: the paper's assumptions, each seen to hold and seen to fail, and its summary."""

import dataclasses
import json
import re

import numpy as np
import pytest
from slides import SLIDES

import closedloop as cl
from closedloop.record.report import NEAR_SINGULAR, RESIDUAL_TOLERANCE, energy_balance, notes, print_report
from closedloop.record.report.tables import MOST_EVENTS

NAMES = ("one_loop", "single_point", "contact_kept", "frictionless", "nonsingular")


@pytest.fixture(scope="module")
def slide():
    """Return 0.7 s of the WAM's slide."""
    return cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.7}))


def with_column(run, name, changes):
    """Return the run with some rows of a column replaced."""
    column = run.columns[name].copy()
    for row, value in changes.items():
        column[row] = value
    return dataclasses.replace(run, columns={**run.columns, name: column})


def failures(run):
    """Return when each assumption that failed did so first."""
    return {name: v["first_failed"] for name, v in run.summary()["assumptions"].items() if v["held"] is not True}


def test_every_assumption_holds_in_a_good_run(slide):
    """All five are reported, held, with what decided beside them."""
    report = slide.summary()["assumptions"]
    assert tuple(report) == NAMES
    assert failures(slide) == {}
    assert all(verdict["measured"] for verdict in report.values())


def test_value_that_is_no_number_is_null_and_named(slide):
    """A summary is strict JSON: a value whose squares overflow is null, and its name stands beside; else none does."""
    assert slide.summary()["not_finite"] == []
    summary = with_column(slide, "velocity", {5: np.full(3, 1e200)}).summary()
    assert summary["max_tip_speed"] is None
    assert "max_tip_speed" in summary["not_finite"]
    assert all(summary[name] is None for name in summary["not_finite"])
    json.dumps(summary, allow_nan=False)


def test_force_beyond_all_bounds_is_divergence():
    """A torque beyond what squares can hold stops the run, and its summary is JSON."""
    with pytest.raises(cl.DivergenceError) as caught:
        cl.simulate(
            cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=lambda t, q, v, terms: [1e200 * (t > 0.004)] * 4
        )
    run = caught.value.run
    assert len(run) == 5
    assert run.summary()["not_finite"] == []
    json.dumps(run.summary(), allow_nan=False)


def test_pulling_is_a_contact_that_is_lost_from_the_start():
    """A law that pulls with 5 N would lift the tip: the contact is not kept, from the first row on."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"law.force": -5.0, "time.duration": 0.01}))
    assert run.contact_force[0] == pytest.approx(-5.0)
    assert failures(run) == {"contact_kept": 0.0}


def test_contact_that_is_lost_in_the_transient_is_timed():
    """A push of 1 N does not outlast the dip of 1.68 N: lost as the tip stops, where the force is first below zero."""
    stop = {"reference.stop": 0.6, "time.duration": 0.7}
    run = cl.simulate(cl.load_scenario("wam_slide", stop | {"law.force": 1.0}))
    assert run.contact_force[599] > 0.0 > run.contact_force[600]
    assert failures(run) == {"contact_kept": pytest.approx(0.6)}
    kept = cl.simulate(cl.load_scenario("wam_slide", stop | {"law.force": 1.8}))
    assert failures(kept) == {}


@pytest.mark.parametrize(
    ("column", "bad", "names"),
    [
        ("residual_motion", 10 * RESIDUAL_TOLERANCE, {"single_point", "frictionless"}),
        ("residual_closure", 10 * RESIDUAL_TOLERANCE, {"one_loop"}),
        ("contact_force", -1e-3, {"contact_kept"}),
        ("normal_mobility", 0.1 * NEAR_SINGULAR, {"nonsingular"}),
        ("residual_motion", np.nan, {"single_point", "frictionless"}),
        ("residual_closure", np.nan, {"one_loop"}),
        ("contact_force", np.nan, {"contact_kept"}),
        ("normal_mobility", np.nan, {"nonsingular"}),
    ],
)
def test_one_bad_row_is_found_and_timed(column, bad, names, slide):
    """A flaw planted in a single row fails exactly the assumptions that it touches, at that row's time."""
    flawed = with_column(slide, column, {123: bad, 456: bad})
    assert failures(flawed) == dict.fromkeys(names, pytest.approx(0.123))


@pytest.mark.parametrize("column", ["residual_motion", "residual_closure"])
def test_residual_within_rounding_is_no_failure(column, slide):
    """Half the tolerance is still held: the threshold is where it is said to be."""
    assert failures(with_column(slide, column, {123: 0.5 * RESIDUAL_TOLERANCE})) == {}


def test_singular_stop_fails_the_assumption_when_it_first_failed(slide):
    """A run that stopped as singular did not hold, from its first near-singular row, also if that is row 0."""
    words = "stopped at t = 0.701 s: singular pose"
    at_the_end = dataclasses.replace(slide, stopped=words)
    assert failures(at_the_end) == {"nonsingular": pytest.approx(0.701)}
    for row in (0, 300):
        early = dataclasses.replace(with_column(slide, "normal_mobility", {row: 1e-9}), stopped=words)
        assert failures(early) == {"nonsingular": pytest.approx(0.001 * row)}


def test_nothing_is_claimed_of_a_run_without_rows():
    """A run that stopped at t = 0 held nothing and failed nothing that was checked; its values are None."""
    changes = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold", "time.duration": 0.1}
    with pytest.raises(cl.SingularClosureError) as caught:
        cl.simulate(cl.load_scenario("planar2_slide", changes))
    summary = caught.value.run.summary()
    assert summary["steps"] == 0
    assert summary["final_contact_force"] is None
    assert summary["stopped"].startswith("stopped at t = 0 s: singular pose")
    assert all(verdict["held"] is not True for verdict in summary["assumptions"].values())


def test_summary_has_the_keys_that_others_rely_on(slide):
    """The summary has every promised key, and its values are those of the columns."""
    s = slide.summary()
    promised = {
        "scenario", "steps", "final_contact_force", "peak_contact_force", "min_contact_force",
        "max_abs_closure_error", "final_closure_error", "max_kkt_residual", "max_kkt_condition", "assumptions",
        "wall_seconds",
    }  # fmt: skip
    assert promised <= set(s)
    assert s["scenario"] == "wam_slide"
    assert s["steps"] == 700
    assert s["end_time"] == pytest.approx(0.7)
    assert s["stopped"] is None
    assert s["final_contact_force"] == slide.contact_force[-1]
    assert s["peak_contact_force"] == slide.contact_force.max()
    assert s["min_contact_force"] == slide.contact_force.min()
    assert s["max_abs_closure_error"] == np.abs(slide.closure_error).max()
    assert s["final_closure_error"] == slide.closure_error[-1]
    assert s["max_kkt_residual"] == max(slide.residual_motion.max(), slide.residual_closure.max())
    assert s["max_kkt_condition"] == slide.kkt_condition.max()
    assert s["max_tip_speed"] == np.linalg.norm(slide.velocity, axis=1).max()
    assert s["max_stabiliser_force"] == np.abs(slide.stabiliser_force).max()
    assert s["wall_seconds"] > 0.0


@pytest.mark.parametrize("name", SLIDES)
def test_summary_is_json(name, shipped_run):
    """The summary survives JSON, which knows neither NaN nor numpy."""
    summary = shipped_run(name).summary()
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_changing_a_summary_does_not_change_the_run(slide):
    """A summary is the caller's own, down to the verdicts in it."""
    mine = slide.summary()
    mine["steps"] = -1
    mine["assumptions"]["one_loop"]["held"] = "perhaps"
    assert slide.summary()["steps"] == 700
    assert slide.summary()["assumptions"]["one_loop"]["held"] is True


def test_energy_balance_accounts_for_every_work():
    """Energy left over is small against what was exchanged, and halves with the step of a first-order scheme."""
    left = []
    for h in (0.001, 0.0005, 0.00025):
        run = cl.simulate(cl.load_scenario("wam_slide", {"time.step": h, "time.duration": 2.0}))
        residual, exchanged = energy_balance(run)
        assert len(residual) == len(run)
        assert residual[0] == exchanged[0] == 0.0
        assert np.all(np.diff(exchanged) >= 0.0)
        left.append(np.max(np.abs(residual)))
        assert left[-1] < 1e-2 * exchanged[-1]
    assert left[0] / left[1] == pytest.approx(2.0, rel=0.1)
    assert left[1] / left[2] == pytest.approx(2.0, rel=0.1)


def test_energy_balance_misses_a_work_that_is_left_out(shipped_run):
    """The balance notices a work that is recorded 1 % too high: a negative control."""
    run = shipped_run("wam_slide")
    clean, _ = energy_balance(run)
    wrong = {**run.columns, "energy_supplied": 1.01 * run.energy_supplied}
    flawed, _ = energy_balance(dataclasses.replace(run, columns=wrong))
    assert np.max(np.abs(flawed)) > 10 * np.max(np.abs(clean))


def test_energy_balance_counts_friction_in_joints(shipped_run):
    """What joints lose to friction is in the balance and in the summary, with a thousandth unaccounted for."""
    run = shipped_run("joint_friction")
    facts = run.summary()
    rate = np.einsum("ij,ij->i", run.joint_friction, run.v)
    assert facts["energy_lost_to_friction"] == pytest.approx(-np.trapezoid(rate, run.time), rel=1e-12)
    assert facts["energy_lost_to_friction"] > 0.1
    assert facts["max_energy_residual"] < 1e-3 * facts["energy_lost_to_friction"]
    assert facts["max_joint_friction"] == np.max(np.abs(run.joint_friction))
    verdict = facts["assumptions"]["frictionless"]
    assert verdict["held"] is False
    assert "N m in joints" in verdict["measured"]


def test_friction_that_may_drive_is_noted():
    """A run on LuGre's bristles with constant damping says so, with its cures; none of the other laws has a note."""
    lugre = {"kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.01, "stiffness": 1e4, "damping": 10.0, "kind": "lugre"}

    def told(**changes):
        """Return the notes on a short run that speak of friction."""
        run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.002} | changes))
        return [note for note in notes(run) if "friction" in note]

    (note,) = told(friction=lugre)
    assert note.startswith("friction: lugre may add energy at high speed: damping_speed = ")
    assert "viscous = 50 N s/m or more" in note  # 10 N × 10 s/m × (0.3 − 0.2)/0.2
    assert told(friction=lugre | {"viscous": 51.0}) == []
    (note,) = told(joint_friction=lugre)
    assert note.startswith("joint_friction: lugre of joint 0 may add energy")


@pytest.mark.parametrize("width", [80, 120, 200])
def test_printed_report_says_what_the_summary_says(width, slide, capsys):
    """The tables fit the width, have all five assumptions, and cut nothing off."""
    print_report(with_column(slide, "contact_force", {5: -2.0}), width=width)
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text.replace(" … ", "")
    assert text.count("yes") == 4
    assert text.count("NO") == 1
    for word in ("f > 0", "0.005 s", "closure error", "energy"):
        assert word in text


def test_printed_report_of_a_run_without_rows(capsys):
    """A run without rows prints its unknown assumptions, and no values."""
    changes = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold", "time.duration": 0.1}
    with pytest.raises(cl.SingularClosureError) as caught:
        cl.simulate(cl.load_scenario("planar2_slide", changes))
    print_report(caught.value.run, width=100)
    text = capsys.readouterr().out
    assert "nan" not in text.lower()
    assert "no row could be computed" in text


def printed(run, capsys, width=80):
    """Return what is printed of a run, the blanks that only fill lines taken out."""
    capsys.readouterr()
    print_report(run, width=width)
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text.replace(" … ", "")
    return re.sub(r"[ ]+", " ", text)


@pytest.mark.parametrize("name", ["wam_touchdown", "wam_liftoff"])
def test_contact_that_was_not_kept_says_for_how_long(name, shipped_run):
    """A tip that starts free never kept contact, one that leaves did until then; only contact_kept fails by it."""
    run = shipped_run(name)
    change = np.ceil(run.events[-1].time / 0.001) * 0.001  # the first row after the touchdown, or the liftoff
    free = change if name == "wam_touchdown" else run.time[-1] - change
    assert failures(run) == {"contact_kept": pytest.approx(0.0 if name == "wam_touchdown" else change, abs=1e-9)}
    said = run.summary()["assumptions"]["contact_kept"]["measured"]
    assert said == f"free for {free:.4g} of {run.time[-1]:g} s"
    assert run.summary()["time_in_contact"] + free == pytest.approx(run.time[-1], abs=1e-9)


def test_contact_of_a_run_that_is_free_all_along():
    """A run that ends before the tip arrives has no contact at all, and no closure row to meet."""
    run = cl.simulate(cl.load_scenario("wam_touchdown", {"time.duration": 0.01}))
    report = run.summary()["assumptions"]
    assert failures(run) == {"contact_kept": 0.0}
    assert report["contact_kept"]["measured"] == "free from start to end"
    assert report["one_loop"]["measured"] == "no row: the tip is free"


def test_force_that_fails_in_contact_is_named_before_free_time(shipped_run):
    """A pull while in contact decides, not the time for which the tip was free."""
    run = with_column(shipped_run("wam_touchdown"), "contact_force", {5000: -2.0})
    assert run.summary()["assumptions"]["contact_kept"]["measured"] == "f ≥ -2 N, at 5 s"


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize("name", ["wam_touchdown", "wam_bounce", "wam_edge", "wam_liftoff", "planar2_drop"])
def test_events_are_printed_as_they_were(name, width, shipped_run, capsys):
    """Each of the first eight events is a line with its time, rates, impulses and loss; the rest are counted."""
    run = shipped_run(name)
    text = printed(run, capsys, width)
    for event in run.events[:MOST_EVENTS]:
        before = event.rate_before if abs(event.rate_before) >= 1e-15 else 0.0  # less is rounding
        cells = [f"{event.time:.6f}", event.kind, f"{before:.3g}", f"{event.rate_after:.3g}"]
        if event.kind != "liftoff":
            cells += [f"{x:.3g}" for x in (event.compression, event.decompression, event.energy_lost)]
        assert " ".join(cells) in text
    more = len(run.events) - MOST_EVENTS
    assert (f"and {more} more, the last at {run.events[-1].time:.6f} s" in text) == (more > 0)
    assert text.count("more, the last") == (more > 0)


def test_late_and_large_events_fit_the_page(shipped_run, capsys):
    """Times over a thousand seconds and numbers as wide as they come keep the table within 80 columns."""
    run = shipped_run("wam_bounce")
    rates = [name for name in run.columns if name.startswith(("event_rate", "event_energy"))]
    wide = {name: -1.2345e100 * run.columns[name] for name in rates}
    late = {"event_time": run.event_time + 1000.0}
    text = printed(dataclasses.replace(run, columns={**run.columns, **wide, **late}), capsys)
    assert f"{1000.0 + run.event_time[0]:.6f} impact {-1.2345e100 * run.event_rate_before[0]:.3g}" in text


def test_tables_of_a_run_that_ends_free(shipped_run, capsys):
    """Off the surface the closure error is a gap, and the force commanded last is that of the profile."""
    run = shipped_run("wam_liftoff")
    assert 0.02 < run.closure_error[-1] < 0.03
    text = printed(run, capsys, 120)
    assert f"a gap of {run.closure_error[-1]:.3g} m at the end" in text
    assert "free; commanded 10 N" in text
    assert "1 liftoff" in text
    assert "energy lost in impacts" not in text
    ends = cl.simulate(cl.load_scenario("wam_edge", {"time.duration": 2.0}))
    assert f"commanded {ends.reference_force[-1]:.6g} N" in printed(ends, capsys, 120)
    assert ends.reference_force[-1] == pytest.approx(3.0)


def test_force_in_contact_is_what_was_lowest(shipped_run, capsys):
    """The zero force of a free tip is not the lowest force of its contact."""
    run = shipped_run("wam_touchdown")
    lowest = run.contact_force[run.mode != 0].min()
    assert lowest > 3.0
    assert f"{lowest:.4g} … {run.contact_force.max():.4g} N in contact" in printed(run, capsys, 120)


def test_unbroken_contact_has_no_events_to_print(slide, capsys):
    """A bilateral run without friction says nothing of events."""
    text = printed(slide, capsys)
    assert "event" not in text
    assert "in contact" not in text
