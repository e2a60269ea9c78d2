"""coulomb: friction of one size, against the slip.

    slip     F_t = −μ f u/|u|
    stick    |F_t| <= μ f

Source: C. A. Coulomb, Théorie des machines simples, 1785, and any textbook.

Parameters: the coefficient μ >= 0 (dry steel on steel about 0.1-0.6), or for a joint the Coulomb torque, N m.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.friction.layout import KINETIC
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def level(par: Array) -> float:
    """Return μ, or the Coulomb torque, N m."""
    return par[KINETIC]  # type: ignore[no-any-return]
