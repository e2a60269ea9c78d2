"""The smallest joint velocity that moves the tip as told."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Singular values of Jᵣ below this share of the largest count as zero: the arm cannot move the tip that way.
RANK_TOLERANCE = 1e-6


def least_norm(J: Array, velocity: Array) -> Array:
    """Return q̇ = Jᵣ⁺ ṙ (n,): the smallest that gives the tip the velocity ṙ (3,) as nearly as it can; Jᵣ is (3, n)."""
    return np.asarray(np.linalg.lstsq(J, velocity, rcond=RANK_TOLERANCE)[0])
