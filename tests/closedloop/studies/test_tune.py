"""Tuning: optima that are known, traps, constraints that bind or cannot be met, resuming, and the command."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.studies.tune.search import MEAN, STEP, WORST, Search
from closedloop.studies.tune.tune import Runs, limit_of, varied
from tests.closedloop.linear_loops import mass_on_a_spring

SHORT = {"time.duration": 1.0, "reference.stop": 1.0, "reference.start": 0.2}
GAINS = {"law.kd[1]": (5.0, 200.0), "law.kd[3]": (5.0, 200.0)}


def of_functions(values, constraints=(), count=None):
    """Return what evaluates functions of points in the unit square in place of runs."""

    def evaluate(points):
        if count is not None:
            count.append(len(points))
        got = np.array([[value(x) for value in values] for x in points], dtype=float)
        broken = np.array([[[limit(x) for limit in constraints] for _ in values] for x in points], dtype=float)
        return got, broken.reshape(len(points), len(values), len(constraints))

    return evaluate


def rosenbrock(x):
    """Return Rosenbrock's function with its bent valley in the unit square, whose least is 1 at (2/3, 2/3)."""
    a, b = 3.0 * x[0] - 1.0, 3.0 * x[1] - 1.0
    return 1.0 + (1.0 - a) ** 2 + 100.0 * (b - a * a) ** 2


def test_a_bent_valley_is_no_trap():
    """A search that is ended in the valley is not called an optimum; one that is not ended finds the least value."""
    from_side = np.array([0.1, 0.9])
    ended = Search(of_functions([rosenbrock]), 2, iterations=3)
    ended._descend(from_side)
    x, _, _ = ended.best()
    assert ended.merit(ended.look(x[None])[0][0]) > 1.01
    assert ended._explained(x)[0] > 1e-3
    found = Search(of_functions([rosenbrock]), 2).run(from_side, 2, 0)
    assert found.optimal
    np.testing.assert_allclose(found.x, 2.0 / 3.0, atol=1e-4)
    assert found.value == pytest.approx(1.0, abs=1e-7)


def test_the_worst_of_two_and_their_mean():
    """The least worst of two parabolas is where both are equal; the least mean is where their slopes cancel."""
    both = [lambda x: (x[0] - 0.2) ** 2 + 1.0, lambda x: (x[0] - 0.6) ** 2 + 1.0]
    worst = Search(of_functions(both), 1, WORST).run(np.array([0.9]), 2, 0)
    assert worst.optimal
    assert worst.x[0] == pytest.approx(0.4, abs=1e-6)
    uneven = [both[0], lambda x: 3.0 * (x[0] - 0.6) ** 2 + 1.0]
    mean = Search(of_functions(uneven), 1, MEAN).run(np.array([0.9]), 2, 0)
    assert mean.x[0] == pytest.approx(0.5, abs=1e-6)
    assert mean.optimal


def test_a_constraint_binds_with_its_multiplier():
    """The least of x + y + 1 with x y >= 0.25 is at (0.5, 0.5), where a limit moved by m is worth 2 m."""
    found = Search(of_functions([lambda x: x[0] + x[1] + 1.0], [lambda x: 0.25 - x[0] * x[1]]), 2).run(
        np.array([0.9, 0.3]), 2, 0
    )
    assert found.optimal
    np.testing.assert_allclose(found.x, 0.5, atol=1e-3)  # √MET
    assert found.multipliers[0, 0] == pytest.approx(2.0, rel=1e-3)


def test_ends_of_ranges_bind_with_their_multipliers():
    """The least of x + 2 y + 3 (1 − z) is at the ends 0, 0, 1, each worth its slope."""
    found = Search(of_functions([lambda x: 1.0 + x[0] + 2.0 * x[1] + 3.0 * (1.0 - x[2])]), 3).run(np.full(3, 0.5), 2, 0)
    assert found.optimal
    np.testing.assert_allclose(found.x, [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(found.lower, [1.0, 2.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(found.upper, [0.0, 0.0, 3.0], rtol=1e-6)


def test_where_there_is_no_run_the_search_turns_back():
    """Points without a value are left alone, and the least value beside them is found."""
    found = Search(of_functions([lambda x: np.nan if x[0] < 0.3 else (x[0] - 0.4) ** 2 + 1.0]), 1).run(
        np.array([0.9]), 2, 0
    )
    assert found.x[0] == pytest.approx(0.4, abs=1e-5)


@pytest.mark.parametrize("of_limits", [False, True])
def test_a_search_stops_before_the_edge_beyond_which_there_is_no_run(of_limits):
    """Values fall to where there are none, or no limits of finite ones: nothing there is taken for a low value."""

    def value(x):
        return np.nan if x[0] > 0.6 and not of_limits else 5.0 + 4.0 * (1.0 - x[0])

    limits = [lambda x: np.nan if x[0] > 0.6 else -1.0] if of_limits else []
    search = Search(of_functions([value, lambda x: 100.0 * value(x)], limits), 1, MEAN)
    assert 0.1 <= search._descend(np.array([0.1]))[0] <= 0.6
    assert 0.5 < search.run(np.array([0.1]), 2, 0).x[0] <= 0.6


def test_a_search_begins_as_often_as_it_is_asked_to_and_where_limits_are_nearly_met():
    """Of values below zero it finds the least, too; a point far beyond a limit is a worse start than one beside it."""
    search = Search(of_functions([lambda x: (x[0] - 0.4) ** 2 - 1.0]), 1)
    found = search.run(np.array([0.9]), 3, 0)
    assert found.x[0] == pytest.approx(0.4, abs=1e-5)
    assert found.ends == pytest.approx([-1.0] * 3)
    beyond = [search._penalised(np.array([2.0]), np.array([[share]])) for share in (-0.5, 0.0, 0.1, 0.3)]
    assert beyond == pytest.approx([2.0, 2.0, 5.0, 11.0])


@pytest.mark.parametrize("at", [0.0, 0.3, 1.0])
def test_slopes_are_differences_of_a_point_or_of_one_a_step_inside(at):
    """Of a parabola, exactly, and of a constraint; at an end of the range those of a point inside; 0 without a run."""
    search = Search(of_functions([lambda x: x[0] ** 2, lambda x: 3.0 * x[1]], [lambda x: x[0] - 2.0 * x[1]]), 2)
    values, violations = search.slopes(np.array([at, 0.5]))
    inside = min(max(at, STEP), 1.0 - STEP)
    np.testing.assert_allclose(values, [[2.0 * inside, 0.0], [0.0, 3.0]], atol=1e-10)
    np.testing.assert_allclose(violations, [[[1.0, -2.0]], [[1.0, -2.0]]], atol=1e-10)
    lost = Search(of_functions([lambda x: np.nan if x[0] > inside else x[0]]), 1)
    assert lost.slopes(np.array([at]))[0] == 0.0


def test_values_of_runs_that_stop_and_margins_of_loops_that_are_unstable():
    """A run that diverges has none, one that does not has its own; an unstable loop has a margin below zero."""
    scenario = cl.load_scenario("wam_slide", SHORT)
    runs = Runs(scenario, varied(scenario, {"law.kd[3]": (5.0, 5000.0)}), {"rms_force_error": 1.0}, [], {})
    stopped, ended = runs.values(np.array([[1.0], [0.0]]))[:, 0, 0]
    assert np.isnan(stopped)
    run = cl.simulate(cl.load_scenario("wam_slide", SHORT | runs.changes(np.array([0.0]))), engine="compiled")
    assert ended == pytest.approx(run.summary()["rms_force_error"], rel=1e-9)
    spring = mass_on_a_spring()
    names = {f"{margin}@0.05": 1.0 for margin in ("gain_margin", "phase_margin", "delay_margin", "modulus_margin")}
    runs = Runs(spring, varied(spring, {"law.force_integral": (20.0, 40.0)}), names, [], {})
    stable, unstable = runs.values(np.array([[0.0], [1.0]]))[:, 0]
    assert np.all(stable > 0.0)
    assert np.all(unstable < 0.0)
    both = Runs(spring, varied(spring, {"law.force_integral": (0.0, 40.0)}), {"rms_force_error": 1.0, **names}, [], {})
    force, *endless = both.values(np.array([[0.0]]))[0, 0]
    assert np.isfinite(force)
    assert endless[0] == 1e6  # without feedback no gain makes it unstable
    loop = cl.linearise(mass_on_a_spring(gain=40.0), at=0.05)
    assert unstable[3] == pytest.approx(-loop.margins().modulus, rel=1e-6)


def test_values_are_those_of_their_point_and_their_variation():
    """Of three points under two variations each: those of runs that are made one by one."""
    scenario = cl.load_scenario("planar2_slide", {"time.duration": 0.2, "reference.start": 0.0, "law.pd_start": 0.0})
    over = {"law.force": [8.0, 12.0]}
    runs = Runs(scenario, varied(scenario, {"law.kd[1]": (5.0, 60.0)}), {"peak_contact_force": 1.0}, [], over)
    points = np.array([[0.0], [0.4], [1.0]])
    found = runs.values(points)[:, :, 0]
    assert len(set(found.ravel())) == found.size
    for x, row in zip(points, found, strict=True):
        for force, value in zip(over["law.force"], row, strict=True):
            one = cl.simulate(scenario.replace(runs.changes(x) | {"law.force": force}), engine="compiled")
            assert value == pytest.approx(one.summary()["peak_contact_force"], rel=1e-9)


def test_a_constraint_that_cannot_be_met_is_said():
    """The nearest point is returned, and is not called feasible."""
    found = Search(of_functions([lambda x: x[0] + 1.0], [lambda x: 0.2 + (x[0] - 0.7) ** 2]), 1).run(
        np.array([0.1]), 2, 0
    )
    assert not found.feasible
    assert not found.optimal
    assert found.x[0] == pytest.approx(0.7, abs=1e-2)


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """Return a short slide with two gains tuned, and the file of its runs."""
    kept = tmp_path_factory.mktemp("tune") / "runs.jsonl"
    scenario = cl.load_scenario("wam_slide", SHORT)
    return cl.tune(scenario, GAINS, "rms_force_error", ["peak_contact_force<=10.9"], starts=2, kept=kept), kept


def test_gains_of_a_slide_become_better(tuned):
    """The constraint that the shipped gains violate is met, the error falls, and the scenario has the gains."""
    tuning, _ = tuned
    assert tuning.feasible
    assert tuning.value < 0.5 * tuning.value_before
    run = cl.simulate(tuning.scenario, engine="compiled")
    assert run.summary()["rms_force_error"] == pytest.approx(tuning.value, rel=1e-9)
    assert run.summary()["peak_contact_force"] <= 10.9 * (1.0 + 1e-6)
    assert run.summary()["verdict"]["good"]
    assert tuning.scenario.law.kd[0] == tuning.before.law.kd[0]
    for each, number in zip(tuning.vary, tuning.numbers, strict=True):
        assert each.low <= number <= each.high
        down, up = tuning.sensitivity[each.name]
        assert not down < -1e-4 * tuning.value
        assert not up < -1e-4 * tuning.value
    assert "rms_force_error:" in tuning.lines()[0]
    assert len(tuning.figure().axes) == 1


def test_what_was_run_is_not_run_again(tuned):
    """With the file of an interrupted tuning the same is found, and only what is missing is run."""
    tuning, kept = tuned
    lines = kept.read_text().splitlines()
    part = kept.with_name("part.jsonl")
    damaged = ["5", "null", "[]", '["key"]', "[" * 100_000]
    part.write_text("\n".join([*lines[: len(lines) // 2], *damaged]) + '\n["cut')
    again = cl.tune(tuning.before, GAINS, "rms_force_error", ["peak_contact_force<=10.9"], starts=2, kept=part)
    assert again.numbers == tuning.numbers
    assert again.runs < tuning.runs
    whole = cl.tune(tuning.before, GAINS, "rms_force_error", ["peak_contact_force<=10.9"], starts=2, kept=part)
    assert (whole.numbers, whole.runs) == (tuning.numbers, 1)  # of the scenario as it is
    with pytest.raises(cl.OutputError, match="another tuning: the list of ranges differs, the list of values differs"):
        cl.tune(tuning.before, {"law.kd[1]": (5.0, 100.0)}, "rms_force_error", starts=1, kept=kept)
    part.write_text("notes of mine\n")
    with pytest.raises(cl.OutputError, match="holds no tuning"):
        cl.tune(tuning.before, GAINS, "rms_force_error", starts=1, kept=part)
    assert part.read_text() == "notes of mine\n"


def test_what_was_run_is_of_this_robot(tmp_path):
    """A file of runs of an arm whose URDF has other masses since is of another tuning; an empty file is none."""
    robot, kept = tmp_path / "arm.urdf", tmp_path / "runs.jsonl"
    text = (Path(robot_models.__file__).parent / "planar2" / "planar2.urdf").read_text()
    robot.write_text(text)
    kept.touch()
    scenario = cl.load_scenario(
        "planar2_slide", {"robot.model": str(robot), "robot.tip": "tip", "start.q": [0.6, -1.4], "time.duration": 0.6}
    )
    vary = {"law.kd[0]": (5.0, 100.0)}
    first = cl.tune(scenario, vary, starts=1, iterations=1, kept=kept)
    assert cl.tune(scenario, vary, starts=1, iterations=1, kept=kept).numbers == first.numbers
    robot.write_text(re.sub(r'mass value="([^"]*)"', r'mass value="9\1"', text))
    with pytest.raises(cl.OutputError, match="another tuning: the robot differs; name another folder"):
        cl.tune(scenario, vary, starts=1, iterations=1, kept=kept)


def test_gains_that_the_step_does_not_resolve_are_no_optimum():
    """What a ringing loop makes of a value is not looked for: the tip is fastest at gains that are resolved at most."""
    scenario = cl.load_scenario("wam_slide", SHORT)
    for name in ("max_tip_speed", "modulus_margin@0.5"):
        with pytest.raises(cl.ScenarioError, match=r"be good \(resolution\); narrow them"):
            cl.tune(scenario, {"law.kd[3]": (180.0, 230.0)}, {name: -1.0}, starts=1)
    tuning = cl.tune(scenario, {"law.kd[3]": (100.0, 230.0)}, {"max_tip_speed": -1.0}, starts=2)
    assert 130.0 < tuning.numbers[0] < 160.0
    problems = cl.simulate(tuning.scenario, engine="compiled").summary()["verdict"]["problems"]
    assert "resolution" not in [problem["name"] for problem in problems]


@pytest.mark.parametrize(
    ("vary", "subject_to", "more", "words"),
    [
        ({}, [], {}, "nothing varies"),
        ({"law.kind": (0, 1)}, [], {}, "it is a word"),
        ({"law.kd[7]": (0, 1)}, [], {}, "no such entry"),
        ({"law.kd": (5, 1)}, [], {}, "the lower end first"),
        ({"law.kd": 5}, [], {}, "two ends"),
        ({"law.kd": (0, 10)}, [], {"log": ["law.kd"]}, "above 0"),
        ({"law.kd": (1, 10), "law.kd[1]": (1, 10)}, [], {}, "varies twice"),
        ({"law.kd": (1, 10)}, ["peak_contact_force<12"], {}, "must be a value and its limit"),
        ({"law.kd": (1, 10)}, ["peak<=12"], {}, "no value of a run's summary"),
        ({"law.kd": (1, 10)}, ["modulus_margin>=0.5"], {}, "at which instant"),
        ({"law.kd": (1, 10)}, [], {"minimise": "error"}, "no value of a run's summary"),
        ({"law.kd": (1, 10)}, [], {"robust": "best"}, "'worst' or 'mean'"),
        ({"law.kd": (1, 10)}, [], {"starts": 0}, "from 1 to"),
        ({"law.force": (1, 10)}, [], {"over": {"law.force": [5.0]}}, "cannot vary"),
    ],
)
def test_bad_input_is_one_line(vary, subject_to, more, words):
    """It says what is wrong and what would be right."""
    with pytest.raises(cl.ScenarioError, match=words) as error:
        cl.tune(cl.load_scenario("wam_slide", SHORT), vary, subject_to=subject_to, **more)
    assert "\n" not in str(error.value)


def test_a_constraint_reads_either_way():
    """`>=` and `<=`, with the violation as a share of the limit."""
    least, most = limit_of(" modulus_margin@3 >= 0.5"), limit_of("peak_contact_force<=12")
    assert least.violation(np.array([0.25])) == pytest.approx([0.5])
    assert most.violation(np.array([15.0])) == pytest.approx([0.25])
    assert limit_of("lowest<=-2").violation(np.array([-1.0, -3.0])) == pytest.approx([0.5, -0.5])
    assert str(least) == "modulus_margin@3 >= 0.5"


def test_the_command_writes_the_scenario(tmp_path, capsys):
    """It prints the report, writes tuned.toml, which runs, and says by its status whether the constraints are met."""
    from closedloop.command.logs import tune

    words = ["wam_slide", "--time.duration", "0.6", "--reference.start", "0.1", "--reference.stop", "0.6",
             "--starts", "1", "--vary", "law.kd[3]=log:5:200", "--out", str(tmp_path / "out")]  # fmt: skip
    assert tune([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["feasible"]
    assert report["value"] < report["value_before"]
    scenario = cl.load_scenario(tmp_path / "out" / "tuned.toml")
    assert scenario.law.kd[3] == report["numbers"]["law.kd[3]"]
    assert (tmp_path / "out" / "tune.png").exists()
    assert tune([*words[:-2], "--subject-to", "peak_contact_force<=9"]) == 3
    assert "peak_contact_force <= 9 cannot be met" in capsys.readouterr().out
    assert tune(["wam_slide"]) == 2
    assert "--vary law.kd=5:200" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "vary", "subject_to", "over"),
    [
        ("wam_slide", {}, {"law.kd": (5.0, 200.0)}, ["peak_contact_force<=10.5"], None),
        ("wam_hybrid_friction", {"compliance.kind": "kelvin_voigt"}, {"law.force_integral": (1.0, 200.0)},
         ["modulus_margin@3>=0.5"], None),
        ("wam_slide", {"friction.kind": "coulomb", "friction.coefficient": 0.4},
         {"law.force_integral": (0.0, 200.0)}, [],
         {"friction.coefficient": [0.2, 0.4, 0.6]}),
    ],
)  # fmt: skip
def test_shipped_gains_become_better(name, changes, vary, subject_to, over):
    """Better than shipped, with the margins kept, under each of the variations."""
    tuning = cl.tune(cl.load_scenario(name, changes), vary, subject_to=subject_to, over=over, starts=2)
    assert tuning.feasible
    assert tuning.value < 0.9 * tuning.value_before
    assert np.all(tuning.values["rms_force_error"] < tuning.values_before["rms_force_error"])


def test_a_number_at_the_rounding_of_an_end_is_the_end():
    """A search that ends a rounding beside 0 gives 0: a gain of 1e-14 is refused where the tuned scenario is read."""
    vary = varied(cl.load_scenario("wam_slide"), {"law.force_integral": (0.0, 60.0)}, ())
    assert [vary[0].at(share) for share in (0.0, 3e-16, 2e-11, 1.0 - 2e-16, 1.0)] == [0.0, 0.0, 0.0, 60.0, 60.0]
    assert 1e-7 < vary[0].at(1e-7) < 1e-5
    beyond = varied(cl.load_scenario("wam_slide"), {"law.kd[3]": (1.0, 2.0), "law.kd[1]": (1e3, 2e3)})
    assert [each.share for each in beyond] == [1.0, 0.0]
