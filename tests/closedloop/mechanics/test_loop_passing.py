"""What loops require of the acceleration near a pose in which they lose rank: as the mechanism's own angles have it."""

import numpy as np
import pytest

from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.closed_loops import find_required_on_the_way
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.solve import close_state, leave_free
from closedloop.mechanics.robot.pinocchio import Robot
from validation.loops.cases import bar, joint, loop, mechanism, point

CRANK, BASE, ROCKER = 0.2, 0.3, 0.4
COUPLER = BASE + ROCKER - CRANK


def angles(crank):
    """J1, J2, J3 of the four-bar on the way that passes its flat pose, crank = 0, from one side to the other."""
    x, z = BASE - CRANK * np.cos(crank), -CRANK * np.sin(crank)
    far = np.hypot(x, z)
    cosine = (far**2 + COUPLER**2 - ROCKER**2) / (2 * far * COUPLER)
    coupler = np.arctan2(z, x) + np.sign(crank) * np.arccos(np.clip(cosine, -1, 1))
    end = CRANK * np.array([np.cos(crank), np.sin(crank)]) + COUPLER * np.array([np.cos(coupler), np.sin(coupler)])
    return np.array([crank, coupler - crank, np.arctan2(end[1], end[0] - BASE)])


def state(crank):
    """The angles, their first and their second derivatives by the crank: of a polynomial through some at a distance."""
    around = crank + 0.02 * np.arange(-6.5, 7.0)
    along = [np.polynomial.Polynomial.fit(around, each, 13) for each in np.transpose([angles(a) for a in around])]
    return (np.array([each.deriv(k)(crank) if k else each(crank) for each in along]) for k in range(3))


@pytest.fixture(scope="module")
def memory():
    """The memory of the loop, its rows along directions at an angle to the bars."""
    body = bar("crank", CRANK) + bar("coupler", COUPLER) + bar("rocker", ROCKER)
    body += joint("J1", "base", "crank") + joint("J2", "crank", "coupler", f"{CRANK} 0 0")
    body += joint("J3", "base", "rocker", f"{BASE} 0 0") + point("a", "coupler", f"{COUPLER} 0 0")
    body += point("b", "rocker", f"{ROCKER} 0 0", rpy="0 0.7 0")
    return loop_memory(Robot(mechanism("four_bar", body, [loop("pin", "point", "ab")], angles(0.3), tip="a")))


def metric(seed):
    """A factor L of a metric, and how the kernels keep it: with the reciprocals of its diagonal."""
    rng = np.random.default_rng(seed)
    L = np.tril(rng.normal(size=(3, 3))) + 2.0 * np.eye(3)
    kept = L.copy()
    kept[np.diag_indices(3)] = 1.0 / np.diag(L)
    return L, kept


@pytest.mark.parametrize("crank", [0.0, 1e-9, -1e-6, 1e-4, -8e-4, -0.3])
def test_what_is_required_is_as_the_angles_have_it(memory, crank):
    """The acceleration across the mechanism's one motion, in any metric, that motion, and the rank, on both sides."""
    links, rows = memory
    q, rate, bend = state(crank)
    for seed, speed in ((0, 3.0), (1, 30.0)):
        L, kept = metric(seed)
        links.known = 2
        interpreted(find_required_on_the_way)(links, rows, kept, q, speed * rate)
        assert links.rank == 2
        way = L.T @ rate / np.linalg.norm(L.T @ rate)
        across = speed**2 * (L.T @ bend - way * (way @ L.T @ bend))
        np.testing.assert_allclose(rows.part, across, atol=3e-8 * speed**2)
        left = np.array([0.3, -0.7, 1.1])
        expected = way * (way @ left)
        interpreted(leave_free)(links, rows, left)
        np.testing.assert_allclose(left, expected, atol=3e-7)
        interpreted(leave_free)(links, rows, rows.part)
        np.testing.assert_allclose(rows.part, 0.0, atol=1e-15 * speed**2)


@pytest.mark.parametrize("crank", [0.3, -1e-2, 1e-4, -1e-5, 1e-6, -1e-7, 1e-8, 1e-9, 0.0])
def test_closing_a_closed_state_leaves_its_velocity(memory, crank):
    """However near it is to a pose in which the rows lose rank, and whatever state was closed before."""
    links, rows = memory
    q, rate, _ = state(crank)
    for before in (0.3, 1e-4, crank):
        links.known = 2
        interpreted(close_state)(links, rows, *(each.copy() for each in tuple(state(before))[:2]))
        closed, velocity = q.copy(), 5.0 * rate
        assert interpreted(close_state)(links, rows, closed, velocity) < 1e-12
        np.testing.assert_allclose(closed, q, atol=1e-9)
        np.testing.assert_allclose(velocity, 5.0 * rate, atol=3e-6)


def test_at_rest_in_the_flat_pose_nothing_is_required(memory):
    """There is no way on which the lost row would have a direction."""
    links, rows = memory
    links.known = 2
    interpreted(find_required_on_the_way)(links, rows, metric(0)[1], np.zeros(3), np.zeros(3))
    assert links.rank == links.known == 1
    np.testing.assert_array_equal(rows.part, 0.0)
