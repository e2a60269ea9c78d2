"""none: no friction.

    F_t = 0

No parameters, no states.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]


@kernel
def level(par: Array) -> float:
    """Return 0."""
    return 0.0
