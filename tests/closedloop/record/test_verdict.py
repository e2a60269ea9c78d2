"""The verdict of a run: nonsense of each kind is named, in the report, in JSON and in a table; good runs are good."""

import dataclasses
import json

import numpy as np
import pytest
from pyarrow import parquet

import closedloop as cl
import robot_models
from closedloop.command.sweep import main as run_sweeps
from closedloop.record.report import print_report
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES, Values, alternation
from closedloop.record.report.summary import joint_measures
from closedloop.record.report.verdict import (
    Facts,
    energy_bound,
    judge,
    names_of,
    probable_reason,
    verdict_of,
    verdicts_of,
)

SHORT = {"time.duration": 0.65}
COARSE = {"time.step": 0.05, "time.integrator": "semi_implicit_euler", "stabiliser.time_constant": "auto"}
# Scenario, what makes nonsense of it, and what must be named; where `only`, nothing else.
PLANTED = {
    "good": ("wam_slide", SHORT, ["good"], True),
    "gains": ("wam_slide", SHORT | {"law.kd": [60.0, 60.0, 30.0, 290.0]}, ["gains", "energy", "chatter"], False),
    # Its step of 50 ms gets the law's decay of 38 1/s wrong by its own size, which is why energy is missing.
    "energy": ("planar2_drop", COARSE | {"law.kd": 2.0}, ["energy", "resolution"], True),
    "effort": ("wam_slide", SHORT | {"law.force": 200.0}, ["effort_limit"], True),
    "limits": ("planar2_drop", {"start.v": [5.0, -15.0]}, ["position_limit", "velocity_limit"], True),
    "chatter": ("wam_bounce", {"time.integrator": "explicit_euler"}, ["chatter"], True),
    "closure": (
        "wam_slide_unstabilised",
        {"reference.speed": 0.1, "reference.stop": 1.5, "time.step": 0.01, "time.duration": 1.5, "law.kp": 100.0,
         "law.kd": [5.0, 5.0, 1.0, 1.0]},
        ["closure"], True,
    ),
    "contact": ("wam_slide", SHORT | {"law.force": 1.0, "reference.stop": 0.6}, ["contact_kept"], True),
    "singular pose passed": ("wam_through_singularity", {"time.duration": 0.62}, ["good"], True),
    "end in a singular pose": ("wam_through_singularity", {"time.duration": 0.6}, ["nonsingular"], True),
}  # fmt: skip


def names(run):
    """Return the names of what is wrong with a run."""
    return list(dict.fromkeys(problem["name"] for problem in run.summary()["verdict"]["problems"]))


@pytest.mark.parametrize("kind", PLANTED)
def test_planted_nonsense_is_named_everywhere(kind, capsys):
    """The first line of the report, the JSON and the column of a table name it, and the three agree."""
    name, changes, expected, only = PLANTED[kind]
    scenario = cl.load_scenario(name, changes)
    try:
        run = cl.simulate(scenario, engine="compiled")
    except cl.SimulationError as stopped:
        run = stopped.run
    verdict = json.loads(json.dumps(run.summary(), allow_nan=False))["verdict"]
    told = [problem["name"] for problem in verdict["problems"]] or ["good"]
    assert verdict["good"] == (told == ["good"])
    assert set(expected) <= set(told)
    assert not only or set(expected) == set(told)
    capsys.readouterr()
    print_report(run, width=80)
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("verdict: good" if verdict["good"] else "verdict: BAD: ")
    assert all(word in first for word in expected)
    table = cl.simulate_batch(scenario, {"surface.normal": [scenario.surface.normal]}, workers=1)
    assert table["verdict"].to_pylist() == [names_of(verdict["problems"])]
    for key, column in joint_measures(run).items():
        mine = [np.nan if x is None else x for x in table[key][0].as_py()]
        assert mine == pytest.approx(column.tolist(), rel=1e-12, abs=1e-15, nan_ok=True), key


def facts(changes=None, name="wam_slide", **own):
    """Return what a good run is judged by, with some of it replaced."""
    scenario, model = cl.load_scenario(name, changes or {}), robot_models.load("wam4")
    measures = dict.fromkeys(MEASURES, 0.0) | {"energy_exchanged": 1.0}
    joints = {key: [np.nan if key.endswith("_at") else 0.0] * 4 for key in JOINT_MEASURES}
    measures |= {key: own.pop(key) for key in list(own) if key in MEASURES}
    joints |= {key: own.pop(key) for key in list(own) if key in JOINT_MEASURES}
    whole = Facts(scenario, model, None, 8000, measures, 0, {}, joints)
    return whole._replace(**own)


def told(given, gains=""):
    """Return the names of what is wrong."""
    return names_of(judge(given, lambda: gains))


@pytest.mark.parametrize(
    ("own", "inside", "beyond", "name"),
    [
        ("max_energy_residual", 0.099, 0.101, "energy"),
        ("force_chatter", 0.049, 0.051, "chatter"),
        ("torque_chatter", [0, 0, 0.049, 0], [0, 0, 0.051, 0], "chatter"),
        ("events", 400, 401, "chatter"),
        ("max_abs_closure_error", 0.99e-4, 1.01e-4, "closure"),
        ("deepest_penetration", 0.99e-4, 1.01e-4, "closure"),
        ("position_limit_left_at", [np.nan] * 4, [np.nan, 0.5, np.nan, np.nan], "position_limit"),
        ("velocity_limit_exceeded_at", [np.nan] * 4, [np.nan, 0.5, np.nan, np.nan], "velocity_limit"),
        ("effort_limit_exceeded_at", [np.nan] * 4, [np.nan, 0.5, np.nan, np.nan], "effort_limit"),
        ("torque_limited_share", [0, 0, 0.5, 0], [0, 0, 0.51, 0], "saturation"),
        ("failed", {}, {"nonsingular": (0.5, "")}, "nonsingular"),
        ("stopped", None, "stopped at t = 1 s", "stopped"),
    ],
)
def test_every_bound_from_both_sides(own, inside, beyond, name):
    """Just within a bound a run is good, just beyond it is not, for that reason alone."""
    assert told(facts(**{own: inside})) == "good"
    assert told(facts(**{own: beyond})) == name


def test_one_row_that_did_not_converge_is_not_good():
    """Of contacts of links; without any there is no such number."""
    contact = {"contact": [{"link": "link3", "at": [0.0, 0.0, 0.0]}]}
    assert told(facts(contact)) == "good"
    assert told(facts(contact, rows_not_converged=1.0)) == "convergence"
    assert told(facts(contact, rows_not_converged=np.nan)) == "convergence"
    assert told(facts(rows_not_converged=np.nan)) == "good"


@pytest.mark.parametrize("figure", ["max_energy_residual", "force_chatter", "max_abs_closure_error"])
@pytest.mark.parametrize("value", [None, np.nan, np.inf])
def test_what_is_missing_never_passes(figure, value):
    """A value that does not exist, or is no number, is judged bad."""
    assert told(facts(**{figure: value})) != "good"


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e3, 0.0, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("rest", [1e-7, 1.0])
def test_runs_of_one_set_are_judged_as_alone(rest, value):
    """Any value of any run of eight may be good or bad: the verdicts of the set are those of its runs, each alone."""
    robot, n = cl.Robot(robot_models.load("wam4"), "tip"), 4
    scenarios, said = [cl.load_scenario("wam_slide")] * 8, [[]] * 8
    good = np.zeros(Values.count(n))
    one = Values(good, n)
    one.failed_at[:], one.energy_exchanged, one.max_kinetic_energy, one.max_energy_residual = np.nan, 1.0, rest, 0.05
    one.max_abs_closure_error, one.start_closure_error = 1.5e-4, 1e-4
    for name in JOINT_MEASURES:
        getattr(one, name)[:] = np.nan if name.endswith("_at") else 0.0
    assert verdicts_of(scenarios, robot, np.tile(good, (8, 1)), 8000, said) == ["good"] * 8
    several = set()
    for at in range(good.size):
        if len(MEASURES) <= at < Values.place("failed_at", n).start and not np.isfinite(value):
            continue  # how many events there were is a number
        values = np.tile(good, (8, 1))
        values[3, at] = value
        alone = [verdict_of(scenario, robot, own, 8000) for scenario, own in zip(scenarios, values, strict=True)]
        assert verdicts_of(scenarios, robot, values, 8000, said) == alone, at
        several |= set(alone)
    assert len(several) > 2
    said[7] = ["a line"]
    assert verdicts_of(scenarios, robot, np.tile(good, (8, 1)), 8000, said) == ["good"] * 7 + ["resolution"]


def test_a_better_integrator_must_leave_less():
    """Order two and more: a hundredth, but where the power jumps, at events and held torques, a tenth again."""
    assert energy_bound(facts()) == pytest.approx(0.1)
    rk4 = {"time.integrator": "rk4"}
    assert energy_bound(facts(rk4)) == pytest.approx(0.01)
    assert energy_bound(facts(rk4, events=1)) == pytest.approx(0.1)
    assert energy_bound(facts(rk4 | {"law.sample_period": 0.002})) == pytest.approx(0.1)
    assert energy_bound(facts(energy_exchanged=0.0)) == pytest.approx(1e-6)
    assert energy_bound(facts(energy_lost_to_friction=2.0, max_kinetic_energy=3.0)) == pytest.approx(0.6)


def test_gains_are_named_where_they_show():
    """Gains that the step cannot carry are no fault of a run in which nothing shakes, and come first where it does."""
    assert told(facts(), "law.kd is too large") == "good"
    assert told(facts(failed={"contact_kept": (0.1, "")}), "law.kd is too large") == "contact_kept"
    assert told(facts(force_chatter=0.3), "law.kd is too large") == "gains, chatter"
    assert told(facts(stopped="why", steps=-1), "law.kd is too large") == "gains, stopped"


@pytest.mark.parametrize(
    ("law", "reason"),
    [({"law.kp": 3e5}, "the gains are too high for this step"), ({"law.kd": -30.0}, "the motion diverges")],
)
def test_an_instability_is_the_reason_in_the_first_line(law, reason, capsys):
    """Of gains too high for the step, of a motion that diverges, and of an oscillation; not of a limit alone."""
    with pytest.raises(cl.DivergenceError) as caught:
        cl.simulate(cl.load_scenario("wam_slide", law | {"time.duration": 1.0}))
    print_report(caught.value.run)
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("verdict: BAD: ")
    assert first.endswith(f"(probably unstable: {reason})")
    assert probable_reason([{"name": name, "text": ""} for name in ("energy", "chatter")]).endswith("from step to step")
    assert probable_reason([{"name": name, "text": ""} for name in ("energy", "velocity_limit")]) == ""


def test_a_start_off_the_surface_is_no_closure_error():
    """A closure that starts 0.9 mm off comes to the surface from there; the bound is beyond what it started with."""
    assert told(facts(start_closure_error=9e-4, max_abs_closure_error=9e-4)) == "good"
    assert told(facts(start_closure_error=-9e-4, deepest_penetration=9e-4)) == "good"
    assert told(facts(start_closure_error=9e-4, max_abs_closure_error=1.01e-3)) == "closure"


def test_limits_are_told_by_joint(shipped_run):
    """Each joint beyond a limit has a line with its largest value, the limit and when it first was."""
    run = shipped_run("wam_slide")
    q, v, torque = (run.columns[name].copy() for name in ("q", "v", "torque"))
    q[2000:2100, 1] = run.model.position_upper[1] + 0.25
    v[3000, [0, 3]] = -2.5, 6.0
    torque[4000:, 2] *= 1e3
    flawed = dataclasses.replace(run, columns={**run.columns, "q": q, "v": v, "torque": torque})
    summary = flawed.summary()
    limits = [p for p in summary["verdict"]["problems"] if p["name"].endswith("_limit")]
    assert [(p["name"], p["at"]) for p in limits[:3]] == [
        ("position_limit", pytest.approx(2.0)), ("velocity_limit", pytest.approx(3.0)),
        ("velocity_limit", pytest.approx(3.0)),
    ]  # fmt: skip
    assert limits[0]["text"] == "joint J2 is up to 0.25 rad beyond its limits [-1.97222, 1.97222]"
    assert limits[1]["text"] == "joint J1 moves with up to 2.5 rad/s, its limit is 2.39"
    assert summary["joints"]["J2"]["position_excess"] == pytest.approx(0.25)
    assert summary["joints"]["J2"]["position_limit_left_at"] == pytest.approx(2.0)
    assert summary["joints"]["J1"]["position_limit_left_at"] is None
    assert summary["joints"]["J4"]["max_joint_velocity"] == 6.0
    assert run.summary()["joints"]["J2"]["position_excess"] == 0.0


def test_alternation_is_the_amplitude_of_what_alternates():
    """Of 5 ± 0.3 it is 0.3 a row, whatever bends slowly under it; of a slow sine or a ramp nothing."""
    k = np.arange(1000)
    flip, slow = (-1.0) ** k, np.sin(0.01 * k)
    smooth = np.stack([slow, 0.1 * k, 1.0 * (k > 400)], axis=1)
    assert alternation(np.stack([5.0 + 0.3 * flip, slow + 0.3 * flip], axis=1)) == pytest.approx(0.3 * 997, rel=1e-3)
    assert np.all(alternation(smooth[:, :2]) < 1e-3)
    assert alternation(smooth[:, 2:]) == pytest.approx(0.25)  # the jump itself, once


def test_assumptions_that_the_scenario_gives_up(shipped_run, capsys):
    """Friction on purpose and contact that may break are outside the paper by the scenario; nothing is in red."""
    for name, outside in (("wam_slide_friction", {"frictionless", "one_loop"}), ("wam_touchdown", {"contact_kept"})):
        run = shipped_run(name)
        report = run.summary()["assumptions"]
        assert {key for key, verdict in report.items() if not verdict["expected"]} == outside
        assert all(verdict["held"] for verdict in report.values() if verdict["expected"])
        capsys.readouterr()
        print_report(run, width=120)
        text = capsys.readouterr().out
        assert "outside, by" in text
        assert "NO" not in text


def test_strict_makes_a_bad_verdict_the_exit_status(command_line, tmp_path):
    """Status 4 with --strict, with everything saved; 0 without it, and of a good run."""
    bad = ("wam_slide", "--time.duration", "0.01", "--law.force", "-5", "--no-figures", "--out", "r")
    outcome = command_line(*bad, "--strict")
    assert outcome.status == 4
    assert outcome.out.splitlines()[0] == "verdict: BAD: contact_kept"
    assert outcome.err == ""
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert summary["verdict"]["problems"][0]["name"] == "contact_kept"
    assert cl.load_run(tmp_path / "r" / "run.nc").summary()["verdict"] == summary["verdict"]
    assert command_line(*bad).status == 0
    assert command_line("wam_slide", "--time.duration", "0.01", "--no-figures", "--strict").status == 0


def test_gains_are_warned_of_before_the_run(command_line):
    """One line on standard error, whatever becomes of the run; a note in the report where it shows no sign of it."""
    run = ("wam_slide", "--time.duration", "0.01", "--law.kd", "[60, 60, 30, 380]", "--no-figures", "--strict")
    outcome = command_line(*run)
    assert outcome.status == 0  # the gains do not act before 0.5 s
    assert outcome.err.startswith("closedloop: warning: law.kd[3] (joint J4) times time.step is 2.8 times the inertia")
    assert len(outcome.err.splitlines()) == 1
    assert "note: gains: law.kd[3]" in outcome.out
    assert command_line("wam_slide", "--time.duration", "0.01", "--no-figures", "--out", "good").err == ""


def test_strict_sweep_ends_with_status_4_if_any_run_is_bad(capsys, tmp_path):
    """The column names what is wrong, the last line counts it, and a sweep that is done already says it again."""
    out = str(tmp_path / "t.parquet")
    sweep = ["wam_slide", "--time.duration", "0.02", "--over", "law.force=10,-5,12", "--out", out]
    for strict, status in (((), 0), (("--strict",), 4)):
        assert run_sweeps([*sweep, *strict]) == status
        assert "3 runs: 3 done; 1 with a bad verdict: 1 contact_kept; " in capsys.readouterr().out
    assert parquet.read_table(out)["verdict"].to_pylist() == ["good", "contact_kept", "good"]
    good = [word.replace("10,-5,12", "10,12").replace("t.parquet", "good.parquet") for word in sweep]
    assert run_sweeps([*good, "--strict"]) == 0
    assert "2 runs: 2 done; 2 in " in capsys.readouterr().out


@pytest.mark.parametrize(("gained", "expected"), [(0.99e-3, "good"), (1.01e-3, "gain")])
def test_what_nothing_drives_gains_no_energy(gained, expected):
    """A thousandth of what it could lose, not of the motion that it has gained; or, if soft, of the start."""
    body = {"name": "b", "shape": "ball", "radius": 0.1, "mass": 1.0, "position": [0, 0, 1.0]}
    contact = {"link": "b", "at": "collision"}
    passive = {"robot": {"model": "none"}, "body": [body], "contact": [contact]}
    held = {"max_kinetic_energy": 1.0 + gained, "energy_gained": gained, "energy_above_start": 0.0}
    for more, driven, said in (
        ({}, False, expected),
        ({}, True, "good"),
        ({"motion": {"kind": "conveyor", "velocity": [1.0, 0.0, 0.0]}}, False, "good"),
        ({"compliance": {"kind": "kelvin_voigt", "stiffness": 1e3}}, False, "good"),
    ):
        scenario = cl.Scenario.model_validate(passive | {"contact": [contact | more]})
        given = facts(**held)._replace(scenario=scenario, passive=scenario.is_passive and not driven)
        assert told(given) == said


@pytest.mark.parametrize("step", [1e-3, 5e-5])
def test_what_falls_under_explicit_euler_gains_half_of_m_g2_h2_in_each_step(step):
    """That is its error, of order one, and no fault of the contact: the bound of `gain` is a share of the motion."""
    body = {"name": "b", "shape": "ball", "radius": 0.1, "mass": 2.0, "position": [0.0, 0.0, 1.0]}
    scenario = {
        "robot": {"model": "none"}, "body": [body | {"velocity": [0.4, -0.3, 0.1]}],
        "contact": [{"link": "b", "at": "collision"}],
        "time": {"duration": 0.1, "step": step, "integrator": "explicit_euler"},
    }  # fmt: skip
    summary = cl.simulate(cl.Scenario.model_validate(scenario)).summary()
    assert summary["energy_gained"] == pytest.approx(0.5 * 2.0 * 9.81**2 * step * 0.1, rel=1e-6)
    bound = 1e-3 * (summary["max_kinetic_energy"] - summary["energy_gained"])
    assert summary["verdict"]["good"] == (summary["energy_gained"] < bound)


def test_a_body_that_spins_under_explicit_euler_is_not_good():
    """Its energy grows by a hundredth and more, which the balance does not see."""
    body = {"name": "b", "shape": "box", "edges": [0.1, 0.2, 0.3], "mass": 1.0, "spin": [6.0, 5.0, 4.0]}
    time = {"duration": 0.5, "step": 2e-3, "integrator": "explicit_euler"}
    run = cl.simulate(cl.Scenario.model_validate({"robot": {"model": "none"}, "body": [body], "time": time}))
    assert "gain" in [problem["name"] for problem in run.summary()["verdict"]["problems"]]
