"""q_des(t), q̇_des(t) and q̈_des(t): a cubic Hermite spline over knots, at rest before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.tip_path import INSTANT
from closedloop.jit.interim import call_once
from closedloop.jit.kernel import entry_kernel, kernel_inlined

# So many take as long interpreted, 20 µs each, as `sample_spline` takes to be compiled.
FEW_INSTANTS = 50_000


@dataclass(frozen=True)
class JointPath:
    """The joint path: at rest before `times[0]`, a cubic Hermite spline over the knots, at rest after the last.

    Attributes
    ----------
    times : (K,) array
        Knots, s, increasing; an instant at which the velocity jumps is there twice.
    q, v : (K, n) arrays
        Joint positions, rad (m), and velocities, rad/s (m/s), at the knots.
    """

    times: Array
    q: Array
    v: Array

    @classmethod
    def hold(cls, q: Array) -> JointPath:
        """Make the path that stays at joint positions q (n,)."""
        return cls(np.zeros(1), q[None, :].copy(), np.zeros((1, q.size)))

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q_des, q̇_des and q̈_des, each (N, n), at times t (N,), s.

        At a discontinuity the velocity has its right limit, and its jump does not enter q̈_des. q̈_des is the
        spline's own: linear between knots, with jumps of the order of their spacing squared.
        """
        n = self.q.shape[1]
        rows = np.zeros((np.size(t), 3 * n))
        self.write(t, rows, 3)
        return rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n :]

    def write(self, t: Array, rows: Array, orders: int) -> None:
        """Write q_des, q̇_des and, if `orders` is 3, q̈_des at times t (N,), s, to the first columns of zeros (N, m)."""
        t = np.ascontiguousarray(t, dtype=np.float64)
        call_once(sample_spline, (rows,), t.size <= FEW_INSTANTS, self.times, self.q, self.v, t, rows, orders)


@kernel_inlined
def cubic(q0: float, q1: float, v0: float, v1: float, h: float, s: float) -> tuple[float, float, float]:
    """Return position, velocity and acceleration at the share s of an interval of h seconds: Hermite's cubic.

    q0, q1 and v0, v1 are positions and velocities at both ends.
    """
    rise, u0, u1 = q1 - q0, h * v0, h * v1
    c2, c3 = 3.0 * rise - 2.0 * u0 - u1, u0 + u1 - 2.0 * rise
    return (
        q0 + s * (u0 + s * (c2 + s * c3)),
        (u0 + s * (2.0 * c2 + s * 3.0 * c3)) / h,
        (2.0 * c2 + s * 6.0 * c3) / h / h,
    )


@entry_kernel
def sample_spline(times: Array, q: Array, v: Array, t: Array, rows: Array, orders: int) -> None:
    """Write position, velocity and, if `orders` is 3, acceleration of a path at times t (N,), s; see `JointPath`.

    `times` (K,), q and v (K, n) are its knots; rows (N, >= orders n) are zeros at first.
    """
    last, n = times.shape[0] - 1, q.shape[1]
    instant = INSTANT * (times[last] - times[0])
    for i in range(t.shape[0]):
        row = rows[i]
        if last == 0 or t[i] < times[0] - instant or t[i] >= times[last] - instant:
            rest = 0 if last == 0 or t[i] < times[0] - instant else last
            for j in range(n):
                row[j] = q[rest, j]
        else:
            k, beyond = 0, last  # the last interval that has begun by now
            while beyond - k > 1:
                middle = (k + beyond) // 2
                if times[middle] <= t[i] + instant:
                    k = middle
                else:
                    beyond = middle
            h = times[k + 1] - times[k]
            s = (t[i] - times[k]) / h
            for j in range(n):
                row[j], row[n + j], acceleration = cubic(q[k, j], q[k + 1, j], v[k, j], v[k + 1, j], h, s)
                if orders == 3:
                    row[2 * n + j] = acceleration
