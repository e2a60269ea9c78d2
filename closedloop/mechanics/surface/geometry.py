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

Material that flows along the surface with V (constant in the surface's axes but for V̇) leaves n, gap and their rates as
they are. What rubs on it slips with t·v − t·V, so that along a tangent t the velocity u has − t·V more, and u̇ has
− ṫ·V − t·V̇ more.
"""

from typing import Annotated

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.kernel import kernel

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
    flow: Annotated[Array, 3]  # V, m/s, and its rate, m/s², surface's axes
    flow_rate: Annotated[Array, 3]


class Touch(Block):
    """A point and the surface; written by `contact_geometry`, but for what `level` writes."""

    level: float  # φ
    size: float  # |∇φ|
    growth: float  # d|∇φ|/dt / |∇φ| along the point's motion, 1/s
    at: Annotated[Array, 3]  # p, m, surface's axes
    gradient: Annotated[Array, 3]
    hessian: Annotated[Array, 3, 3]
    local: Annotated[Array, 3, 3]  # N in the surface's axes
    carried: Annotated[Array, 3]  # N (ṡ + ω × d) and the flow, m/s, contact frame
    flow: Annotated[Array, 3]  # the part of it that is the flow's: 0, t1·V, t2·V
    bend: Annotated[Array, 3]  # ṅ, 1/s, surface's axes, of a surface that moves
    turning: Annotated[Array, 3]  # u̇ − N r̈, m/s², contact frame


@kernel
def into_surface_axes(pose: Pose, r: Array, touch: Touch) -> None:
    """Write where the point r (3,), m, base frame, is in the surface's axes; and zero into gradient and Hessian."""
    d0, d1, d2 = r[0] - pose.origin[0], r[1] - pose.origin[1], r[2] - pose.origin[2]
    for i in range(3):
        touch.at[i] = pose.axes[i, 0] * d0 + pose.axes[i, 1] * d1 + pose.axes[i, 2] * d2
        touch.gradient[i] = 0.0
        for k in range(3):
            touch.hessian[i, k] = 0.0


@kernel
def frame_and_turning(v: Array, touch: Touch) -> bool:
    """Write N in the surface's axes and Ṅ v of a point that moves with v (3,), m/s; False if ∇φ has no direction.

    In single numbers, with one division for each of the two denominators: what is kept in an array is read anew after
    each number that is written to another, and a division takes as long as ten products.
    """
    g, B, local, turning = touch.gradient, touch.hessian, touch.local, touch.turning
    v0, v1, v2 = v[0], v[1], v[2]
    size = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    touch.size = size
    if not 0.0 < size < np.inf:
        return False
    share = 1.0 / size
    n0, n1, n2 = share * g[0], share * g[1], share * g[2]
    b0 = share * (B[0, 0] * v0 + B[0, 1] * v1 + B[0, 2] * v2)
    b1 = share * (B[1, 0] * v0 + B[1, 1] * v1 + B[1, 2] * v2)
    b2 = share * (B[2, 0] * v0 + B[2, 1] * v1 + B[2, 2] * v2)
    bend = n0 * b0 + n1 * b1 + n2 * b2
    x, y, z = b0 - bend * n0, b1 - bend * n1, b2 - bend * n2  # ṅ
    along = x * v0 + y * v1 + z * v2
    touch.growth = bend
    local[0, 0], local[0, 1], local[0, 2] = n0, n1, n2
    turning[0] = along
    if 1.0 + n2 > ANTIPODE:
        over = 1.0 / (1.0 + n2)
        m0, m1 = n0 * over, n1 * over
        forward = over * (n0 * v0 + n1 * v1 + (n2 + 1.0) * v2)  # (n + z)·v/(1 + n·z)
        local[1, 0], local[1, 1], local[1, 2] = 1.0 - n0 * m0, -n1 * m0, -n0
        local[2, 0], local[2, 1], local[2, 2] = -n0 * m1, 1.0 - n1 * m1, -n1
        turning[1] = (m0 * z - x) * forward - m0 * along
        turning[2] = (m1 * z - y) * forward - m1 * along
    else:
        local[1, 0], local[1, 1], local[1, 2] = 1.0, 0.0, 0.0
        local[2, 0], local[2, 1], local[2, 2] = 0.0, -1.0, 0.0
        turning[1], turning[2] = 0.0, 0.0
    return True


@kernel
def turned_back(axes: Array, frame: Array) -> tuple[float, float]:
    """Return cos and sin of the angle about n by which the tangents of a surface that moves have turned with it.

    Without that they would be x and y of the surface as it was, turned by the least rotation that takes its z to n. A
    vector with parts a and b along the tangents of `frame` has the parts c a + s b and c b − s a along these.

    `axes`, `frame`, (3, 3) arrays: rows x, y, z of the surface as it was at t = 0, and n, t1, t2 as it is.
    """
    x, z, n = axes[0], axes[2], frame[0]
    across, over = n[0] * x[0] + n[1] * x[1] + n[2] * x[2], 1.0 + n[0] * z[0] + n[1] * z[1] + n[2] * z[2]
    if over <= ANTIPODE:
        return 1.0, 0.0
    c, s = 0.0 * over, 0.0 * over
    for i in range(3):
        along = x[i] - across / over * (n[i] + z[i])
        c, s = c + along * frame[1, i], s + along * frame[2, i]
    return c, s


@kernel
def normal_rate(v: Array, touch: Touch, rate: Array) -> None:
    """Write ṅ (3,), 1/s, of a point that moves with v (3,), m/s, relative to the surface, in the surface's axes."""
    n, B, share = touch.local[0], touch.hessian, 1.0 / touch.size
    bend = 0.0
    for i in range(3):
        rate[i] = share * (B[i, 0] * v[0] + B[i, 1] * v[1] + B[i, 2] * v[2])
        bend += n[i] * rate[i]
    for i in range(3):
        rate[i] -= bend * n[i]


@kernel
def tangent_rates(rate: Array, w: Array, touch: Touch) -> tuple[float, float]:
    """Return ṫ1·w and ṫ2·w for ṅ = `rate` and any vector w (3,), both in the surface's axes."""
    n = touch.local[0]
    if 1.0 + n[2] <= ANTIPODE:
        return 0.0, 0.0
    over = 1.0 / (1.0 + n[2])
    forward = over * (n[0] * w[0] + n[1] * w[1] + (n[2] + 1.0) * w[2])
    along = rate[0] * w[0] + rate[1] * w[1] + rate[2] * w[2]
    m0, m1 = n[0] * over, n[1] * over
    return (m0 * rate[2] - rate[0]) * forward - m0 * along, (m1 * rate[2] - rate[1]) * forward - m1 * along


@kernel
def contact_geometry(pose: Pose, moving: bool, r: Array, velocity: Array, frame: Array, touch: Touch) -> bool:
    """Write the contact frame of a point and what its motion is relative to; after `into_surface_axes` and `level`.

    Returns False if the gradient is zero or not a number: there is no normal.

    `moving`: whether the surface moves; else no velocity of the pose is read.
    `r`, `velocity`, (3,) arrays: position, m, and velocity ṙ, m/s, of the point, base axes.
    `frame` (3, 3): written: N, rows n, t1, t2 in base axes.
    `touch`: written: local, size, carried and turning.
    """
    w0, w1, w2 = velocity[0], velocity[1], velocity[2]
    c0 = c1 = c2 = a0 = a1 = a2 = 0.0
    if moving:
        o, a = pose.spin, pose.spin_rate
        d0, d1, d2 = r[0] - pose.origin[0], r[1] - pose.origin[1], r[2] - pose.origin[2]
        c0, c1, c2 = o[1] * d2 - o[2] * d1, o[2] * d0 - o[0] * d2, o[0] * d1 - o[1] * d0  # ω × d
        w0, w1, w2 = w0 - pose.velocity[0] - c0, w1 - pose.velocity[1] - c1, w2 - pose.velocity[2] - c2
        # s̈ + ω̇ × d + ω × (ω × d + 2 w)
        e0, e1, e2 = c0 + 2.0 * w0, c1 + 2.0 * w1, c2 + 2.0 * w2
        a0 = pose.acceleration[0] + a[1] * d2 - a[2] * d1 + o[1] * e2 - o[2] * e1
        a1 = pose.acceleration[1] + a[2] * d0 - a[0] * d2 + o[2] * e0 - o[0] * e2
        a2 = pose.acceleration[2] + a[0] * d1 - a[1] * d0 + o[0] * e1 - o[1] * e0
        c0, c1, c2 = c0 + pose.velocity[0], c1 + pose.velocity[1], c2 + pose.velocity[2]
    v, P, N = touch.carried, pose.axes, touch.local  # carried is scratch, until it is written below
    for i in range(3):
        v[i] = P[i, 0] * w0 + P[i, 1] * w1 + P[i, 2] * w2
    if not frame_and_turning(v, touch):
        return False
    b1 = b2 = 0.0
    if moving:
        normal_rate(v, touch, touch.bend)
        b1, b2 = tangent_rates(touch.bend, pose.flow, touch)
    for i in range(3):
        f0 = N[i, 0] * P[0, 0] + N[i, 1] * P[1, 0] + N[i, 2] * P[2, 0]
        f1 = N[i, 0] * P[0, 1] + N[i, 1] * P[1, 1] + N[i, 2] * P[2, 1]
        f2 = N[i, 0] * P[0, 2] + N[i, 1] * P[1, 2] + N[i, 2] * P[2, 2]
        frame[i, 0], frame[i, 1], frame[i, 2] = f0, f1, f2
        touch.carried[i] = f0 * c0 + f1 * c1 + f2 * c2
        touch.turning[i] -= f0 * a0 + f1 * a1 + f2 * a2
        touch.flow[i] = 0.0
        if moving and i > 0:
            t0, t1, t2 = N[i, 0], N[i, 1], N[i, 2]
            touch.flow[i] = t0 * pose.flow[0] + t1 * pose.flow[1] + t2 * pose.flow[2]
            touch.carried[i] += touch.flow[i]
            gains = t0 * pose.flow_rate[0] + t1 * pose.flow_rate[1] + t2 * pose.flow_rate[2]
            touch.turning[i] -= gains + (b1 if i == 1 else b2)
    return True
