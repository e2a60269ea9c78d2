"""Positions, velocities and accelerations of the links, from sine and cosine of all joint angles.

The library's sine takes one angle at a time. This one takes four, without a branch, as accurately: the angle
less its nearest multiple of π/2, which is subtracted in three parts (W. J. Cody and W. Waite, Software Manual for the
Elementary Functions, 1980), then the polynomials for |x| <= π/4 of fdlibm (Sun Microsystems 1993, k_sin.c, k_cos.c).

From the base to the tips, a link's frame follows from its parent's by a rotation about z that makes the first axis
perpendicular to both joint axes (mostly the identity), a twist about that axis, and the joint's own angle. With q̈ = 0
and the base accelerating upwards instead of gravity, and with d from the parent's origin to the joint's,

    ω = ω_p + z q̇        α = α_p + ω_p × z q̇        b = b_p + α_p × d + ω_p × (ω_p × d + 2 z ḋ)

where a revolute joint has no ḋ, and a prismatic one adds nothing to ω and α. A ball joint turns its link by a unit
quaternion; with the rates s in the link's axes, ω = ω_p + s and α = α_p + ω_p × s.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.dual8 import sought
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import MANY_TURNS, every, nearest, select
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.layout import Tree

# π/2 in parts of 33, 33 and 53 bits: a multiple below 2²⁰ of each of the first two is exact.
PART_1, PART_2, PART_3 = 1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21
PER_RIGHT_ANGLE = 2.0 / math.pi

# x + ROUND − ROUND is x rounded to a whole number: no bits are left for a fraction.
ROUND = 1.5 * 2.0**52

# Below this angle sin(x)/x is 1 - x²/6 to rounding.
SMALL = 1e-4

S1, S2, S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
S4, S5, S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
C1, C2, C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
C4, C5, C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@kernel_inlined
def sines(tree: Tree, q: Array, work: Array) -> None:
    """Write SINE, COSINE and SLIDE of every joint at q (n,): those of 0 and q for a prismatic joint, else q and 0."""
    n, links, k, w = tree.n, tree.links, tree.constants, work
    for i in range(n):
        x = q[i]
        if not every(abs(x) <= MANY_TURNS) and links[at.REVOLUTE * n + i] != 0:
            x = nearest(x)
        w[links[at.SCRATCH * n + i] + at.POSITION] = x
    if tree.balls != 0:
        half_angles(tree, q, work)
    for block in range(tree.blocks):
        c = at.HEAD + block * at.CONSTANTS
        s = block * at.SCRATCHES
        for lane in range(at.LANES * tree.once):
            position = w[s + at.POSITION + lane]
            turn = k[c + at.KIND + lane] * position
            offset = k[c + at.ANGLE + lane]
            angle = turn + offset
            taken = angle - turn
            lost = (turn - (angle - taken)) + (offset - taken)  # by rounding the sum: 1e-10 rad at a million
            quarters = sought((angle * PER_RIGHT_ANGLE + ROUND) - ROUND)  # a whole number has no derivatives
            x = (((angle - quarters * PART_1) - quarters * PART_2) - quarters * PART_3) + lost
            # quarters modulo 4; rounding its quarter less 3/8 rounds down
            quarter = quarters - 4.0 * ((quarters * 0.25 - 0.375 + ROUND) - ROUND)
            x2 = x * x
            x4 = x2 * x2
            sine = x + x * x2 * ((S1 + x2 * S2) + x4 * ((S3 + x2 * S4) + x4 * (S5 + x2 * S6)))
            half = 0.5 * x2
            near = 1.0 - half  # the rounding of this difference is added again
            rest = x4 * ((C1 + x2 * C2) + x4 * ((C3 + x2 * C4) + x4 * (C5 + x2 * C6)))
            cosine = near + ((1.0 - near - half) + rest)
            odd = (quarter == 1.0) | (quarter == 3.0)
            a = select(odd, cosine, sine)
            b = select(odd, sine, cosine)
            w[s + at.SINE + lane] = select(quarter >= 2.0, -a, a)
            w[s + at.COSINE + lane] = select((quarter == 1.0) | (quarter == 2.0), -b, b)
            w[s + at.SLIDE + lane] = position - turn
    if tree.balls != 0:
        quaternions(tree, q, work)


@kernel_inlined
def half_angles(tree: Tree, q: Array, work: Array) -> None:
    """Write half the length of each ball joint's rotation vector as the first of its angles, and 0 as the others."""
    n, links, w = tree.n, tree.links, work
    for i in range(n - 2):
        if links[at.REVOLUTE * n + i] == at.BALL:
            square = q[i] * q[i] + q[i + 1] * q[i + 1] + q[i + 2] * q[i + 2]
            w[links[at.SCRATCH * n + i] + at.POSITION] = 0.5 * math.sqrt(square)
            for k in range(1, 3):
                w[links[at.SCRATCH * n + i + k] + at.POSITION] = 0.0 * square


@kernel_inlined
def quaternions(tree: Tree, q: Array, work: Array) -> None:
    """Write the vector part of each ball joint's quaternion, θ sin(|θ|/2)/|θ|; its scalar part is the first cosine."""
    n, links, w = tree.n, tree.links, work
    for i in range(n - 2):
        if links[at.REVOLUTE * n + i] == at.BALL:
            s = links[at.SCRATCH * n + i]
            half, sine = w[s + at.POSITION], w[s + at.SINE]
            turns = half > SMALL
            share = 0.5 * select(turns, sine / select(turns, half, 1.0 + half), 1.0 - half * half * (1.0 / 6.0))
            for k in range(3):
                w[links[at.SCRATCH * n + i + k] + at.POSITION] = share * q[i + k]


@kernel_inlined
def motion(tree: Tree, v: Array, work: Array) -> None:
    """Write the axes, origin, ω, α and b of every link, at joint rates v (n,)."""
    n, table, k, w = tree.n, tree.links, tree.constants, work
    x0 = x1 = x2 = y0 = y1 = y2 = z0 = z1 = z2 = p0 = p1 = p2 = 0.0
    o0 = o1 = o2 = a0 = a1 = a2 = b0 = b1 = b2 = 0.0
    for i in range(n):
        parent = table[at.PARENT * n + i]
        c = table[at.CONSTANT * n + i]
        s = table[at.SCRATCH * n + i]
        cosine, sine, rate = w[s + at.COSINE], w[s + at.SINE], v[i]
        if table[at.REVOLUTE * n + i] >= at.BALL:
            if table[at.REVOLUTE * n + i] == at.BALL:
                ball(tree, i, v, work)
            elif i > 1 and table[at.REVOLUTE * n + i - 2] == at.BALL:  # what the next joint finds at hand
                x0, x1, x2 = w[s + at.X0], w[s + at.X1], w[s + at.X2]
                z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
                y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
                p0, p1, p2 = w[s + at.P0], w[s + at.P1], w[s + at.P2]
                o0, o1, o2 = w[s + at.O0], w[s + at.O1], w[s + at.O2]
                a0, a1, a2 = w[s + at.A0], w[s + at.A1], w[s + at.A2]
                b0, b1, b2 = w[s + at.B0], w[s + at.B1], w[s + at.B2]
            continue
        if parent < 0:
            e0, e1, e2 = k[c + at.R00], k[c + at.R10], k[c + at.R20]
            f0, f1, f2 = k[c + at.R01], k[c + at.R11], k[c + at.R21]
            z0, z1, z2 = k[c + at.R02], k[c + at.R12], k[c + at.R22]
            x0, x1, x2 = cosine * e0 + sine * f0, cosine * e1 + sine * f1, cosine * e2 + sine * f2
            y0, y1, y2 = cosine * f0 - sine * e0, cosine * f1 - sine * e1, cosine * f2 - sine * e2
            slide = w[s + at.SLIDE]
            p0, p1, p2 = k[c + at.T0] + slide * z0, k[c + at.T1] + slide * z1, k[c + at.T2] + slide * z2
            rate = rate * k[c + at.KIND]
            o0, o1, o2 = z0 * rate, z1 * rate, z2 * rate
            a0 = a1 = a2 = 0.0
            b0, b1, b2 = -k[at.GRAVITY], -k[at.GRAVITY + 1], -k[at.GRAVITY + 2]
        else:
            if parent != i - 1:  # else the parent's numbers are at hand
                m = table[at.SCRATCH * n + parent]
                x0, x1, x2 = w[m + at.X0], w[m + at.X1], w[m + at.X2]
                z0, z1, z2 = w[m + at.Z0], w[m + at.Z1], w[m + at.Z2]
                y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
                p0, p1, p2 = w[m + at.P0], w[m + at.P1], w[m + at.P2]
                o0, o1, o2 = w[m + at.O0], w[m + at.O1], w[m + at.O2]
                a0, a1, a2 = w[m + at.A0], w[m + at.A1], w[m + at.A2]
                b0, b1, b2 = w[m + at.B0], w[m + at.B1], w[m + at.B2]
            t0, t1, t2 = k[c + at.T0], k[c + at.T1], k[c + at.T2]
            d0, d1, d2 = x0 * t0 + y0 * t1 + z0 * t2, x1 * t0 + y1 * t1 + z1 * t2, x2 * t0 + y2 * t1 + z2 * t2
            if parent != i - 1:
                cos, sin = k[c + at.COS_TURN], k[c + at.SIN_TURN]
                e0, e1, e2 = cos * x0 + sin * y0, cos * x1 + sin * y1, cos * x2 + sin * y2
                y0, y1, y2 = cos * y0 - sin * x0, cos * y1 - sin * x1, cos * y2 - sin * x2
                x0, x1, x2 = e0, e1, e2
            cos, sin = k[c + at.COS_TWIST], k[c + at.SIN_TWIST]
            f0, f1, f2 = cos * y0 + sin * z0, cos * y1 + sin * z1, cos * y2 + sin * z2
            z0, z1, z2 = cos * z0 - sin * y0, cos * z1 - sin * y1, cos * z2 - sin * y2
            y0, y1, y2 = cosine * f0 - sine * x0, cosine * f1 - sine * x1, cosine * f2 - sine * x2
            x0, x1, x2 = cosine * x0 + sine * f0, cosine * x1 + sine * f1, cosine * x2 + sine * f2
            g0, g1, g2 = z0 * rate, z1 * rate, z2 * rate
            if table[at.REVOLUTE * n + i] != 0:
                u0, u1, u2 = o1 * d2 - o2 * d1, o2 * d0 - o0 * d2, o0 * d1 - o1 * d0
                b0 += a1 * d2 - a2 * d1 + o1 * u2 - o2 * u1
                b1 += a2 * d0 - a0 * d2 + o2 * u0 - o0 * u2
                b2 += a0 * d1 - a1 * d0 + o0 * u1 - o1 * u0
                a0 += o1 * g2 - o2 * g1
                a1 += o2 * g0 - o0 * g2
                a2 += o0 * g1 - o1 * g0
                o0 += g0
                o1 += g1
                o2 += g2
            else:
                slide = w[s + at.SLIDE]
                d0 += slide * z0
                d1 += slide * z1
                d2 += slide * z2
                u0 = o1 * d2 - o2 * d1 + 2.0 * g0
                u1 = o2 * d0 - o0 * d2 + 2.0 * g1
                u2 = o0 * d1 - o1 * d0 + 2.0 * g2
                b0 += a1 * d2 - a2 * d1 + o1 * u2 - o2 * u1
                b1 += a2 * d0 - a0 * d2 + o2 * u0 - o0 * u2
                b2 += a0 * d1 - a1 * d0 + o0 * u1 - o1 * u0
            p0 += d0
            p1 += d1
            p2 += d2
        w[s + at.X0], w[s + at.X1], w[s + at.X2] = x0, x1, x2
        w[s + at.Z0], w[s + at.Z1], w[s + at.Z2] = z0, z1, z2
        w[s + at.P0], w[s + at.P1], w[s + at.P2] = p0, p1, p2
        w[s + at.O0], w[s + at.O1], w[s + at.O2] = o0, o1, o2
        w[s + at.A0], w[s + at.A1], w[s + at.A2] = a0, a1, a2
        w[s + at.B0], w[s + at.B1], w[s + at.B2] = b0, b1, b2


@kernel
def ball(tree: Tree, i: int, v: Array, work: Array) -> None:
    """Write the same of the three entries of the ball joint that begins at joint i."""
    n, table, k, w = tree.n, tree.links, tree.constants, work
    parent, c = table[at.PARENT * n + i], table[at.CONSTANT * n + i]
    s = table[at.SCRATCH * n + i]
    s1, s2 = table[at.SCRATCH * n + i + 1], table[at.SCRATCH * n + i + 2]
    zero = 0.0 * w[s + at.COSINE]
    o0, o1, o2, a0, a1, a2 = zero, zero, zero, zero, zero, zero
    e0, e1, e2 = k[c + at.R00] + zero, k[c + at.R10] + zero, k[c + at.R20] + zero
    f0, f1, f2 = k[c + at.R01] + zero, k[c + at.R11] + zero, k[c + at.R21] + zero
    d0, d1, d2 = k[c + at.T0] + zero, k[c + at.T1] + zero, k[c + at.T2] + zero
    p0, p1, p2 = zero, zero, zero
    b0, b1, b2 = zero - k[at.GRAVITY], zero - k[at.GRAVITY + 1], zero - k[at.GRAVITY + 2]
    if parent >= 0:
        m = table[at.SCRATCH * n + parent]
        x0, x1, x2 = w[m + at.X0], w[m + at.X1], w[m + at.X2]
        z0, z1, z2 = w[m + at.Z0], w[m + at.Z1], w[m + at.Z2]
        y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
        d0, d1, d2 = x0 * d0 + y0 * d1 + z0 * d2, x1 * d0 + y1 * d1 + z1 * d2, x2 * d0 + y2 * d1 + z2 * d2
        e0, e1, e2 = x0 * e0 + y0 * e1 + z0 * e2, x1 * e0 + y1 * e1 + z1 * e2, x2 * e0 + y2 * e1 + z2 * e2
        f0, f1, f2 = x0 * f0 + y0 * f1 + z0 * f2, x1 * f0 + y1 * f1 + z1 * f2, x2 * f0 + y2 * f1 + z2 * f2
        p0, p1, p2 = w[m + at.P0], w[m + at.P1], w[m + at.P2]
        o0, o1, o2 = w[m + at.O0], w[m + at.O1], w[m + at.O2]
        a0, a1, a2 = w[m + at.A0], w[m + at.A1], w[m + at.A2]
        u0, u1, u2 = o1 * d2 - o2 * d1, o2 * d0 - o0 * d2, o0 * d1 - o1 * d0
        b0 = w[m + at.B0] + (a1 * d2 - a2 * d1) + (o1 * u2 - o2 * u1)
        b1 = w[m + at.B1] + (a2 * d0 - a0 * d2) + (o2 * u0 - o0 * u2)
        b2 = w[m + at.B2] + (a0 * d1 - a1 * d0) + (o0 * u1 - o1 * u0)
    g0, g1, g2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    p0, p1, p2 = p0 + d0, p1 + d1, p2 + d2
    # the columns of the rotation of a unit quaternion
    t, r0, r1, r2 = w[s + at.COSINE], w[s + at.POSITION], w[s1 + at.POSITION], w[s2 + at.POSITION]
    q00, q10, q20 = 1.0 - 2.0 * (r1 * r1 + r2 * r2), 2.0 * (r0 * r1 + r2 * t), 2.0 * (r0 * r2 - r1 * t)
    q01, q11, q21 = 2.0 * (r0 * r1 - r2 * t), 1.0 - 2.0 * (r0 * r0 + r2 * r2), 2.0 * (r1 * r2 + r0 * t)
    x0, x1, x2 = (e0 * q00 + f0 * q10 + g0 * q20, e1 * q00 + f1 * q10 + g1 * q20, e2 * q00 + f2 * q10 + g2 * q20)
    y0, y1, y2 = (e0 * q01 + f0 * q11 + g0 * q21, e1 * q01 + f1 * q11 + g1 * q21, e2 * q01 + f2 * q11 + g2 * q21)
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    v0, v1, v2 = v[i], v[i + 1], v[i + 2]
    g0, g1, g2 = x0 * v0 + y0 * v1 + z0 * v2, x1 * v0 + y1 * v1 + z1 * v2, x2 * v0 + y2 * v1 + z2 * v2
    a0, a1, a2 = a0 + (o1 * g2 - o2 * g1), a1 + (o2 * g0 - o0 * g2), a2 + (o0 * g1 - o1 * g0)
    o0, o1, o2 = o0 + g0, o1 + g1, o2 + g2
    w[s + at.X0], w[s + at.X1], w[s + at.X2] = y0, y1, y2
    w[s + at.Z0], w[s + at.Z1], w[s + at.Z2] = x0, x1, x2
    w[s1 + at.X0], w[s1 + at.X1], w[s1 + at.X2] = z0, z1, z2
    w[s1 + at.Z0], w[s1 + at.Z1], w[s1 + at.Z2] = y0, y1, y2
    cosine, sine = w[s2 + at.COSINE], w[s2 + at.SINE]  # its constant angle, see `closedloop.mechanics.robot.tree.model`
    w[s2 + at.X0], w[s2 + at.X1] = cosine * x0 + sine * y0, cosine * x1 + sine * y1
    w[s2 + at.X2] = cosine * x2 + sine * y2
    w[s2 + at.Z0], w[s2 + at.Z1], w[s2 + at.Z2] = z0, z1, z2
    for e in (s, s1, s2):
        w[e + at.P0], w[e + at.P1], w[e + at.P2] = p0, p1, p2
        w[e + at.O0], w[e + at.O1], w[e + at.O2] = o0, o1, o2
        w[e + at.A0], w[e + at.A1], w[e + at.A2] = a0, a1, a2
        w[e + at.B0], w[e + at.B1], w[e + at.B2] = b0, b1, b2


@kernel_inlined
def tip(tree: Tree, work: Array, r: Array, drift: Array) -> None:
    """Write the tip's position r (3,) and its acceleration for q̈ = 0, gravity taken out, `drift` (3,)."""
    n, k, w = tree.n, tree.constants, work
    t0, t1, t2 = k[at.TIP], k[at.TIP + 1], k[at.TIP + 2]
    if tree.carrier < 0:
        r[0], r[1], r[2] = t0, t1, t2
        drift[0] = drift[1] = drift[2] = 0.0
        return
    s = tree.links[at.SCRATCH * n + tree.carrier]
    x0, x1, x2 = w[s + at.X0], w[s + at.X1], w[s + at.X2]
    z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    d0, d1, d2 = x0 * t0 + y0 * t1 + z0 * t2, x1 * t0 + y1 * t1 + z1 * t2, x2 * t0 + y2 * t1 + z2 * t2
    r[0], r[1], r[2] = w[s + at.P0] + d0, w[s + at.P1] + d1, w[s + at.P2] + d2
    o0, o1, o2 = w[s + at.O0], w[s + at.O1], w[s + at.O2]
    a0, a1, a2 = w[s + at.A0], w[s + at.A1], w[s + at.A2]
    u0, u1, u2 = o1 * d2 - o2 * d1, o2 * d0 - o0 * d2, o0 * d1 - o1 * d0
    drift[0] = k[at.GRAVITY] + w[s + at.B0] + (a1 * d2 - a2 * d1) + (o1 * u2 - o2 * u1)
    drift[1] = k[at.GRAVITY + 1] + w[s + at.B1] + (a2 * d0 - a0 * d2) + (o2 * u0 - o0 * u2)
    drift[2] = k[at.GRAVITY + 2] + w[s + at.B2] + (a0 * d1 - a1 * d0) + (o0 * u1 - o1 * u0)


@kernel_inlined
def jacobian(tree: Tree, work: Array, r: Array, J: Array) -> None:
    """Write the tip's Jacobian J (3, n): z × (r − p) of a revolute joint, z of a prismatic one, zero off the path."""
    n, table, w = tree.n, tree.links, work
    r0, r1, r2 = r[0], r[1], r[2]
    for i in range(n):
        s = table[at.SCRATCH * n + i]
        if table[at.SUPPORT * n + i] == 0:
            J[0, i] = J[1, i] = J[2, i] = 0.0
        elif table[at.REVOLUTE * n + i] != 0:
            z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
            d0, d1, d2 = r0 - w[s + at.P0], r1 - w[s + at.P1], r2 - w[s + at.P2]
            J[0, i], J[1, i], J[2, i] = z1 * d2 - z2 * d1, z2 * d0 - z0 * d2, z0 * d1 - z1 * d0
        else:
            J[0, i], J[1, i], J[2, i] = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]


@kernel_inlined
def turning(tree: Tree, work: Array, axes: Array, J: Array) -> None:
    """Write the axes of the link that carries the tip, columns of (3, 3), and how the joints turn it, J (3, n)."""
    n, table, w = tree.n, tree.links, work
    for i in range(n):
        s = table[at.SCRATCH * n + i]
        if table[at.SUPPORT * n + i] != 0 and table[at.REVOLUTE * n + i] != 0:
            J[0, i], J[1, i], J[2, i] = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
        else:
            J[0, i] = J[1, i] = J[2, i] = 0.0
    if tree.carrier < 0:
        for i in range(3):
            for k in range(3):
                axes[i, k] = 1.0 if i == k else 0.0
        return
    s = table[at.SCRATCH * n + tree.carrier]
    x0, x1, x2 = w[s + at.X0], w[s + at.X1], w[s + at.X2]
    z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
    axes[0, 0], axes[1, 0], axes[2, 0] = x0, x1, x2
    axes[0, 1], axes[1, 1], axes[2, 1] = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    axes[0, 2], axes[1, 2], axes[2, 2] = z0, z1, z2
