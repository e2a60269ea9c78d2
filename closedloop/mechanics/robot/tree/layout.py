"""The memory layout of a tree of joints: its constants, the scratch of its kernels, the names of their rows; its steps.

Most of the work is the same for every joint, so four joints share a SIMD register: joint i is lane i % 4 of block
i // 4, and one row of a block holds one number of each of four joints, handled in one instruction. Rows are named by
their offset in a block; lanes without a joint hold zeros.

In a small step of a posture ball joints turn: a rotation vector is not advanced by adding to it.
"""

import math
from typing import NamedTuple

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.kernel import kernel
from closedloop.mechanics.robot.tree import layout as at

LANES = 4

# `Tree.links`: rows of n whole numbers.
PARENT, CONSTANT, SCRATCH, REVOLUTE, SUPPORT, RUN, END = range(7)
LINK_ROWS = 7

# The row REVOLUTE: what a joint is. A ball joint is three joints in a row whose axes are those of the link that it
# carries. All three entries have that link's origin, ω, α and b; the last has its inertia, but h_z and Σ_zz, which are
# an h_y and a Σ_yy to the first.
SLIDES, TURNS, BALL, BALL_AXIS = range(4)

# `Tree.constants`: gravity, the tip in its link, the first moment of the immobile mass, then the blocks. Inertia is as
# moved by `closedloop.mechanics.robot.tree.model`: h_z = Σ_zz = 0, and either m or h and Σ are zero.
GRAVITY, TIP, RESTING, HEAD = 0, 3, 6, 12
(
    KIND,  # 1 for a revolute joint, 0 for a prismatic one
    ANGLE,  # from the parent's first axis to the link's, beside q
    COS_TWIST, SIN_TWIST,  # from the parent's joint axis to this one, about the axis perpendicular to both
    COS_TURN, SIN_TURN,  # from the parent's first axis to that perpendicular one; 1, 0 where they are the same
    R00, R10, R20, R01, R11, R21, R02, R12, R22,  # for one on the base, and a ball joint anywhere: its axes at q = 0
    T0, T1, T2,  # its origin in the parent's frame, m
    HALF_XX, XY, XZ, HALF_YY, YZ,  # second moments of the link, kg m², halved where they are squares
    HX, HY,  # first moments, kg m
    MASS, CARRIED,  # of the link, and of all that it carries, kg
    ARMATURE,
) = range(0, 28 * LANES, LANES)  # fmt: skip
CONSTANTS = 28 * LANES

# Scratch; all in base axes.
(
    POSITION,  # of a ball joint the vector part of its quaternion; the first COSINE is the scalar part
    SINE, COSINE, SLIDE,
    X0, X1, X2, Z0, Z1, Z2, P0, P1, P2,  # first axis and joint axis of the link, origin of the joint
    O0, O1, O2, A0, A1, A2, B0, B1, B2,  # angular velocity and acceleration, acceleration of the origin, for q̈ = 0
    W0, W1, W2, V0, V1, V2,  # twist of the link per joint rate: rotation, and velocity of its point at the base origin
    F0, F1, F2, N0, N1, N2,  # force, and moment about the base origin, that move the link with q̈ = 0
    S00, S01, S02, S11, S12, S22, H0, H1, H2,  # second and first moments about the base origin
) = range(0, 43 * LANES, LANES)  # fmt: skip
SCRATCHES = 43 * LANES


class Tree(NamedTuple):
    """A robot as arrays, for the kernels of this package; `tree_of` makes it."""

    # n, blocks: joints, and blocks of four that hold them
    n: int
    blocks: int
    once: int  # 1. A loop over `LANES * once` lanes is vectorised; with a constant length the compiler would unroll it.
    carrier: int  # the joint that carries the tip; −1 if it sits on the base
    serial: int  # 1 if every joint but the first is a child of the one before it, else 0
    # (LINK_ROWS n,): for each joint: its parent (−1: base; always smaller than the joint), where its constants and its
    # scratch begin, what it is (SLIDES, TURNS ...), whether it moves the tip, the first joint of its unbranched chain:
    # of the joints up to it that are each a child of the one before; and the end of its group, see `group_ends`
    links: IntArray
    # (HEAD + blocks * CONSTANTS + springs,): see the names of `closedloop.mechanics.robot.tree.layout`. The z axis of a
    # link is its joint axis; its x axis is perpendicular to its own joint axis and to that of the next joint. The
    # springs are the rows of `RobotModel.springs`.
    constants: Array
    # ball joints. Positions of one are the rotation vector θ of its link, rad, its rates the angular velocity in the
    # link's axes; see `robot_models.coordinates`.
    balls: int

    @property
    def ends(self) -> IntArray:
        """Return where the groups of joints end (n,), see `closedloop.mechanics.robot.tree.group_ends`."""
        return self.links[END * self.n : (END + 1) * self.n]


@kernel
def work_size(n: int) -> int:
    """Return how many numbers of scratch the kernels need for n joints; they begin as zeros."""
    return (n + LANES - 1) // LANES * SCRATCHES


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
