"""What is desired at an instant, from the table that the reference is prepared as."""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.control.reference.joint_path import cubic
from closedloop.jit.kernel import kernel, kernel_inlined

# The sum of two slopes, rad/s² (m/s²), that are rounding: their signs say nothing, but they may have derivatives.
STILL = 1e-11


@kernel_inlined
def reference_row(t: float, spacing: float, table: Array, n: int, row: Array) -> None:
    """Write the reference at time t: between the table's rows positions are cubics and the rest is linear.

    Parameters
    ----------
    t, spacing : float
        Time, and time between two rows of the table, s.
    table : (P, >= 2 n + 10) array
        q_des, q̇_des, then r_des, ṙ_des and r̈_des of the tip in base axes, then f_des.
    row : (2 n + 10,) array
        Written.
    """
    x = t / spacing
    at = nearest_row(t, spacing, table.shape[0])
    width = row.shape[0]
    if abs(x - at) < 1e-6 or round(x) > at:
        for j in range(width):
            row[j] = table[at, j]
        return
    at = min(int(x), table.shape[0] - 2)
    s = x - at
    for j in range(width):
        row[j] = (1.0 - s) * table[at, j] + s * table[at + 1, j]
    for block in range(2):
        begin = 0 if block == 0 else 2 * n
        size = n if block == 0 else 3
        for j in range(begin, begin + size):
            row[j], _, _ = cubic(
                table[at, j], table[at + 1, j], table[at, j + size], table[at + 1, j + size], spacing, s
            )


@kernel_inlined
def nearest_row(t: float, spacing: float, count: int) -> int:
    """Return which of the table's rows is nearest to time t, s."""
    return min(round(t / spacing), count - 1)


@kernel
def desired_acceleration(t: float, spacing: float, table: Array, qdd: Array) -> None:
    """Write q̈_des (n,) at the table's row nearest to t, s, of the rates q̇_des on either side of it.

    It is the smaller of the two slopes, and zero where they differ in sign: so a velocity that jumps, as at the start
    of a line, asks for no acceleration, and a smooth one for its own, to first order in the spacing.
    """
    n, at = qdd.shape[0], nearest_row(t, spacing, table.shape[0])
    for j in range(n):
        qdd[j] = 0.0
        if 0 < at < table.shape[0] - 1:
            before = (table[at, n + j] - table[at - 1, n + j]) / spacing
            after = (table[at + 1, n + j] - table[at, n + j]) / spacing
            if before * after > 0.0 or abs(before) + abs(after) <= STILL:
                qdd[j] = before if abs(before) < abs(after) else after
