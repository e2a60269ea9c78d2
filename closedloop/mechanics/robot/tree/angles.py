"""Sine and cosine of all joint angles at once.

The library's sine takes one angle at a time. This one takes four, without a branch, as accurately: the angle
less its nearest multiple of π/2, which is subtracted in three parts (W. J. Cody and W. Waite, Software Manual for the
Elementary Functions, 1980), then the polynomials for |x| <= π/4 of fdlibm (Sun Microsystems 1993, k_sin.c, k_cos.c).
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.dual8 import sought
from closedloop.jit.kernel import kernel_inlined
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
