"""The closure: what holds the tip on the surface, and the stabiliser that keeps it there (Eqs. 11, 19-23).

A closure is m >= 1 rows, and for each row

    A (n,)      so that ė = A q̇           A = nᵀJᵣ for the plane
    drift       Ȧq̇, the part of ë that q̈ does not cause
    e, ė        closure error (m; positive off the surface) and its rate

from which the right-hand side of Eq. 24 follows: b_s = −Ȧq̇ − s_v ė − s_p e (Eq. 23).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import kernel

Array = NDArray[np.float64]


@kernel
def plane_rows(
    plane: Array, J: Array, r: Array, drift: Array, v: Array, A: Array, gamma: Array, e: Array, rate: Array
) -> None:
    """Write the one row of the plane closure n·r = d (Eq. 11), differentiated twice (Eqs. 19-21).

    Parameters
    ----------
    plane : (4,) array
        Unit normal n and offset d.
    J : (>=3, n) array
        Jacobian of the tip, linear part in the first three rows, base axes (Jᵣ of Eq. 13).
    r, drift : (3,) arrays
        Tip position, m, and J̇ᵣq̇ (Eq. 18), m/s², base axes.
    v : (n,) array
        Joint velocity.
    A, gamma, e, rate : (1, n), (1,), (1,), (1,) arrays
        Written: nᵀJᵣ, nᵀJ̇ᵣq̇, e = n·r − d, ė = nᵀJᵣq̇.
    """
    n0, n1, n2 = plane[0], plane[1], plane[2]
    speed = 0.0
    for j in range(v.shape[0]):
        a = n0 * J[0, j] + n1 * J[1, j] + n2 * J[2, j]
        A[0, j] = a
        speed += a * v[j]
    gamma[0] = n0 * drift[0] + n1 * drift[1] + n2 * drift[2]
    e[0] = n0 * r[0] + n1 * r[1] + n2 * r[2] - plane[3]
    rate[0] = speed


@kernel
def stabilised_acceleration(gains: Array, gamma: Array, e: Array, rate: Array, b: Array, b_stabiliser: Array) -> None:
    """Write b_s of Eq. 23 and, apart, the stabiliser's share −s_v ė − s_p e of it.

    `gains` is (s_v, s_p) in 1/s and 1/s²; zeros switch the stabiliser off.
    """
    for i in range(b.shape[0]):
        b_stabiliser[i] = -gains[0] * rate[i] - gains[1] * e[i]
        b[i] = -gamma[i] + b_stabiliser[i]
