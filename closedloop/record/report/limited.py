"""How often, and since when, the limits of the drives cut a joint's torque: of the column `torque_limited`."""

from __future__ import annotations

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.drives import AS_ASKED


def count_limited(limited: Array, h: float, values: Any) -> None:
    """Write `torque_limited_share` and `torque_limited_at` into a run's values.

    Parameters
    ----------
    limited : (N, n) array
        The column `torque_limited`, N >= 1.
    values : Values
        See `closedloop.record.report.measured.Values`; written.
    """
    cut = limited != AS_ASKED
    values.torque_limited_share[:] = np.mean(cut, axis=0)
    values.torque_limited_at[:] = np.where(np.any(cut, axis=0), h * np.argmax(cut, axis=0), np.nan)
