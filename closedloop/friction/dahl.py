"""dahl: an elastic bristle that yields at the Coulomb level.

    F_t = −σ_0 z f − b u,    ż = u − σ_0 |u|/μ z,    |z| <= μ/σ_0

In one dimension this is dF/dx = σ_0 (1 − F/F_C sgn u): with displacement, not with time, so hysteresis loops do not
depend on speed. A loop between ±x_0 has the force ±F_C tanh(σ_0 x_0/F_C) at its ends.

It has no static level above the kinetic one and no mode of sticking: a tip that is pulled below μ f creeps by the
deflection μ/σ_0 and stays.

Energy: σ_0|z|²/2 per newton of f is stored, and F_t·u + d/dt(stored) = −σ_0 a f|z|² − b|u|² <= 0 while f is
constant.

Source: P. R. Dahl, A solid friction model, The Aerospace Corporation, TOR-158(3107-18), 1968 (recalled); the
exponent of its factor (1 − F/F_C sgn u) is taken as 1, as is usual. It has no viscous part; b = 0 is the
published law.

Parameters: μ > 0, or for a joint the Coulomb torque, N m; σ_0 > 0, 1/m (N m/rad for a joint): μ/σ_0 is the largest
deflection, of the order of 1-50 µm for metals; b >= 0, N s/m (N m s/rad). States: z (d,), m (rad).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import KINETIC, STIFFNESS
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def yielding(par: Array, speed: float) -> float:
    """Return a = σ_0|u|/μ, 1/s, at the slip speed |u|."""
    return par[STIFFNESS] * speed / par[KINETIC]  # type: ignore[no-any-return]


@kernel
def force(par: Array, z: Array, c: Array) -> None:
    """Write c = σ_0 z (d,): the friction per newton of normal force, or N m."""
    for k in range(c.shape[0]):
        c[k] = par[STIFFNESS] * z[k]
