"""Batches: the values are those of the runs one by one, whatever ran before or beside; a failed run is a row."""

import math

import numpy as np
import pyarrow as pa
import pytest

import closedloop as cl
from closedloop.loop.step.memory import State
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.record.report.verdict import names_of
from closedloop.scenario.load import Variants
from closedloop.scenario.messages import key_unit
from closedloop.simulation.batch import worker as worker_module
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare

# What adds up is added in another order than numpy's: 8000 terms of like size, each rounded.
SUMMED = {
    "max_energy_residual", "energy_exchanged", "energy_lost_to_friction", "energy_lost_in_impacts", "rms_force_error",
    "rms_path_error", "max_tip_speed", "max_friction_force", "time_in_contact", "force_chatter", "torque_chatter",
}  # fmt: skip
SHORT = {"time.duration": 0.65}

# A scenario, what is the same in all runs, and the range of each key that changes.
MIXTURE = [
    ("wam_slide", SHORT, {"law.force": (1.0, 20.0), "stabiliser.time_constant": (0.001, 0.01), "law.kp": (1.0, 900.0)}),
    ("wam_slide", {"time.duration": 0.3, "time.integrator": "rk4"}, {"law.force": (-5.0, 5.0)}),
    ("wam_bounce", {"time.duration": 0.8}, {"impact.restitution": (0.0, 0.9), "surface.gap": (0.001, 0.02)}),
    ("wam_slide_friction", SHORT, {"friction.kinetic": (0.05, 0.2), "law.force": (5.0, 15.0)}),
    ("joint_friction", {"time.duration": 0.3}, {"law.force": (5.0, 15.0)}),
    ("wam_hybrid_friction", {"time.duration": 0.3}, {"law.force_integral": (1.0, 20.0), "sensor.noise": (0.0, 0.1)}),
    ("panda_touchdown", {"time.duration": 0.4}, {"law.force": (5.0, 15.0)}),
    ("planar2_drop", {"time.duration": 0.4}, {"impact.restitution": (0.0, 0.9)}),
]


def drawn(ranges, count, seed):
    """Return `count` random values for each key."""
    rng = np.random.default_rng(seed)
    return {key: rng.uniform(low, high, count).tolist() for key, (low, high) in ranges.items()}


def compare(row, summary, rows):
    """Compare a row of the table with the summary of the same run."""
    assert row["rows"] == rows
    assert row["end_time"] == summary["end_time"]
    assert row["reason"] == summary["stopped"]
    exchanged = max(summary["energy_exchanged"] or 0.0, 1e-3)
    for name in MEASURES:
        mine, theirs = row[name], summary[name]
        if mine is None or theirs is None:
            assert mine is theirs is None, name
        elif name in SUMMED:
            # The energies differ by rounding of the potential energy too, some 10 J for these arms.
            size = exchanged + 10.0 if name == "max_energy_residual" else abs(theirs) + 1e-3
            assert mine == pytest.approx(theirs, rel=0.0, abs=1e-13 * math.sqrt(rows) * size), name
        else:
            assert mine == theirs, name
    assert {kind: row[f"{kind}_events"] for kind in summary["events"]} == summary["events"]
    for name, verdict in summary["assumptions"].items():
        assert row[f"{name}_failed_at"] == verdict["first_failed"], name
    assert row["verdict"] == names_of(summary["verdict"]["problems"])
    for name in JOINT_MEASURES:
        theirs = [joint[name] for joint in summary["joints"].values()]
        assert row[name] == pytest.approx(theirs, rel=1e-11) if name in SUMMED else row[name] == theirs, name


def one_by_one(scenario, values):
    """Return the summary and the number of rows of a run on its own."""
    try:
        run = cl.simulate(cl.load_scenario(scenario, values), engine="compiled")
    except cl.SimulationError as stopped:
        run = stopped.run
    return run.summary(), len(run)


# The larger form of the loop, with friction, takes its time to compile.
CASES = [
    pytest.param(k, id=f"{k}-{name}", marks=[pytest.mark.slow] if "friction" in name else [])
    for k, (name, *_) in enumerate(MIXTURE)
]


@pytest.mark.parametrize("case", CASES)
def test_random_runs_have_the_values_of_simulate(case):
    """Every value of every row is that of `simulate` on its own: laws, friction, impacts, sensors, integrators."""
    name, fixed, ranges = MIXTURE[case]
    changes = drawn(ranges, 4, case)
    table = cl.simulate_batch(cl.load_scenario(name, fixed), changes, workers=2)
    for i, row in enumerate(table.to_pylist()):
        values = {key: column[i] for key, column in changes.items()}
        assert {key: row[key] for key in values} == values
        compare(row, *one_by_one(name, fixed | values))


def test_what_ran_before_leaves_no_trace():
    """In another order, on one thread or three, with long runs before short ones: every row is the same to the bit."""
    scenario = cl.load_scenario("wam_bounce", {"time.duration": 0.2})
    changes = {
        "law.force": [1.0, 5.0, 9.0, 5.0, 2.0, 7.0],
        "surface.gap": [0.001, 0.0, 0.002, 0.01, 0.0, 0.003],
        "time.duration": [0.3, 0.02, 0.2, 0.01, 0.25, 0.05],
        "robot.drive_inertia": [True, False, True, True, False, False],
    }
    table = cl.simulate_batch(scenario, changes, workers=1, keep=["f"])
    order = [3, 0, 5, 1, 4, 2]
    shuffled = {key: [values[i] for i in order] for key, values in changes.items()}
    for workers in (1, 3):
        again = cl.simulate_batch(scenario, shuffled, workers=workers, keep=["f"])
        assert again.drop_columns("run").equals(table.take(order).drop_columns("run"))


def test_pieces_are_as_good_as_new():
    """A problem made of what others have left is the problem made alone, whichever keys have changed in between."""
    base = {"time.duration": 0.6}
    changes = [
        {}, {"law.force": 3.0}, {"reference.speed": 0.01, "reference.stop": 0.7}, {}, {"surface.normal": [0.1, 0, 1]},
        {"sensor.noise": 0.2},
        {"sensor.seed": 3, "sensor.noise": 0.2}, {}, {"time.step": 0.0005}, {"time.integrator": "rk4"},
        {"robot.tip": "tip"}, {"start.q": [1.5, 1.0, 0.1, 2.0]}, {"robot.drive_inertia": False},
        {"surface.gap": 0.1, "surface.contact": "unilateral"}, {"reference.kind": "hold"}, {},
        {"force_profile.kind": "step", "force_profile.to": 4.0, "force_profile.at": 0.3}, {"surface.offset": 0.3387911},
        {},
    ]  # fmt: skip
    for cache in (Cache(), Cache(limit=1)):
        for more in changes:
            scenario = cl.load_scenario("wam_slide", base | more)
            alone, reused = prepare(scenario), prepare(scenario, None, cache)
            for name in ("table", "frame", "q", "v", "stabiliser"):
                np.testing.assert_array_equal(getattr(reused, name), getattr(alone, name), err_msg=f"{name} {more}")
            again, first = reused.loop(), alone.loop()
            np.testing.assert_array_equal(again.w.memory, first.w.memory)
            np.testing.assert_array_equal(again.constants.memory, first.constants.memory)
            alike = np.ones(State.count(), dtype=bool)
            for name in ("address", "addresses.constants", "addresses.work", "addresses.group_ends"):
                alike[State.place(name)] = False
            np.testing.assert_array_equal(again.state.memory[alike], first.state.memory[alike])
            assert reused.wanted.profile == alone.wanted.profile
            assert (reused.mode, reused.steps, reused.pd_start) == (alone.mode, alone.steps, alone.pd_start)


def test_places_of_contacts_are_found_again_where_they_may_change():
    """A key that moves no contact leaves them as they are; the section of a contact and the robot do not."""
    cache, found = Cache(), []
    for more in ({}, {"law.force": 30.0}, {"contact.11.through": [0.0, 0.0, -0.5]}, {"tool.mass": 0.1}, {}):
        scenario = cl.load_scenario("gripper_block", {"time.duration": 0.01} | more)
        reused, alone = prepare(scenario, None, cache).placed, prepare(scenario).placed
        for one, other in zip(
            (*reused.rows.bound, *reused.rows[1:]), (*alone.rows.bound, *alone.rows[1:]), strict=True
        ):
            np.testing.assert_array_equal(one, other)
        found.append(reused)
    assert found[0] is found[1]
    assert len({id(each) for each in found}) == 4


def test_cache_keeps_the_entries_used_last():
    """Nothing is made twice within the limit; the entry not used for longest is removed first."""
    made = []

    def entry(key, size):
        return cache.get(key, lambda: made.append(key), lambda _: size)

    cache = Cache(limit=10)
    for key in ("a", "b", "a", "c", "a", "b"):
        entry(key, 4)
    assert made == ["a", "b", "c", "b"]


def test_failed_runs_are_rows_with_their_reason():
    """A refused run has no values, a stopped one those of what ran; the other runs are not affected."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.6, "stabiliser.kind": "none"})
    changes = {"law.kd": [20.0, 4e4, 20.0, 20.0], "law.force": [10.0, 10.0, float("nan"), 10.0]}
    good, stopped, refused, also = cl.simulate_batch(scenario, changes).to_pylist()
    assert (good["status"], stopped["status"], refused["status"]) == ("done", "stopped", "refused")
    assert good["reason"] is None
    assert (good["verdict"], refused["verdict"]) == ("good", None)  # what never ran is not judged
    assert "stopped" in stopped["verdict"].split(", ")
    assert "stopped at t = " in stopped["reason"]
    assert "law.kd" in stopped["reason"]
    assert 0 < stopped["rows"] < 601
    assert stopped["final_contact_force"] is not None
    assert "wam_slide: law.force = nan: must be finite" in refused["reason"]
    assert refused["rows"] == 0
    assert refused["end_time"] is refused["final_contact_force"] is refused["impact_events"] is None
    assert {k: v for k, v in also.items() if k != "run"} == {k: v for k, v in good.items() if k != "run"}


def test_a_pose_that_becomes_singular_is_said_as_simulate_says_it():
    """The assumption fails at the step after the last row, as in the summary of the run."""
    straight = {"start.q": [1.57, 1.0, 0.0, 0.02], "reference.kind": "hold", "law.force": 10.0, "time.duration": 0.2}
    base = cl.load_scenario("wam_slide", straight)
    (row,) = cl.simulate_batch(base, {"law.kp": [0.0]}).to_pylist()
    compare(row, *one_by_one("wam_slide", straight | {"law.kp": 0.0}))


def test_kept_columns_are_those_of_the_run():
    """f, e, and a column of several numbers are the run's own, to the bit."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.02})
    table = cl.simulate_batch(scenario, {"law.force": [5.0, 6.0]}, keep=["f", "closure_error", "q"])
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.02, "law.force": 6.0}), engine="compiled")
    for name in ("contact_force", "closure_error", "q"):
        np.testing.assert_array_equal(np.array(table[name][1].as_py()), getattr(run, name))


def test_grid_takes_every_value_with_every_other():
    """The last key changes fastest."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.002})
    table = cl.simulate_batch(scenario, {"law.force": [1.0, 2.0], "law.kp": [3.0, [4.0] * 4]}, grid=True)
    assert table["law.force"].to_pylist() == [1.0, 1.0, 2.0, 2.0]
    assert table["law.kp"].to_pylist() == ["3.0", "[4.0, 4.0, 4.0, 4.0]"] * 2
    assert table["run"].to_pylist() == [0, 1, 2, 3]


def test_columns_carry_units():
    """Every value has a unit and a meaning, and so has every key that changes."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.002})
    table = cl.simulate_batch(scenario, {"law.force": [1.0], "stabiliser.time_constant": [0.001]})
    units = {field.name: field.metadata[b"units"].decode() for field in table.schema}
    assert units["law.force"] == "N"
    assert units["stabiliser.time_constant"] == "s"
    assert units["max_abs_closure_error"] == "m"
    assert all(field.metadata[b"meaning"] for field in table.schema)
    assert key_unit("law.damping") == "N s/m"
    assert key_unit("reference.turns") == key_unit("surface.normal") == key_unit("no.such") == ""


def test_pinocchio_gives_the_same_table_to_rounding_and_takes_any_integrator():
    """The engines differ by rounding; the adaptive scheme runs on Pinocchio."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.05, "law.kp": 0.0})
    changes = {"law.force": [5.0, 6.0]}
    ours, theirs = (cl.simulate_batch(scenario, changes, engine=name) for name in ("compiled", "pinocchio"))
    np.testing.assert_allclose(ours["peak_contact_force"], theirs["peak_contact_force"], rtol=1e-9)
    adaptive = cl.simulate_batch(scenario, {"time.integrator": ["dop853", "rk4"]}, engine="pinocchio")
    assert adaptive["status"].to_pylist() == ["done", "done"]


def test_progress_counts_to_the_end():
    """The callable hears of the first and of the last run."""
    heard = []
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.002})
    cl.simulate_batch(scenario, {"law.force": [1.0, 2.0]}, progress=lambda *counts: heard.append(counts))
    assert heard[0] == (0, 2)
    assert heard[-1] == (2, 2)


@pytest.mark.parametrize(
    ("changes", "options", "said"),
    [
        ({"law.forse": [1.0]}, {}, "wam_slide: unknown key 'law.forse'; did you mean 'law.force'?"),
        ({"law.force": [1.0, 2.0], "law.kp": [1.0]}, {}, "law.force has 2, law.kp has 1 values: give each as many"),
        ({"law.force": []}, {}, "changes['law.force']: is empty"),
        ({"law.force": "5:15:3"}, {}, "must be a list with one value for each run"),
        ({"law.force": 5.0}, {}, "must be a list with one value for each run"),
        ({}, {}, "name at least one key"),
        ({"law.force": [-1.0]}, {"engine": "mujoco"}, "engine = 'mujoco': must be 'pinocchio' or 'compiled'"),
        ({"law.force": [-1.0]}, {"keep": ["g"]}, "no column 'g'; there are f (contact_force)"),
        ({"law.force": [-1.0]}, {"workers": 0}, "workers = 0: must be at least 1"),
        (
            {"time.integrator": ["dop853"]},
            {},
            "engine = 'compiled': has no integrator that chooses its steps, as 'dop853' does",
        ),
    ],
)
def test_refusals(changes, options, said):
    """What cannot be meant is refused before anything runs."""
    with pytest.raises(cl.ScenarioError) as refusal:
        cl.simulate_batch(cl.load_scenario("wam_slide"), changes, **options)
    assert said in str(refusal.value)


def break_for(monkeypatch, force, error, where="problem_of"):
    """Let a function that a worker calls raise an error of the interpreter's in the run with this force."""
    whole = getattr(worker_module, where)

    def broken(asked, *rest):
        if getattr(asked, "scenario", asked).law.force == force:
            raise error
        return whole(asked, *rest)

    monkeypatch.setattr(worker_module, where, broken)


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("division\nby zero"), MemoryError(), np.linalg.LinAlgError("singular")]
)
@pytest.mark.parametrize("where", ["problem_of", "kind_of"])
def test_an_error_that_nobody_foresaw_costs_its_row_and_no_other(monkeypatch, caplog, error, where):
    """Alone or among eight side by side: the row says type, message and where, the others are as without it."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.004})
    forces = [float(force) for force in range(1, 14)]
    sound = cl.simulate_batch(scenario, {"law.force": forces})
    assert set(sound["status"].to_pylist()) == {"done"}
    break_for(monkeypatch, 5.0, error, where)
    with caplog.at_level("DEBUG", "closedloop.simulation.batch.worker"):
        table = cl.simulate_batch(scenario, {"law.force": forces}, workers=1)
    others = [i for i in range(13) if i != 4]
    assert table.take(others).equals(sound.take(others))
    failed = table.to_pylist()[4]
    assert failed["status"] == "failed"
    assert failed["reason"].startswith(f"{type(error).__name__}: {' '.join(str(error).split())}")
    assert "test_batch.py:" in failed["reason"]
    assert "in broken, called from worker.py:" in failed["reason"]
    assert failed["reason"].isprintable()
    assert (failed["rows"], failed["end_time"], failed["final_contact_force"]) == (0, None, None)
    assert type(error).__name__ in caplog.text
    assert "Traceback" in caplog.text


def test_an_error_among_eight_side_by_side_leaves_them_to_go_alone(monkeypatch):
    """A fault of the loop for eight itself costs no row: each of the eight goes alone."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.004})
    forces = [1.0, 2.0, 3.0, 4.0]
    sound = cl.simulate_batch(scenario, {"law.force": forces})
    tried = []
    monkeypatch.setattr("closedloop.simulation.engines.lanes.LaneRuns.run", lambda *_: tried.append(1) or 1 / 0)
    assert cl.simulate_batch(scenario, {"law.force": forces}, workers=1).equals(sound)
    assert tried == [1]


def test_an_error_in_reading_the_first_scenario_costs_its_row(monkeypatch):
    """Not even the first run, at which a batch looks before it begins, ends it."""
    whole = Variants.scenario

    def broken(self, values):
        return 1 / 0 if values == (1.0,) else whole(self, values)

    monkeypatch.setattr(Variants, "scenario", broken)
    table = cl.simulate_batch(cl.load_scenario("wam_slide", {"time.duration": 0.002}), {"law.force": [1.0, 2.0]})
    assert table["status"].to_pylist() == ["failed", "done"]
    with pytest.raises(ZeroDivisionError):  # where there is no other, it is the batch that is broken
        cl.simulate_batch(cl.load_scenario("wam_slide", {"time.duration": 0.002}), {"law.force": [1.0]})


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_an_interruption_is_no_error_of_a_row(monkeypatch, error):
    """Ctrl-C ends a batch."""
    break_for(monkeypatch, 2.0, error())
    with pytest.raises(error):
        cl.simulate_batch(cl.load_scenario("wam_slide", {"time.duration": 0.002}), {"law.force": [1.0, 2.0]})


def test_table_is_arrow():
    """A row for each run, with its number first."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.002})
    table = cl.simulate_batch(scenario, {"law.force": np.array([1.0, 2.0, 3.0])})
    assert isinstance(table, pa.Table)
    assert table.column_names[:3] == ["run", "law.force", "status"]
    assert table.num_rows == 3
