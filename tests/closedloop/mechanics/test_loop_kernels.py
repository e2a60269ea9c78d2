"""The kernels of loop joints, interpreted, against closed forms: a gear's polynomial, a basis of rows."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.loops.rows import _gear
from closedloop.mechanics.loops.solve import combine_rows, meet_rows, orthonormal_rows


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("x", [0.7, -1.3])
def test_each_coefficient_of_a_gear_acts_on_value_slope_and_curvature(degree, x):
    """q1 = P(q2) with P = c xᵏ: error, row, rate and drift are those of the polynomial and its derivatives."""
    c = np.zeros(5)
    c[degree] = 0.8
    P, v = Polynomial(c), np.array([0.4, -1.7])
    rows = SimpleNamespace(
        value=c[None], q=np.array([0.2, x]), v=v, G=np.zeros((1, 2)), error=np.zeros(1), rate=np.zeros(1),
        drift=np.zeros(1), first=np.array([[1.0, 0.0]]), second=np.array([[0.0, 1.0]]),
    )  # fmt: skip
    interpreted(_gear)(rows, 0, 2)
    slope, curvature = P.deriv(1)(x), P.deriv(2)(x)
    np.testing.assert_allclose(rows.error, [0.2 - P(x)], rtol=1e-14)
    np.testing.assert_allclose(rows.G, [[1.0, -slope]], rtol=1e-14)
    np.testing.assert_allclose(rows.rate, [v[0] - slope * v[1]], rtol=1e-14)
    np.testing.assert_allclose(rows.drift, [-curvature * v[1] ** 2], rtol=1e-14)


def basis_of(Z):
    """Return the basis of rows, what each direction was made of, the coefficients and the rank."""
    m = len(Z)
    B, order, coefficients = Z.copy(), np.zeros(m), np.full((m, m), np.nan)
    rank = interpreted(orthonormal_rows)(B, m, order, coefficients, np.zeros(m))
    return B, order, coefficients, rank


def slanted(seed, m=5, n=7, near=1.0):
    """Return rows that lie within `near` of each other, of lengths from 0.01 to 100."""
    rng = np.random.default_rng(seed)
    return (rng.normal(size=n) + near * rng.normal(size=(m, n))) * 10.0 ** rng.uniform(-2, 2, size=(m, 1))


@pytest.mark.parametrize("near", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("seed", range(3))
def test_rows_are_their_coefficients_in_the_basis(seed, near):
    """Z = C B, row for row, to a few ulps of each row; B is orthonormal to rounding however near the rows are."""
    Z = slanted(seed, near=near)
    B, order, coefficients, rank = basis_of(Z)
    assert rank == len(Z)
    np.testing.assert_allclose(B @ B.T, np.eye(rank), atol=1e-14)
    for k in range(rank):
        row = Z[int(order[k])]
        made = coefficients[k, : k + 1] @ B[: k + 1]
        assert np.max(np.abs(made - row)) < 1e-14 * np.linalg.norm(row)


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_met_and_forces_spanned(seed):
    """The shortest y with Z y = b, and the force with Zᵀ force = t, as the pseudo-inverse has them."""
    Z, rng = slanted(seed), np.random.default_rng(seed + 10)
    Z[3] = 2.0 * Z[0] - Z[2]  # one that depends on others
    B, order, coefficients, rank = basis_of(Z)
    assert rank == 4
    y0 = rng.normal(size=7)
    b, y, along, force = Z @ y0, np.zeros(7), np.zeros(5), np.zeros(5)
    interpreted(meet_rows)(b, order, coefficients, B, rank, along, y)
    np.testing.assert_allclose(y, np.linalg.pinv(Z) @ b, atol=1e-11)
    t = Z.T @ rng.normal(size=5)
    combined = np.zeros(rank)
    interpreted(combine_rows)(B[:rank] @ t, coefficients, rank, combined)
    force[order[:rank].astype(int)] = combined
    np.testing.assert_allclose(Z.T @ force, t, rtol=0.0, atol=1e-12 * np.abs(t).max())
