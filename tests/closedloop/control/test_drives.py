"""Drives with limits: a torque that is cut is the limit to the bit, in both engines, in a batch and from the file."""

import re
from dataclasses import replace

import numpy as np
import pytest

import closedloop as cl
from closedloop.control.drives import AS_ASKED, AT_RATE_LIMIT, AT_TORQUE_LIMIT, cut_torque
from closedloop.jit.interpreted import interpreted

# A start off the path, which the law answers with more torque than the limits allow.
OFF = {"time.duration": 0.4, "law.pd_start": 0.2, "law.sample_period": 0.002, "reference.start": 0.0,
       "reference.speed": 0.1, "reference.stop": 0.4}  # fmt: skip
LIMITS = {"drives.torque_limit": [4.0, 5.7, 3.0, 2.6], "drives.rate_limit": 200.0}


def limited(changes=LIMITS, **options):
    """Return a run of the slide with these limits."""
    return cl.simulate(cl.load_scenario("wam_slide", OFF | changes), **options)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_a_torque_that_is_cut_is_the_limit_to_the_bit(engine):
    """Every recorded torque is the law's, the limit, or that before and the largest change; Eq. 24 has it."""
    run, limit, change = limited(engine=engine), np.array(LIMITS["drives.torque_limit"]), 0.002 * 200.0
    asked, at_limit, at_rate = (run.torque_limited == kind for kind in (AS_ASKED, AT_TORQUE_LIMIT, AT_RATE_LIMIT))
    assert min(at_limit.sum(), at_rate.sum(), asked.sum()) > 0
    assert np.all(np.abs(run.torque) <= limit)
    assert np.all((np.abs(run.torque) == limit)[at_limit])
    before, now = run.torque[:-2:2], run.torque[2::2]  # a sample every two rows
    cut = at_rate[2::2]
    assert np.all((now == np.where(now > before, before + change, before - change))[cut])
    assert np.all(np.abs(now - before)[asked[2::2]] <= change)
    assert np.array_equal(run.torque[:-1:2], run.torque[1::2])
    assert np.max(run.residual_motion) < 1e-13
    assert "energy" not in {problem["name"] for problem in run.summary()["verdict"]["problems"]}


@pytest.mark.parametrize("first", [True, False])
def test_a_cut_is_the_nearest_torque_within_the_limits(first):
    """First within the rate limit, then within ±limit, either way; what is just at a limit is as asked for."""
    asked, before = (x.ravel() for x in np.meshgrid(np.arange(-6.0, 7.0), np.arange(-6.0, 7.0)))
    torque, change, limit, limited = asked.copy(), np.full(169, 2.0), np.full(169, 4.0), np.full(169, -1)
    interpreted(cut_torque)(torque, before, change, limit, first, limited)
    slow = asked if first else np.clip(asked, before - change, before + change)
    assert np.array_equal(torque, np.clip(slow, -limit, limit))
    kinds = np.where(np.abs(slow) > limit, AT_TORQUE_LIMIT, np.where(slow != asked, AT_RATE_LIMIT, AS_ASKED))
    assert np.array_equal(limited, kinds)
    endless = np.array([np.nan, np.inf, -np.inf])  # the run is to end by it
    interpreted(cut_torque)(endless, np.zeros(3), change, limit, True, limited)
    assert np.array_equal(endless, [np.nan, np.inf, -np.inf], equal_nan=True)


def test_limits_that_are_not_reached_change_nothing():
    """Nor does it matter to the torque whether the loop is the general one."""
    free, wide = limited({}), limited({"drives.torque_limit": 1e6, "drives.rate_limit": 1e9})
    assert np.array_equal(free.torque, wide.torque)
    assert np.array_equal(free.contact_force, wide.contact_force)
    assert np.all(wide.torque_limited == AS_ASKED)
    kept = cl.simulate_batch(free.scenario, {"law.force": [10.0]}, keep=["torque_limited"])["torque_limited"]
    assert np.isnan(np.array(kept.to_pylist()[0], dtype=float)).all()  # in lanes, which have no such column


def test_the_engines_a_batch_and_the_file_agree(tmp_path, capsys):
    """The figures of the report are those of the columns, and a batch's are the run's."""
    run, other = limited(), limited(engine="compiled")
    assert np.allclose(run.torque, other.torque, rtol=0, atol=1e-9)
    assert np.array_equal(run.torque_limited, other.torque_limited)
    loaded = cl.load_run(run.save(tmp_path / "run.nc"))
    again = cl.simulate(loaded.scenario, model=loaded.model)
    assert np.array_equal(loaded.torque_limited, run.torque_limited)
    assert np.array_equal(again.torque, run.torque)
    cut = run.torque_limited != AS_ASKED
    table = cl.simulate_batch(run.scenario, {"law.force": [10.0, 12.0]}, engine="pinocchio")
    for j, name in enumerate(run.model.joint_names):
        joint = run.summary()["joints"][name]
        assert joint["torque_limited_share"] == np.mean(cut[:, j])
        assert joint["torque_limited_at"] == (run.time[np.argmax(cut[:, j])] if cut[:, j].any() else None)
        assert table["torque_limited_share"].to_pylist()[0][j] == joint["torque_limited_share"]
        assert table["torque_limited_at"].to_pylist()[0][j] == joint["torque_limited_at"]
    from closedloop.record.report import print_report

    print_report(run, width=120)
    assert "J2, first at 0.2" in (text := capsys.readouterr().out)
    assert "rate limit" in text


def test_limits_of_the_robots_file_act_on_request():
    """They are those of the model; the report no longer says that they cut nothing, and the verdict has none beyond."""
    changes = {"drives.torque_limit": "urdf", "time.duration": 0.05, "law.kp": 1e5, "start.v": [0, 2.0, 0, 0, 0, 0, 0],
               "surface.contact": "unilateral", "surface.gap": 0.01, "law.pd_start": 0.0}  # fmt: skip
    run = cl.simulate(cl.load_scenario("panda_slide", changes))
    limit = run.model.effort_limit
    at = run.torque_limited == AT_TORQUE_LIMIT
    assert at.any()
    assert np.all((np.abs(run.torque) == limit)[at])
    assert np.all(np.abs(run.torque) <= limit)
    from closedloop.record.report.tables import notes

    assert not any("effort" in note for note in notes(run))
    assert "effort_limit" not in {problem["name"] for problem in run.summary()["verdict"]["problems"]}


def test_a_torque_from_outside_is_cut_too():
    """A simulator's torque goes through the same drives: the limit to the bit, and so far from the torque before."""
    sim = cl.Simulator(cl.load_scenario("wam_slide", OFF | LIMITS))
    first = sim.reset().torque
    given = sim.step(np.full(4, 100.0)) and sim.step(np.full(4, 100.0))
    run = sim.run()
    assert np.array_equal(run.torque[0], np.minimum(100.0, LIMITS["drives.torque_limit"]))
    assert np.all(np.abs(first) <= LIMITS["drives.torque_limit"])
    down = sim.step(np.full(4, -100.0))
    assert np.array_equal(sim.run().torque[2], run.torque[1] - 0.001 * 200.0)
    assert down.time > given.time


REFUSED = {
    "negative": ({"drives.torque_limit": -1.0}, "drives.torque_limit = -1.0: must be greater than 0"),
    "word": ({"drives.torque_limit": "mjcf"}, "drives.torque_limit = 'mjcf': must be N m, one number or one per joint"),
    "length": ({"drives.torque_limit": [1.0, 2.0]}, "drives.torque_limit has 2 entries: the robot has 4 joints"),
    "zero in a list": ({"drives.rate_limit": [1.0, 0.0, 1.0, 1.0]}, "entry 1 is 0: must be greater than 0"),
    "continuous": ({"drives.rate_limit": 5.0, "law.sample_period": None}, "give law.sample_period"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """Each with the key, the value and the cure."""
    changes, said = REFUSED[case]
    changes = {key: value for key, value in (OFF | changes).items() if value is not None}
    with pytest.raises(cl.ScenarioError) as refused:
        cl.simulate(cl.load_scenario("wam_slide", changes))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_without_effort_limits_has_none_to_act():
    """Asked for, they are refused, not taken for infinite."""
    model = replace(cl.prepare(cl.load_scenario("planar2_slide")).robot.model, effort_limit=np.full(2, np.inf))
    with pytest.raises(cl.ScenarioError, match="has no effort limits; give them in N m"):
        cl.prepare(cl.load_scenario("planar2_slide", {"drives.torque_limit": "urdf"}), model)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_friction_of_the_robots_file_acts_on_request(engine):
    """It is coulomb_viscous with the damping and friction of the URDF, to the bit; no note says that it does not."""
    from closedloop.record.report.tables import notes

    model = cl.prepare(cl.load_scenario("panda_slide")).robot.model
    model = replace(model, text=re.sub("<dynamics[^>]*>", '<dynamics damping="0.4" friction="0.2"/>', model.text))
    changes = {"time.duration": 0.05, "law.pd_start": 0.01}
    run = cl.simulate(cl.load_scenario("panda_slide", changes | {"robot.friction": True}), engine=engine, model=model)
    own = {"joint_friction.kind": "coulomb_viscous", "joint_friction.kinetic": 0.2, "joint_friction.viscous": 0.4}
    same = cl.simulate(cl.load_scenario("panda_slide", changes | own), engine=engine, model=model)
    assert np.array_equal(run.q, same.q)
    assert np.max(np.abs(run.joint_friction)) > 0.0
    assert not any("friction" in note for note in notes(run))
    assert run.summary()["assumptions"]["frictionless"]["expected"] is False


def test_friction_of_the_robots_file_is_refused_where_it_has_none():
    """Or beside the scenario's, or where the step would matter and there is none; one line each."""
    for name, changes, said in (
        ("wam_slide", {}, "no joint of the robot's file has damping or friction"),
        ("panda_slide", {"joint_friction.kind": "coulomb", "joint_friction.kinetic": 0.1}, "leave out one of them"),
        ("panda_slide", {"time.integrator": "dop853"}, "depends on the step"),
    ):
        with pytest.raises(cl.ClosedLoopError, match=said) as refused:
            cl.prepare(cl.load_scenario(name, changes | {"robot.friction": True}))
        assert "\n" not in str(refused.value)
