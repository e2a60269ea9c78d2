"""The verdict of the control: each criterion from both sides of its bound, whatever the rows and the noise."""

import dataclasses
import re

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report.control_verdict import (
    LOST_SHARE,
    MEAN_SHARE,
    PATH_FLOOR,
    RMS_SHARE,
    SATURATED_SHARE,
    SWING_SHARE,
    Signals,
    judge_control,
    run_signals,
    signals_of,
)
from closedloop.record.report.control_verdict import told as told_of
from closedloop.record.report.verdict import names_of
from closedloop.simulation.batch import worker

FORCE, DURATION = 10.0, 10.0


def drawn(miss=0.0, h=1e-3, *, touching=True, off=None, touchdowns=(), sparse=False, wanted=FORCE):
    """Return the signals of ten seconds in which f is off by `miss`, a function of time or a number."""
    t = h * np.arange(round(DURATION / h) + 1)
    error = miss(t) if callable(miss) else np.full(t.size, miss)
    touch = np.broadcast_to(touching(t) if callable(touching) else touching, t.shape)
    f_des = np.full(t.size, wanted)
    way = None if off is None else np.outer(off(t), [1.0, 0.0, 0.0])
    return Signals(
        h, np.where(touch, f_des + error, 0.0), f_des, touch, f_des != 0.0, False, way, np.zeros((t.size, 3)),
        np.ones(t.size, dtype=bool), np.asarray(touchdowns, dtype=float), sparse,
    )  # fmt: skip


def told(signals, limited=None):
    """Return what is wrong."""
    return names_of(judge_control(signals, limited or {})[0])


def cycle(share, hertz=3.0, grows=0.0):
    """Return a swing of a share of the force, which it has at the end, and grows with a rate, 1/s."""
    return lambda t: share * FORCE * np.exp(grows * (t - DURATION)) * np.sin(2.0 * np.pi * hertz * t)


@pytest.mark.parametrize("h", [1e-3, 5e-3, 0.01])
@pytest.mark.parametrize(
    ("inside", "beyond", "name"),
    [
        (cycle(0.9 * SWING_SHARE), cycle(1.1 * SWING_SHARE), "oscillation"),
        (cycle(0.5 * SWING_SHARE, grows=0.5), cycle(2.0 * SWING_SHARE, grows=0.5), "oscillation"),
        (lambda t: 0.5 * FORCE * np.exp(-t) * np.sin(19.0 * t), lambda t: cycle(0.08)(t), "oscillation"),
        (lambda t: 0.95 * MEAN_SHARE * FORCE, lambda t: 1.05 * MEAN_SHARE * FORCE, "force_error"),
        (lambda t: -FORCE * np.exp(-t / 2.0), lambda t: -FORCE * np.exp(-t / 4.0), "not_settled"),
    ],
)
def test_force_from_both_sides_of_its_bounds(inside, beyond, name, h):
    """However far apart the rows are: a swing that lasts or grows, one that dies away, a constant error, a slow one."""
    fill = lambda of: lambda t: np.broadcast_to(of(t), t.shape)  # noqa: E731
    assert told(drawn(fill(inside), h)) == "good"
    assert name in told(drawn(fill(beyond), h))


def test_growing_and_lasting_swings_are_told_apart():
    """By the ratio of the swings at both ends; the instant is where the judged swing begins."""
    for grows, word in ((0.5, "grows"), (0.0, "limit cycle")):
        (problem,) = judge_control(drawn(cycle(0.12, grows=grows)), {})[0]
        assert problem["name"] == "oscillation"
        assert word in problem["text"]
        assert re.search(r"with 3(\.0\d)? Hz", problem["text"])
        assert DURATION / 2 <= problem["at"] < (DURATION - 1.0 if grows else DURATION / 2 + 1.0)


@pytest.mark.parametrize("share", [0.02, 0.05, 0.09])
def test_noise_is_no_swing_and_no_force_error(share):
    """Noise of up to nine tenths of the RMS bound, white and filtered."""
    rng = np.random.default_rng(7)
    assert share < RMS_SHARE
    white = rng.normal(size=10001)
    smooth = np.convolve(white, np.ones(20) / 20.0, mode="same")
    for noise in (white, smooth / np.std(smooth)):
        assert told(drawn(lambda t, noise=noise: share * FORCE * noise)) == "good"
    # and does not hide a swing beneath it
    assert "oscillation" in told(drawn(lambda t: cycle(0.4, 2.0)(t) + 0.02 * FORCE * white))


def test_contact_that_never_comes_is_lost_or_bounces():
    """Each from both sides; bounces of a touchdown, at its start, are none of the later half."""
    assert told(drawn(touching=False)) == "no_contact"
    assert told(drawn(touching=False, wanted=0.0)) == "good"
    end = DURATION * (1.0 - LOST_SHARE)
    assert told(drawn(touching=lambda t: t < 0.98 * end)) == "lost_contact"
    assert told(drawn(touching=lambda t: t < DURATION - 1e-2)) == "good"
    assert told(drawn(touchdowns=[0.1 * k for k in range(30)])) == "good"
    assert told(drawn(touchdowns=[6.0, 7.0])) == "good"
    (problem,) = judge_control(drawn(touchdowns=[1.0, 6.0, 7.0, 8.0]), {})[0]
    assert (problem["name"], problem["at"]) == ("bouncing", 6.0)


def test_what_is_after_the_time_commanded_or_where_nothing_leads_does_not_count():
    """Touchdowns after f_des has become zero, and the path of the rows that are led alone, however few."""
    half = drawn(touchdowns=[6.0, 7.0, 8.0])
    first = np.arange(half.wanted.size) * half.h < 5.5
    assert told(half._replace(wanted=FORCE * first, force=FORCE * first, commanded=first)) == "good"
    brief = np.arange(half.wanted.size) * half.h < 1.0
    for share, verdict in ((0.95, "good"), (1.05, "path_error")):
        off = drawn(off=lambda t, share=share: np.full(t.size, share * PATH_FLOOR))
        assert told(off._replace(led=brief)) == verdict


def test_path_and_saturation_from_both_sides():
    """RMS off the path, a swing about it, and torques cut."""
    assert told(drawn(off=lambda t: np.full(t.size, 0.95 * PATH_FLOOR))) == "good"
    assert told(drawn(off=lambda t: np.full(t.size, 1.05 * PATH_FLOOR))) == "path_error"
    assert told(drawn(off=lambda t: 0.45 * PATH_FLOOR * np.sin(9.0 * t))) == "good"
    assert told(drawn(off=lambda t: 0.6 * PATH_FLOOR * np.sin(9.0 * t))) == "oscillation"
    assert told(drawn(), {"J1": (0.99 * SATURATED_SHARE, 1.0)}) == "good"
    (problem,) = judge_control(drawn(), {"J1": (1.01 * SATURATED_SHARE, 1.5)})[0]
    assert (problem["name"], problem["at"]) == ("saturated", 1.5)


def test_sparse_rows_say_that_a_swing_is_not_known():
    """Rows 0.1 s apart of a scheme with steps of its own: a swing of 9 Hz would look like one of 1 Hz."""
    problems, unknown = judge_control(drawn(cycle(0.08, 9.0), 0.1, sparse=True), {})
    assert problems == []
    assert "oscillation" in unknown[0]
    changes = {"time.integrator": "dop853", "time.step": 0.1, "time.duration": 2.0}
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    facts = run.summary()
    assert facts["verdict"]["good"], facts["verdict"]
    assert facts["control_verdict"]["good"]
    assert "0.1 s apart" in facts["control_verdict"]["not_known"][0]


def test_a_gain_of_the_wrong_sign_is_bad_before_it_shows():
    """The path drifts by a tenth of a millimetre only in eight seconds, and doubles every eight; in a table too."""
    scenario = cl.load_scenario("wam_slide", {"law.kp": -5.0, "time.duration": 0.2})
    assert [p["name"] for p in cl.simulate(scenario).summary()["control_verdict"]["problems"]] == ["unstable"]


def test_a_path_off_the_surface_commands_no_contact(shipped_run):
    """Until it leads off, contact is commanded; where the path stays, a tip that leaves is at fault."""
    run = shipped_run("wam_liftoff")
    s = run_signals(run)
    assert s.commanded[1000]
    assert not s.commanded[1200:].any()
    stays = np.zeros(len(run))
    changed = signals_of(run.scenario, s.h, s.force, s.wanted, s.touching, (s.off, stays, s.tip), s.touchdowns)
    assert names_of(judge_control(changed, {})[0]) == "lost_contact"


def test_settling_is_found_between_rows(shipped_run):
    """Of an exponential the instant is within (h/τ)²/8 of a row's of the closed form, and not on a row."""
    run = shipped_run("wam_slide")
    h, tau = run.scenario.time.step, 0.05
    force = run.reference_force * (1.0 - np.exp(-run.time / tau))
    slow = dataclasses.replace(run, columns={**run.columns, "contact_force": force})
    exact = tau * np.log(50.0)
    assert slow.summary()["force_settled_at"] == pytest.approx(exact, abs=h * (h / tau))
    assert abs(exact / h - round(exact / h)) > 0.1


def test_a_tip_that_never_touches_may_be_in_any_pose(shipped_run):
    """Its mobility along the normal of a surface that it never touches is no singular pose."""
    run = shipped_run("wam_liftoff")
    free = run.mode == 0
    mobility = np.where(free, 0.0, run.normal_mobility)
    changed = dataclasses.replace(run, columns={**run.columns, "normal_mobility": mobility})
    assert changed.summary()["assumptions"]["nonsingular"]["held"]
    assert changed.summary()["verdict"]["good"]
    touching = np.where(free, run.normal_mobility, 0.0)
    assert not dataclasses.replace(run, columns={**run.columns, "normal_mobility": touching}).summary()["verdict"][
        "good"
    ]


def test_a_slow_swing_that_grows_is_seen_over_all_of_the_time():
    """Six periods, too few of them in the later half; the same swing dying away is none."""
    swing = lambda t: 0.09 * FORCE * np.sin(1.2 * np.pi * t)  # noqa: E731
    slow = lambda rate: lambda t: swing(t) * np.exp(rate * t - max(rate, 0.0) * DURATION)  # noqa: E731
    (problem,) = judge_control(drawn(slow(0.12)), {})[0]
    assert problem["name"] == "oscillation"
    assert "grows" in problem["text"]
    assert told(drawn(slow(-0.12))) == "good"


def test_a_swing_across_the_axes_counts_as_one_along_them():
    """The path's direction is not an axis of the base: the same swing, turned, is judged alike."""
    flat = drawn(off=lambda t: 0.6 * PATH_FLOOR * np.sin(9.0 * t))
    turned = flat._replace(off=flat.off @ np.array([[1.0, 1.0, 1.0]] * 3) / np.sqrt(3.0))
    assert told(turned) == told(flat) == "oscillation"


def test_contact_that_is_lost_for_long_and_comes_back():
    """A flight of a quarter of the time counts wherever it is, one of a tenth does not; touchdowns end flights."""
    away = lambda until: lambda t: (t < 1.0) | (t > until)  # noqa: E731
    (problem,) = judge_control(drawn(touching=away(3.5)), {})[0]
    assert (problem["name"], problem["at"]) == ("lost_contact", pytest.approx(1.0, abs=2e-3))
    assert told(drawn(touching=away(2.0))) == "good"
    assert told(drawn(touching=away(3.5), touchdowns=[2.0, 3.0])) == "good"


def test_a_tip_that_only_bounces_has_come_to_the_surface():
    """Impacts leave no row in contact: it is bouncing, and contact did come."""
    said = told(drawn(touching=False, touchdowns=[0.5 * k for k in range(1, 20)]))
    assert "bouncing" in said
    assert "no_contact" not in said


def test_a_flight_after_an_impact_is_a_bounce():
    """What is off the surface at the end, or for long, is lost after a liftoff and bounces after an impact."""
    away = lambda begin, until: lambda t: (t < begin) | (t > until)  # noqa: E731
    for until in (3.5, DURATION):
        (problem,) = judge_control(drawn(touching=away(1.0, until), touchdowns=[1.2]), {})[0]
        assert (problem["name"], problem["at"]) == ("bouncing", pytest.approx(1.2, abs=2e-3))
    assert told(drawn(touching=away(1.0, 3.5), touchdowns=[0.9])) == "lost_contact"
    assert told(drawn(touching=False, touchdowns=[0.5, 0.9])) == "bouncing"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "control"),
    [
        ("wam_bounce", {"impact.restitution": 0.95, "time.duration": 0.3}, {"bouncing"}),
        ("wam_bounce", {"impact.restitution": 0.95, "time.duration": 0.5}, {"bouncing"}),
        ("wam_bounce", {"impact.restitution": 0.95, "time.duration": 1.0}, {"bouncing", "force_error"}),
        ("panda_scan", {"law.kind": "admittance", "compliance.kind": "kelvin_voigt", "compliance.stiffness": 1e6},
         {"bouncing", "force_error"}),
        ("wam_slide", {"law.kp": -5.0}, {"unstable"}),
        ("wam_slide", {"force_profile.kind": "waypoints", "force_profile.times": [6.0, 6.05],
                       "force_profile.forces": [10.0, 15.0]}, {"good"}),
        ("wam_slide", {"reference.stop": 2.0}, {"good"}),
        ("wam_slide", {"drives.torque_limit": [60.0, 4.0, 4.0, 4.0]}, {"saturated", "path_error", "force_error"}),
        ("wam_liftoff", {}, {"good"}),
        ("wam_hybrid_friction", {}, {"good"}),
        ("wam_bounce", {}, {"good"}),
    ],
)  # fmt: skip
def test_simulated_runs(name, changes, control):
    """A force step, a dwell, a low torque limit, a release, bounces that end and bounces that do not."""
    problems = cl.simulate(cl.load_scenario(name, changes), progress=False).summary()["control_verdict"]["problems"]
    assert {p["name"] for p in problems} - {"force_error"} == control - {"good", "force_error"}


def test_lanes_say_what_a_summary_says(monkeypatch):
    """Good, a soft law off its path, a wrong sign: the column in lanes is the summary's text, and lanes it is."""
    lanes, told_in_lanes = [], worker.control_in_lanes

    def counted(runs, lane, *of_run):
        lanes.append(lane)
        return told_in_lanes(runs, lane, *of_run)

    monkeypatch.setattr(worker, "control_in_lanes", counted)
    changes = {
        "law.kp": [900.0, 0.1, -5.0, 900.0, 900.0],
        "law.force": [10.0, 10.0, 10.0, 2.0, 2.0],
        "law.kd": [30.0, 0.01, 30.0, 30.0, 3.0],
    }
    base = {"time.duration": 3.0, "reference.stop": 2.5}
    column = cl.simulate_batch(cl.load_scenario("wam_slide", base), changes, workers=1)["control_verdict"].to_pylist()
    rows = [dict(zip(changes, row, strict=True)) for row in zip(*changes.values(), strict=True)]
    alone = [cl.simulate(cl.load_scenario("wam_slide", base | row), progress=False).summary() for row in rows]
    assert column == [told_of(facts) for facts in alone]
    assert sorted(lanes) == [0, 1, 2, 3, 4]
    assert len(set(column)) > 2


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
def test_a_swing_that_is_too_slow_for_the_run_is_not_good(phase):
    """Of 3.2 periods it is not known whether they last; of six it is. Those that die away are a transient."""

    def swing(periods, decay=0.0):
        rate = 2.0 * np.pi * periods / DURATION
        return drawn(lambda t: 0.07 * FORCE * np.exp(-decay * t) * np.sin(rate * t + phase))

    problems, unknown = judge_control(swing(3.2), {})
    assert "oscillation" not in names_of(problems)
    (line,) = unknown
    assert re.fullmatch(
        r"oscillation: the force swings by ±0.\d+ N with 0.3\d* Hz, and 2 periods are too few: .*", line
    )
    assert "oscillation" in told(swing(6.3))
    for periods in (3.2, 6.3):
        problems, unknown = judge_control(swing(periods, decay=0.15), {})
        assert "oscillation" not in names_of(problems)
        assert not unknown


def test_strict_ends_with_5_where_only_the_control_is_bad(tmp_path):
    """4 is kept for the numbers; without --strict a bad control ends with 0."""
    from closedloop.run import main

    words = ["wam_slide", "--law.kp", "-5", "--time.duration", "0.2", "--no-figures", "--out", str(tmp_path / "r")]
    assert main([*words, "--strict"]) == 5
    assert main(words) == 0
