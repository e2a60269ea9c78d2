"""Very many impacts in a compiled loop: always an end, finite, never energy; and the same without compilation."""

import numpy as np
import pytest

from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.solve import DIVERGED, OK, SINGULAR
from closedloop.mechanics.impact import ImpactWork, impact
from closedloop.mechanics.impact.begin import (
    CUT,
    JAM,
    NEWTON,
    POISSON,
    RECOMPRESSION,
    REVERSAL,
    SLIP,
    STICK,
    STRONGE,
    TURN,
    WEDGE,
)

ALL = SLIP | STICK | REVERSAL | TURN | JAM | RECOMPRESSION | CUT | WEDGE


@kernel
def many(S, u, restitution, law, mu, work, compression, decompression, after, status, happened):
    """Do one impact a row."""
    for k in range(u.shape[0]):
        status[k] = impact(
            S[k], u[k], restitution[k], law[k], mu[k], work, (compression[k], decompression[k]), after[k]
        )  # fmt: skip
        happened[k] = int(ImpactWork(work).happened)


@pytest.mark.slow  # compiles the loop, some ten seconds
def test_a_hundred_thousand_impacts():
    """Mobilities of rank 1 to 4, of any shape, all laws, every mode met: no failure, no NaN, no energy, in the cone."""
    count, rng = 100_000, np.random.default_rng(1)
    B = rng.normal(size=(count, 3, 4))
    for rank in (1, 2, 3):
        B[rank::5, :, rank:] = 0.0
    B *= np.exp(rng.integers(0, 3, size=(count, 1, 1)) * rng.normal(size=(count, 3, 1)))
    B[::11, 2] = 0.0
    S = B @ B.transpose(0, 2, 1)
    v = rng.normal(size=(count, 4, 1))
    u = (B @ v)[:, :, 0]
    u[u[:, 0] > 0.0] *= -1.0
    mu = np.exp(1.5 * rng.normal(size=count) - 0.5)
    law = rng.integers(0, 3, size=count)
    compression, decompression, after = np.full((3, count, 3), np.nan)
    status, happened = np.full((2, count), -1)
    eps, work = rng.uniform(size=count), np.zeros(ImpactWork.count())
    many(S, u, eps, law, mu, work, compression, decompression, after, status, happened)
    assert np.all(status == OK)
    assert np.bitwise_or.reduce(happened) == ALL
    assert np.all(np.isfinite(compression) & np.isfinite(decompression) & np.isfinite(after))
    assert np.all(after[:, 0] >= 0.0)
    for phase in (compression, decompression):
        assert np.all(phase[:, 0] >= 0.0)
        assert np.all(np.hypot(phase[:, 1], phase[:, 2]) <= mu * phase[:, 0] * (1.0 + 1e-12))
    impulse = compression + decompression
    lost = -0.5 * np.sum((u + after) * impulse, axis=1)
    energy = 0.5 * np.sum(v**2, axis=(1, 2))
    # Energy is a sum of terms u_i P_i and P_i S_ij P_j, each rounded.
    rounding = np.einsum("ki,kij,kj->k", np.abs(impulse), np.abs(S), np.abs(impulse)) + energy
    assert np.all(lost >= -1e-13 * rounding)
    # Without Newton's law, not even by that
    assert np.all(lost[law != NEWTON] > 0.0)


def call(S, u, restitution, law, mu):
    """Return status, modes and the nine numbers that the kernel writes, from outputs full of NaN."""
    work = np.full(ImpactWork.count(), np.nan)
    out = np.full((3, 3), np.nan)
    status = impact(np.array(S), np.array(u), restitution, law, mu, work, (out[0], out[1]), out[2])
    return status, int(ImpactWork(work).happened), out


def test_status_and_outputs_where_there_is_no_impact():
    """Not finite: DIVERGED; no normal mobility, or a velocity no tip with this S has: SINGULAR; leaving: nothing."""
    eye, u = np.eye(3), [-1.0, 0.5, 0.0]
    nan = [-1.0, np.nan, 0.0]
    for S, velocity, mu, expected in [
        (eye, nan, 0.1, DIVERGED),
        (np.full((3, 3), np.inf), u, 0.1, DIVERGED),
        (eye, u, np.nan, DIVERGED),
        (np.diag([0.0, 1.0, 1.0]), u, 0.1, SINGULAR),
        (np.ones((3, 3)), [-1.0, 1.0, 1.0], 2.0, SINGULAR),
        (eye, [0.0, 1.0, 1.0], 0.1, OK),
        (eye, [0.2, 1.0, 1.0], 0.1, OK),
    ]:
        for law in (NEWTON, POISSON, STRONGE):
            status, modes, out = call(S, velocity, 0.5, law, mu)
            assert (status, modes) == (expected, 0)
            assert not out[:2].any()
            np.testing.assert_array_equal(out[2], velocity)


@pytest.mark.parametrize("law", [NEWTON, POISSON, STRONGE])
def test_numbers_that_underflow_are_zero(law):
    """The smallest approach, restitution and friction there are: an end, and no decompression of rounding."""
    tiny = 5e-324
    for S in (np.eye(3), 1e9 * np.eye(3)):
        status, _, out = call(S, [-tiny, 0.0, 0.0], 1.0, law, 0.5)
        assert status == OK
        assert not out.any()
        for mu in (0.0, tiny):
            status, _, out = call(S, [-1.0, 0.5, 0.0], tiny, law, mu)
            assert status == OK
            np.testing.assert_array_equal(out[1], 0.0)
            assert out[0, 0] == pytest.approx(1.0 / S[0, 0], rel=1e-15)
