"""The control law: Eq. 33 as it is written, sampled and held, and a law of one's own."""

import numpy as np
import pytest
from rounding import within
from slides import SLIDES

import closedloop as cl


def equation_33(scenario):
    """Return Eq. 33 in plain numpy, as a law of one's own, for a scenario whose reference is `hold`."""
    kp, kd, force = (np.array(x) for x in (scenario.law.kp, scenario.law.kd, scenario.law.force))
    q_des = np.array(scenario.start.q)
    normal = np.array(scenario.surface.normal) / np.linalg.norm(scenario.surface.normal)

    def law(t, q, v, terms):
        pd = 1.0 if t >= (scenario.law.pd_start or 0.0) - 1e-9 else 0.0
        return -pd * (kp * (q - q_des) + kd * v) + terms.bias - terms.jacobian.T @ normal * force

    return law


@pytest.mark.parametrize("name", SLIDES)
def test_recorded_torque_is_eq_33(name, shipped_run):
    """In every shipped scenario the torque of a row is Eq. 33 in the state and reference of that row."""
    run = shipped_run(name)
    robot = cl.Robot(run.model, run.scenario.robot.tip)
    law = run.scenario.law
    for k in range(0, len(run), 97):
        terms = robot.terms(run.q[k], run.v[k])
        pd = 1.0 if run.time[k] > 0.4995 else 0.0
        torque = (
            -pd * (np.array(law.kp) * (run.q[k] - run.reference_position[k]))
            - pd * (np.array(law.kd) * (run.v[k] - run.reference_velocity[k]))
            + terms.bias
            + terms.jacobian.T @ run.surface_normal[k] * (-law.force)
        )
        assert np.max(np.abs(run.torque[k] - torque)) < 1e-11


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_same_law_in_python_gives_the_same_run(integrator):
    """Eq. 33 written by a user in numpy, and the built-in law, give the same run to rounding."""
    changes = {
        "reference.kind": "hold",
        "start.v": [0.4, 0.0, 0.6, 0.0],
        "law.pd_start": 0.02,
        "time.duration": 0.1,
        "time.integrator": integrator,
    }
    scenario = cl.load_scenario("wam_slide", changes)
    ours, theirs = cl.simulate(scenario), cl.simulate(scenario, law=equation_33(scenario))
    assert np.ptp(ours.contact_force) > 0.1
    for column in ("q", "v", "torque", "contact_force"):
        assert np.max(np.abs(getattr(ours, column) - getattr(theirs, column))) < 1e-10, column


def test_pd_part_waits_for_its_start():
    """Before `pd_start` the torque has no PD part, and from that row on it has: absence, then presence."""
    changes = {"reference.kind": "hold", "start.v": [0.0, 0.0, 0.1, 0.0], "time.duration": 0.02, "law.pd_start": 0.007}
    late = cl.simulate(cl.load_scenario("wam_slide", changes))
    never = cl.simulate(cl.load_scenario("wam_slide", changes | {"law.pd_start": 9.0}))
    assert np.array_equal(late.torque[:7], never.torque[:7])
    assert np.max(np.abs(late.torque[7] - never.torque[7])) > 0.1


def test_pd_part_starts_with_the_reference_unless_told_otherwise():
    """Without `pd_start` the PD part starts with the motion of a line, and at once where the tip is to hold."""
    line = {"start.v": [0.0, 0.0, 0.01, 0.0], "time.duration": 0.6}
    run, never = (cl.simulate(cl.load_scenario("wam_slide", line | x)) for x in ({}, {"law.pd_start": 9.0}))
    differs = np.any(run.torque != never.torque, axis=1)
    assert np.flatnonzero(differs)[0] == 500
    held = {"reference.kind": "hold", "start.v": [0.0, 0.0, 0.01, 0.0], "time.duration": 0.01}
    run, never = (cl.simulate(cl.load_scenario("wam_slide", held | x)) for x in ({}, {"law.pd_start": 9.0}))
    assert np.any(run.torque[0] != never.torque[0])


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "explicit_euler", "rk4"])
def test_sampled_torque_is_held_exactly(integrator):
    """With a sample period of four steps the torque changes at every fourth row and at no other."""
    changes = {
        "law.sample_period": 0.004,
        "law.pd_start": 0.0,
        "start.v": [0.0, 0.0, 0.1, 0.0],
        "reference.kind": "hold",
        "time.duration": 0.2,
        "time.integrator": integrator,
    }
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    blocks = run.torque[:200].reshape(50, 4, 4)
    assert np.array_equal(blocks, np.repeat(blocks[:, :1], 4, axis=1))
    assert np.all(np.any(np.diff(blocks[:, 0], axis=0) != 0.0, axis=1))
    continuous = cl.simulate(cl.load_scenario("wam_slide", changes | {"law.sample_period": 0.0}))
    assert np.array_equal(continuous.torque[0], run.torque[0])
    assert np.all(np.any(np.diff(continuous.torque, axis=0) != 0.0, axis=1))


def test_sampled_law_is_called_once_a_period():
    """A user's sampled law is called at the sampling instants alone, also by an integrator of four stages."""
    instants = []

    def law(t, q, v, terms):
        instants.append(t)
        return terms.bias

    changes = {"law.sample_period": 0.004, "time.duration": 0.02, "time.integrator": "rk4"}
    cl.simulate(cl.load_scenario("wam_slide", changes), law=law)
    assert within(16, instants, [0.0, 0.004, 0.008, 0.012, 0.016, 0.02])


def test_sampling_at_every_step_is_no_sampling():
    """A one-stage scheme that samples at every step gives the run without sampling, to the last bit."""
    plain, sampled = (
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.7, "law.sample_period": period}))
        for period in (0.0, 0.001)
    )
    for name in plain.columns:
        assert np.array_equal(plain.columns[name], sampled.columns[name]), name


def test_rk4_with_a_held_torque_is_rk4_of_the_arm_alone():
    """With the torque held over the step rk4 keeps its fourth order, since nothing jumps within a step.

    Compared at two steps, with the same 20 ms samples and gains that stand them, against a much finer step.
    """
    changes = {
        "law.sample_period": 0.02,
        "law.kp": 10.0,
        "law.kd": [5.0, 5.0, 2.0, 1.0],
        "start.v": [0.0, 0.0, 2.0, 0.0],
        "reference.kind": "hold",
        "law.pd_start": 0.0,
    }
    changes |= {"time.duration": 0.1, "time.integrator": "rk4", "stabiliser.kind": "none"}
    ends = [cl.simulate(cl.load_scenario("wam_slide", changes | {"time.step": h})).q[-1] for h in (0.01, 0.005, 0.0005)]
    coarse, fine = (np.max(np.abs(q - ends[2])) for q in ends[:2])
    assert 12.0 < coarse / fine < 20.0


def test_user_law_gets_what_it_is_promised():
    """A law gets the time, read-only arrays of the state, and the terms of that very state."""
    seen = []

    def law(t, q, v, terms):
        assert not q.flags.writeable
        assert not v.flags.writeable
        seen.append((t, q, v, terms))
        return terms.bias - terms.jacobian.T @ [0.0, 0.0, 10.0] + [0.1, 0.2, 0.3, 0.4]

    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=law)
    assert len(seen) == len(run) == 11
    robot = cl.Robot(run.model)
    for k, (t, q, v, terms) in enumerate(seen):
        assert t == run.time[k]
        assert np.array_equal(q, run.q[k])
        assert np.array_equal(v, run.v[k])
        assert np.array_equal(terms.mass_matrix, robot.terms(q, v).mass_matrix)
        assert np.array_equal(run.torque[k], terms.bias - terms.jacobian.T @ [0.0, 0.0, 10.0] + [0.1, 0.2, 0.3, 0.4])
    assert run.law.endswith(":test_user_law_gets_what_it_is_promised.<locals>.law")


@pytest.mark.parametrize("torque", [[1.0], np.ones((4, 1)), None, 3.0])
def test_law_of_the_wrong_shape_is_refused(torque):
    """A law that does not return one torque a joint is refused with the shape it returned."""
    with pytest.raises(cl.ScenarioError, match="the law returned") as caught:
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=lambda t, q, v, terms: torque)
    assert "(4,)" in str(caught.value)


@pytest.mark.parametrize(
    "torque",
    ["abc", [[1], [2, 3], 4, 5], [1j, 0, 0, 0], np.full(4, 1j), {"a": 1}],
    ids=["text", "ragged", "complex", "complex array", "table"],
)
def test_law_that_returns_no_numbers_is_refused(torque):
    """A law that returns something else than real numbers is refused by the simulator, not by numpy in its depths."""
    with pytest.raises(cl.ClosedLoopError, match="the law returned"):
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=lambda t, q, v, terms: torque)


def test_law_that_returns_nan_stops_the_run_and_keeps_it():
    """A torque that is not a number stops the run at that row; what ran until then is kept, without a NaN."""

    def law(t, q, v, terms):
        return terms.bias * (np.nan if t > 0.0045 else 1.0)

    with pytest.raises(cl.DivergenceError, match=r"t = 0\.005 s.*nan") as caught:
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=law)
    assert len(caught.value.run) == 5
    assert caught.value.time == pytest.approx(0.005)
    assert all(np.all(np.isfinite(column)) for column in caught.value.run.columns.values())


def test_exceptions_of_a_law_come_through():
    """What a user's law raises is told with its place, and is the cause: hiding it would hide the law's bug."""

    def law(t, q, v, terms):
        raise KeyError("mine")

    with pytest.raises(cl.LawError, match=r"test_control\.py:\d+: KeyError: 'mine'$") as caught:
        cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}), law=law)
    assert isinstance(caught.value.__cause__, KeyError)
    assert caught.value.__cause__.args == ("mine",)
