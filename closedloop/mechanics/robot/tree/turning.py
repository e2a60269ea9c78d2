"""Small steps of a posture, of which ball joints turn: a rotation vector is not advanced by adding to it."""

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.layout import Tree


@kernel
def quaternion(x0: float, x1: float, x2: float) -> tuple[float, float, float, float]:
    """Return the quaternion w, x, y, z of a rotation vector, rad."""
    half = 0.5 * math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    share = 0.5 * math.sin(half) / half if half > 1e-8 else 0.5
    return math.cos(half), share * x0, share * x1, share * x2


@kernel
def turn(q: Array, j: int, from_: Array, i: int, u0: float, u1: float, u2: float) -> None:
    """Write θ ∘ u to q from entry j on, rad, with θ in `from_` from entry i on: of at most half a turn."""
    w, x, y, z = quaternion(from_[i], from_[i + 1], from_[i + 2])
    d, a, b, c = quaternion(u0, u1, u2)
    x, y, z, w = (
        w * a + d * x + (y * c - z * b), w * b + d * y + (z * a - x * c), w * c + d * z + (x * b - y * a),
        w * d - (x * a + y * b + z * c),
    )  # fmt: skip
    sine = math.sqrt(x * x + y * y + z * z)
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    share = 2.0 * math.atan2(sine, w) / sine if sine > 1e-8 else 2.0
    q[j], q[j + 1], q[j + 2] = share * x, share * y, share * z


@kernel
def move_posture(tree: Tree, q: Array, by: Array, share: float) -> None:
    """Move q (n,) by a share of a small step (n,), rad (m), of ball joints in their links' axes."""
    for j in range(tree.n):
        kind = tree.links[at.REVOLUTE * tree.n + j]
        if kind == at.BALL:
            turn(q, j, q, j, share * by[j], share * by[j + 1], share * by[j + 2])
        elif kind != at.BALL_AXIS:
            q[j] += share * by[j]
