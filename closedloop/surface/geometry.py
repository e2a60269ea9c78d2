"""Contact of a point with a surface φ = 0 that may be curved and may move: its frame, its gap and their rates.

In the surface's axes the point is at p and moves with v. With n = ∇φ/|∇φ|

    gap   e = φ/|∇φ|          the distance, of a φ that is no distance to first order in it
    rate  ė = n·v,   ë = n·v̇ + ṅ·v,   ṅ = (1 − n nᵀ) ∇∇φ v/|∇φ|

and a tangent is that of the surface's origin, turned by the least rotation that takes the z axis to n:
t = e − (n·e)(n + z)/(1 + n·z) with e the x or the y axis. It turns without a jump wherever n ≠ −z. With N = [n; t1; t2]
the velocity in the contact frame is u = N v and u̇ = N v̇ + Ṅ v, whose first row is ë.

A surface that moves has its origin at s, angular velocity ω, and axes R (rows, base frame). With d = r − s the point
moves relative to it with w = ṙ − ṡ − ω × d, and

    u = N ṙ − N (ṡ + ω × d),      u̇ = N r̈ + Ṅ v − N (s̈ + ω̇ × d + ω × (ω × d) + 2 ω × w),      N in base axes

These are Eqs. 2-3 with R, Ṙ, v₀ and a₀ of a closure that is neither flat nor at rest.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel

Array = NDArray[np.float64]

# 1 + n·z below which the tangents are those half a turn away: they jump there, as any choice must somewhere.
ANTIPODE = 1e-12


class Pose(Block):
    """Where a surface is, and how it moves, in base axes."""

    origin: Annotated[Array, 3]  # s, m
    axes: Annotated[Array, 3, 3]  # rows x, y, z
    velocity: Annotated[Array, 3]  # ṡ, m/s
    acceleration: Annotated[Array, 3]  # s̈, m/s²
    spin: Annotated[Array, 3]  # ω, rad/s
    spin_rate: Annotated[Array, 3]  # ω̇, rad/s²


class Touch(Block):
    """A point and the surface; written by `contact_geometry`, but for what `level` writes."""

    level: float  # φ
    size: float  # |∇φ|
    at: Annotated[Array, 3]  # p, m, surface's axes
    gradient: Annotated[Array, 3]
    hessian: Annotated[Array, 3, 3]
    local: Annotated[Array, 3, 3]  # N in the surface's axes
    carried: Annotated[Array, 3]  # N (ṡ + ω × d), m/s, contact frame
    turning: Annotated[Array, 3]  # u̇ − N r̈, m/s², contact frame


@kernel
def into_surface_axes(pose: Pose, r: Array, touch: Touch) -> None:
    """Write where the point r (3,), m, base frame, is in the surface's axes; and zero into gradient and Hessian."""
    for i in range(3):
        s = 0.0
        for k in range(3):
            s += pose.axes[i, k] * (r[k] - pose.origin[k])
            touch.hessian[i, k] = 0.0
        touch.at[i] = s
        touch.gradient[i] = 0.0


@kernel
def frame_and_turning(v: Array, touch: Touch) -> bool:
    """Write N in the surface's axes and Ṅ v of a point that moves with v (3,), m/s; False if ∇φ has no direction."""
    g, n, turning = touch.gradient, touch.local[0], touch.turning
    touch.size = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    if not 0.0 < touch.size < np.inf:
        return False
    bend = 0.0
    for i in range(3):
        n[i] = g[i] / touch.size
    for i in range(3):
        turning[i] = 0.0
        for k in range(3):
            turning[i] += touch.hessian[i, k] * v[k] / touch.size
    for i in range(3):
        bend += n[i] * turning[i]
    x, y, z = turning[0] - bend * n[0], turning[1] - bend * n[1], turning[2] - bend * n[2]  # ṅ
    over = 1.0 + n[2]
    along = x * v[0] + y * v[1] + z * v[2]
    if over > ANTIPODE:
        forward = n[0] * v[0] + n[1] * v[1] + (n[2] + 1.0) * v[2]  # (n + z)·v
        for i in range(2):
            rate = x if i == 0 else y
            for k in range(3):
                lean = n[k] + (1.0 if k == 2 else 0.0)
                touch.local[1 + i, k] = (1.0 if k == i else 0.0) - n[i] * lean / over
            turning[1 + i] = (n[i] * z / over - rate) * forward / over - n[i] * along / over
    else:
        for k in range(3):
            touch.local[1, k], touch.local[2, k] = 1.0 if k == 0 else 0.0, -1.0 if k == 1 else 0.0
        turning[1], turning[2] = 0.0, 0.0
    turning[0] = along
    return True


@kernel
def contact_geometry(pose: Pose, r: Array, velocity: Array, frame: Array, touch: Touch) -> bool:
    """Write the contact frame of a point and what its motion is relative to; after `into_surface_axes` and `level`.

    Parameters
    ----------
    pose : Pose
    r, velocity : (3,) arrays
        Position, m, and velocity ṙ, m/s, of the point, base axes.
    frame : (3, 3) array
        Written: N, rows n, t1, t2 in base axes.
    touch : Touch
        Written: local, size, carried and turning.

    Returns
    -------
    bool
        False if the gradient is zero or not a number: there is no normal.
    """
    o, a = pose.spin, pose.spin_rate
    d0, d1, d2 = r[0] - pose.origin[0], r[1] - pose.origin[1], r[2] - pose.origin[2]
    c0, c1, c2 = o[1] * d2 - o[2] * d1, o[2] * d0 - o[0] * d2, o[0] * d1 - o[1] * d0  # ω × d
    w0 = velocity[0] - pose.velocity[0] - c0
    w1 = velocity[1] - pose.velocity[1] - c1
    w2 = velocity[2] - pose.velocity[2] - c2
    # s̈ + ω̇ × d + ω × (ω × d + 2 w)
    e0, e1, e2 = c0 + 2.0 * w0, c1 + 2.0 * w1, c2 + 2.0 * w2
    a0 = pose.acceleration[0] + a[1] * d2 - a[2] * d1 + o[1] * e2 - o[2] * e1
    a1 = pose.acceleration[1] + a[2] * d0 - a[0] * d2 + o[2] * e0 - o[0] * e2
    a2 = pose.acceleration[2] + a[0] * d1 - a[1] * d0 + o[0] * e1 - o[1] * e0
    v = touch.carried  # scratch, until it is written below
    for i in range(3):
        v[i] = pose.axes[i, 0] * w0 + pose.axes[i, 1] * w1 + pose.axes[i, 2] * w2
    if not frame_and_turning(v, touch):
        return False
    for i in range(3):
        for k in range(3):
            frame[i, k] = (
                touch.local[i, 0] * pose.axes[0, k]
                + touch.local[i, 1] * pose.axes[1, k]
                + touch.local[i, 2] * pose.axes[2, k]
            )
    for i in range(3):
        f0, f1, f2 = frame[i, 0], frame[i, 1], frame[i, 2]
        touch.carried[i] = f0 * (pose.velocity[0] + c0) + f1 * (pose.velocity[1] + c1) + f2 * (pose.velocity[2] + c2)
        touch.turning[i] -= f0 * a0 + f1 * a1 + f2 * a2
    return True
