"""Simulations side by side do, to the bit, what `closedloop.Simulator` and `closedloop.simulate` do."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.loop.step.record_row import Row
from closedloop.simulation.ensemble.ensemble import Ensemble
from closedloop.simulation.ensemble.member import FORCE, PARAMETER, SHIFT, TORQUE, Between
from closedloop.simulation.prepare import prepare

SCENARIOS = {
    "planar2_drop": {"time.duration": 0.6},  # impacts
    "wam_slide_friction": {"time.duration": 0.6, "surface.contact": "unilateral"},  # sticks and breaks away
    "soft_table": {"time.duration": 0.4, "sensor.noise": 0.1, "sensor.delay": 0.003},
}


def torques(n):
    """Return a plan that sets the torque of each joint."""
    return np.array([(TORQUE, j, j) for j in range(n)])


@pytest.mark.parametrize("name", SCENARIOS)
def test_torques_act_as_in_a_simulator(name):
    """Held torques from outside give each row of a simulator's, through impacts, sticking and a noisy sensor."""
    scenario = cl.load_scenario(name, SCENARIOS[name])
    problem = prepare(scenario)
    n, steps = problem.robot.n, 4
    together = Ensemble(3, steps, torques(n), n, held=True, threads=2)
    for i in range(3):
        together.begin(i, prepare(scenario))
    together.start(range(3))
    simulator = cl.Simulator(scenario, engine="compiled")
    state, random, events = simulator.reset(), np.random.default_rng(0), 0
    first = state.torque.copy()
    for _ in range(problem.steps // steps):
        torque = first + 0.3 * random.normal(size=n)
        together.actions[:] = torque
        together.step(range(3))
        for _ in range(steps):
            state = simulator.step(torque)
        row = Row(together.rows[1], n)
        assert np.array_equal(row.q, state.q)
        assert np.array_equal(row.v, state.v)
        assert row.contact_force == state.f
        assert row.mode == state.mode
        assert Between(together.between[1]).measured == state.measured
        assert np.array_equal(together.rows[0], together.rows[2])
        events += int(Between(together.between[0]).events)
    assert events == len(simulator.run().events)
    together.close()


def test_the_law_acts_as_in_a_run():
    """With the force of the scenario as the action the rows are those of the scenario's run."""
    scenario = cl.load_scenario("wam_hybrid_friction", {"time.duration": 0.6})
    together = Ensemble(1, 5, np.array([(FORCE, 0, 0)]), 1)
    together.begin(0, prepare(scenario))
    together.start([0])
    run = cl.simulate(scenario, engine="compiled")
    for k in range(5, 601, 5):
        together.actions[:] = 10.0
        together.step([0])
        row = Row(together.rows[0], 4)
        assert np.array_equal(row.q, run.q[k])
        assert row.contact_force == run.contact_force[k]
        assert row.measured_force == run.measured_force[k]


def test_what_an_action_sets():
    """A force, a parameter, and a displacement reach the law; what is displaced goes back with the next action."""
    scenario = cl.load_scenario("wam_hybrid_friction", {"time.duration": 0.4})
    problem = prepare(scenario)
    plan = np.array([(FORCE, 0, 0), (PARAMETER, problem.law.numbers.size - 1, 1), (SHIFT, 1, 2)])
    together = Ensemble(1, 100, plan, 3)
    together.begin(0, problem)
    together.start([0])
    together.actions[:] = 14.0, problem.law.numbers[-1], 0.004
    together.step([0])
    own = together.problem(0)
    before, after = problem.table[:101, 8:11], own.table[:101, 8:11]
    assert np.allclose((after - before) @ problem.frame[1], 0.004, rtol=0.0, atol=1e-12)
    assert own.table[100, 17] == 14.0
    together.actions[:] = 14.0, problem.law.numbers[-1], 0.0
    together.step([0])
    assert np.array_equal(own.table[101:201, 8:11], problem.table[101:201, 8:11])
    assert np.array_equal(own.table[100, 8:11], problem.table[100, 8:11])


def test_one_that_stops_stops_no_other():
    """A simulation that diverges says why, at its last good row; the other goes on as by itself."""
    scenario = cl.load_scenario("planar2_drop", {"time.duration": 0.2})
    runs = []
    for wild in (1e7, 0.0):
        together = Ensemble(2, 10, torques(2), 2, held=True)
        for i in range(2):
            together.begin(i, prepare(scenario))
        together.start([0, 1])
        going = [0, 1]
        for _ in range(6):
            together.actions[:] = (wild, 0.0), (0.1, 0.0)
            together.step(going)
            going = [i for i in going if not together.failed[i]]
        assert together.failed.tolist() == [wild > 0.0, False]
        if wild:
            assert "diverges" in str(together.failures[0]) or "stopped at t" in str(together.failures[0])
            with pytest.raises(ValueError, match="simulation 0 is at its end, or could not go on"):
                together.step([0, 1])
        runs.append(together.rows[1].copy())
    assert np.array_equal(*runs)


def test_the_end_is_the_end():
    """There is no step beyond the last control instant."""
    together = Ensemble(1, 100, torques(2), 2, held=True)
    together.begin(0, prepare(cl.load_scenario("planar2_drop", {"time.duration": 0.2})))
    together.start([0])
    assert together.left(0) == 2
    together.step([0])
    together.step([0])
    assert together.left(0) == 0
    with pytest.raises(ValueError, match="at its end"):
        together.step([0])


def test_torques_that_cannot_act_are_refused():
    """Limits of drives act on a law's torque, and loop joints ask for more than a torque a joint."""
    for name, changes, said in (
        ("wam_slide", {"drives.torque_limit": 50.0}, "drives"),
        ("four_bar", {}, "loop joints"),
    ):
        problem = prepare(cl.load_scenario(name, changes))
        n = problem.robot.n
        with pytest.raises(cl.ScenarioError, match=said):
            Ensemble(1, 1, torques(n), n, held=True).begin(0, problem)
