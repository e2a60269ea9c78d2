"""The joint velocity of least norm, and inverse kinematics along the tip's path by it.

Between knots q̇ = Jᵣ⁺ ṙ_des is integrated with one step of RK4, and the error of the tip is removed by least-norm
Newton steps. Where the tool's axis is held too, or the whole of its frame, Jᵣ has two rows more, or three: those of the
angular velocity across the axis, or of all of it. The errors of the axis a, and of the frame's axes cᵢ, are to first
order

    a × a_des        ½ Σ cᵢ × cᵢ_des

The joints' path q_des(t), with q̇_des(t) and q̈_des(t), is a cubic Hermite spline over the knots, at rest before and
after.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.tip_path import INSTANT
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import call_at
from closedloop.jit.interim import call_once
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.mechanics.loops.memory import loops_at as loops_memory
from closedloop.mechanics.loops.solve import NEAREST, TANGENT
from closedloop.mechanics.robot.tree import Tree, tree_kinematics, tree_turning, work_size

# So many take as long interpreted, 20 µs each, as `sample_spline` takes to be compiled.
FEW_INSTANTS = 50_000


@dataclass(frozen=True)
class JointPath:
    """The joint path: at rest before `times[0]`, a cubic Hermite spline over the knots, at rest after the last."""

    times: Array  # (K,): knots, s, increasing; an instant at which the velocity jumps is there twice
    # q, v (K, n): joint positions, rad (m), and velocities, rad/s (m/s), at the knots
    q: Array
    v: Array

    @classmethod
    def hold(cls, q: Array) -> "JointPath":
        """Make the path that stays at joint positions q (n,)."""
        return cls(np.zeros(1), q[None, :].copy(), np.zeros((1, q.size)))

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q_des, q̇_des and q̈_des, each (N, n), at times t (N,), s.

        At a discontinuity the velocity has its right limit, and its jump does not enter q̈_des. q̈_des is the
        spline's own: linear between knots, with jumps of the order of their spacing squared.
        """
        n = self.q.shape[1]
        rows = np.zeros((np.size(t), 3 * n))
        self.write(t, rows, 3)
        return rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n :]

    def write(self, t: Array, rows: Array, orders: int) -> None:
        """Write q_des, q̇_des and, if `orders` is 3, q̈_des at times t (N,), s, to the first columns of zeros (N, m)."""
        if self.times.size == 1:
            rows[:, : self.q.size] = self.q[0]
            return
        t = np.ascontiguousarray(t, dtype=np.float64)
        call_once(sample_spline, (rows,), t.size <= FEW_INSTANTS, self.times, self.q, self.v, t, rows, orders)


@kernel_inlined
def cubic(q0: float, q1: float, v0: float, v1: float, h: float, s: float) -> tuple[float, float, float]:
    """Return position, velocity and acceleration at the share s of an interval of h seconds: Hermite's cubic.

    q0, q1 and v0, v1 are positions and velocities at both ends.
    """
    rise, u0, u1 = q1 - q0, h * v0, h * v1
    c2, c3 = 3.0 * rise - 2.0 * u0 - u1, u0 + u1 - 2.0 * rise
    return (
        q0 + s * (u0 + s * (c2 + s * c3)),
        (u0 + s * (2.0 * c2 + s * 3.0 * c3)) / h,
        (2.0 * c2 + s * 6.0 * c3) / h / h,
    )


@entry_kernel
def sample_spline(times: Array, q: Array, v: Array, t: Array, rows: Array, orders: int) -> None:
    """Write position, velocity and, if `orders` is 3, acceleration of a path at times t (N,), s; see `JointPath`.

    `times` (K,), q and v (K, n) are its knots; rows (N, >= orders n) are zeros at first.
    """
    last, n = times.shape[0] - 1, q.shape[1]
    instant = INSTANT * (times[last] - times[0])
    for i in range(t.shape[0]):
        row = rows[i]
        if last == 0 or t[i] < times[0] - instant or t[i] >= times[last] - instant:
            rest = 0 if last == 0 or t[i] < times[0] - instant else last
            for j in range(n):
                row[j] = q[rest, j]
        else:
            k, beyond = 0, last  # the last interval that has begun by now
            while beyond - k > 1:
                middle = (k + beyond) // 2
                if times[middle] <= t[i] + instant:
                    k = middle
                else:
                    beyond = middle
            h = times[k + 1] - times[k]
            s = (t[i] - times[k]) / h
            for j in range(n):
                row[j], row[n + j], acceleration = cubic(q[k, j], q[k + 1, j], v[k, j], v[k + 1, j], h, s)
                if orders == 3:
                    row[2 * n + j] = acceleration


# Singular values of Jᵣ below this share of the largest count as zero: the arm cannot move the tip in that direction.
RANK_TOLERANCE = 1e-6
# Rows are orthogonal when their product is below this share of the product of their lengths: rounding.
ORTHOGONAL = 1e-15
# A row whose square is below this, where the largest entry is 1, is rounding, far below `RANK_TOLERANCE`.
NOTHING = 1e-40
# Sweeps over the pairs of rows; they converge quadratically, so six do.
SWEEPS = 30


@kernel
def least_norm(J: Array, wanted: Array, W: Array, c: Array, rate: Array) -> None:
    """Write q̇ = Jᵣ⁺ ṙ (Moore-Penrose): the smallest q̇ that gives the tip ṙ as nearly as it can.

    The singular value decomposition by one-sided Jacobi rotations (M. R. Hestenes, J. SIAM 6, 1958; G. H. Golub and
    C. F. Van Loan, Matrix Computations, 4th ed., 8.6.3): with an orthogonal U that makes the rows of W = U Jᵣ
    orthogonal to each other, and c = U ṙ, q̇ is the sum of Wᵢ cᵢ/|Wᵢ|² over the rows that are not zero; their lengths
    are the singular values. Small ones are as accurate as large ones, which those of Jᵣ Jᵣᵀ would not be.

    `J` (m, n): Jᵣ, and what else is to move, a row each.
    `wanted` (m,): ṙ, m/s, and the rates of the rest.
    `W`, `c`, (m, n), (m,) arrays: scratch.
    `rate` (n,): written: q̇, rad/s (m/s); NaN if an entry of J or `wanted` is not finite.
    """
    m, n = J.shape
    size, finite = 0.0, True
    for i in range(m):
        finite = finite and math.isfinite(wanted[i])
        for j in range(n):
            finite = finite and math.isfinite(J[i, j])
            size = max(size, abs(J[i, j]))
    for j in range(n):
        rate[j] = 0.0 if finite else math.nan
    if size == 0.0 or not finite:
        return
    for i in range(m):
        c[i] = wanted[i]
        for j in range(n):
            W[i, j] = J[i, j] / size  # so that no square overflows
    make_rows_orthogonal(W, c)
    longest = 0.0
    for i in range(m):
        square = 0.0
        for j in range(n):
            square += W[i, j] * W[i, j]
        longest = max(longest, square)
    for i in range(m):
        square = 0.0
        for j in range(n):
            square += W[i, j] * W[i, j]
        if square > RANK_TOLERANCE * RANK_TOLERANCE * longest:
            share = c[i] / square / size
            for j in range(n):
                rate[j] += W[i, j] * share


@kernel
def make_rows_orthogonal(W: Array, c: Array) -> None:
    """Turn the rows of W (m, n), and c (m,) with them, by Jacobi rotations until they are orthogonal to each other."""
    m, n = W.shape
    turned, sweep = True, 0
    while turned and sweep < SWEEPS:
        turned, sweep = False, sweep + 1
        for i in range(m - 1):
            for k in range(i + 1, m):
                first = second = product = 0.0
                for j in range(n):
                    first += W[i, j] * W[i, j]
                    second += W[k, j] * W[k, j]
                    product += W[i, j] * W[k, j]
                if min(first, second) > NOTHING and abs(product) > ORTHOGONAL * math.sqrt(first * second):
                    turned = True
                    cot = (second - first) / (2.0 * product)  # of twice the angle
                    tan = math.copysign(1.0, cot) / (abs(cot) + math.sqrt(1.0 + cot * cot))
                    cos = 1.0 / math.sqrt(1.0 + tan * tan)
                    sin = cos * tan
                    for j in range(n):
                        W[i, j], W[k, j] = cos * W[i, j] - sin * W[k, j], sin * W[i, j] + cos * W[k, j]
                    c[i], c[k] = cos * c[i] - sin * c[k], sin * c[i] + cos * c[k]


# Tolerances of the tip's distance from the path, m, and of its orientation, rad: between knots, a hundredth of the
# closure error that the stabiliser leaves; at a knot; and of Newton's method.
PATH_TOLERANCE, KNOT_TOLERANCE, NEWTON_TOLERANCE = 1e-10, 1e-11, 1e-14
# Newton ends where a step moves no joint by more than this, rad (m), or after so many steps.
SMALLEST_MOVE, NEWTON_STEPS = 1e-15, 20

# What is held, as the number of its rows: the tip's position, the tool's axis with it, the tip's frame with it.
POSITION, AXIS, FRAME = 3, 5, 6

# How it ended: at the last knot; with something that is not finite; off the path; outside the joint limits.
REACHED, BROKEN, OFF, OUTSIDE = range(4)
# Where `walk` writes how it ended, and how far from the path the tip is midway between knots at most, m.
ENDED, MIDWAY, OUTCOMES = 0, 1, 2


class Way(NamedTuple):
    """The tip's path at the knots, and the joints' path along it."""

    times: Array  # (K,): instants of the knots, s; only their differences matter
    # knots, midway (K, 12), (K - 1, 12): the tip's position, m, and velocity, m/s, base frame, at the knots and midway
    # between them; then the wanted axis of the tool, a unit vector, and its rate, 1/s, which only `AXIS` reads
    knots: Array
    midway: Array
    rows: int  # what is held: `POSITION`, `AXIS` or `FRAME`
    # (3, 3): columns: axes of the tip's frame, of which `AXIS` holds the last, in the axes of its link as `Tree` has
    # them
    held: Array
    frame: Array  # (3, 3): of `FRAME`: the same as wanted, base axes
    limits: Array  # (2, n): lower and upper joint limits, rad (m)
    # q, v (K, n): joint positions, rad (m), of which the first are given, and velocities, rad/s (m/s), for `walk` to
    # write
    q: Array
    v: Array


N, M = Count.of("n"), Count.of("rows")


class Scratch(Block, sizes=("n", "rows", "work")):
    """Scratch of `walk`, zeros at first: the tip at x, joint velocities, and what `least_norm` needs.

    `rest` stays zero; `tree` has as many numbers as `work_size` says.
    """

    J: Annotated[Array, M, N]
    W: Annotated[Array, M, N]
    rest: Annotated[Array, N]
    x: Annotated[Array, N]
    slope: Annotated[Array, N]
    total: Annotated[Array, N]
    turn: Annotated[Array, 3, N]
    r: Annotated[Array, 3]
    drift: Annotated[Array, 3]
    error: Annotated[Array, M]
    rate: Annotated[Array, M]
    c: Annotated[Array, M]
    link: Annotated[Array, 3, 3]
    axes: Annotated[Array, 3, 3]
    tree: Annotated[Array, Count.of("work")]


@entry_kernel
def walk(tree: Tree, work: Array, way: Way, outcome: Array, loops: int, loops_at: int) -> int:
    """Follow the tip's path from knot to knot, and return how many knots were reached.

    `tree`: the robot.
    `work`: the memory of a `Scratch`.
    `way`: q and v are written, those of a knot that was not reached too, as far as they are there.
    `outcome` (OUTCOMES,): written: `ENDED` and `MIDWAY`.
    `loops`, `loops_at`: addresses of the entry of the mechanism's loops, `closedloop.mechanics.loops.assemble`, and of
        their memory; 0: none.
    """
    w = Scratch(work, tree.n, way.rows, work_size(tree.n))
    outcome[ENDED], outcome[MIDWAY] = REACHED, 0.0
    _look(tree, w, way, way.q[0], way.knots[0], loops, loops_at)
    least_norm(w.J, w.rate, w.W, w.c, way.v[0])
    for k in range(len(way.times) - 1):
        ended = _advance(tree, w, way, k, loops, loops_at)
        if ended != REACHED:
            outcome[ENDED] = ended
            return k + 1
        h = way.times[k + 1] - way.times[k]
        for j in range(tree.n):
            w.x[j], _, _ = cubic(way.q[k, j], way.q[k + 1, j], way.v[k, j], way.v[k + 1, j], h, 0.5)
        outcome[MIDWAY] = max(outcome[MIDWAY], _look(tree, w, way, w.x, way.midway[k], loops, loops_at))
    return len(way.times)


@kernel
def _advance(tree: Tree, w: Scratch, way: Way, k: int, loops: int, loops_at: int) -> int:
    """Write joint positions and velocities at knot k + 1 from those at knot k, and return the result."""
    n = tree.n
    h = way.times[k + 1] - way.times[k]
    q, v, q_next, v_next = way.q[k], way.v[k], way.q[k + 1], way.v[k + 1]
    target, midway = way.knots[k + 1], way.midway[k]
    for j in range(n):
        w.slope[j] = w.total[j] = v[j]
    for stage in range(1, 4):
        ahead = h if stage == 3 else 0.5 * h
        finite = True
        for j in range(n):
            w.x[j] = q[j] + ahead * w.slope[j]
            finite = finite and math.isfinite(w.x[j])
        if not finite:
            return BROKEN
        _look(tree, w, way, w.x, target if stage == 3 else midway, loops, loops_at)
        least_norm(w.J, w.rate, w.W, w.c, w.slope)
        weight = 1.0 if stage == 3 else 2.0
        for j in range(n):
            w.total[j] += weight * w.slope[j]
    for j in range(n):
        q_next[j] = q[j] + h / 6.0 * w.total[j]
    _close(q_next, loops, loops_at)
    off, move, step = _look(tree, w, way, q_next, target, loops, loops_at), math.inf, 0
    while step < NEWTON_STEPS and move >= SMALLEST_MOVE and off >= NEWTON_TOLERANCE:
        least_norm(w.J, w.error, w.W, w.c, w.slope)
        move, step = 0.0, step + 1
        for j in range(n):
            q_next[j] += w.slope[j]
            move = max(move, abs(w.slope[j]))
        _close(q_next, loops, loops_at)
        off = _look(tree, w, way, q_next, target, loops, loops_at)
    least_norm(w.J, w.rate, w.W, w.c, v_next)
    finite, inside = True, True
    for j in range(n):
        finite = finite and math.isfinite(q_next[j]) and math.isfinite(v_next[j])
        inside = inside and way.limits[0, j] <= q_next[j] <= way.limits[1, j]
    if not finite:
        return BROKEN
    if off > KNOT_TOLERANCE:
        return OFF
    return REACHED if inside else OUTSIDE


@kernel
def _close(q: Array, loops: int, loops_at: int) -> None:
    """Move q to the nearest posture that closes the loops."""
    if loops != 0:
        _, rows = loops_memory(loops_at)
        for j in range(q.shape[0]):
            rows.q[j] = q[j]
        call_at(loops, loops_at, NEAREST)
        for j in range(q.shape[0]):
            q[j] = rows.q[j]


@kernel
def _look(tree: Tree, w: Scratch, way: Way, x: Array, target: Array, loops: int, loops_at: int) -> float:
    """Write the rows at joint positions x (n,), the way from there to a target (12,), and the rates that it asks for.

    Returns the largest component of the way, m or rad.
    """
    tree_kinematics(tree, x, w.rest, w.tree, w.J[0:3], w.r, w.drift)
    for i in range(3):
        w.error[i], w.rate[i] = target[i] - w.r[i], target[3 + i]
    if way.rows > POSITION:
        tree_turning(tree, w.tree, w.link, w.turn)
        for i in range(3):
            for k in range(3):
                w.axes[i, k] = 0.0
                for j in range(3):
                    w.axes[i, k] += w.link[i, j] * way.held[j, k]
        if way.rows == AXIS:
            _axis_rows(w, target)
        else:
            _frame_rows(w, way.frame)
    if loops != 0:  # what the loops leave of the rows
        _, rows = loops_memory(loops_at)
        for j in range(x.shape[0]):
            rows.q[j] = x[j]
            for i in range(way.rows):
                rows.tip[i, j] = w.J[i, j]
        call_at(loops, loops_at, TANGENT)
        for j in range(x.shape[0]):
            for i in range(way.rows):
                w.J[i, j] = rows.tip[i, j]
    largest = 0.0
    for i in range(way.rows):
        largest = max(largest, abs(w.error[i]))
    return largest


@kernel
def _axis_rows(w: Scratch, target: Array) -> None:
    """Write the two rows across the tool's axis, which is to be target[6:9] and to move with target[9:12]."""
    a0, a1, a2 = w.axes[0, 2], w.axes[1, 2], w.axes[2, 2]
    d0, d1, d2, e0, e1, e2 = target[6], target[7], target[8], target[9], target[10], target[11]
    # Across it: with the coordinate axis that it leans to least, t = e − (e·a) a, and a × t.
    least = 0 if abs(a0) <= abs(a1) and abs(a0) <= abs(a2) else (1 if abs(a1) <= abs(a2) else 2)
    lean = w.axes[least, 2]
    t0, t1, t2 = -lean * a0, -lean * a1, -lean * a2
    t0 += 1.0 if least == 0 else 0.0
    t1 += 1.0 if least == 1 else 0.0
    t2 += 1.0 if least == 2 else 0.0
    size = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    t0, t1, t2 = t0 / size, t1 / size, t2 / size
    for row in range(3, 5):
        if row == 4:
            t0, t1, t2 = a1 * t2 - a2 * t1, a2 * t0 - a0 * t2, a0 * t1 - a1 * t0
        w.error[row] = t0 * (a1 * d2 - a2 * d1) + t1 * (a2 * d0 - a0 * d2) + t2 * (a0 * d1 - a1 * d0)
        w.rate[row] = t0 * (d1 * e2 - d2 * e1) + t1 * (d2 * e0 - d0 * e2) + t2 * (d0 * e1 - d1 * e0)
        for j in range(w.turn.shape[1]):
            w.J[row, j] = t0 * w.turn[0, j] + t1 * w.turn[1, j] + t2 * w.turn[2, j]


@kernel
def _frame_rows(w: Scratch, frame: Array) -> None:
    """Write the three rows of the tip's frame, which is to have these axes and to keep them."""
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        turn = 0.0
        for c in range(3):
            turn += 0.5 * (w.axes[k, c] * frame[m, c] - w.axes[m, c] * frame[k, c])
        w.error[3 + i], w.rate[3 + i] = turn, 0.0
        for j in range(w.turn.shape[1]):
            w.J[3 + i, j] = w.turn[i, j]
