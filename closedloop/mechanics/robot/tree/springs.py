"""Springs of joints and tendons: their forces, as part of C, and their energy; see `robot_models.tendon`."""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.jit.simd8 import select
from closedloop.mechanics.robot.tree.layout import CONSTANTS, HEAD, Tree
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
