"""The rows of loop joints at a state: G q̇ = 0 and G q̈ = −drift, with their error and its rate (Eqs. 1-6).

A row is of one of six kinds. With a and b points of either side, and u and w directions fixed to them,

    POSITION    e = u·(a − b)       u fixed to the side of b: the two points stay together along u
    ROTATION    e = u·w             the two directions stay perpendicular
    DISTANCE    e = |a − b| − l
    GEAR        e = q1 − P(q2)      P a polynomial
    STOP        e = q1 − limit      of a joint that is at a stop; of one that is not there is no row, but zeros
    IDLE        zeros               what no joint of the tree can move, as across a planar mechanism

A loop joint of the paper is a set of them: its R (Eq. 2) has the forces of these rows as columns, and the drift is its
Ṙᵀ(vₙ − v₀) + Rᵀ(aₙ − a₀) at q̈ = 0 (Eqs. 3, 5).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import integers_at, vector_at
from closedloop.loops.memory import DISTANCE, GEAR, IDLE, POSITION, ROTATION, STOP, LoopLinks, LoopRows, tree_at
from closedloop.robot.tree import Tree
from closedloop.robot.tree import layout as at
from closedloop.robot.tree.angles import sines
from closedloop.robot.tree.kinematics import motion

Array = NDArray[np.float64]

# Of a point and a direction fixed to a link, in base axes: position, velocity and acceleration at q̈ = 0 of the point,
# then the direction with its first and second derivative.
POINT, VELOCITY, ACCELERATION, ALONG, TURNING, SECOND = 0, 3, 6, 9, 12, 15


@kernel
def locate_rows(links: LoopLinks, rows: LoopRows) -> None:
    """Write the rows G, their drift, error and rate at (q, q̇) of the memory."""
    _locate(links, rows, True)


@kernel
def place_rows(links: LoopLinks, rows: LoopRows) -> None:
    """Write the rows G and their error at q of the memory, which takes half as long; drift and rate are not written."""
    _locate(links, rows, False)


@kernel
def _locate(links: LoopLinks, rows: LoopRows, moving: bool) -> None:
    """Write the rows G and their error, and if asked for their drift and rate."""
    tree, work = tree_at(links), vector_at(links.scratch, links.scratch_size)
    if links.m > links.stops:
        sines(tree, rows.q, work)
        motion(tree, rows.v, work)
    sides = integers_at(links.bound, 4 * links.m)
    a, b = rows.motions[0], rows.motions[1]
    for k in range(links.m):
        kind, one, other = sides[k], sides[links.m + k], sides[2 * links.m + k]
        for j in range(links.n):
            rows.G[k, j] = 0.0
        if kind == GEAR:
            _gear(rows, k, one, other)
            continue
        if kind == IDLE:
            rows.error[k], rows.rate[k], rows.drift[k] = 0.0, 0.0, 0.0
            continue
        if kind == STOP:
            side = rows.held[one]
            there = 1.0 if side != 0.0 else 0.0
            rows.G[k, one], rows.rate[k], rows.drift[k] = there, there * rows.v[one], 0.0
            rows.error[k] = 0.0
            if side != 0.0:
                rows.error[k] = rows.q[one] - (rows.value[k, 1] if side > 0.0 else rows.value[k, 0])
            continue
        if kind != ROTATION and sides[3 * links.m + k] == 0:
            _move_point(tree, work, rows.v, one, rows.at_a[k], a, moving)
            _move_point(tree, work, rows.v, other, rows.at_b[k], b, moving)
        if kind == ROTATION:
            _turn_direction(tree, work, one, rows.along_a[k], a, moving)
        if kind != DISTANCE:
            _turn_direction(tree, work, other, rows.along_b[k], b, moving)
        error, rate, drift = 0.0, 0.0, 0.0
        if kind == ROTATION:
            for i in range(3):
                error += a[ALONG + i] * b[ALONG + i]
            for i in range(3 if moving else 0):
                rate += a[TURNING + i] * b[ALONG + i] + a[ALONG + i] * b[TURNING + i]
                drift += a[SECOND + i] * b[ALONG + i] + 2.0 * a[TURNING + i] * b[TURNING + i]
                drift += a[ALONG + i] * b[SECOND + i]
            _couple(tree, work, one, a, b, 1.0, rows.G[k])
            _couple(tree, work, other, a, b, -1.0, rows.G[k])
        elif kind == POSITION:
            for i in range(3):
                error += b[ALONG + i] * (a[POINT + i] - b[POINT + i])
            for i in range(3 if moving else 0):
                apart, parting = a[POINT + i] - b[POINT + i], a[VELOCITY + i] - b[VELOCITY + i]
                rate += b[ALONG + i] * parting + b[TURNING + i] * apart
                drift += b[ALONG + i] * (a[ACCELERATION + i] - b[ACCELERATION + i])
                drift += 2.0 * b[TURNING + i] * parting + b[SECOND + i] * apart
            # The point of the other link that lies at a: it is there that the force acts on both.
            _force(tree, work, one, a, b, 1.0, rows.G[k])
            _force(tree, work, other, a, b, -1.0, rows.G[k])
        else:
            square, speed = 0.0, 0.0
            for i in range(3):
                b[ALONG + i] = a[POINT + i] - b[POINT + i]
                square += b[ALONG + i] * b[ALONG + i]
            length = math.sqrt(square)
            for i in range(3):
                b[ALONG + i] /= length
            for i in range(3 if moving else 0):
                parting = a[VELOCITY + i] - b[VELOCITY + i]
                rate += b[ALONG + i] * parting
                speed += parting * parting
                drift += b[ALONG + i] * (a[ACCELERATION + i] - b[ACCELERATION + i])
            error = length - rows.value[k, 0]
            drift += (speed - rate * rate) / length
            _force(tree, work, one, a, b, 1.0, rows.G[k])
            _force(tree, work, other, b, b, -1.0, rows.G[k])
        rows.error[k], rows.rate[k], rows.drift[k] = error, rate, drift


@kernel
def _gear(rows: LoopRows, k: int, one: int, other: int) -> None:
    """Write the row of a gear between two joints, or of one joint that is held."""
    c, x, y = rows.value[k], 0.0, 0.0
    if other >= 0:
        x, y = rows.q[other], rows.v[other]
    value = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * c[4])))
    slope = c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * 4.0 * c[4]))
    curvature = 2.0 * c[2] + x * (6.0 * c[3] + x * 12.0 * c[4])
    rows.G[k, one] = 1.0
    if other >= 0:
        rows.G[k, other] = -slope
    rows.error[k] = rows.q[one] - value
    rows.rate[k] = rows.v[one] - slope * y
    rows.drift[k] = -curvature * y * y


@kernel
def move_point(tree: Tree, work: Array, v: Array, link: int, point: Array, out: Array) -> None:
    """Write position, velocity and acceleration of a point that is fixed to a link; see `POINT`."""
    _move_point(tree, work, v, link, point, out, True)


@kernel
def _move_point(tree: Tree, work: Array, v: Array, link: int, point: Array, out: Array, moving: bool) -> None:
    """Write the position of a point that is fixed to a link, and if asked for its velocity and acceleration."""
    if link < 0:
        for i in range(3):
            out[POINT + i], out[VELOCITY + i], out[ACCELERATION + i] = point[i], 0.0, 0.0
        return
    _carry(tree, work, link, point, out, POINT, moving)
    s = tree.links[at.SCRATCH * tree.n + (link & at.INDEX)] & at.INDEX
    w, k = work, tree.constants
    out[POINT] += w[s + at.P0]
    out[POINT + 1] += w[s + at.P1]
    out[POINT + 2] += w[s + at.P2]
    if not moving:
        return
    out[ACCELERATION] += w[s + at.B0] + k[at.GRAVITY]  # the base accelerates upwards instead of gravity
    out[ACCELERATION + 1] += w[s + at.B1] + k[at.GRAVITY + 1]
    out[ACCELERATION + 2] += w[s + at.B2] + k[at.GRAVITY + 2]
    _add_velocity(tree, work, v, link, out)


@kernel
def turn_direction(tree: Tree, work: Array, link: int, along: Array, out: Array) -> None:
    """Write a direction that is fixed to a link, with its first and second derivative; see `ALONG`."""
    _turn_direction(tree, work, link, along, out, True)


@kernel
def _turn_direction(tree: Tree, work: Array, link: int, along: Array, out: Array, moving: bool) -> None:
    """Write a direction that is fixed to a link, and if asked for its derivatives."""
    if link < 0:
        for i in range(3):
            out[ALONG + i], out[TURNING + i], out[SECOND + i] = along[i], 0.0, 0.0
        return
    _carry(tree, work, link, along, out, ALONG, moving)


@kernel
def _carry(tree: Tree, work: Array, link: int, c: Array, out: Array, first: int, moving: bool) -> None:
    """Write a vector that is fixed to a link in base axes, and if asked for its derivatives, from an entry on."""
    w = work
    s = tree.links[at.SCRATCH * tree.n + (link & at.INDEX)] & at.INDEX
    x0, x1, x2 = w[s + at.X0], w[s + at.X1], w[s + at.X2]
    z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    d0 = x0 * c[0] + y0 * c[1] + z0 * c[2]
    d1 = x1 * c[0] + y1 * c[1] + z1 * c[2]
    d2 = x2 * c[0] + y2 * c[1] + z2 * c[2]
    out[first], out[first + 1], out[first + 2] = d0, d1, d2
    if not moving:
        return
    o0, o1, o2 = w[s + at.O0], w[s + at.O1], w[s + at.O2]
    e0, e1, e2 = w[s + at.A0], w[s + at.A1], w[s + at.A2]
    u0, u1, u2 = o1 * d2 - o2 * d1, o2 * d0 - o0 * d2, o0 * d1 - o1 * d0
    out[first + 3], out[first + 4], out[first + 5] = u0, u1, u2
    out[first + 6] = e1 * d2 - e2 * d1 + o1 * u2 - o2 * u1
    out[first + 7] = e2 * d0 - e0 * d2 + o2 * u0 - o0 * u2
    out[first + 8] = e0 * d1 - e1 * d0 + o0 * u1 - o1 * u0


@kernel
def _add_velocity(tree: Tree, work: Array, v: Array, link: int, out: Array) -> None:
    """Add the velocity of a link's origin, the sum over the joints that move it, to that of its point."""
    n, w = tree.n, work
    joint = link
    p = tree.links[at.SCRATCH * n + (link & at.INDEX)] & at.INDEX
    while joint >= 0:
        s = tree.links[at.SCRATCH * n + (joint & at.INDEX)] & at.INDEX
        z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
        if tree.links[at.REVOLUTE * n + joint] != 0:
            d0, d1, d2 = w[p + at.P0] - w[s + at.P0], w[p + at.P1] - w[s + at.P1], w[p + at.P2] - w[s + at.P2]
            z0, z1, z2 = z1 * d2 - z2 * d1, z2 * d0 - z0 * d2, z0 * d1 - z1 * d0
        out[VELOCITY] += z0 * v[joint]
        out[VELOCITY + 1] += z1 * v[joint]
        out[VELOCITY + 2] += z2 * v[joint]
        joint = tree.links[at.PARENT * n + joint]


@kernel
def _force(tree: Tree, work: Array, link: int, place: Array, direction: Array, sign: float, row: Array) -> None:
    """Add to a row what each joint that moves a link adds to the velocity of its point at `place` along `direction`."""
    n, w, joint = tree.n, work, link
    f0, f1, f2 = direction[ALONG], direction[ALONG + 1], direction[ALONG + 2]
    while joint >= 0:
        s = tree.links[at.SCRATCH * n + (joint & at.INDEX)] & at.INDEX
        z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
        if tree.links[at.REVOLUTE * n + joint] != 0:
            d0 = place[POINT] - w[s + at.P0]
            d1 = place[POINT + 1] - w[s + at.P1]
            d2 = place[POINT + 2] - w[s + at.P2]
            z0, z1, z2 = z1 * d2 - z2 * d1, z2 * d0 - z0 * d2, z0 * d1 - z1 * d0
        row[joint] += sign * (f0 * z0 + f1 * z1 + f2 * z2)
        joint = tree.links[at.PARENT * n + joint]


@kernel
def _couple(tree: Tree, work: Array, link: int, a: Array, b: Array, sign: float, row: Array) -> None:
    """Add to a row what each joint that turns a link adds to the rate of u·w: its axis along w × u."""
    n, w, joint = tree.n, work, link
    c0 = a[ALONG + 1] * b[ALONG + 2] - a[ALONG + 2] * b[ALONG + 1]
    c1 = a[ALONG + 2] * b[ALONG] - a[ALONG] * b[ALONG + 2]
    c2 = a[ALONG] * b[ALONG + 1] - a[ALONG + 1] * b[ALONG]
    while joint >= 0:
        s = tree.links[at.SCRATCH * n + (joint & at.INDEX)] & at.INDEX
        if tree.links[at.REVOLUTE * n + joint] != 0:
            row[joint] += sign * (w[s + at.Z0] * c0 + w[s + at.Z1] * c1 + w[s + at.Z2] * c2)
        joint = tree.links[at.PARENT * n + joint]
