"""The shipped scenarios with friction: each shows what its comment says."""

import numpy as np
import pytest

import closedloop as cl

STUCK = 2
SETTLED = 1.0  # s; the motion starts at 0.5 s, and the tip slips before 0.9 s


def errors(run):
    """Return the errors of force (N,), N, and path (N,), m: the latter in the surface."""
    normal = np.array(run.scenario.surface.normal)
    normal /= np.linalg.norm(normal)
    path = run.position - run.reference_tip
    path -= np.outer(path @ normal, normal)
    return run.contact_force - run.reference_force, np.linalg.norm(path, axis=1)


def rms(values):
    """Return the root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))


def test_force_and_path_are_kept_on_an_unknown_surface(shipped_run):
    """From 1 s to the end, stop included: 0.05 N and 0.1 mm RMS, ten times better than the paper's law."""
    good, bad = shipped_run("wam_hybrid_friction"), shipped_run("wam_slide_friction")
    assert good.scenario.friction == bad.scenario.friction
    assert good.scenario.reference == bad.scenario.reference
    window = good.time >= SETTLED
    (force, path), (paper_force, paper_path) = errors(good), errors(bad)
    assert rms(force[window]) < 0.05
    assert rms(path[window]) < 1e-4
    assert rms(paper_force[window]) > 10 * rms(force[window])
    assert rms(paper_path[window]) > 10 * rms(path[window])


def test_the_slide_is_quiet(shipped_run):
    """Between 2 s and 6 s, while the tip slides, the force is within a millinewton RMS."""
    run = shipped_run("wam_hybrid_friction")
    force, _ = errors(run)
    assert rms(force[(run.time >= 2.0) & (run.time <= 6.0)]) < 1e-3
    assert [event.kind for event in run.events] == ["slip"]  # at its goal it creeps: the observer takes friction away


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("step", [0.001, 0.0005, 0.0002])
def test_the_aim_is_met_at_any_step(step, scheme):
    """Once the break-away has settled, half a second after it, and until the stop: 0.001 N and 0.01 mm RMS."""
    run = cl.simulate(cl.load_scenario("wam_hybrid_friction", {"time.step": step, "time.integrator": scheme}))
    force, path = errors(run)
    window = (run.time >= 1.5) & (run.time <= 6.0)
    assert rms(force[window]) < 1e-3
    assert rms(path[window]) < 1e-5


def test_the_papers_law_sticks_and_trails(shipped_run):
    """The tip starts late, stops short of its goal and keeps a false force."""
    run = shipped_run("wam_slide_friction")
    force, path = errors(run)
    assert [event.kind for event in run.events] == ["slip", "stick"]
    assert run.events[0].time - run.scenario.reference.start > 0.5
    assert abs(force[-1]) > 1.0
    assert path[-1] > 5e-4


def test_a_soft_law_sticks_and_slips_by_turns(shipped_run):
    """Seven jumps of four to five millimetres, at rest for most of the time."""
    run = shipped_run("wam_stick_slip")
    assert [event.kind for event in run.events] == ["slip", "stick"] * 7
    assert np.mean(run.mode == STUCK) > 0.9
    jumps = [
        np.linalg.norm(stick.position - slip.position)
        for slip, stick in zip(run.events[::2], run.events[1::2], strict=True)
    ]
    assert min(jumps) > 4e-3
    assert max(jumps) < 5e-3


def test_a_wiping_arm_keeps_its_raster(shipped_run):
    """Within 0.5 mm of the raster, within 0.1 N for nine tenths of the time, and 0.04 N RMS."""
    run = shipped_run("panda_wipe")
    force, path = errors(run)
    assert run.time[-1] == pytest.approx(13.0)
    assert path.max() < 5e-4
    assert np.mean(np.abs(force) < 0.1) > 0.9
    assert rms(force) < 0.04
    assert np.max(np.abs(force)) < 0.5


def test_an_observer_compensates_friction_in_joints(shipped_run):
    """Two joints turn, two never do, and force and path are kept."""
    run = shipped_run("joint_friction")
    force, path = errors(run)
    assert rms(force) < 0.1
    assert rms(path) < 2e-5
    still = np.all(np.abs(run.v) < 1e-9, axis=0)
    assert still.tolist() == [True, False, True, False]
    plain = cl.simulate(cl.load_scenario("joint_friction", {"compensation.kind": "none"}))
    assert rms(errors(plain)[0]) > 10 * rms(force)
