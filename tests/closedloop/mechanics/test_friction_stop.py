"""A sliding block stops when and where the closed form says; friction with memory lags its speed."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.limits import MAX_IN_STEP, OUTPACED

G, MU, SPEED = 9.81, 0.3, 0.25
STUCK = 2


@pytest.mark.parametrize("law", ["coulomb", "stribeck"])
@pytest.mark.parametrize("degrees", [0, 90, 120, 225, 270, 350])
def test_a_block_stops_when_and_where_the_closed_form_says(degrees, law):
    """With μ m g against it, it stops at v/(μ g), v²/(2 μ g) on, and stays there; the stop falls within a step."""
    angle = np.radians(degrees)
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    levels = {"friction.coefficient": MU} if law == "coulomb" else {
        "friction.kinetic": MU, "friction.static": MU, "friction.stribeck_speed": 0.01,
    }  # fmt: skip
    scenario = cl.load_scenario(
        "planar2_drop",
        {
            "robot.model": "pointmass3", "surface.offset": 0.0, "surface.gap": 0.0, "start.q": [0.0, 0.0, 0.0],
            "start.v": (SPEED * along).tolist(), "law.kd": 0.0, "stabiliser.kind": "projection",
            "friction.kind": law, "time.integrator": "rk4", "time.step": 0.004, "time.duration": 0.1,
        } | levels,
    )  # fmt: skip
    run = cl.simulate(scenario, law=lambda t, q, v, terms: np.zeros(3))
    assert [event.kind for event in run.events] == ["stick"]
    stop = SPEED / (MU * G)
    assert run.event_time[0] == pytest.approx(stop, abs=1e-12)
    t = np.minimum(run.time, stop)
    np.testing.assert_allclose(run.q, np.outer(SPEED * t - 0.5 * MU * G * t**2, along), atol=1e-13)
    assert np.all(run.mode[run.time > stop] == STUCK)
    sliding = run.time < stop
    np.testing.assert_allclose(run.friction_force[sliding], np.outer(-2.0 * MU * G * np.ones(sliding.sum()), along),
                               atol=1e-12)  # fmt: skip


@pytest.mark.parametrize("scheme", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("lag", [4e-4, 2.5e-3, 3e-3, 1.0])
def test_friction_with_memory_is_that_of_the_slip_some_time_ago(lag, scheme):
    """Every row has the friction of the speed that lies `lag` seconds before it, on a line between the rows."""
    along, kinetic, excess, speed = np.array([np.cos(2.0), np.sin(2.0), 0.0]), 0.1, 0.3, 0.05
    scenario = cl.load_scenario(
        "planar2_drop",
        {
            "robot.model": "pointmass3", "surface.offset": 0.0, "surface.gap": 0.0, "start.q": [0.0, 0.0, 0.0],
            "start.v": (0.3 * along).tolist(), "law.kd": 0.0, "stabiliser.kind": "projection",
            "friction.kind": "seven_parameter", "friction.kinetic": kinetic, "friction.static_excess": excess,
            "friction.stribeck_speed": speed, "friction.stiffness": 1e5, "friction.memory_delay": lag,
            "friction.rise_time": 0.0, "time.integrator": scheme, "time.step": 1e-3, "time.duration": 0.05,
        },
    )  # fmt: skip
    run = cl.simulate(scenario, law=lambda t, q, v, terms: np.zeros(3))
    assert len(run.events) == 0
    slip = np.linalg.norm(run.velocity[:, :2], axis=1)
    assert slip[-1] < 0.25
    before = np.interp(run.time - lag, run.time, slip)
    level = kinetic + excess / (1.0 + (before / speed) ** 2)
    np.testing.assert_allclose(run.friction_force, np.outer(-2.0 * G * level, along), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("degrees", [0, 90, 230])
def test_a_block_breaks_away_when_the_pull_is_too_strong(degrees):
    """Pulled by a force that rises evenly, it stays until the pull is μ m g, and then slides off along it."""
    rise, angle = 100.0, np.radians(degrees)  # N/s
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    scenario = cl.load_scenario(
        "planar2_drop",
        {
            "robot.model": "pointmass3", "surface.offset": 0.0, "surface.gap": 0.0, "start.q": [0.0, 0.0, 0.0],
            "start.v": [0.0, 0.0, 0.0], "law.kd": 0.0, "stabiliser.kind": "projection", "friction.kind": "coulomb",
            "friction.coefficient": MU, "time.integrator": "rk4", "time.step": 0.004, "time.duration": 0.08,
        },
    )  # fmt: skip
    run = cl.simulate(scenario, law=lambda t, q, v, terms: rise * t * along)
    away = MU * 2.0 * G / rise
    assert [event.kind for event in run.events] == ["slip"]
    assert run.event_time[0] == pytest.approx(away, abs=1e-9)
    stuck = run.time < away
    np.testing.assert_array_equal(run.mode[stuck], STUCK)
    np.testing.assert_allclose(run.friction_force[stuck], np.outer(-rise * run.time[stuck], along), atol=1e-12)
    slid = np.maximum(run.time - away, 0.0) ** 3 * rise / (6.0 * 2.0)
    np.testing.assert_allclose(run.q, np.outer(slid, along), atol=1e-9)


@pytest.mark.slow
def test_stick_and_slip_without_end_end_the_run():
    """Elastic joints measured at their motors feed a swing that no step resolves: the tip sticks and slips in it.

    The number of events is limited, and the line names them, not the divergence that they come before.
    """
    elastic = {"transmission.stiffness": 5126.416396908399, "transmission.damping": 0.0,
               "transmission.motor_inertia": 0.04560882887733263, "transmission.measured": "motor",
               "joint_friction.kind": "coulomb", "joint_friction.kinetic": 0.6262351154754134,
               "time.duration": 0.12, "time.integrator": "rk4"}  # fmt: skip
    with pytest.raises(cl.SimulationError, match=r"too many events|diverges") as stopped:
        cl.simulate(cl.load_scenario("panda_polish", elastic), engine="compiled")
    run = stopped.value.run
    assert 100 < len(run.events) <= MAX_IN_STEP + OUTPACED * len(run)
    assert not run.summary()["verdict"]["good"]
