"""H and C of a tree: inertia and inertial forces of the links, summed from the tips to the base.

A body has mass m, first moments h = ∫ s dm and second moments Σ = ∫ s sᵀ dm, with s from the joint's origin. Its points
accelerate by b + U s with U = [α]× + [ω]×², so with q̈ = 0 its motion requires the force F and the moment N,

    F = U h + m b            N = ∫ s × (b + U s) dm, the antisymmetric part of U Σ + b hᵀ.

The links that a joint carries form a composite body. At unit joint rate, with twist (w, v), it has about the base
origin the momentum l = w × h + m v and the angular momentum L = (tr Σ 1 − Σ) w + h × v. Then

    C_i = w_i·N_i + v_i·F_i            H_ji = w_j·L_i + v_j·l_i       for j between the base and i

with F_i, N_i, Σ_i, h_i summed over all that joint i carries. These are the H of Eq. 8 by composite bodies
(R. Featherstone, Robot Dynamics Algorithms, 1987) and its C by recursive Newton-Euler.

Pinocchio's calls for these terms cost half a microsecond each and are made from Python. These kernels are compiled into
the loop that uses them.
"""

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.energy import add_springs
from closedloop.mechanics.robot.tree.kinematics import jacobian, motion, sines, tip, turning
from closedloop.mechanics.robot.tree.layout import Tree


@kernel_inlined
def bodies(tree: Tree, work: Array) -> None:
    """Write each link's twist (w, v), force F and moment N, Σ and h, all about the base origin."""
    k, w = tree.constants, work
    for block in range(tree.blocks):
        c = at.HEAD + block * at.CONSTANTS
        s = block * at.SCRATCHES
        for lane in range(at.LANES * tree.once):
            x0, x1, x2 = w[s + at.X0 + lane], w[s + at.X1 + lane], w[s + at.X2 + lane]
            z0, z1, z2 = w[s + at.Z0 + lane], w[s + at.Z1 + lane], w[s + at.Z2 + lane]
            y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
            p0, p1, p2 = w[s + at.P0 + lane], w[s + at.P1 + lane], w[s + at.P2 + lane]
            kind = k[c + at.KIND + lane]
            w0, w1, w2 = kind * z0, kind * z1, kind * z2
            w[s + at.W0 + lane], w[s + at.W1 + lane], w[s + at.W2 + lane] = w0, w1, w2
            w[s + at.V0 + lane] = p1 * w2 - p2 * w1 + (z0 - w0)
            w[s + at.V1 + lane] = p2 * w0 - p0 * w2 + (z1 - w1)
            w[s + at.V2 + lane] = p0 * w1 - p1 * w0 + (z2 - w2)
            # h and Σ = x eᵀ + e xᵀ + y fᵀ + f yᵀ about the joint's origin
            hx, hy, m = k[c + at.HX + lane], k[c + at.HY + lane], k[c + at.MASS + lane]
            h0, h1, h2 = hx * x0 + hy * y0, hx * x1 + hy * y1, hx * x2 + hy * y2
            xx, xy, xz = k[c + at.HALF_XX + lane], k[c + at.XY + lane], k[c + at.XZ + lane]
            yy, yz = k[c + at.HALF_YY + lane], k[c + at.YZ + lane]
            e0, e1, e2 = xx * x0 + xy * y0 + xz * z0, xx * x1 + xy * y1 + xz * z1, xx * x2 + xy * y2 + xz * z2
            f0, f1, f2 = yy * y0 + yz * z0, yy * y1 + yz * z1, yy * y2 + yz * z2
            s00 = 2.0 * (x0 * e0 + y0 * f0)
            s01 = (x0 * e1 + e0 * x1) + (y0 * f1 + f0 * y1)
            s02 = (x0 * e2 + e0 * x2) + (y0 * f2 + f0 * y2)
            s11 = 2.0 * (x1 * e1 + y1 * f1)
            s12 = (x1 * e2 + e1 * x2) + (y1 * f2 + f1 * y2)
            s22 = 2.0 * (x2 * e2 + y2 * f2)
            o0, o1, o2 = w[s + at.O0 + lane], w[s + at.O1 + lane], w[s + at.O2 + lane]
            a0, a1, a2 = w[s + at.A0 + lane], w[s + at.A1 + lane], w[s + at.A2 + lane]
            b0, b1, b2 = w[s + at.B0 + lane], w[s + at.B1 + lane], w[s + at.B2 + lane]
            o00, o11, o22, o01, o02, o12 = o0 * o0, o1 * o1, o2 * o2, o0 * o1, o0 * o2, o1 * o2
            u00, u01, u02 = -o11 - o22, o01 - a2, o02 + a1
            u10, u11, u12 = o01 + a2, -o00 - o22, o12 - a0
            u20, u21, u22 = o02 - a1, o12 + a0, -o00 - o11
            g0 = u00 * h0 + u01 * h1 + u02 * h2 + m * b0
            g1 = u10 * h0 + u11 * h1 + u12 * h2 + m * b1
            g2 = u20 * h0 + u21 * h1 + u22 * h2 + m * b2
            w[s + at.F0 + lane], w[s + at.F1 + lane], w[s + at.F2 + lane] = g0, g1, g2
            w[s + at.N0 + lane] = (
                (u20 * s01 + u21 * s11 + u22 * s12 + b2 * h1)
                - (u10 * s02 + u11 * s12 + u12 * s22 + b1 * h2)
                + (p1 * g2 - p2 * g1)
            )
            w[s + at.N1 + lane] = (
                (u00 * s02 + u01 * s12 + u02 * s22 + b0 * h2)
                - (u20 * s00 + u21 * s01 + u22 * s02 + b2 * h0)
                + (p2 * g0 - p0 * g2)
            )
            w[s + at.N2 + lane] = (
                (u10 * s00 + u11 * s01 + u12 * s02 + b1 * h0)
                - (u00 * s01 + u01 * s11 + u02 * s12 + b0 * h1)
                + (p0 * g1 - p1 * g0)
            )
            # moved to the base origin: Σ + p hᵀ + h pᵀ + m p pᵀ, h + m p
            m0, m1, m2 = h0 + m * p0, h1 + m * p1, h2 + m * p2
            w[s + at.S00 + lane] = s00 + p0 * (h0 + m0)
            w[s + at.S01 + lane] = s01 + (p0 * h1 + m0 * p1)
            w[s + at.S02 + lane] = s02 + (p0 * h2 + m0 * p2)
            w[s + at.S11 + lane] = s11 + p1 * (h1 + m1)
            w[s + at.S12 + lane] = s12 + (p1 * h2 + m1 * p2)
            w[s + at.S22 + lane] = s22 + p2 * (h2 + m2)
            w[s + at.H0 + lane], w[s + at.H1 + lane], w[s + at.H2 + lane] = m0, m1, m2
    if tree.balls != 0:
        gather(tree, work)


@kernel
def gather(tree: Tree, work: Array) -> None:
    """Add what the first entry of each ball joint has of its link's inertia to the last, which the others carry."""
    n, table, w = tree.n, tree.links, work
    for i in range(n - 2):
        if table[at.REVOLUTE * n + i] == at.BALL:
            first, last = table[at.SCRATCH * n + i], table[at.SCRATCH * n + i + 2]
            for row in range(at.F0, at.SCRATCHES, at.LANES):
                w[last + row] += w[first + row]
                w[first + row] = 0.0 * w[first + row]


@kernel_inlined
def matrix_and_bias(tree: Tree, work: Array, H: Array, C: Array) -> None:
    """Write the upper triangle of H (n, n), armature included, and C (n,), from the tips to the base.

    Along an unbranched chain of joints the sums stay in registers; at its end they are added to the parent joint.
    """
    n, table, k, w = tree.n, tree.links, tree.constants, work
    if tree.serial == 0:
        for i in range(n):
            for j in range(i):
                H[j, i] = 0.0  # joints on different branches
    i = n - 1
    while i >= 0:
        f0 = f1 = f2 = n0 = n1 = n2 = h0 = h1 = h2 = 0.0
        s00 = s01 = s02 = s11 = s12 = s22 = 0.0
        parent = i
        while parent == i and i >= 0:
            s = table[at.SCRATCH * n + i]
            c = table[at.CONSTANT * n + i]
            f0 += w[s + at.F0]
            f1 += w[s + at.F1]
            f2 += w[s + at.F2]
            n0 += w[s + at.N0]
            n1 += w[s + at.N1]
            n2 += w[s + at.N2]
            h0 += w[s + at.H0]
            h1 += w[s + at.H1]
            h2 += w[s + at.H2]
            s00 += w[s + at.S00]
            s01 += w[s + at.S01]
            s02 += w[s + at.S02]
            s11 += w[s + at.S11]
            s12 += w[s + at.S12]
            s22 += w[s + at.S22]
            m, w0, w1, w2 = k[c + at.CARRIED], w[s + at.W0], w[s + at.W1], w[s + at.W2]
            v0, v1, v2 = w[s + at.V0], w[s + at.V1], w[s + at.V2]
            l0, l1, l2 = w1 * h2 - w2 * h1 + m * v0, w2 * h0 - w0 * h2 + m * v1, w0 * h1 - w1 * h0 + m * v2
            e0 = ((s11 + s22) * w0 - s01 * w1) + (h1 * v2 - h2 * v1 - s02 * w2)
            e1 = ((s00 + s22) * w1 - s01 * w0) + (h2 * v0 - h0 * v2 - s12 * w2)
            e2 = ((s00 + s11) * w2 - s02 * w0) + (h0 * v1 - h1 * v0 - s12 * w1)
            C[i] = (w0 * n0 + w1 * n1 + w2 * n2) + (v0 * f0 + v1 * f1 + v2 * f2)
            H[i, i] = (w0 * e0 + w1 * e1 + w2 * e2) + (v0 * l0 + v1 * l1 + v2 * l2) + k[c + at.ARMATURE]
            parent = table[at.PARENT * n + i]
            j = parent
            while j >= 0:  # chain by chain: a loop of known length is quicker than following the parents
                first = table[at.RUN * n + j]
                for back in range(j - first + 1):
                    above = j - back
                    t = table[at.SCRATCH * n + above]
                    H[above, i] = (w[t + at.W0] * e0 + w[t + at.W1] * e1 + w[t + at.W2] * e2) + (
                        w[t + at.V0] * l0 + w[t + at.V1] * l1 + w[t + at.V2] * l2
                    )
                j = table[at.PARENT * n + first]
            i -= 1
        if parent >= 0:
            s = table[at.SCRATCH * n + parent]
            w[s + at.F0] += f0
            w[s + at.F1] += f1
            w[s + at.F2] += f2
            w[s + at.N0] += n0
            w[s + at.N1] += n1
            w[s + at.N2] += n2
            w[s + at.H0] += h0
            w[s + at.H1] += h1
            w[s + at.H2] += h2
            w[s + at.S00] += s00
            w[s + at.S01] += s01
            w[s + at.S02] += s02
            w[s + at.S11] += s11
            w[s + at.S12] += s12
            w[s + at.S22] += s22


@kernel
def tree_terms(
    tree: Tree, q: Array, v: Array, work: Array, H: Array, C: Array, of_tip: tuple[Array, Array, Array]
) -> None:
    """Write the terms of the robot in Eq. 24 at (q, v).

    `tree`: from `tree_of`.
    `q`, `v`, (n,) arrays: joint positions, rad (m), and rates, rad/s (m/s).
    `work`, (work_size(n),) array: scratch, zeros at first; not shared by threads.
    `H` (n, n): written: mass matrix, kg m² (kg), armature included, the upper triangle; below it nothing is written.
    `C` (n,): written: Coriolis, centrifugal and gravity terms, and those of springs, N m (N).
    `of_tip`, arrays (3, n), (3,) and (3,): written: the tip's Jacobian Jᵣ (Eq. 13; zero for joints that do not move
        it), position r, m, and J̇ᵣq̇ (Eq. 18), m/s², in base axes.
    """
    J, r, drift = of_tip
    sines(tree, q, work)
    motion(tree, v, work)
    tip(tree, work, r, drift)
    jacobian(tree, work, r, J)
    bodies(tree, work)
    matrix_and_bias(tree, work, H, C)
    add_springs(tree, q, C)


@kernel
def tree_kinematics(tree: Tree, q: Array, v: Array, work: Array, J: Array, r: Array, drift: Array) -> None:
    """Write J (3, n), r (3,) and drift (3,) alone; see `tree_terms`."""
    sines(tree, q, work)
    motion(tree, v, work)
    tip(tree, work, r, drift)
    jacobian(tree, work, r, J)


@kernel
def tree_turning(tree: Tree, work: Array, axes: Array, J: Array) -> None:
    """Write the orientation of the tip's link, after `tree_kinematics` with this scratch.

    `tree`, `work`: see `tree_terms`.
    `axes` (3, 3): written: the link's axes as `Tree` has them, columns, base axes.
    `J` (3, n): written: the link's angular velocity per joint rate, base axes.
    """
    turning(tree, work, axes, J)
