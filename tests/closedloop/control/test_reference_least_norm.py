"""The smallest joint velocity by one-sided Jacobi rotations, held against numpy's singular value decomposition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from closedloop.control.reference.inverse_kinematics import RANK_TOLERANCE, least_norm
from closedloop.jit.kernel import plain


def rate_of(J, wanted):
    """Return what `least_norm` makes of Jᵣ and a velocity."""
    rate = np.full(J.shape[1], 7.0)
    plain(least_norm)(np.array(J, dtype=float), np.array(wanted, dtype=float), np.zeros(J.shape), np.zeros(3), rate)
    return rate


def jacobian(seed, n, sizes):
    """Return a random Jᵣ (3, n) with these singular values, and a velocity."""
    rng = np.random.default_rng(seed)
    U, V = (np.linalg.qr(rng.normal(size=(k, k)))[0] for k in (3, n))
    count = min(3, n)
    return U[:, :count] @ np.diag(sizes[:count]) @ V[:, :count].T, rng.normal(size=3)


@given(st.integers(0, 10**6), st.integers(1, 9), st.floats(-3, 3), st.floats(-3, 3), st.integers(-150, 150))
def test_equals_the_pseudoinverse(seed, n, second, third, scale):
    """Jᵣ⁺ ṙ for singular values up to a million apart, of any size; to rounding times the condition number."""
    sizes = 10.0 ** np.array([0.0, second, third])
    J, wanted = jacobian(seed, n, sizes)
    kept = sizes[: min(3, n)]
    if kept.min() < 10 * RANK_TOLERANCE * kept.max():
        kept = kept * 0.0 + 1.0
        J, wanted = jacobian(seed, n, kept)
    expected = np.linalg.pinv(J) @ wanted
    condition = kept.max() / kept.min()
    found = rate_of(J * 10.0**scale, wanted) * 10.0**scale
    assert np.max(np.abs(found - expected)) <= 1e-14 * condition * np.linalg.norm(wanted) / kept.min()


@pytest.mark.parametrize(("n", "rank"), [(2, 1), (4, 1), (4, 2), (7, 1), (7, 2)])
def test_what_no_joint_moves_counts_as_nothing(n, rank):
    """Directions below the rank tolerance, exactly zero or by rounding, take no part; one just above it does."""
    for small in (0.0, 1e-17, 0.1 * RANK_TOLERANCE):
        sizes = np.array([1.0, 0.5, 0.25])
        sizes[rank:] = small
        J, wanted = jacobian(5, n, sizes)
        expected = np.linalg.pinv(J, rcond=RANK_TOLERANCE) @ wanted
        assert np.max(np.abs(rate_of(J, wanted) - expected)) < 1e-12
    sizes[rank:] = 10.0 * RANK_TOLERANCE
    assert np.max(np.abs(rate_of(*jacobian(5, n, sizes)))) > 1e3


def test_small_singular_values_are_accurate():
    """Rows of sizes 1, 1e-3 and 1e-5 along the axes: each comes out to rounding, not to rounding times 1e10."""
    J = np.diag([1.0, 1e-3, 1e-5])
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    assert np.max(np.abs(rate_of(J @ turn, [1.0, 1e-3, 1e-5]) - turn.T @ np.ones(3))) < 1e-14


def test_an_arm_that_cannot_move_stays():
    """Zero in, zero out; also for a velocity of zero."""
    assert np.all(rate_of(np.zeros((3, 4)), [1.0, 2.0, 3.0]) == 0.0)
    assert np.all(rate_of(np.eye(3), np.zeros(3)) == 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_not_a_number(bad):
    """Nothing that is not finite comes out as a motion."""
    J = np.eye(3)
    assert np.all(np.isnan(rate_of(J, [0.0, bad, 0.0])))
    J[1, 2] = bad
    assert np.all(np.isnan(rate_of(J, np.ones(3))))
