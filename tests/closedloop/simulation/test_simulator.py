"""The stepwise interface: the same bits as `simulate`, whoever drives, and errors that leave the run so far."""

import signal

import numpy as np
import pytest
from budget import budget, others

import closedloop as cl
from closedloop.mechanics.closure.conditioning import BATCH


def assert_same(a, b):
    """Two runs have the same columns, to the bit."""
    for name, column in a.columns.items():
        assert np.array_equal(column, b.columns[name], equal_nan=True), name


def stepped(scenario, engine="pinocchio"):
    """Return the run of a scenario stepped to its end by its own law, and the states that it showed."""
    sim = cl.Simulator(scenario, engine=engine)
    states = [sim.reset()]
    while not sim.done:
        states.append(sim.step())
    return sim.run(), states


def assert_stepped_the_same(scenario, engine):
    """Stepping is simulating, and each state is its row."""
    once = cl.simulate(scenario, engine=engine)
    run, states = stepped(scenario, engine)
    assert_same(once, run)
    assert (run.law, run.stopped, run.engine) == ("scenario", None, engine)
    assert [each[:2] for state in states for each in state.events] == [each[:2] for each in once.events]
    for k in (0, 1, len(once) // 2, len(once) - 1):
        state = states[k]
        assert (state.time, state.row, state.mode) == (once.time[k], k, once.mode[k])
        gap = once.closure_error[k] if scenario.has_surface else np.inf
        assert (state.f, state.gap, state.gap_rate) == (once.contact_force[k], gap, once.closure_rate[k])
        for name in ("q", "v", "acceleration", "torque", "position", "velocity", "friction_force"):
            shown, recorded = getattr(state, name), getattr(once, name)[k]
            if (
                name == "q" and "quaternion" in once.model.coordinate_types
            ):  # a quaternion and its negative are one rotation
                shown, recorded = np.abs(shown), np.abs(recorded)
            assert np.array_equal(shown, recorded)
        if k:
            assert state.measured == once.measured_force[k - 1]


LONGEST = budget(2.5, np.inf)  # s of a scenario, in the longer tests
# Those whose terms cost most begin to move at once, and end soon.
SOON = {"reference.start": 0.02, "time.duration": 0.12}
SHORTER = budget({"stewart": SOON, "delta": SOON, "five_bar": {"time.duration": 1.5}}, {})
BRIEF = {"wam_slide": 0.6, "wam_bounce": 0.6, "panda_wipe": 0.8, "wam_edge": 3.0, "joint_friction": 1.0}


@pytest.mark.parametrize(("name", "duration"), BRIEF.items())
def test_stepping_is_simulating(name, duration):
    """By the scenario's own law the record is that of `simulate`, and every state is its row."""
    assert_stepped_the_same(cl.load_scenario(name, {"time.duration": duration}), "pinocchio")


@pytest.mark.parametrize(
    ("name", "engine"),
    others((name, ("pinocchio", "compiled")[k % 2]) for k, name in enumerate(cl.shipped_scenarios())),
)
def test_every_shipped_scenario_can_be_stepped(name, engine):
    """The same for every scenario, on the engines in turn; with the full budget to its end."""
    ends = min(cl.load_scenario(name).time.duration, LONGEST)
    assert_stepped_the_same(cl.load_scenario(name, {"time.duration": ends}), engine)


# Torques recorded with Runge-Kutta and held over steps are another run, which bounces: an event that both the held
# torque and the next would cause is located to 1e-14 s from another bracket. Held without feedback, those of panda_scan
# let the tip leave the moving surface, and those of wam_through_singularity push along the normal in the singular pose.
OTHERS = (
    "fr3_press", "hand_rolls", "hidden_bump", "panda_polish", "panda_scan", "panda_touchdown", "panda_wipe",
    "push_block", "quadruped", "two_arms_bar", "wam_touchdown", "wam_through_singularity",
)  # fmt: skip
ALIKE = [name for name in cl.shipped_scenarios() if name not in OTHERS and cl.load_scenario(name).law.kind != "none"]


@pytest.mark.parametrize(
    ("name", "duration"),
    [
        ("wam_slide", 0.6),
        ("wam_stick_slip", 3.0),
        ("wam_bounce", 0.7),
        *others((name, None) for name in ALIKE),
    ],
)
def test_torques_from_outside_are_a_sampled_law(name, duration):
    """Recorded torques, given step by step, give the run of a user's law that returns these, held over each step."""
    if duration is None:
        duration = min(cl.load_scenario(name).time.duration, LONGEST)
    changes = {"time.duration": duration} | SHORTER.get(name, {})
    recorded = cl.simulate(cl.load_scenario(name, changes)).torque
    h = cl.load_scenario(name).time.step
    scenario = cl.load_scenario(name, {**changes, "law.sample_period": h})
    steps = len(recorded) - 1
    expected = cl.simulate(scenario, law=lambda t, q, v, terms: recorded[min(round(t / h), steps - 1)])
    sim = cl.Simulator(scenario)
    sim.reset()
    for k in range(steps):
        sim.step(recorded[k])
    assert_same(expected, sim.run())
    assert sim.run().law == "torque from outside"


def test_own_law_and_the_same_torques_by_turns_are_one_run():
    """A torque acts from the row just seen: steps with the law's own torque, given or not, are the same run."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.6})
    once = cl.simulate(scenario)
    sim = cl.Simulator(scenario)
    for k in range(600):
        sim.step(once.torque[k] if k % 3 == 1 else None)
        if k % 100 == 0:
            sim.run()  # looking changes nothing
    assert_same(once, sim.run())
    assert sim.run().law == "scenario and torque from outside"


def test_controller_outside_sees_what_a_law_inside_sees():
    """A force loop around `step` is the law `law(x)` at the same rate: q, q̇ and the sensor's reading are x's."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.6, "law.sample_period": 0.001, "sensor.noise": 0.1})
    problem = cl.prepare(scenario)

    def inside(x):
        return x.C - x.A[0] * (10.0 + 0.3 * (10.0 - x.f_measured)) - 5.0 * x.v

    sim = cl.Simulator(scenario)
    state = sim.reset()
    while not sim.done:
        terms = problem.robot.terms(state.q, state.v)
        press = terms.jacobian.T @ problem.plane.normal
        state = sim.step(terms.bias - press * (10.0 + 0.3 * (10.0 - state.measured)) - 5.0 * state.v)
    expected = cl.simulate(scenario, law=inside)
    assert np.std(expected.measured_force) > 0.02
    assert sim.run().contact_force[:-1] == pytest.approx(expected.contact_force[:-1], abs=1e-9)


class Press:
    """A law with a count of its resets."""

    def __init__(self):
        self.resets = 0

    def reset(self):
        """Count."""
        self.resets += 1

    def __call__(self, x):
        """Compensate C and press."""
        return x.C - x.A[0] * x.f_des - 5.0 * x.v


def test_users_law_until_a_time():
    """`run_until` with a law in two parts is `simulate` with it, and the scenario's law can take over."""
    scenario, law = cl.load_scenario("wam_slide", {"time.duration": 0.6}), Press()
    sim = cl.Simulator(scenario)
    assert sim.run_until(0.2, law).time == 0.2
    assert sim.run_until(0.2, law).row == 200
    sim.run_until(0.6, law)
    assert law.resets == 1
    assert_same(cl.simulate(scenario, law=Press()), sim.run())
    sim.reset()
    sim.run_until(0.3, law)
    assert sim.run_until(0.6).time == 0.6
    assert (law.resets, len(sim.run().law.split(" and "))) == (2, 2)


def test_what_a_torque_at_the_start_does():
    """At t = 0 a torque replaces the law's, with what that caused: a tip drawn off is pressed on instead."""
    scenario = cl.load_scenario("wam_liftoff", {"law.force": -1.0, "time.duration": 0.01})
    sim = cl.Simulator(scenario)
    assert [e.kind for e in sim.reset().events] == ["liftoff"]
    press = cl.simulate(cl.load_scenario("wam_liftoff", {"time.duration": 0.01})).torque[0]
    state = sim.step(press)
    assert state.mode == 1
    assert state.f == pytest.approx(10.0, abs=0.1)
    assert sim.run().events == ()


@pytest.mark.parametrize("torque", [[1.0, 2.0], "x", [np.nan] * 4, [[1.0, 2.0], [3.0]], 1.0, [True] * 4])
def test_wrong_torque_is_refused_and_nothing_stepped(torque):
    """One line says what a torque must be, and the simulation is where it was."""
    sim = cl.Simulator(cl.load_scenario("wam_slide", {"time.duration": 0.01}))
    state = sim.reset()
    with pytest.raises(ValueError, match=r"step: torque = .*: must be 4 finite numbers, one torque a joint, \(4,\)"):
        sim.step(torque)
    assert sim.state is state


@pytest.mark.parametrize("t", [-1.0, 99.0, float("nan")])
def test_wrong_time_is_refused(t):
    """A time before the present or after the end is refused with both."""
    sim = cl.Simulator(cl.load_scenario("wam_slide", {"time.duration": 0.01}))
    with pytest.raises(ValueError, match=r"run_until: t = .*between the present time, 0 s, and the end, .*0\.01 s"):
        sim.run_until(t)


def test_adaptive_integrator_is_refused():
    """An integrator that steps over rows cannot be driven row by row."""
    with pytest.raises(cl.ScenarioError, match=r"time.integrator = 'dop853': its steps do not end at the rows"):
        cl.Simulator(cl.load_scenario("wam_slide", {"time.integrator": "dop853"}))


def test_use_after_the_end_is_one_error():
    """Beyond the end there is nothing to step, and the error has the run."""
    sim = cl.Simulator(cl.load_scenario("wam_slide", {"time.duration": 0.01}))
    sim.run_until(0.01)
    with pytest.raises(cl.SimulationError, match=r"is at its end, t = 0\.01 s; reset\(\) begins anew") as caught:
        sim.step()
    assert len(caught.value.run) == 11
    assert sim.reset().time == 0.0
    assert not sim.done


def test_failure_has_the_run_so_far():
    """A torque that throws the arm about ends the simulation, as it ends `simulate`."""
    sim = cl.Simulator(cl.load_scenario("wam_slide"))

    def throw():
        for _ in range(1000):
            sim.step([1e5, 0.0, 0.0, 0.0])

    with pytest.raises(cl.DivergenceError, match=r"the motion diverges.*; look at .* in the law") as caught:
        throw()
    run = caught.value.run
    assert run.stopped == str(caught.value)
    assert len(run) in (sim.state.row, sim.state.row + 1)
    assert sim.done
    assert sim.run() is run
    with pytest.raises(cl.SimulationError, match="the simulation failed: stopped at"):
        sim.step()


def test_run_so_far_says_that_it_is_not_whole():
    """Before the end the run has its rows and condition numbers, and says where it stands."""
    scenario = cl.load_scenario("wam_touchdown", {"time.duration": 1.6})
    whole, sim = cl.simulate(scenario), cl.Simulator(scenario)
    for k in (3, 13, 1580):
        sim.run_until(k * 0.001)
        run = sim.run()
        assert len(run) == k + 1
        assert np.array_equal(run.kkt_condition, whole.kkt_condition[: k + 1])
        assert run.stopped == f"at t = {k * 0.001:g} s it was not stepped further"
    expected = [event[:2] for event in whole.events if event.time <= 1.58]
    assert [event[:2] for event in sim.run().events] == expected != []


@pytest.mark.parametrize("when", range(1, 12))
def test_interrupted_anywhere_it_goes_on(when, monkeypatch):
    """Ctrl-C at any call of the loop, in steps with impacts too, leaves the run so far, and a run that can go on."""
    scenario = cl.load_scenario("wam_bounce", {"time.duration": 0.17})
    whole, sim = cl.simulate(scenario), cl.Simulator(scenario)
    sim.run_until(0.158)  # an impact is at 0.1606 s
    calls, go_on = [0], sim._stepper._go_on
    torque = sim.state.torque

    def interrupting(request):
        calls[0] += 1
        if calls[0] == when:
            raise KeyboardInterrupt
        return go_on(request)

    monkeypatch.setattr(sim._stepper, "_go_on", interrupting)
    with pytest.raises(cl.InterruptedRunError, match="interrupted") as caught:
        sim.run_until(0.17)
    run = caught.value.run
    for name in ("q", "contact_force", "kkt_condition", "torque"):
        assert np.array_equal(run.columns[name], whole.columns[name][: len(run)])
    assert sim.run_until(0.17).time == 0.17
    assert_same(whole, sim.run())
    assert torque.flags.writeable is False


def test_interrupted_where_a_batch_begins_anew():
    """Ctrl-C after a row that is the first of a new batch of condition numbers does not change those of the last."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.08})

    def driven(interrupted):
        sim = cl.Simulator(scenario)
        torque = sim.reset().torque
        while not sim.done:
            if sim.state.row == interrupted:
                sim._stepper.seen, seen = interrupt, sim._stepper.seen
                with pytest.raises(cl.InterruptedRunError):
                    sim.step(torque)
                sim._stepper.seen = seen
            sim.step(torque * (1.0 + 0.01 * sim.state.row))
        return sim.run()

    def interrupt():
        raise KeyboardInterrupt

    whole = driven(None)
    for row in (BATCH - 2, BATCH - 1, BATCH):
        assert_same(whole, driven(row))


def test_ctrl_c_itself():
    """A real signal while many steps are taken is an InterruptedRunError, and stepping goes on."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 1.0})
    sim = cl.Simulator(scenario)
    sim.reset()
    before = signal.signal(signal.SIGALRM, lambda number, frame: signal.raise_signal(signal.SIGINT))

    def go_on():
        signal.setitimer(signal.ITIMER_REAL, 0.003)
        while not sim.done:
            sim.run_until(1.0)
            sim.reset()

    try:
        with pytest.raises(KeyboardInterrupt):  # an InterruptedRunError, unless `reset` was at work
            go_on()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    sim.run_until(1.0)
    assert_same(cl.simulate(scenario), sim.run())


def test_states_are_copies():
    """A state stays what it was, and cannot be written into."""
    sim = cl.Simulator(cl.load_scenario("wam_slide", {"time.duration": 0.6}))
    first = sim.reset()
    q = first.q.copy()
    sim.run_until(0.6)
    assert np.array_equal(first.q, q)
    with pytest.raises(ValueError, match="read-only"):
        first.q[0] = 0.0
    assert repr(first) == "<StepState at 0 s: pressed, f = 10 N, gap = 0 m>"


def test_the_forces_of_a_state_have_the_names_of_columns_and_of_laws():
    """f and its reading are called in a `Simulator` as they are in a run and in a law."""
    sim = cl.Simulator(cl.load_scenario("wam_slide", {"time.duration": 0.01, "sensor.bias": 0.5}))
    state = sim.run_until(0.005)
    run = sim.run()
    assert state.f == state.contact_force == run.f[-1] == run.contact_force[-1]
    assert state.measured == state.f_measured == state.measured_force != state.f
    assert (state.e, state.f) == (state.closure_error, state.contact_force)
    assert all(np.array_equal(a, b) for a, b in ((state.r, run.r[-1]), (state.n, run.n[-1]), (state.Q, run.Q[-1])))
    assert run.measured_force[-1] == pytest.approx(state.measured, abs=1e-12)  # computed anew


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
@pytest.mark.parametrize("saved_at", [0.0, 0.012, 0.1599, 0.161])
def test_a_saved_state_goes_on_as_if_nothing_had_been(engine, saved_at):
    """After other torques, after the end and after `reset`, to the last bit, impacts and condition numbers included."""
    scenario = cl.load_scenario("wam_bounce", {"time.duration": 0.17})  # an impact is at 0.1606 s
    whole, sim = cl.simulate(scenario, engine=engine), cl.Simulator(scenario, engine=engine)
    sim.run_until(saved_at)
    saved = sim.save()
    for elsewhere in (lambda: sim.run_until(0.17), lambda: [sim.step(np.zeros(4)) for _ in range(5)], sim.reset):
        sim.restore(saved)
        elsewhere()
        assert sim.restore(saved).time == saved._now.state.time
        sim.run_until(0.17)
        run = sim.run()
        assert all(np.array_equal(run.columns[name], whole.columns[name]) for name in whole.columns)
    with pytest.raises(ValueError, match="must be given what save"):
        cl.Simulator(scenario).restore(saved)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("cube_toss", {"time.duration": 0.45}),  # it lands, slips and tumbles
        ("cube_toss", {"time.duration": 0.45, "time.integrator": "time_stepping"}),
        ("push_block", {"time.duration": 0.3}),
        ("hand_rolls", {"time.duration": 0.1}),
        ("gripper_block", {"time.duration": 0.2}),
        ("quadruped", {"time.duration": 0.1}),
    ],
)
def test_what_no_copy_of_the_memory_has_is_written_anew(name, changes):
    """Rows and scratch of the contacts, filled with NaN before each torque, do not tell in any column."""
    scenario, runs = cl.load_scenario(name, changes), []
    for filled in (False, True):
        sim = cl.Simulator(scenario, engine="compiled")
        torque = np.zeros(len(sim.reset().torque))
        contacts = sim._stepper.loop.w.kept["contacts"].contacts
        while not sim.done:
            if filled:
                for rows in (contacts.G, contacts.X):
                    rows[rows != 0.0] = np.nan
                for block in (contacts.stepping, contacts.given, contacts.scratch):
                    block.memory[:] = np.nan
            sim.step(torque)
        runs.append(sim.run())
    assert max(np.abs(runs[0].columns[each]).max() for each in runs[0].columns if "force" in each) > 0.0
    assert_same(*runs)


def test_a_run_begins_where_another_ended():
    """`run.state` are overrides of a scenario; a row that is not there is refused."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.7})
    run = cl.simulate(scenario)
    after = cl.simulate(scenario.replace(run.state(-1) | {"time.duration": 0.001}))
    assert np.array_equal(after.q[0], run.q[-1])
    assert np.allclose(after.v[0], run.v[-1], rtol=0, atol=1e-6)
    with pytest.raises(cl.ScenarioError, match="row = 701: the run has 701 rows"):
        run.state(701)
