"""Least-norm inverse kinematics along the tip's path as a kernel; see `closedloop.reference.follow`.

Between knots q̇ = Jᵣ⁺ ṙ_des is integrated with one step of RK4, and the error of the tip is removed by least-norm Newton
steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel, kernel, plain
from closedloop.loops.along_path import NEAREST, TANGENT
from closedloop.loops.memory import loops_at as loops_memory
from closedloop.reference.joint_path import cubic
from closedloop.reference.least_norm import least_norm
from closedloop.robot.tree import Tree, tree_kinematics, work_size

Array = NDArray[np.float64]

# Tolerances of the tip's distance from the path, m: between knots, a hundredth of the closure error that the stabiliser
# leaves; at a knot; and of Newton's method.
PATH_TOLERANCE, KNOT_TOLERANCE, NEWTON_TOLERANCE = 1e-10, 1e-11, 1e-14
# Newton ends where a step moves no joint by more than this, rad (m), or after so many steps.
SMALLEST_MOVE, NEWTON_STEPS = 1e-15, 20

# How it ended: at the last knot; with something that is not finite; off the path; outside the joint limits.
REACHED, BROKEN, OFF, OUTSIDE = range(4)
# Where `walk` writes how it ended, and how far from the path the tip is midway between knots at most, m.
ENDED, MIDWAY, OUTCOMES = 0, 1, 2


class Way(NamedTuple):
    """The tip's path at the knots, and the joints' path along it.

    Attributes
    ----------
    times : (K,) array
        Instants of the knots, s; only their differences matter.
    knots, midway : (K, 6), (K - 1, 6) arrays
        The tip's position, m, and velocity, m/s, base frame, at the knots and midway between them.
    limits : (2, n) array
        Lower and upper joint limits, rad (m).
    q, v : (K, n) arrays
        Joint positions, rad (m), of which the first are given, and velocities, rad/s (m/s), for `walk` to write.
    """

    times: Array
    knots: Array
    midway: Array
    limits: Array
    q: Array
    v: Array


class Scratch(NamedTuple):
    """Views into the scratch of `walk`: the tip at x, joint velocities, and what `least_norm` needs."""

    J: Array
    r: Array
    drift: Array
    rest: Array
    x: Array
    slope: Array
    total: Array
    error: Array
    W: Array
    c: Array
    tree: Array


@kernel
def _scratch(work: Array, n: int) -> Scratch:
    """Return the views; joint velocities `rest` are zeros and stay so."""
    at = 10 * n
    return Scratch(
        work[0 : 3 * n].reshape(3, n),
        work[at : at + 3],
        work[at + 3 : at + 6],
        work[6 * n : 7 * n],
        work[7 * n : 8 * n],
        work[8 * n : 9 * n],
        work[9 * n : 10 * n],
        work[at + 6 : at + 9],
        work[3 * n : 6 * n].reshape(3, n),
        work[at + 9 : at + 12],
        work[at + 12 :],
    )


def scratch_size(n: int) -> int:
    """Return how many numbers of scratch `walk` needs for n joints; they begin as zeros."""
    return 10 * n + 12 + int(plain(work_size)(n))


@entry_kernel
def walk(tree: Tree, work: Array, way: Way, outcome: Array, loops: int, loops_at: int) -> int:
    """Follow the tip's path from knot to knot, and return how many knots were reached.

    Parameters
    ----------
    tree : Tree
        The robot.
    work : (scratch_size(n),) array
        Scratch, zeros at first.
    way : Way
        q and v are written, those of a knot that was not reached too, as far as they are there.
    outcome : (OUTCOMES,) array
        Written: `ENDED` and `MIDWAY`.
    loops, loops_at : int
        Addresses of the entry of the mechanism's loops, `closedloop.loops.along_path`, and of their memory; 0: none.
    """
    w = _scratch(work, tree.n)
    outcome[ENDED], outcome[MIDWAY] = REACHED, 0.0
    _locate(tree, w, way.q[0], loops, loops_at)
    least_norm(w.J, way.knots[0, 3:6], w.W, w.c, way.v[0])
    for k in range(len(way.times) - 1):
        ended = _advance(tree, w, way, k, loops, loops_at)
        if ended != REACHED:
            outcome[ENDED] = ended
            return k + 1
        h = way.times[k + 1] - way.times[k]
        for j in range(tree.n):
            w.x[j], _, _ = cubic(way.q[k, j], way.q[k + 1, j], way.v[k, j], way.v[k + 1, j], h, 0.5)
        tree_kinematics(tree, w.x, w.rest, w.tree, w.J, w.r, w.drift)
        outcome[MIDWAY] = max(outcome[MIDWAY], _miss(way.midway[k, 0:3], w))
    return len(way.times)


@kernel
def _advance(tree: Tree, w: Scratch, way: Way, k: int, loops: int, loops_at: int) -> int:
    """Write joint positions and velocities at knot k + 1 from those at knot k, and return the result."""
    n = tree.n
    h = way.times[k + 1] - way.times[k]
    q, v, q_next, v_next = way.q[k], way.v[k], way.q[k + 1], way.v[k + 1]
    target, rate, rate_midway = way.knots[k + 1, 0:3], way.knots[k + 1, 3:6], way.midway[k, 3:6]
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
        _locate(tree, w, w.x, loops, loops_at)
        least_norm(w.J, rate if stage == 3 else rate_midway, w.W, w.c, w.slope)
        weight = 1.0 if stage == 3 else 2.0
        for j in range(n):
            w.total[j] += weight * w.slope[j]
    for j in range(n):
        q_next[j] = q[j] + h / 6.0 * w.total[j]
    _close(q_next, loops, loops_at)
    _locate(tree, w, q_next, loops, loops_at)
    off, move, step = _miss(target, w), math.inf, 0
    while step < NEWTON_STEPS and move >= SMALLEST_MOVE and off >= NEWTON_TOLERANCE:
        least_norm(w.J, w.error, w.W, w.c, w.slope)
        move, step = 0.0, step + 1
        for j in range(n):
            q_next[j] += w.slope[j]
            move = max(move, abs(w.slope[j]))
        _close(q_next, loops, loops_at)
        _locate(tree, w, q_next, loops, loops_at)
        off = _miss(target, w)
    least_norm(w.J, rate, w.W, w.c, v_next)
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
def _locate(tree: Tree, w: Scratch, q: Array, loops: int, loops_at: int) -> None:
    """Write the tip's position and Jacobian at q; of a mechanism with loops, for what they leave free."""
    tree_kinematics(tree, q, w.rest, w.tree, w.J, w.r, w.drift)
    if loops != 0:
        _, rows = loops_memory(loops_at)
        for j in range(q.shape[0]):
            rows.q[j] = q[j]
            for i in range(3):
                rows.tip[i, j] = w.J[i, j]
        call_at(loops, loops_at, TANGENT)
        for j in range(q.shape[0]):
            for i in range(3):
                w.J[i, j] = rows.tip[i, j]


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
def _miss(target: Array, w: Scratch) -> float:
    """Write the way from the tip to its target (3,), m, and return its largest component."""
    largest = 0.0
    for i in range(3):
        w.error[i] = target[i] - w.r[i]
        largest = max(largest, abs(w.error[i]))
    return largest
