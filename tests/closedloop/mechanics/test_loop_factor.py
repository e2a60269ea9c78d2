"""The rows of loops by themselves: their factors, what they leave free, and torques through the drives, by SVD."""

import numpy as np
import pytest
import scipy.linalg

import robot_models
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.factor import PIVOT, factor, fewest_entries, meet, order_of, smallest_share
from closedloop.mechanics.loops.reactions import through_drives
from closedloop.mechanics.loops.solve import basis_alike, basis_in_metric, leave_free, take_free
from closedloop.mechanics.robot.pinocchio import Robot

M, N = 5, 4


@pytest.fixture
def memory():
    """The memory of a mechanism with M rows and N joints."""
    return loop_memory(Robot(robot_models.load("five_bar")))


def give_rows(rows, rank, rng):
    """Write rows (M, N) of usual lengths from 1e-3 to 1e3, of which so many are independent."""
    rows.scale[:] = 10.0 ** rng.uniform(-3, 3, size=M)
    rows.G[:] = rng.normal(size=(M, rank)) @ rng.normal(size=(rank, N)) / rows.scale[:, None]


def test_factors_and_basis_are_those_of_the_rows(memory):
    """Rank, motions that meet the rows, and P in both metrics, by either basis."""
    links, rows = memory
    for rank in range(N + 1):
        rng = np.random.default_rng(rank)
        give_rows(rows, rank, rng)
        scale = 1.0 / rows.scale
        x = rng.normal(size=N)
        interpreted(factor)(links, rows, rows.G @ x, M)
        assert links.rank == rank
        np.testing.assert_allclose((rows.G @ rows.met - rows.G @ x) / scale, 0.0, atol=1e-10)
        rows.met[:] = np.nan
        interpreted(meet)(links, rows, rows.G @ x)
        np.testing.assert_allclose((rows.G @ rows.met - rows.G @ x) / scale, 0.0, atol=1e-10)
        L = np.tril(rng.normal(size=(N, N))) + 5.0 * np.eye(N)
        for metric in (np.eye(N), L, np.tril(L, -1) + np.eye(N)):
            if metric is L or metric[1, 0]:
                interpreted(basis_in_metric)(links, rows, np.tril(metric, -1) + np.diag(1.0 / np.diag(metric)))
            else:
                interpreted(basis_alike)(links, rows)
            assert links.free == (N - rank < rank)
            Z = np.linalg.solve(metric, rows.G.T / scale).T
            null = np.linalg.svd(Z)[2][rank:]
            left, taken = x.copy(), x.copy()
            interpreted(leave_free)(links, rows, left)
            interpreted(take_free)(links, rows, taken)
            np.testing.assert_allclose(left, null.T @ (null @ x), atol=1e-10)
            np.testing.assert_allclose(left + taken, x, atol=1e-12)


def test_order_is_kept_until_a_pivot_becomes_small(memory):
    """Rows that have changed a little are eliminated in the order there is; where a pivot vanishes, in another."""
    links, rows = memory
    rng = np.random.default_rng(1)
    give_rows(rows, 3, rng)
    G, x = rows.G.copy(), rng.normal(size=N)
    of_rows, joints = interpreted(order_of)(links)
    interpreted(factor)(links, rows, rows.G @ x, M)
    first = [*of_rows, *joints]
    rows.G[:] = G @ (np.eye(N) + 1e-3 * rng.normal(size=(N, N)))
    interpreted(factor)(links, rows, rows.G @ x, M)
    assert [*of_rows, *joints] == first
    rows.G[:, first[M]] *= 1e-3
    interpreted(factor)(links, rows, rows.G @ x, M)
    assert [*of_rows, *joints] != first
    np.testing.assert_allclose(rows.G @ rows.met, rows.G @ x, atol=1e-9 * np.abs(G).max())


@pytest.mark.parametrize("rank", [0, 1, 2, 3, N])
def test_share_of_the_last_row_is_its_part_outside_the_span_of_the_others(memory, rank):
    """Where the rows determine all joints; else no more than that: the motion of the joints that they determine."""
    links, rows = memory
    rng = np.random.default_rng(10 + rank)
    give_rows(rows, rank, rng)
    interpreted(factor)(links, rows, rows.drift, M)
    share = interpreted(smallest_share)(links, rows)
    if rank == 0:
        assert share == 1.0
        return
    of_rows, joints = interpreted(order_of)(links)
    units = (rows.scale[:, None] * rows.G)[of_rows[:rank]]
    alone = np.linalg.solve(units[:, joints[:rank]], np.eye(rank)[-1])
    assert share == pytest.approx(1.0 / np.linalg.norm(alone), rel=1e-9)
    last, others = units[-1], units[:-1]
    outside = np.linalg.norm(last - others.T @ np.linalg.lstsq(others.T, last)[0])
    assert share <= outside * (1 + 1e-9)
    assert rank < N or share == pytest.approx(outside, rel=1e-9)


def test_pivot_is_the_entry_with_the_fewest_others():
    """Of those that are large enough, by the number of entries in its row and column; the largest of several."""
    rng = np.random.default_rng(3)
    for first in (0, 1, 2):
        R = rng.normal(size=(M, N)) * (rng.random((M, N)) < 0.6)
        of_rows, joints = rng.permutation(M), rng.permutation(N)
        left = R[of_rows[first:]][:, joints[first:]]
        least = PIVOT * np.abs(left).max()
        row, column = interpreted(fewest_entries)(R, of_rows, joints, first, least)
        there = left != 0.0
        fill = np.outer(there.sum(axis=1) - 1, there.sum(axis=0) - 1)
        best = fill[np.abs(left) >= least].min()
        entry = np.abs(left[row - first, column - first])
        assert entry == np.abs(left[(np.abs(left) >= least) & (fill == best)]).max()
        assert fill[row - first, column - first] == best


def test_drives_give_the_power_of_all_torques(memory):
    """By the smallest change where they can, more drives than needed or just as many; of one too few no other part.

    What is lost then is the part of the passive joints along the one motion of theirs with the drive at rest.
    """
    links, rows = memory
    rng = np.random.default_rng(2)
    give_rows(rows, 2, rng)
    interpreted(factor)(links, rows, rows.drift, M)
    motions = np.linalg.svd(rows.G / np.linalg.norm(rows.G, axis=1, keepdims=True))[2][2:]
    for drives in (1, 2, 3):
        rows.undriven[: N - drives] = np.eye(N)[drives:]
        links.undriven = N - drives
        asked = rng.normal(size=N)
        torque = asked.copy()
        lost = interpreted(through_drives)(links, rows, torque)
        assert lost == max(0, 2 - drives)
        np.testing.assert_array_equal(torque[drives:], 0.0)
        free = interpreted(order_of)(links)[1][2:]  # powers are those of motions of one free joint at rate one each
        alone = np.linalg.solve(motions[:, free], motions)
        passive = scipy.linalg.null_space(rows.G[:2, drives:])  # motions of the passive joints alone
        assert passive.shape[1] == lost
        passed = asked[drives:] - passive @ (passive.T @ asked[drives:])
        least = np.linalg.pinv(alone[:, :drives]) @ (alone[:, drives:] @ passed)
        np.testing.assert_allclose(torque[:drives], asked[:drives] + least, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(motions @ torque, motions @ np.concatenate([asked[:drives], passed]), atol=1e-8)


@pytest.mark.parametrize("rounding", [0.0, 1e-30, -5e-42])
def test_a_drive_in_a_motion_by_rounding_takes_no_part_in_it(memory, rounding):
    """What moves by 1e-30 rad where a passive joint moves by 1 rad does not bear what is asked of that joint."""
    links, rows = memory
    rows.scale[:], rows.G[:] = 1.0, 0.0
    rows.G[0, [0, 2]], rows.G[1] = (1.0, rounding), (0.0, 1.0, 0.4, -0.3)
    interpreted(factor)(links, rows, rows.drift, M)
    rows.undriven[: N - 1] = np.eye(N)[1:]
    links.undriven = N - 1
    torque = np.array([0.7, 1.0, -2.0, 0.5])
    assert interpreted(through_drives)(links, rows, torque) == 2
    np.testing.assert_allclose(torque, [0.7, 0.0, 0.0, 0.0], atol=1e-15)
