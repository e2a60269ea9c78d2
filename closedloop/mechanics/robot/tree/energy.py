"""Potential energy of a tree, and its springs.

Springs of joints and tendons: their forces, as part of C, and their energy; see `robot_models.tendon`.
"""

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import entry_kernel, kernel, plain
from closedloop.jit.simd8 import select
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.kinematics import motion, sines
from closedloop.mechanics.robot.tree.layout import CONSTANTS, HEAD, Tree, work_size
from robot_models.tendon import SPRING


@kernel
def add_springs(tree: Tree, q: Array, C: Array) -> None:
    """Add to C (n,) the gradient of the energy of all springs at q (n,), N m (N)."""
    n, k = tree.n, tree.constants
    for c in range(HEAD + tree.blocks * CONSTANTS, k.shape[0], SPRING + n):
        x = stretch(tree, q, c)
        force = x * (k[c] + x * (k[c + 1] + x * k[c + 2]))
        for j in range(n):
            C[j] += force * k[c + SPRING + j]


@kernel
def spring_energy(tree: Tree, q: Array) -> float:
    """Return the energy of all springs at q (n,), J."""
    n, k = tree.n, tree.constants
    energy: float = 0.0 * q[0]
    for c in range(HEAD + tree.blocks * CONSTANTS, k.shape[0], SPRING + n):
        x = stretch(tree, q, c)
        energy += x * x * (k[c] / 2.0 + x * (k[c + 1] / 3.0 + x * k[c + 2] / 4.0))
    return energy


@kernel
def stretch(tree: Tree, q: Array, c: int) -> float:
    """Return by how much the spring whose row begins at c is longer than its rest lengths, or shorter, rad (m)."""
    n, k = tree.n, tree.constants
    length = k[c + SPRING] * q[0]
    for j in range(1, n):
        length += k[c + SPRING + j] * q[j]
    short, long = length - k[c + 3], length - k[c + 4]
    found: float = select(long > 0.0, long, select(short < 0.0, short, 0.0 * length))
    return found


# Rows whose numbers stay in the processor's cache.
ROWS_AT_ONCE = 2000


@kernel
def tree_potential_energy(tree: Tree, q: Array, work: Array) -> float:
    """Return −g·∫ r dm over all moving links at q (n,), J: zero where the mass would be at the base origin.

    The energy of springs is added. `work` (work_size(n),) is scratch.
    """
    sines(tree, q, work)
    if tree.balls != 0:
        motion(tree, q, work)  # where the links are does not depend on the rates
    return energy_there(tree, q, work)


@entry_kernel
def potential_energies(tree: Tree, q: Array, work: Array, energies: Array) -> None:
    """Write the potential energy of each row of q (N, n), J, to `energies` (N,); `work` (work_size(n),) is scratch."""
    for i in range(q.shape[0]):
        energies[i] = tree_potential_energy(tree, q[i], work)


def energies_of_rows(tree: Tree, q: Array) -> Array:
    """Return the same (N,), interpreted: each line is done once for many rows, as an operation of numpy on columns.

    That takes less time than reading the compiled form from the disk, and gives the same bits.
    """
    energies, energy_of = np.empty(q.shape[0]), interpreted(tree_potential_energy)
    size = plain(work_size)(tree.n)
    if tree.balls != 0:
        potential_energies(tree, np.ascontiguousarray(q), np.zeros(size), energies)
        return energies
    for begin in range(0, q.shape[0], ROWS_AT_ONCE):
        rows = np.ascontiguousarray(q[begin : begin + ROWS_AT_ONCE].T)
        energies[begin : begin + ROWS_AT_ONCE] = energy_of(tree, rows, np.zeros((size, rows.shape[1])))
    return energies


@kernel
def energy_there(tree: Tree, q: Array, work: Array) -> float:
    """Return the same for the q (n,) whose sines `tree_terms` has written into `work`; with ball joints, whose motion.

    First moments are summed from the tips to the base, from each unbranched chain separately, so that nothing need be
    stored but the sines.
    """
    n, table, k = tree.n, tree.links, tree.constants
    springs = spring_energy(tree, q)
    if tree.balls != 0:
        return springs + energy_of_links(tree, work)
    total0, total1, total2 = k[at.RESTING], k[at.RESTING + 1], k[at.RESTING + 2]
    h0 = h1 = h2 = mass = 0.0
    for tip in range(n - 1, -1, -1):
        joint = tip
        c = table[at.CONSTANT * n + joint]
        h0 += k[c + at.HX]
        h1 += k[c + at.HY]
        mass += k[c + at.MASS]
        while joint >= 0:
            c = table[at.CONSTANT * n + joint]
            s = table[at.SCRATCH * n + joint]
            sine, cosine, slide = work[s + at.SINE], work[s + at.COSINE], work[s + at.SLIDE]
            h0, h1, h2 = cosine * h0 - sine * h1, sine * h0 + cosine * h1, h2 + mass * slide
            parent = table[at.PARENT * n + joint]
            if parent < 0:
                total0 += k[c + at.R00] * h0 + k[c + at.R01] * h1 + k[c + at.R02] * h2 + mass * k[c + at.T0]
                total1 += k[c + at.R10] * h0 + k[c + at.R11] * h1 + k[c + at.R12] * h2 + mass * k[c + at.T1]
                total2 += k[c + at.R20] * h0 + k[c + at.R21] * h1 + k[c + at.R22] * h2 + mass * k[c + at.T2]
            else:
                cos, sin = k[c + at.COS_TWIST], k[c + at.SIN_TWIST]
                h1, h2 = cos * h1 - sin * h2, sin * h1 + cos * h2
                cos, sin = k[c + at.COS_TURN], k[c + at.SIN_TURN]
                h0, h1 = cos * h0 - sin * h1, sin * h0 + cos * h1
                h0 += mass * k[c + at.T0]
                h1 += mass * k[c + at.T1]
                h2 += mass * k[c + at.T2]
                if joint == tip and parent == tip - 1:
                    break
            joint = parent
        if joint < 0:
            h0 = h1 = h2 = mass = 0.0
    energy: float = -(k[at.GRAVITY] * total0 + k[at.GRAVITY + 1] * total1 + k[at.GRAVITY + 2] * total2)
    return springs + energy


@kernel
def energy_of_links(tree: Tree, work: Array) -> float:
    """Return that of gravity, link by link, where `closedloop.mechanics.robot.tree.kinematics` has written axes and
    origins."""
    n, table, k, w = tree.n, tree.links, tree.constants, work
    zero = 0.0 * w[table[at.SCRATCH * n]]
    total0, total1, total2 = k[at.RESTING] + zero, k[at.RESTING + 1] + zero, k[at.RESTING + 2] + zero
    for i in range(n):
        c, s = table[at.CONSTANT * n + i], table[at.SCRATCH * n + i]
        hx, hy, mass = k[c + at.HX], k[c + at.HY], k[c + at.MASS]
        x0, x1, x2 = w[s + at.X0], w[s + at.X1], w[s + at.X2]
        z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
        total0 += hx * x0 + hy * (z1 * x2 - z2 * x1) + mass * w[s + at.P0]
        total1 += hx * x1 + hy * (z2 * x0 - z0 * x2) + mass * w[s + at.P1]
        total2 += hx * x2 + hy * (z0 * x1 - z1 * x0) + mass * w[s + at.P2]
    energy: float = -(k[at.GRAVITY] * total0 + k[at.GRAVITY + 1] * total1 + k[at.GRAVITY + 2] * total2)
    return energy
