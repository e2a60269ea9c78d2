"""coulomb_viscous: Coulomb's friction and a force proportional to the slip.

    slip     F_t = −μ f u/|u| − b u
    stick    |F_t| <= μ f

The viscous part does not depend on the normal force. Every law but coulomb may have one; it enters them all alike,
as the part w = b u of `laws.sliding`.

Parameters: μ >= 0, or for a joint the Coulomb torque, N m; b >= 0, N s/m, or for a joint N m s/rad.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import VISCOUS
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def viscous_part(par: Array, u: Array, w: Array) -> None:
    """Write w = b u (d,), N or N m."""
    for k in range(u.shape[0]):
        w[k] = par[VISCOUS] * u[k]
