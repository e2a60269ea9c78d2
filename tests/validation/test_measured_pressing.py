"""The study of a robot that presses, on tests that the package makes itself in the form of the measured ones."""

import json
from dataclasses import replace

import numpy as np
import pytest

import closedloop as cl
from closedloop.base.errors import ModelError
from validation.measured.__main__ import main
from validation.measured.judged import BETTER, EQUAL, WORSE, Judged, paired
from validation.measured.pressing.__main__ import main as draw
from validation.measured.pressing.judging import (
    GOALS,
    Fit,
    compare,
    fits_of,
    force_mode,
    intervals,
    judge,
    measured_figures,
    repeats,
    residuals,
    sizes_of_differences,
)
from validation.measured.pressing.machine import (
    BAND,
    CONTACT,
    MACHINE,
    SIZES,
    ClosedLoopArm,
    Figures,
    MuJoCoArm,
    Touchdown,
    contact_time,
    figures,
    pose,
    read,
    scenario,
)

VALUES = {p.name: p.first for p in (*MACHINE, *CONTACT)}
NAMES = ("straight_F55_g1_v0.25", "straight_F35_g0.5_v0.10")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a file of two tests that the machine itself made, and a fit whose numbers made them."""
    folder, arrays = tmp_path_factory.mktemp("pressing"), {}
    for name in NAMES:
        place, force, gain, _ = name.split("_")
        test = Touchdown(name, place, float(force[1:]), float(gain[1:]), 0.25, 0.2, 3.2, np.zeros(0), np.zeros(0))
        time, force = ClosedLoopArm().simulate(VALUES, test)
        at = np.arange(-0.1, 3.3, 8e-4)
        speed = np.arange(-0.1, 3.3, 2e-3)
        arrays[f"{name}/force_measured"] = np.array([at, np.interp(at, time, force)])
        arrays[f"{name}/speed_measured"] = np.array([speed, np.full(len(speed), 0.2)])
    np.savez(folder / "made.npz", **arrays)
    mine = {"values": VALUES, "intervals": {n: (0.9 * x, 1.1 * x) for n, x in VALUES.items()}, "tests": [NAMES[0]]}
    (folder / "fit.json").write_text(json.dumps({"closedloop": mine}))
    return folder


def test_what_the_machine_made_is_predicted(made):
    """With the numbers that made it, every figure of the other test comes out, and the contract's keys are there."""
    out = made / "out.json"
    words = ["pressing", "--data", made / "made.npz", "--fitted", made / "fit.json", "--json", out]
    assert main([str(word) for word in words]) == 0
    numbers = json.loads(out.read_text())
    ours = numbers["closedloop"]
    assert (ours["tests"], list(ours["each"])) == (1, [NAMES[1]])
    for key, within in (("peak_percent", 1.0), ("frequency_percent", 1.0), ("settling_percent", 1.0)):
        assert ours[key] < within
    assert ours["mean_newton"] < 0.01
    assert numbers["poles"]["straight_F35_g0.5"]["frequency"] > 0.0


def test_a_wrong_number_is_seen(made):
    """A surface half as stiff strikes less: the residuals grow, and the interval of a number holds the true one."""
    test = read(made / "made.npz")[1]
    right = residuals(ClosedLoopArm(), VALUES, [test])
    wrong = residuals(ClosedLoopArm(), VALUES | {"stiffness_straight": 0.5 * VALUES["stiffness_straight"]}, [test])
    assert np.sum(right**2) < 0.05 < np.sum(wrong**2)
    low, high = intervals(ClosedLoopArm(), VALUES, [test])["mode_inertia"]
    assert low <= VALUES["mode_inertia"] <= high


def test_a_fit_is_written_and_names_its_tests(made, monkeypatch):
    """Where the file of the fit is not there, it is made from the tests to fit to, better than the first guess."""
    monkeypatch.setattr("validation.measured.pressing.judging.find_spec", lambda name: None)
    monkeypatch.setattr("validation.measured.pressing.judging.BUDGET", 0.5)
    path = made / "new.json"
    fits = fits_of(read(made / "made.npz"), made / "made.npz", path)
    assert fits["closedloop"]["tests"] == [NAMES[0]]
    assert json.loads(path.read_text())["closedloop"]["values"] == fits["closedloop"]["values"]
    assert fits_of([], made / "made.npz", path)["closedloop"]["cost"] == fits["closedloop"]["cost"]


def test_fits_to_halves_are_told(made, monkeypatch):
    """The table has what each half of the tests gives, and names a number in which they differ too much."""
    ten = {n: (0.9 * x, 1.1 * x) for n, x in VALUES.items()}

    def searched(engine, tests, told):
        late = 2.0 if [test.name for test in tests] == [NAMES[1]] else 1.0
        return Fit(VALUES | {"delay": late * VALUES["delay"]}, ten, 1.0, 1)

    monkeypatch.setattr("validation.measured.pressing.judging.find_spec", lambda name: None)
    monkeypatch.setattr("validation.measured.pressing.judging.TRAINING", NAMES)
    monkeypatch.setattr("validation.measured.pressing.judging.fit", searched)
    path = made / "halves.json"
    fits = fits_of(read(made / "made.npz"), made / "made.npz", path)
    fits["closedloop"]["tests"] = [NAMES[0]]
    path.write_text(json.dumps(fits))
    judged = judge(made / "made.npz", path)
    assert judged.numbers["closedloop"]["halves_differ"] == ["delay"]
    assert sum(line.endswith("halves differ") for line in judged.lines) == 1


def test_a_tip_that_sticks_makes_the_arm_stiffer():
    """The square of the swing's frequency at rest is as the stiffness along n, with the tip held sideways or not."""
    test = Touchdown(NAMES[0], "straight", 55.0, 1.0, 0.25, 0.2, 3.2, np.zeros(0), np.zeros(0))
    held = scenario(VALUES, test)
    poles = [
        min((p for p in cl.linearise(one, at=3.0).poles() if p.s.imag > 0.0 and p.participation.get("law", 0.0) > 0.4),
            key=lambda p: p.frequency)
        for one in (held, held.replace({"friction": {"kind": "none"}}))
    ]  # fmt: skip
    problem = cl.prepare(held)
    A = problem.frame @ problem.robot.terms(problem.q, np.zeros(6)).jacobian
    gives = 1.0 / SIZES * (1.0 / VALUES["joint_stiffness"] + 1.0 / VALUES["servo_stiffness"])
    compliance = A * gives @ A.T
    stiffer = np.linalg.inv(compliance)[0, 0] * compliance[0, 0]
    assert stiffer > 1.5
    assert (abs(poles[0].s) / abs(poles[1].s)) ** 2 == pytest.approx(stiffer, rel=0.15)


@pytest.mark.parametrize("gain", [0.5, 1.0])
def test_the_force_mode_is_found_from_its_own_log(gain, monkeypatch):
    """Mass, damper and lag are those that made the speed of the set point, whatever machine made the force."""
    monkeypatch.setattr("validation.measured.pressing.judging.LOST_BELOW", 0.0)  # this force has no noise
    test = Touchdown(NAMES[0], "straight", 55.0, gain, 0.25, 0.03, 2.5, np.zeros(0), np.zeros(0))
    run = cl.simulate(scenario(VALUES, test), progress=False)
    time = run.time - contact_time(run.time, run.contact_force)
    desired = np.array([time, np.abs(run.law_set_point_rate)])
    mass, damping, lag, missed = force_mode(replace(test, time=time, measured=run.contact_force, desired=desired))
    assert (mass, damping) == pytest.approx((VALUES["mode_inertia"], VALUES["mode_damping"]), rel=0.02)
    assert lag == pytest.approx(VALUES["delay"], rel=0.2)
    assert missed < 0.01


def test_the_map_and_the_figures_are_drawn(made, monkeypatch):
    """The force of each test, its scenario, and the map of the loop at rest, are written."""
    monkeypatch.setattr("validation.measured.pressing.figures.GAINS", np.array([0.5, 1.0]))
    monkeypatch.setattr("validation.measured.pressing.figures.STIFFNESSES", np.array([1.0, 10.0]))
    words = ["--data", made / "made.npz", "--fitted", made / "fit.json", "--figures", made, "--map", made / "map.png"]
    assert draw([str(word) for word in words]) == 0
    for name in (*NAMES, "map"):
        assert (made / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_figures_of_a_known_force():
    """A decaying swing: its peak, frequency, decay, settling time and mean are those of its formula."""
    t = np.arange(0.0, 4.0, 1e-4)
    force = 50.0 + 40.0 * np.exp(-2.0 * t) * np.sin(2.0 * np.pi * 5.0 * t)
    found = figures(t, force, 50.0, 3.0)
    assert found.frequency == pytest.approx(5.0, rel=0.02)
    assert found.decay == pytest.approx(2.0, rel=0.1)
    assert found.settling == pytest.approx(np.log(40.0 / 5.0) / 2.0, abs=0.1)
    assert found.mean == pytest.approx(50.0, abs=0.05)
    assert (found.losses, found.peak) == (0, pytest.approx(force[t < 0.06].max(), rel=1e-3))
    lost = np.where((t > 0.5) & (t < 0.6), 0.0, 50.0)
    assert (figures(t, lost, 50.0, 3.0).losses, figures(t, lost, 50.0, 3.0).lost) == (1, pytest.approx(0.1, abs=0.005))


def test_a_mean_is_not_read_as_a_swing():
    """Losses of contact at the ends of the window move its mean: the frequency is not the lower end of the band."""
    t = np.arange(0.0, 4.0, 8e-4)
    lost = (t < 0.3) | ((t > 1.1) & (t < 1.3))
    force = np.where(lost, 5.0, 55.0) + 10.0 * np.sin(2.0 * np.pi * 2.0 * t)
    assert figures(t, force, 55.0, 3.2).frequency > 1.2 * BAND[0]


def test_an_engine_is_better_or_worse_where_the_tests_agree():
    """Six kinds of tests that agree decide, five do not; repeats, and a figure that is not known, are no evidence."""
    agree = np.array([1.0, 2.0, 0.5, 1.5, 1.0, 3.0])
    assert paired(agree, np.zeros(6), range(6)).verdict == WORSE
    assert paired(np.zeros(6), agree, range(6)).verdict == BETTER
    assert paired(agree * [1, 1, 1, 1, 1, -1], np.zeros(6), range(6)).verdict == EQUAL
    five = paired(np.repeat(agree[:5], 4), np.zeros(20), np.repeat(range(5), 4).tolist())
    assert (five.verdict, five.confidence) == (EQUAL, 1.0 - 2.0 / 32)
    assert (five.mean, five.low, five.high) == (1.2, 0.5, 2.0)
    assert paired(np.append(agree, np.nan), np.zeros(7), range(7)) == paired(agree, np.zeros(6), range(6))
    assert paired(np.full(2, np.nan), np.zeros(2), range(2)).verdict == EQUAL


@pytest.mark.parametrize("kinds", [8, 24])
def test_the_interval_holds_the_true_difference(kinds):
    """In 95 % of the cases, of errors with heavy tails too, each test with a repeat that is as far off."""
    drawn = np.random.default_rng(1)
    held = 0
    for _ in range(400):
        size = np.repeat(0.3 + drawn.standard_t(2, kinds), 2)
        found = paired(size, np.zeros(2 * kinds), np.repeat(range(kinds), 2).tolist())
        held += found.low <= 0.3 <= found.high
    assert held / 400 == pytest.approx(0.95, abs=0.03)


def test_engines_are_compared_test_by_test():
    """An engine that is off by more in every figure is worse in each, and a fault; one that is off alike is equal."""
    t = np.arange(0.0, 3.3, 8e-4)
    swing = 40.0 * np.exp(-2.0 * t) * np.sin(2.0 * np.pi * 5.0 * t)
    tests = [Touchdown(f"{f:g}", "straight", f, 1.0, 0.25, 0.2, 3.2, t, f + swing) for f in np.linspace(40.0, 75.0, 8)]
    unsettled = replace(tests[0], name="unsettled", measured=tests[0].measured + 20.0)

    def off(share):
        found = [Figures(*(share * np.array(measured_figures(test)))) for test in (*tests, unsettled)]
        return sizes_of_differences([*tests, unsettled], found)

    for ours, peers, verdict in ((1.1, 1.2, BETTER), (1.2, 1.1, WORSE), (1.1, 1.1, EQUAL)):
        judged = Judged("", "")
        compare(judged, [*tests, unsettled], off(ours), off(peers))
        told = judged.numbers["paired"]
        assert {told[key]["verdict"] for key in GOALS} == {verdict}
        assert told["peak_percent"]["mean"] == pytest.approx(100.0 * (ours - peers))
        assert told["settling_percent"]["each"]["unsettled"] is None
        assert [fault.partition(" ")[0] for fault in judged.faults] == (list(GOALS) if verdict == WORSE else [])
        assert sum(line.endswith(verdict) for line in judged.lines) == len(GOALS)


def test_the_scatter_of_repeats_is_told():
    """Tests that come down alike scatter by the standard deviation of what was measured; others are no repeats."""
    t = np.arange(0.0, 3.3, 8e-4)
    force = 50.0 + 40.0 * np.exp(-2.0 * t) * np.sin(2.0 * np.pi * 5.0 * t)
    one = Touchdown("a", "straight", 50.0, 1.0, 0.25, 0.2, 3.2, t, force)
    judged = Judged("", "")
    repeats(judged, [one, replace(one, measured=1.04 * force), replace(one, gain=0.5, measured=2.0 * force)])
    told = judged.numbers["repeats"]
    assert told["peak_percent"] == pytest.approx(100.0 * 0.02 / 1.02 * np.sqrt(2.0))
    assert told["mean_newton"] == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert (told["frequency_percent"], judged.lines[-1][:41]) == (0.0, "2 measured tests are repeats of 1 kinds, ")
    repeats(judged, [one])
    assert judged.numbers["repeats"] == {}


def test_mujoco_has_the_same_machine():
    """Both engines settle at the commanded force, and their first peaks are alike."""
    test = Touchdown(NAMES[0], "straight", 55.0, 1.0, 0.25, 0.2, 3.2, np.zeros(0), np.zeros(0))
    found = [
        figures(*engine.simulate({p.name: p.first for p in engine.parameters}, test), 55.0, 3.2)
        for engine in (ClosedLoopArm(), MuJoCoArm())
    ]
    assert [one.mean for one in found] == pytest.approx([55.0, 55.0], abs=0.5)
    assert found[1].peak == pytest.approx(found[0].peak, rel=0.4)


def test_the_pose_points_the_tool_down():
    """The tip is at its place, and its speed at the start is the test's, straight down."""
    q, rates = pose("ramp")
    test = Touchdown("ramp_F15_g1_v0.10", "ramp", 15.0, 1.0, 0.1, 0.1, 3.2, np.zeros(0), np.zeros(0))
    assert scenario(VALUES, test).start.v == pytest.approx(0.1 * rates)
    assert q[1] < 0.0 < q[2]


@pytest.mark.parametrize(
    ("name", "arrays", "said"),
    [
        ("sideways_F15_g1_v0.10", {}, "must be PLACE_F"),
        ("ramp_F15_g1_v0.10", {"force_measured": np.zeros(3)}, r"force_measured: must be \(2, N\)"),
        ("ramp_F15_g1_v0.10", {"force_measured": np.zeros((2, 3)), "speed_measured": np.zeros((2, 3))}, "must rise"),
    ],
)
def test_what_is_no_test_is_said(tmp_path, name, arrays, said):
    """A name or an array of another form is refused in one line, and so is a study without its data."""
    arrays = arrays or {"force_measured": np.zeros((2, 3))}
    np.savez(tmp_path / "x.npz", **{f"{name}/{key}": value for key, value in arrays.items()})
    with pytest.raises(ModelError, match=said):
        read(tmp_path / "x.npz")
    with pytest.raises(ModelError, match="give them, --data"):
        judge()
