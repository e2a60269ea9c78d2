"""karnopp: friction with a band of speeds in which slip counts as none.

    |u| > D_v      F_t = −μ_k f u/|u| − b u
    |u| <= D_v     sticking is tried: the tip sticks if |F_t| <= μ_s f is enough to hold it

The band is what makes the model quick with a fixed step: the instant of zero slip need not be found. In
Karnopp's original the momentum is kept within the band; here a tip that sticks has u = 0, and what D_v takes is
at most the energy of that slow slip.

Source: D. Karnopp, Computer simulation of stick-slip friction in mechanical dynamic systems, J. Dyn. Sys.,
Meas., Control 107 (1985) 100-103. It leaves the slip function open; here it is Coulomb's and a viscous part.

Parameters: 0 <= μ_k <= μ_s, or for a joint torques, N m; D_v > 0, m/s (rad/s), small against the speeds of
interest; b >= 0, N s/m (N m s/rad).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import DEAD_BAND, KINETIC
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def level(par: Array) -> float:
    """Return μ_k, or the Coulomb torque, N m."""
    return par[KINETIC]  # type: ignore[no-any-return]


@kernel
def dead_band(par: Array) -> float:
    """Return D_v, m/s or rad/s."""
    return par[DEAD_BAND]  # type: ignore[no-any-return]
