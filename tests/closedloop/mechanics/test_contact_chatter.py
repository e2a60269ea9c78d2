"""Laws that look at the contact and work against it: no run hangs, whatever they do."""

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from budget import others

import closedloop as cl
from closedloop.mechanics.limits import MAX_IN_STEP
from closedloop.record.report.tables import notes
from closedloop.studies.gradient import exact
from robot_models import load
from validation.speed.scenes import scenario_of

MODEL = load("pointmass3")


def simulate(law, **changes):
    """Return the run of the ball on the ground at z = 0 under this vertical force beside gravity, law(t, z, ż)."""
    scenario = {
        "robot.model": "pointmass3",
        "surface.offset": 0.0,
        "surface.gap": 0.0,
        "start.q": [0.0, 0.0, 0.0],
        "start.v": None,
        "impact.restitution": 0.0,
        "stabiliser.kind": "projection",
        "time.integrator": "semi_implicit_euler",
        "time.duration": 0.2,
    }

    def vertical(t, q, v, terms):
        return terms.bias + np.array([0.0, 0.0, law(t, terms.position[2], terms.jacobian[2] @ v)])

    return cl.simulate(cl.load_scenario("planar2_drop", scenario | changes), law=vertical, model=MODEL)


LAWS = {
    "lifts when on it": lambda t, z, rate: 5.0 if z <= 0.0 else -5.0,
    "lifts below a micrometre": lambda t, z, rate: 5.0 if z < 1e-6 else -5.0,
    "lifts below a picometre": lambda t, z, rate: 5.0 if z < 1e-12 else -5.0,
    "pulls off what falls": lambda t, z, rate: 50.0 if rate <= 0.0 else -50.0,
    "shakes with the time": lambda t, z, rate: 5.0 * np.sin(4e4 * t),
    "turns with the time": lambda t, z, rate: 5.0 if int(t * 1e5) % 2 else -5.0,
    "leans on rounding": lambda t, z, rate: 1e-9 * np.sign(z + 1e-17),
}


CHANGES = ({}, {"time.integrator": "rk4"}, {"impact.restitution": 0.5})


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *((name, CHANGES[k % 3]) for k, name in enumerate(LAWS)),
        *others((name, CHANGES[i]) for k, name in enumerate(LAWS) for i in range(3) if k % 3 != i),
    ],
)
def test_no_law_makes_a_run_hang(name, changes):
    """Whatever the law, the run ends: at its end, with no force that pulls and no tip inside, or as chattering."""
    failure = None
    try:
        run = simulate(LAWS[name], **changes)
    except cl.ChatterError as error:
        failure, run = error, error.run
    if failure is None:
        assert len(run) == 201
    else:
        assert f"t = {failure.time:.6g}" in str(failure)
        assert "chatters" in str(failure)
    assert np.all(run.contact_force >= 0.0)
    assert np.min(run.closure_error, initial=0.0) > -2e-9
    for column in run.columns.values():
        assert np.all(np.isfinite(column))


def test_a_law_that_contradicts_itself_at_one_instant_is_named():
    """A law that presses and lifts in turn, each time it is asked, ends in ChatterError: when, and what to look at."""
    asked = itertools.count()
    with pytest.raises(cl.ChatterError, match=r"stopped at t = .*chatters.*law that depends on the contact") as caught:
        simulate(lambda t, z, rate: 5.0 if next(asked) % 2 else -5.0)
    assert caught.value.run.stopped == str(caught.value)
    assert len(caught.value.run) <= 2
    assert next(asked) < 1000


def test_a_law_that_is_held_does_not_chatter():
    """Evaluated once in four steps and then held, the same contrary law gives hops, and the run reaches its end."""
    run = simulate(LAWS["lifts below a micrometre"], **{"law.sample_period": 0.004})
    assert len(run) == 201
    assert len(run.events) > 4
    assert np.all(run.torque[1:4] == run.torque[0])


@pytest.mark.parametrize(
    ("mu", "force"), [(0.02, 5.0), (0.05, 40.0), (0.06, 40.0), (0.07, 40.0), (0.08, 10.0), (0.2, 5.0)]
)
def test_what_is_symmetric_slips_symmetrically(mu, force):
    """A block that hardly held fingers lift, or not: forces are not unique; modes are those of the forces that follow.

    Before, the block turned about one corner (0.07), or two feet parted and came back without end (0.05, 0.06).
    """
    run = cl.simulate(cl.load_scenario("gripper_block", {"contact.*.friction": mu, "law.force": force}))
    assert len(run.event_time) <= 30
    sideways_and_turning = run.v[:, [4, 6, 7, 8]]
    assert np.max(np.abs(sideways_and_turning)) < 1e-9
    assert np.max(np.ptp(run.link_modes[:, :8], axis=1)) == 0
    assert np.min(run.link_gaps) > -1e-9


def test_a_block_is_lifted_by_joints_with_dry_friction():
    """As the floor no longer carries the block, friction of the joints holds it until the drive exceeds it."""
    changes = {"joint_friction.kind": "coulomb", "joint_friction.kinetic": [3.0] * 3 + [0.0] * 6, "time.duration": 0.16}
    run = cl.simulate(cl.load_scenario("gripper_block", changes))
    kinds = [event.kind for event in run.events]
    assert kinds.count("liftoff") - kinds.count("touchdown") == 4
    assert len(kinds) <= 80  # twelve contacts: three time steps
    held = (run.time > 0.144) & (run.time < 0.148)
    assert np.all(np.abs(run.joint_friction[held, 0]) < 3.0)
    assert np.abs(run.v[held]).max() < 1e-7  # rk4 lessens the speed of a joint by a factor a step
    np.testing.assert_allclose(run.joint_friction[-1, 0], -3.0, rtol=1e-12)
    np.testing.assert_allclose(run.v[-1, [0, 5]], run.v[-1, 0], rtol=1e-9)


def test_a_heap_comes_to_rest_by_events():
    """Five dominoes slide down on each other: steps of impulses follow where modes end often, until they stay.

    There were 1900 events in one step, at which no mode changed: it took 18 s, and a later one more than a minute.
    """
    sim = cl.Simulator(scenario_of("dominoes", "semi_implicit_euler"), engine="compiled")
    sim.reset()
    state, most, steps = sim._stepper.loop.state, 0, 0
    while not sim.done:
        sim.step()
        most, steps = max(most, int(state.event.in_step)), steps + int(state.event.stepping)
    run = sim.run()
    energy = run.kinetic_energy + run.potential_energy
    assert most < MAX_IN_STEP / 4
    assert 100 < steps < len(run)
    assert np.max(np.diff(energy)) < 1e-6 * (energy[0] - energy[-1])
    assert np.max(np.abs(run.v[-1])) < 1e-6
    assert np.min(np.where(run.link_forces > 0.0, run.link_gaps, 0.0)) > -1e-4
    assert "time_stepping_start" in {event.kind for event in run.events}
    assert any("time.integrator = 'time_stepping'" in note for note in notes(run))


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
def test_what_an_event_begins_with_does_not_act_before_it(engine):
    """A foot that leaves its face, or edges that turn parallel, change forces at once: at an instant, not at a stage.

    Before, stages beyond the instant of such an event took part in the step to it, with a force of 700 N that pulls:
    dominoes gained 0.024 J at 0.553 s, with Pinocchio's rounding.
    """
    run = cl.simulate(scenario_of("dominoes", "rk4").replace(**{"time.duration": 0.6}), engine=engine)
    energy = run.kinetic_energy + run.potential_energy
    assert np.max(np.diff(energy)) < 1e-7 * energy[0]


def test_dual_numbers_do_not_go_through_steps_of_impulses():
    """Their impulses are found in rounds that end by their values: derivatives are differences of runs."""
    scenario = scenario_of("dominoes", "semi_implicit_euler").replace({"time.duration": 0.86})
    keys: Any = SimpleNamespace(scenario=scenario, directions=())
    nothing: Any = None
    with pytest.raises(exact.NotDualError, match="time stepping"):
        exact._exact(keys, cl.simulate(scenario, engine="compiled"), nothing, (), None, nothing, 1)
