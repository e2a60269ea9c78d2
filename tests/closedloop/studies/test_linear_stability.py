"""Where the force loop becomes unstable: closed forms, and whole runs on both sides."""

import math
from dataclasses import replace

import numpy as np
import pytest
from linear_loops import DAMPING, MASS, STIFFNESS, mass_on_a_spring

import closedloop as cl
from closedloop.mechanics.loops.assemble import errors_at
from closedloop.simulation.parts import Cache
from closedloop.studies.analysis import stability
from closedloop.studies.analysis.here import Here
from closedloop.studies.analysis.linear_loop import margins_of
from closedloop.studies.analysis.page import overview, page_of
from closedloop.studies.analysis.stability import Range, Stability


def limit_of(k, c=DAMPING, m=MASS):
    """Return the integral gain at which m s³ + (k + c s)(s + K) has roots on the axis."""
    return c * k / (m * k - c * c)


@pytest.fixture(scope="module")
def study():
    """Return the study of a mass on a spring under an integral law, continuous."""
    return Stability(mass_on_a_spring())


def test_limit_of_a_gain(study):
    """The boundary is K = c k/(m k − c²), to 1e-9, and its pole oscillates at the frequency of the closed form."""
    (limit,), refused = study.limits(Range("law.force_integral", 5.0, 80.0))
    assert limit.value == pytest.approx(limit_of(STIFFNESS), rel=1e-9)
    assert limit.upwards
    assert not refused
    assert limit.pole.part == "contact"
    assert abs(limit.pole.z) == pytest.approx(1.0, abs=1e-9)


def test_limit_below_which_it_is_unstable(study):
    """With too little damping of the surface the loop is unstable: the limit is one downwards."""
    (limit,), _ = study.limits(Range("compliance.damping", 10.0, 60.0), {"law.force_integral": 20.0})
    k = STIFFNESS  # K (m k − c²) = c k
    wanted = (-k + (k * k + 4.0 * 20.0**2 * MASS * k) ** 0.5) / (2.0 * 20.0)
    assert limit.value == pytest.approx(wanted, rel=1e-8)
    assert not limit.upwards


def test_the_search_goes_on_behind_values_without_a_linear_loop(study, monkeypatch):
    """Such values are named once, with the first of them and why, and the limit behind them is found."""
    growth = study.growth

    def refusing(values):
        if 6.0 < values["law.force_integral"] < 15.0:
            raise cl.SimulationError("linearise: no loop", 0.0)
        return growth(values)

    monkeypatch.setattr(study, "growth", refusing)
    (limit,), refused = study.limits(Range("law.force_integral", 5.0, 80.0))
    assert limit.value == pytest.approx(limit_of(STIFFNESS), rel=1e-9)
    assert refused == "law.force_integral = 8.125: linearise: no loop"
    found = study.boundary(Range("law.force_integral", 5.0, 80.0), Range("law.force", 9.0, 10.0), 2)
    assert [each.value for _, each in found] == pytest.approx([limit_of(STIFFNESS)] * 2, rel=1e-9)


def test_a_drive_at_its_limit_does_not_end_a_search():
    """At forces that the drive cannot hold there is no linear loop: the least of them is named, with why."""
    study = Stability(cl.load_scenario("wam_slide", {"time.duration": 1.0, "drives.torque_limit": 10.0}))
    limits, refused = study.limits(Range("law.force", 5.0, 100.0))
    assert limits == []
    assert refused.startswith("law.force = 32.71: linearise: the drive of joint J2 is at its limit at t = 0.5 s")
    assert refused.count("at its limit") == 1


def test_boundary_over_two_keys(study, monkeypatch):
    """Over three decades of stiffness the limit of the gain is the closed form, in order, by two processes."""
    begun = []

    class Counted(stability.Beside):
        def __init__(self, work):
            begun.append(work)
            super().__init__(work)

    monkeypatch.setattr(stability, "Beside", Counted)
    monkeypatch.setattr(stability, "SHARED", 3)
    monkeypatch.setattr(stability, "possible", lambda: True)
    along = Range("compliance.stiffness", 2.5e3, 2.5e6, log=True)
    found = study.boundary(Range("law.force_integral", 5.0, 80.0), along, 3, tolerance=1e-9)
    assert len(begun) == 1
    assert [value for value, _ in found] == [along.at(share) for share in (0.0, 0.5, 1.0)]
    for stiffness, limit in found:
        assert limit.value == pytest.approx(limit_of(stiffness), rel=1e-6)


@pytest.mark.parametrize("scheme", ["semi_implicit_euler", "dop853"])
def test_whole_runs_on_both_sides(scheme):
    """Ten per cent below and above the limit two nonlinear runs go together, and apart, as fast as the linear loop.

    With an integrator that chooses its steps they are runs by rk4.
    """
    scenario = mass_on_a_spring(time__integrator=scheme, time__duration=3.0, sensor__delay=0.002)
    study = Stability(scenario, at=0.1)
    (limit,), _ = study.limits(Range("law.force_integral", 5.0, 80.0))
    below, above = study.try_beside(limit)
    for trial in (below, above):
        assert trial.agrees
        assert trial.seen == pytest.approx(trial.expected, rel=0.1, abs=0.05)
    assert below.seen < 0.0 < above.seen


@pytest.mark.parametrize(
    ("name", "stiffness", "damping", "delay", "filtered", "key"),
    [
        # slower modes, which die out, are larger than the pole's; and the posture changes on the way
        ("wam_hybrid_friction", 71180.5161867733, 42.333197623698176, 0.0, 0.0, "compliance.stiffness"),
        ("wam_hybrid_friction", 11848.417845888322, 51.64270411909851, 0.0, 0.0, "law.force_integral"),
        # a pole at half the sampling rate: the runs are far apart, or together but for rounding, at once
        ("wam_slide", 5450.71565116077, 247.00746615434622, 0.0, 0.01, "compliance.stiffness"),
        ("soft_table", 4783.705160192941, 292.8834460533829, 0.005, 0.0, "compliance.stiffness"),
    ],
)
def test_whole_runs_agree_whatever_else_moves(name, stiffness, damping, delay, filtered, key):
    """Drawn at random: each was said to disagree, by runs whose distance was not that of the pole."""
    changes = {"compliance": {"kind": "kelvin_voigt", "stiffness": stiffness, "damping": damping}}
    changes |= {"sensor.delay": delay, "sensor.filter_time_constant": filtered}
    if name == "soft_table":
        changes["surface"] = {"contact": "unilateral"}
    study = Stability(cl.load_scenario(name, changes))
    limits, _ = study.limits(
        Range(key, 1.0 if key.startswith("law") else 1e3, 5e3 if key.startswith("law") else 1e7, True)
    )
    trials = [trial for limit in limits for trial in study.try_beside(limit)]
    assert trials
    assert all(trial.agrees for trial in trials)


@pytest.mark.parametrize(
    ("gain", "delay", "phase"), [(2.0, 0.0, 60.0), (2.0, 0.05, 60.0 - math.degrees(0.05 * math.sqrt(3.0))),
                                 (2.0, 1.25, math.degrees(1.25 * math.sqrt(3.0)) - 60.0)],
)  # fmt: skip
def test_the_nearest_phase_margin_is_on_either_side(gain, delay, phase):
    """Of L = K e^(−T s)/(1 + s) the phase at |L| = 1, ω = √3, is −60° − T ω: beyond −180° the nearest is the lead.

    A lag of T may grow by the whole turn less that.
    """
    grid = np.linspace(0.01, 1.0, 4000)

    def transfer(f):
        s = 2j * np.pi * np.asarray(f)
        return gain * np.exp(-delay * s) / (1.0 + s)

    margins = margins_of(transfer, grid, "sensor", True)
    rate = math.sqrt(gain * gain - 1.0)
    ahead = (math.pi - math.atan(rate) - delay * rate) % (2.0 * math.pi)
    assert margins.phase == pytest.approx(math.degrees(min(ahead, 2.0 * math.pi - ahead)), rel=1e-6)
    assert margins.phase_at == pytest.approx(rate / (2.0 * math.pi), rel=1e-6)
    assert margins.delay == pytest.approx(ahead / rate, rel=1e-6)


@pytest.mark.parametrize("stiffness", [1e2, 1e6])
def test_a_tip_is_moved_into_a_surface_that_would_not_carry_it_where_it_is(stiffness):
    """Of a contact that only pushes, a biased sensor and four decades of stiffness each has a loop, with the same f."""
    study = Stability(
        cl.load_scenario("wam_hybrid_friction", {
            "compliance.kind": "kelvin_voigt", "surface.contact": "unilateral", "sensor.bias": 0.2,
        })
    )  # fmt: skip
    problem, moved = study._at({"compliance.stiffness": stiffness})
    assert Here(problem, moved)()["f"][0] == pytest.approx(study._instant.force, rel=1e-3)
    assert (study.growth({"compliance.stiffness": stiffness}) > 0.0) == (stiffness == 1e6)


@pytest.mark.slow
def test_whole_runs_beside_the_boundary_of_a_shipped_scenario():
    """With friction, an observer and a moving arm: three stiffnesses, on both sides unless the posture changes that."""
    study = Stability(cl.load_scenario("wam_hybrid_friction", {"compliance.kind": "kelvin_voigt"}), at=3.0)
    found = study.boundary(
        Range("law.force_integral", 1.0, 300.0), Range("compliance.stiffness", 3e4, 1e6, log=True), 3
    )
    assert len(found) == 3
    trials = [study.try_beside(limit, {"compliance.stiffness": stiffness}) for stiffness, limit in found]
    assert all(trial.agrees for pair in trials for trial in pair)
    assert sum(len(pair) == 2 and pair[0].expected < 0.0 < pair[1].expected for pair in trials) >= 2


@pytest.mark.slow
def test_page_of_a_stable_loop(study):
    """The first line is a sentence with margins and limits, and the gain margin leads to the limit of the gain."""
    page = page_of(study)
    limit = limit_of(STIFFNESS)
    assert page.sentence().startswith("stable; 3.1 dB and ")
    assert f"law.force_integral above {limit:.3g} 1/s makes it unstable" in page.sentence()
    assert page.limits["law.force_integral"].value == pytest.approx(limit, rel=1e-6)
    assert 20.0 * page.margins["sensor"].gain == pytest.approx(limit, rel=0.02)
    assert page.lines()[0] == page.sentence()
    assert page.delay == pytest.approx(page.margins["sensor"].delay, abs=3 * 0.0005)  # sampled, the reading is older


def test_page_without_feedback():
    """Where nothing is fed back no margin is said: of a mechanism with no freedom left, and of bodies alone."""
    page = page_of(Stability(cl.load_scenario("four_bar")))
    assert page.sentence() == "stable; nothing is fed back"
    assert "belongs to" not in "".join(page.lines())
    page = page_of(Stability(cl.load_scenario("ball_on_turntable"), 0.3))
    assert page.sentence().startswith("unstable: a motion that nothing controls oscillates at ")


def test_page_of_a_loop_that_bears_every_delay(study):
    """What has no limit is said in words, and is null in JSON, which has no infinity."""
    page = page_of(study, limits=False)
    page.delay, page.tried = np.inf, 0.512
    assert page.lines()[-1] == "sensor.delay: no limit up to 0.512 s"
    assert page.as_dict()["longest_delay"] is None


@pytest.mark.slow
def test_a_limit_beyond_which_there_are_no_runs_is_no_contradiction():
    """The line of a key says that the loop is stable where it can be run, and then why other values are refused."""
    page = page_of(Stability(cl.load_scenario("soft_table", {"time.duration": 1.0}), 0.5))
    (line,) = [each for each in page.lines() if each.startswith("compliance.stiffness: ")]
    assert line.startswith(
        "compliance.stiffness: stable at all values that can be run; others are refused: compliance: "
    )


def test_page_of_an_unstable_loop():
    """It says what grows, how fast, and below which gain it does not."""
    page = page_of(Stability(mass_on_a_spring(gain=40.0), at=0.005))
    assert page.sentence().startswith("unstable: a mode, mostly of the contact, oscillates at 12.6 Hz and grows")
    assert f"; law.force_integral below {limit_of(STIFFNESS):.3g} makes it stable" in page.sentence()
    assert page.as_dict()["longest_delay"] is None


def test_margins_of_an_integral_with_a_delay():
    """Of L = K exp(−s τ)/s: phase margin π/2 − K τ at K rad/s, delay margin π/(2 K) − τ, gain margin π/(2 K τ)."""
    K, late = 10.0, 0.03

    def transfer(f):
        s = 2j * np.pi * np.atleast_1d(f)
        return K * np.exp(-s * late) / s

    found = margins_of(transfer, np.geomspace(1e-2, 100.0, 2000), "sensor", True)
    assert found.gain == pytest.approx(np.pi / (2.0 * K * late), rel=1e-9)
    assert found.phase == pytest.approx(np.degrees(np.pi / 2.0 - K * late), rel=1e-9)
    assert found.phase_at == pytest.approx(K / (2.0 * np.pi), rel=1e-9)
    assert found.delay == pytest.approx(np.pi / (2.0 * K) - late, rel=1e-9)
    assert found.least_gain == 0.0
    least = np.min(np.abs(1.0 + transfer(np.linspace(1.0, 8.0, 20001))))
    assert found.peak_sensitivity == pytest.approx(1.0 / least, rel=1e-6)


def test_a_gain_that_may_only_fall_has_its_margin_in_decibels():
    """Of L = K (1 + s)²/s³ the phase at 1 rad/s is −180°, where |L| = 2 K: K may fall by that, and rise at will."""

    def transfer(f):
        s = 2j * np.pi * np.atleast_1d(f)
        return 2.0 * (1.0 + s) ** 2 / s**3

    found = margins_of(transfer, np.geomspace(1e-3, 100.0, 3000), "sensor", True)
    assert (found.gain, found.least_gain) == (math.inf, pytest.approx(0.25, rel=1e-9))
    assert found.decibels == pytest.approx(20.0 * math.log10(4.0), rel=1e-9)
    assert found.as_dict()["decibels"] == found.decibels
    risen = replace(found, gain=2.0)
    assert risen.decibels == pytest.approx(20.0 * math.log10(2.0), rel=1e-9)


@pytest.mark.parametrize("gain", [0.5, 4.0])
def test_at_half_of_the_sampling_rate_a_sampled_loop_is_real(gain):
    """L = K/(z − 1) reaches −K/2 there alone: K may rise by 2/K, or has to fall by it."""
    h = 1e-3
    grid = np.linspace(1.0, 0.5 / h * (1.0 - 1e-9), 4000)
    found = margins_of(lambda f: gain / (np.exp(2j * np.pi * h * np.atleast_1d(f)) - 1.0), grid, "sensor", gain < 2.0)
    assert (found.gain, found.least_gain) == (
        (pytest.approx(4.0, rel=1e-6), 0.0) if gain < 2.0 else (math.inf, pytest.approx(0.5, rel=1e-6))
    )
    assert math.isnan(found.gain_at) if gain > 2.0 else found.gain_at == grid[-1]


def test_both_gains_of_a_late_sensor_may_rise_by_the_gain_margin():
    """With low-pass, delay and samples of 2 ms: all that is fed back, larger by the gain margin, oscillates."""
    law = {"kind": "paper", "kp": [100, 100, 0], "kd": [20, 20, 0], "force_integral": 3.0, "force_feedback": 0.05}
    sensor = {"delay": 0.004, "filter_time_constant": 0.006}
    study = Stability(mass_on_a_spring(law=law | {"sample_period": 0.002}, sensor=sensor, time__step=0.002))
    gain = study.base.margins().gain
    rise = {"law.force_integral": 3.0 * gain, "law.force_feedback": 0.05 * gain}
    assert study.loop(rise).radius == pytest.approx(1.0, abs=1e-6)


def test_an_observer_takes_away_a_torque_that_it_is_not_told_of():
    """In time the force forgets a constant torque on a joint; without the observer it does not."""
    left = []
    for changes in ({}, {"compensation.kind": "observer", "compensation.rate": 50.0}):
        loop = cl.linearise(cl.load_scenario("wam_slide", {"time.duration": 3.0, **changes}), at=2.0)
        left.append(abs(loop.response("torque[J2]", duration=3.0)[1][-1]))
    assert left[1] < 1e-3 * left[0]


def test_another_stiffness_carries_the_same_force():
    """On Hertz's surface f = k δ^1.5 the tangent stiffness at 10 N is 1.5 k^(2/3) f^(1/3): the frequency shows it."""
    scenario = mass_on_a_spring(gain=0.0, compliance={"kind": "hunt_crossley", "stiffness": 1e6, "dissipation": 0.1})
    study = Stability(scenario)
    for k in (1e6, 3e7):
        (pair, _) = [pole for pole in study.loop({"compliance.stiffness": k}).poles() if pole.part == "contact"]
        tangent = 1.5 * k ** (2.0 / 3.0) * 10.0 ** (1.0 / 3.0)
        assert 2.0 * np.pi * pair.frequency == pytest.approx((tangent / MASS) ** 0.5, rel=1e-6)


def test_the_tip_of_a_mechanism_is_put_deeper_with_its_loops_closed():
    """Rows of the loops of four_bar depend on others: on a softer surface its tip is as deep as it must be."""
    soft = {"compliance.kind": "kelvin_voigt", "compliance.stiffness": 2e4, "compliance.damping": 400.0}
    study = Stability(cl.load_scenario("four_bar", {"time.duration": 0.4, "time.integrator": "rk4"} | soft))
    problem, there = study._at({"compliance.stiffness": 5e3})
    here = Here(problem, there)
    rows = here.loop_rows(there.values["q"])[0]
    assert np.linalg.matrix_rank(rows) < rows.shape[0]
    assert -here()["gap"][0] == pytest.approx(study._instant.force / 5e3, rel=1e-9)
    error, _ = errors_at(problem.robot, here._loops, there.values["q"], np.zeros(problem.robot.n))
    assert np.max(np.abs(error)) < 1e-12


@pytest.mark.parametrize(("name", "cut"), [("soft_table", "sensor"), ("wam_slide", "torque")])
def test_overview_is_the_page_without_limits(name, cut):
    """Sentence, margins and poles are those of the page, and its curves go through the margins, with a cache too."""
    scenario = cl.load_scenario(name, {"law.force_integral": 20.0} if name == "soft_table" else {})
    page, seen = page_of(Stability(scenario, 3.0), limits=False), overview(cl.linearise(scenario, 3.0))
    assert seen.sentence == page.sentence()
    assert seen.margins == page.weakest
    assert seen.margins.cut.startswith(cut)
    assert seen.poles == page.loop.poles()
    assert (np.diff(seen.frequency) > 0.0).all()
    assert len({len(each) for each in (seen.frequency, seen.transfer, seen.gain, seen.phase, seen.sensitivity)}) == 1
    assert np.interp(seen.margins.phase_at, seen.frequency, seen.gain) == pytest.approx(0.0, abs=0.1)
    assert np.max(seen.sensitivity) == pytest.approx(seen.margins.peak_sensitivity, rel=1e-3)
    cache = Cache()
    again = [overview(cl.linearise(scenario, 3.0, cache=cache)) for _ in range(2)]
    assert all(np.array_equal(each.transfer, seen.transfer) for each in again)
