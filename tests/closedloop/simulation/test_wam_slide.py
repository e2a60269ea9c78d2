"""The paper's simulation: what Figs. 4-7 show, in numbers. The regression test of a force-control study."""

import numpy as np
import pytest

import closedloop as cl

START, STOP = 0.5, 6.5  # s: the tip moves between these
FORCE = 10.0  # N, commanded
SPEED = 0.010  # m/s
TRAVEL = SPEED * (STOP - START)  # m


@pytest.fixture(scope="module")
def slide():
    """Return the run of the shipped scenario."""
    return cl.simulate(cl.load_scenario("wam_slide"))


@pytest.fixture(scope="module")
def unstabilised():
    """Return the run without the stabiliser."""
    return cl.simulate(cl.load_scenario("wam_slide_unstabilised"))


def rows(run, begin, end):
    """Return the rows with begin <= t < end; half a step of slack, since k·h is rounded."""
    return (run.time >= begin - 5e-4) & (run.time < end - 5e-4)


def size_at(run, second):
    """Return |e| of the row at a whole second, m."""
    return abs(run.closure_error[round(second / run.scenario.time.step)])


def test_force_is_exact_while_the_arm_rests(slide):
    """The arm presses with exactly the commanded force while nothing moves.

    Eq. 33 then reads Q = C - Aᵀf_des, so f = f_des in exact arithmetic. Rounding leaves 1e-16 of the terms that
    cancel (some 10 N m) times the condition of Eq. 24 (about 25): 1e-13 N. 1e-9 N is room for another libm.
    """
    rest = rows(slide, 0.0, START)
    assert np.count_nonzero(rest) == 500
    assert np.max(np.abs(slide.contact_force[rest] - FORCE)) < 1e-9


def test_force_jumps_as_eq_24_says_when_the_motion_starts(slide):
    """The first row of the transient is the force that Eq. 24 gives for the PD torque of a velocity step.

    The arm is still at rest and on its path, so Q = C - Aᵀf_des + K_d q̇_des, written here from the robot's own
    terms. 1e-9 N: the state differs from the start by the rounding of 500 steps of rest.
    """
    k = round(START / 0.001)
    robot = cl.Robot(slide.model, "tip")
    terms = robot.terms(slide.q[0], np.zeros(4))
    A = terms.jacobian[2]
    kd = np.array(slide.scenario.law.kd)
    _, f = cl.solve_closure(terms.mass_matrix, kd * slide.reference_velocity[k] - A * FORCE, A, 0.0)
    assert slide.contact_force[k] == pytest.approx(f, abs=1e-9)
    assert abs(slide.contact_force[k] - FORCE) > 1.0


def test_force_overshoots_as_the_motion_starts(slide):
    """The velocity steps are visible in the force: an overshoot at 0.5 s, as the paper has it, and a dip at 6.5 s.

    A tip that must at once run at 10 mm/s, or stand, gets K_d q̇_des of torque too much, of which 1.7 N and 2.4 N
    reach the normal (the test above has the very number). A step of less than 1 N would not be the paper's, and one
    of more than 3 N would be shaking. The contact is never lost.
    """
    lowest, highest = int(np.argmin(slide.contact_force)), int(np.argmax(slide.contact_force))
    assert slide.time[highest] == pytest.approx(START)
    assert 11.0 < slide.contact_force[highest] < 13.0
    assert slide.time[lowest] == pytest.approx(STOP)
    assert 7.0 < slide.contact_force[lowest] < 9.0


def test_force_settles_within_the_motion_and_after_it(slide):
    """The force comes back to 10 N after the motion stops: 1e-3 N after a second, 1e-6 N at the end.

    The slowest closed-loop pole on the surface is at -14 1/s: of a transient of 2.2 N, e^-14 leaves 2e-6 N after a
    second and e^-21 leaves 2e-9 N at the end. While the tip runs at constant speed the law does not know the path's
    joint accelerations: H q̈_des, of some 1e-3 N, stays.
    """
    after = slide.time >= STOP + 1.0 - 5e-4
    assert np.count_nonzero(after) == 501
    assert np.max(np.abs(slide.contact_force[after] - FORCE)) < 1e-3
    assert abs(slide.contact_force[-1] - FORCE) < 1e-6
    cruising = np.abs(slide.contact_force[rows(slide, START + 1.0, STOP)] - FORCE)
    assert 1e-4 < cruising.max() < 1e-2


def test_stabiliser_keeps_the_closure(slide):
    """The closure error stays below 10 nm.

    A first-order scheme leaves h² of the acceleration that it neglects, some 1e-10 m a step at the velocity step, and
    the stabiliser (T = 1 ms) removes it within a few steps: 6e-10 m is left.
    """
    assert np.max(np.abs(slide.closure_error)) < 1e-8
    assert np.max(np.abs(slide.closure_error)) > 1e-12  # it is there: a zero would mean that nothing was measured


def test_without_the_stabiliser_the_closure_drifts_steadily(slide, unstabilised):
    """Without the stabiliser |e| grows through the motion, past half a micrometre, and stays there (Fig. 7)."""
    sizes = [size_at(unstabilised, second) for second in (1, 2, 3, 4, 5, 6)]
    increments = np.diff(sizes)
    assert np.all(increments > 0.0)
    assert increments.max() < 5.0 * increments.min()  # a creep, not a blow-up
    assert 3e-7 < abs(unstabilised.closure_error[-1]) < 3e-6
    assert abs(unstabilised.closure_error[-1]) > 100 * np.max(np.abs(slide.closure_error))


def test_tip_moves_as_slowly_as_it_is_told(slide):
    """The tip runs at 10 mm/s with less than a tenth of overshoot, and comes to rest."""
    speed = np.linalg.norm(slide.velocity, axis=1)
    assert speed.max() < 1.1 * SPEED < 0.02
    middle = rows(slide, 2.0, 6.0)
    assert np.all(np.abs(speed[middle] - SPEED) < 1e-5)
    assert speed[-1] < 1e-9


def test_tip_goes_straight_along_y(slide):
    """Only y changes: x and z stay within a micrometre, and y ends 60 mm further to 10 µm.

    z is held by the closure (nanometres), x by the PD part alone, which lags behind the path in x by the same
    neglected H q̈_des that shows in the force: 1e-3 N over K_p, some 1e-8 m.
    """
    moved = slide.position - slide.position[0]
    assert np.max(np.abs(moved[:, 2])) < 1e-8
    assert np.max(np.abs(moved[:, 0])) < 1e-6
    assert moved[-1, 1] == pytest.approx(TRAVEL, abs=1e-5)
    assert np.max(np.abs(slide.position[slide.time < START - 5e-4] - slide.position[0])) < 1e-12
