"""q_des(t), q̇_des(t) and q̈_des(t): a cubic Hermite spline over knots, at rest before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.reference.tip_path import INSTANT

Array = NDArray[np.float64]


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

        A velocity that jumps has its later value at that instant, and its jump has no part in q̈_des. q̈_des is the
        spline's own: linear between knots, with jumps of the order of their spacing squared.
        """
        t = np.asarray(t, dtype=np.float64)
        q = np.tile(self.q[0], (t.size, 1))
        v, a = np.zeros_like(q), np.zeros_like(q)
        if self.times.size == 1:
            return q, v, a
        instant = INSTANT * (self.times[-1] - self.times[0])
        q[t >= self.times[-1] - instant] = self.q[-1]
        inside = (t >= self.times[0] - instant) & (t < self.times[-1] - instant)
        k = np.clip(np.searchsorted(self.times, t[inside] + instant, side="right") - 1, 0, self.times.size - 2)
        h = (self.times[k + 1] - self.times[k])[:, None]
        s = (t[inside] - self.times[k])[:, None] / h
        q0, q1, v0, v1 = self.q[k], self.q[k + 1], h * self.v[k], h * self.v[k + 1]
        rise = q1 - q0
        c2, c3 = 3 * rise - 2 * v0 - v1, v0 + v1 - 2 * rise
        q[inside] = q0 + s * (v0 + s * (c2 + s * c3))
        v[inside] = (v0 + s * (2 * c2 + s * 3 * c3)) / h
        a[inside] = (2 * c2 + s * 6 * c3) / h / h
        return q, v, a
