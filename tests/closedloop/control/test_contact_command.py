"""What a command to press, to rest or to leave does at the surface, under every law and on both engines."""

import numpy as np
import pytest
from contact_history import assert_one_story
from control_loop import Loop
from test_control_laws import LAWS as SECTIONS

import closedloop as cl

KINDS = ("paper", "hybrid", "operational_space", "dynamic_hybrid", "impedance", "admittance")
ENGINES = ("pinocchio", "compiled")
FREE, PRESSED = 0, 1


def edge(kind, engine="compiled", **changes):
    """Return the run of wam_edge under another law."""
    overrides = ({} if kind == "paper" else {"law.kind": kind}) | changes
    return cl.simulate(cl.load_scenario("wam_edge", overrides), engine=engine)


def constant(force, **changes):
    """Return the changes that command one force all the time."""
    return {"force_profile.kind": "constant", "law.force": force, "time.duration": 1.0} | changes


@pytest.mark.parametrize("kind", KINDS)
def test_a_command_that_changes_its_sign_is_followed_off_the_surface_and_back(kind):
    """wam_edge ends under every law, with one liftoff, one touchdown after it, 10 N at the end; both engines agree."""
    runs = [edge(kind, engine) for engine in (ENGINES if kind in ("paper", "impedance") else ENGINES[1:])]
    for run in runs:
        assert len(run) == 8001
        assert_one_story(run)
        kinds = [event.kind for event in run.events]
        assert kinds[0] == "liftoff"
        assert kinds[-1] == "touchdown"
        assert set(kinds[1:-1]) <= {"impact"}
        assert run.event_time[0] == pytest.approx(2.428, abs=3e-3)  # where the command falls below zero
        assert run.event_time[1] > 4.5  # it stays away until the command is above zero again, at 4.571 s or about
        assert run.closure_error.max() > 1e-3
        assert run.contact_force[-1] == pytest.approx(10.0, abs=0.1)
    assert np.array_equal(runs[0].event_kind, runs[-1].event_kind)
    assert np.max(np.abs(runs[0].event_time - runs[-1].event_time)) < 1e-9


ROUGH = {"friction.kind": "coulomb", "friction.coefficient": 0.3}


@pytest.mark.parametrize(
    "changes", [{"law.force_feedback": 0.5}, {"law.force_integral": 5.0} | ROUGH], ids=["K_f", "K_I"]
)
@pytest.mark.parametrize("kind", ["paper", "operational_space", "impedance"])
def test_feedback_that_lets_go_does_not_press_at_once(kind, changes):
    """With force feedback, and with an integral on a rough surface, f reaches zero while f_des is still above it."""
    run = edge(kind, **changes)
    assert len(run) == 8001
    assert [event.kind for event in run.events].count("liftoff") < 30


@pytest.mark.parametrize("kind", KINDS)
def test_a_negative_command_leaves_at_once_and_stays_away(kind):
    """Told to leave with 4 N, the tip lifts off at t = 0 and never comes back."""
    run = edge(kind, **constant(-4.0))
    assert [event.kind for event in run.events] == ["liftoff"]
    assert run.event_time[0] == 0.0
    assert np.all(run.mode == FREE)
    assert np.all(run.closure_error[1:] > 0.0)
    assert run.closure_error[-1] > 1e-3
    assert not np.any(run.contact_force)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_command_of_zero_rests_without_pressing(kind, engine):
    """At rest under a command of zero the force is rounding of either sign: the tip stays, and nothing happens."""
    run = edge(kind, engine, **constant(0.0, **{"reference.start": 2.0, "reference.stop": 6.0}))
    assert len(run.events) == 0
    assert np.all(run.mode == PRESSED)
    assert np.max(run.contact_force) < 1e-9
    assert np.min(run.contact_force) >= 0.0
    assert np.max(np.abs(run.closure_error)) < 1e-9


@pytest.mark.parametrize("states", [10, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.parametrize("f_des", [-4.0, -1e-3, 0.0, 1e-3, 10.0])
@pytest.mark.parametrize("kind", KINDS)
def test_no_law_presses_when_free_where_it_lets_go_in_contact(kind, f_des, states):
    """On the surface, without speed along n, the tip is accelerated off it when free if it is in contact."""
    rng, let_go = np.random.default_rng(4), 0
    for _ in range(states):
        loop = Loop("wam4", SECTIONS[kind], v=np.zeros(4))
        z = 0.02 * rng.normal(size=loop.z.size)
        x, _ = loop.moment(0.0, loop.q, loop.v)
        x = x._replace(f_des=f_des, q_des=x.q + rng.uniform(-1e-3, 1e-3, 4))
        rates = []
        for pressed in (1.0, 0.0):
            torque = loop.torque(x._replace(pressed=pressed), z)
            rates.append((x.A @ np.linalg.solve(x.H, torque - x.C))[0])
        contact, free = rates
        if contact > 1e-9:
            assert free > -1e-9 * max(1.0, contact)
            let_go += 1
    if f_des < 0.0:
        assert let_go > 0
