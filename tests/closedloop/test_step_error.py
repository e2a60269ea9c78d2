"""What a run says of the error of its step, against runs at shorter steps and closed forms."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report.step_error import variation
from closedloop.scenario.modes import wrong_by

ELASTIC = {"transmission.stiffness": 7e4, "transmission.damping": 3.8, "transmission.motor_inertia": 0.05}


def away_from_changes(run, reference, k):
    """Return the largest difference of f from a run of k steps to each, rows beside a change of mode left out, N."""
    other, mode = reference.contact_force[::k], reference.mode[::k]
    beside = np.zeros(len(run), dtype=bool)
    for found in (run.mode, mode):
        for offset in (-1, 0, 1, 2):
            beside[np.clip(np.flatnonzero(np.diff(found)) + offset, 0, len(run) - 1)] = True
    kept = ~beside & (run.mode == mode)
    return np.max(np.abs(run.contact_force - other)[kept])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wam_slide", "panda_wipe", "soft_table", "joint_friction"])
def test_the_stated_error_bounds_the_true_one_and_is_near_it(name):
    """At four steps, against a run at an eighth of the shortest: at least the true error, at most 30 times that."""
    finest = 1.25e-4 / 8
    reference = cl.simulate(cl.load_scenario(name, {"time.step": finest}), engine="compiled")
    for h in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        run = cl.simulate(cl.load_scenario(name, {"time.step": h}), engine="compiled")
        true, stated = away_from_changes(run, reference, round(h / finest)), run.summary()["step_error"]
        assert true <= stated["contact_force"] <= 30.0 * true


def test_variation_of_a_decay_bounds_eulers_error_and_a_jump_is_none():
    """Of a e^-λt explicit Euler's error is within it and 30 times that; an isolated jump adds nothing."""
    n = np.arange(400)
    for z in (0.02, 0.1, 0.4):
        decay = np.exp(-z * n)
        true = np.max(np.abs((1.0 - z) ** n - decay))
        assert true <= variation(decay[:, None])[0] <= 30.0 * true
    assert variation((1.0 * (n > 50))[:, None])[0] == 0.0


@pytest.mark.parametrize(("z", "bad"), [(2.3, True), (1.0, False)])
def test_rk4_damps_a_swing_that_nothing_damps(z, bad):
    """With rk4 an undamped swing of hω = 2.3 is wrong by a tenth and more, as its polynomial says; of 1 it is not."""
    off, rate = wrong_by("rk4", 1e-3, np.array([[(z / 1e-3) ** 2]]), np.zeros((1, 1)))
    polynomial = sum((1j * z) ** k / f for k, f in enumerate((1, 1, 2, 6, 24)))
    assert off == pytest.approx(abs(np.log(polynomial) - 1j * z) / z, rel=1e-9)
    assert rate == pytest.approx(z / 1e-3)
    assert (off > 0.1) == bad


def test_a_step_that_does_not_resolve_elastic_joints_is_bad():
    """What diverges at every shorter step is not good at 1 ms, alone or in a batch; with rk4 no error is claimed."""
    changes = {**ELASTIC, "time.integrator": "rk4", "time.duration": 0.02}
    scenario = cl.load_scenario("wam_slide", changes)
    summary = cl.simulate(scenario, engine="compiled").summary()
    (row,) = cl.simulate_batch(scenario, {"law.force": [scenario.law.force]}).to_pylist()
    assert row["verdict"] == "resolution"
    assert row["step_error_force"] is row["step_error_position"] is None
    assert [problem["name"] for problem in summary["verdict"]["problems"]] == ["resolution"]
    assert summary["step_error"]["contact_force"] is None
    assert "rk4" in summary["step_error"]["why_not"]
