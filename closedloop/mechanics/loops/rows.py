"""The rows of loop joints at a state: G q̇ = 0 and G q̈ = −drift, with their error and its rate (Eqs. 1-6).

A row is of one of six kinds. With a and b points of either side, and u and w directions fixed to them,

    POSITION    e = u·(a − b)       u fixed to the side of b: the two points stay together along u
    ROTATION    e = u·w             the two directions stay perpendicular
    DISTANCE    e = |a − b| − l
    GEAR        e = x1 − P(x2)      P a polynomial, x1 and x2 sums of coefficients times joint positions
    IDLE        zeros               what no joint of the tree can move, as across a planar mechanism
    BOXES       e = n·(a − b)       three rows of each point in which two boxes touch, along n, t1 and t2

A loop joint of the paper is a set of them: its R (Eq. 2) has the forces of these rows as columns, and the drift is its
Ṙᵀ(vₙ − v₀) + Rᵀ(aₙ − a₀) at q̈ = 0 (Eqs. 3, 5).
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import integers_at, row_of, vector_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.mechanics.loops.boxes import MOST_POINTS, NOWHERE, touch_boxes
from closedloop.mechanics.loops.memory import (
    BOXES,
    DISTANCE,
    ERRORS,
    GEAR,
    IDLE,
    NOTHING,
    POSITION,
    RATES,
    ROTATION,
    ROWS,
    LoopLinks,
    LoopRows,
    tree_at,
)
from closedloop.mechanics.robot.tree import Tree
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.robot.tree.kinematics import motion, sines

# A side on the base, which is at rest; below it frames that move as they are told (`closedloop.mechanics.loops.moved`).
BASE = -1
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
def locate_point(links: LoopLinks, rows: LoopRows, k: int, count: int) -> None:
    """Do `locate_rows` for rows k, k + 1, ... of one point, which were clear, at the state of the last call of it."""
    tree, work = tree_at(links), vector_at(links.scratch, links.scratch_size)
    sides = integers_at(links.bound, 4 * links.m)
    _positions(tree, work, rows, k, count, (sides[links.m + k], sides[2 * links.m + k]), True)


@kernel
def _locate(links: LoopLinks, rows: LoopRows, moving: bool) -> None:
    """Write the rows G and their error, and if asked for their drift and rate."""
    tree, work = tree_at(links), vector_at(links.scratch, links.scratch_size)
    if links.m > 0:
        sines(tree, rows.q, work)
        motion(tree, rows.v, work)
    sides = integers_at(links.bound, 4 * links.m)
    for k in range(links.m):
        kind, one, other = sides[k], sides[links.m + k], sides[2 * links.m + k]
        if sides[3 * links.m + k] != 0:  # located with the row before it
            continue
        if kind == BOXES:
            _boxes(tree, work, rows, k, (one, other))
            continue
        if kind == POSITION:
            count = 1
            while k + count < links.m and sides[3 * links.m + k + count] != 0:
                count += 1
            rows.written[k] = ROWS
            if rows.clear[k] < math.inf or rows.beyond[k] < math.inf:
                rows.written[k] = _written(tree, work, rows, k, count, (one, other))
            if rows.written[k] == ROWS:
                _positions(tree, work, rows, k, count, (one, other), moving)
            continue
        for j in range(links.n):
            rows.G[k, j] = 0.0
        if kind == GEAR:
            _gear(rows, k, links.n)
            continue
        if kind == IDLE:
            rows.error[k], rows.rate[k], rows.drift[k] = 0.0, 0.0, 0.0
            continue
        if kind == ROTATION:
            _rotation(tree, work, rows, k, one, other, moving)
        elif kind == DISTANCE:
            _distance(tree, work, rows, k, one, other, moving)


@kernel
def _written(tree: Tree, work: Array, rows: LoopRows, k: int, count: int, ends: tuple[int, int]) -> float:
    """Write error and rate of rows k, k + 1, ... as `_positions` does, or less; return what is written.

    It is ROWS if the rows themselves are wanted: where neither `clear` nor `beyond` says that they are not. The rate is
    u·(ṗ_a − ṗ), with ṗ the velocity of that point of the other link that lies at a.
    """
    a, b, u = row_of(rows.motions, 0), row_of(rows.motions, 1), rows.directions
    one, other = ends
    _move_point(tree, work, one, row_of(rows.at_a, k), a, False)
    _move_point(tree, work, other, row_of(rows.at_b, k), b, False)
    d0, d1, d2 = a[POINT] - b[POINT], a[POINT + 1] - b[POINT + 1], a[POINT + 2] - b[POINT + 2]
    far = d0 * d0 + d1 * d1 + d2 * d2 > rows.beyond[k] * rows.beyond[k]
    if far and rows.clear[k] == -math.inf:
        return NOTHING
    for r in range(count):
        _turn(tree, work, other, row_of(rows.along_b, k + r), row_of(u, r), 0, False)
        c = row_of(u, r)
        rows.error[k + r] = c[0] * d0 + c[1] * d1 + c[2] * d2
    if rows.clear[k] == -math.inf:
        return ERRORS
    if not (far or rows.error[k] > rows.clear[k]):
        return ROWS
    _along_joints(tree, work, one, a, 1.0, rows, k, 0)
    x, y, z = a[VELOCITY], a[VELOCITY + 1], a[VELOCITY + 2]
    _along_joints(tree, work, other, a, -1.0, rows, k, 0)
    x, y, z = x - a[VELOCITY], y - a[VELOCITY + 1], z - a[VELOCITY + 2]
    for r in range(count):
        c = row_of(u, r)
        rows.rate[k + r] = c[0] * x + c[1] * y + c[2] * z
    return RATES


@kernel
def _positions(
    tree: Tree, work: Array, rows: LoopRows, k: int, count: int, ends: tuple[int, int], moving: bool
) -> None:
    """Write rows k, k + 1, ... of one point of either link, along so many directions of the other link."""
    a, b, u = row_of(rows.motions, 0), row_of(rows.motions, 1), rows.directions
    one, other = ends
    for r in range(k, k + count):
        for j in range(tree.n):
            rows.G[r, j] = 0.0
    _move_point(tree, work, one, row_of(rows.at_a, k), a, moving)
    _move_point(tree, work, other, row_of(rows.at_b, k), b, moving)
    for r in range(count):
        _turn(tree, work, other, row_of(rows.along_b, k + r), row_of(u, r), 0, moving)
    # The point of the other link that lies at a: it is there that the force acts on both.
    _along_joints(tree, work, one, a, 1.0, rows, k, count)
    x, y, z = a[VELOCITY], a[VELOCITY + 1], a[VELOCITY + 2]
    _along_joints(tree, work, other, a, -1.0, rows, k, count)
    x, y, z = x - a[VELOCITY], y - a[VELOCITY + 1], z - a[VELOCITY + 2]
    d0, d1, d2 = a[POINT] - b[POINT], a[POINT + 1] - b[POINT + 1], a[POINT + 2] - b[POINT + 2]
    if moving and other != BASE:  # of its own point
        s = _slot(tree, work, other)
        o0, o1, o2 = work[s + at.O0], work[s + at.O1], work[s + at.O2]
        x, y, z = x + o1 * d2 - o2 * d1, y + o2 * d0 - o0 * d2, z + o0 * d1 - o1 * d0
    for r in range(count):
        c = row_of(u, r)
        rows.error[k + r] = c[0] * d0 + c[1] * d1 + c[2] * d2
        if moving:
            rows.rate[k + r] = c[0] * x + c[1] * y + c[2] * z + c[3] * d0 + c[4] * d1 + c[5] * d2
            drift = 2.0 * (c[3] * x + c[4] * y + c[5] * z) + c[6] * d0 + c[7] * d1 + c[8] * d2
            for i in range(3):
                drift += c[i] * (a[ACCELERATION + i] - b[ACCELERATION + i])
            rows.drift[k + r] = drift


@kernel
def _boxes(tree: Tree, work: Array, rows: LoopRows, k: int, ends: tuple[int, int]) -> None:
    """Write the rows from k on of the points in which two boxes touch: of those that are not `clear` all but the drift.

    The first that there is not has the gap of the boxes, if it is the first of all; the others are NOWHERE.
    """
    a, b, u, p, (one, other) = row_of(rows.motions, 0), row_of(rows.motions, 1), rows.directions, rows.pair, ends
    _move_point(tree, work, one, row_of(rows.at_a, k), a, False)
    _move_point(tree, work, other, row_of(rows.at_b, k), b, False)
    for i in range(3):
        p.half_a[i], p.half_b[i], p.apart[i] = rows.value[k, i], rows.value[k + 1, i], a[POINT + i] - b[POINT + i]
        carry_direction(tree, work, one, row_of(rows.along_a, k + i), row_of(p.axes_a, i))
        carry_direction(tree, work, other, row_of(rows.along_b, k + i), row_of(p.axes_b, i))
    count, apart = touch_boxes(p)
    for m in range(MOST_POINTS):
        first = k + 3 * m
        had, there = rows.written[first] == ROWS, m < count
        for r in range(first, first + 3):
            rows.error[r] = rows.rate[r] = rows.drift[r] = 0.0
            for j in range(tree.n if had else 0):
                rows.G[r, j] = 0.0
        rows.error[first] = p.gaps[m] if there else (apart if m == 0 else NOWHERE)
        rows.written[first] = ROWS if there and not rows.error[first] > rows.clear[first] else NOTHING
        if not there:
            continue
        for i in range(3):
            a[POINT + i] = b[POINT + i] + p.points[m, i]
            for r in range(3):
                u[r, i] = p.frames[m, r, i]
        rows_of_point = 3 if rows.written[first] == ROWS else 0
        _along_joints(tree, work, one, a, 1.0, rows, first, rows_of_point)
        x, y, z = a[VELOCITY], a[VELOCITY + 1], a[VELOCITY + 2]
        _along_joints(tree, work, other, a, -1.0, rows, first, rows_of_point)
        x, y, z = x - a[VELOCITY], y - a[VELOCITY + 1], z - a[VELOCITY + 2]
        for r in range(3):
            rows.rate[first + r] = u[r, 0] * x + u[r, 1] * y + u[r, 2] * z


@kernel
def _rotation(tree: Tree, work: Array, rows: LoopRows, k: int, one: int, other: int, moving: bool) -> None:
    """Write row k, of two directions that stay perpendicular."""
    a, b = row_of(rows.motions, 0), row_of(rows.motions, 1)
    _turn(tree, work, one, row_of(rows.along_a, k), a, ALONG, moving)
    _turn(tree, work, other, row_of(rows.along_b, k), b, ALONG, moving)
    error, rate, drift = 0.0, 0.0, 0.0
    for i in range(3):
        error += a[ALONG + i] * b[ALONG + i]
    for i in range(3 if moving else 0):
        rate += a[TURNING + i] * b[ALONG + i] + a[ALONG + i] * b[TURNING + i]
        drift += a[SECOND + i] * b[ALONG + i] + 2.0 * a[TURNING + i] * b[TURNING + i]
        drift += a[ALONG + i] * b[SECOND + i]
    _couple(tree, work, one, a, b, 1.0, row_of(rows.G, k))
    _couple(tree, work, other, a, b, -1.0, row_of(rows.G, k))
    rows.error[k], rows.rate[k], rows.drift[k] = error, rate, drift


@kernel
def _distance(tree: Tree, work: Array, rows: LoopRows, k: int, one: int, other: int, moving: bool) -> None:
    """Write row k, of two points at a distance."""
    a, b, u = row_of(rows.motions, 0), row_of(rows.motions, 1), row_of(rows.directions, 0)
    _move_point(tree, work, one, row_of(rows.at_a, k), a, moving)
    _move_point(tree, work, other, row_of(rows.at_b, k), b, moving)
    square, speed, rate, drift = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        u[i] = a[POINT + i] - b[POINT + i]
        square += u[i] * u[i]
    length = math.sqrt(square)
    apart = length > 0.0  # of points in one place the row is zeros, and its error says that it is open
    for i in range(3 if apart else 0):
        u[i] /= length
    _along_joints(tree, work, one, a, 1.0, rows, k, 1)
    _along_joints(tree, work, other, b, -1.0, rows, k, 1)
    for i in range(3 if moving else 0):
        parting = a[VELOCITY + i] - b[VELOCITY + i]
        rate += u[i] * parting
        speed += parting * parting
        drift += u[i] * (a[ACCELERATION + i] - b[ACCELERATION + i])
    bend = (speed - rate * rate) / length if apart else 0.0
    rows.error[k], rows.rate[k], rows.drift[k] = length - rows.value[k, 0], rate, drift + bend


@kernel
def _gear(rows: LoopRows, k: int, n: int) -> None:
    """Write the row of a gear between joints or sums of joints, or of what is held."""
    c, first, second = row_of(rows.value, k), row_of(rows.first, k), row_of(rows.second, k)
    one, x, rate, y = 0.0, 0.0, 0.0, 0.0  # x1, x2 and their rates
    for j in range(n):
        one += first[j] * rows.q[j]
        rate += first[j] * rows.v[j]
        x += second[j] * rows.q[j]
        y += second[j] * rows.v[j]
    value = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * c[4])))
    slope = c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * 4.0 * c[4]))
    curvature = 2.0 * c[2] + x * (6.0 * c[3] + x * 12.0 * c[4])
    for j in range(n):
        rows.G[k, j] = first[j] - slope * second[j]
    rows.error[k] = one - value
    rows.rate[k] = rate - slope * y
    rows.drift[k] = -curvature * y * y


@kernel
def move_point(tree: Tree, work: Array, link: int, point: Array, out: Array) -> None:
    """Write position and acceleration of a point that is fixed to a link; see `POINT`."""
    _move_point(tree, work, link, point, out, True)


@kernel
def _move_point(tree: Tree, work: Array, link: int, point: Array, out: Array, moving: bool) -> None:
    """Write the position of a point that is fixed to a link, and if asked for its acceleration."""
    if link == BASE:
        for i in range(3):
            out[POINT + i], out[ACCELERATION + i] = point[i], 0.0
        return
    _carry(tree, work, link, point, out, POINT, moving)
    s = _slot(tree, work, link)
    w, k = work, tree.constants
    out[POINT] += w[s + at.P0]
    out[POINT + 1] += w[s + at.P1]
    out[POINT + 2] += w[s + at.P2]
    if moving:
        out[ACCELERATION] += w[s + at.B0] + k[at.GRAVITY]  # the base accelerates upwards instead of gravity
        out[ACCELERATION + 1] += w[s + at.B1] + k[at.GRAVITY + 1]
        out[ACCELERATION + 2] += w[s + at.B2] + k[at.GRAVITY + 2]


@kernel
def turn_direction(tree: Tree, work: Array, link: int, along: Array, out: Array) -> None:
    """Write a direction that is fixed to a link, with its first and second derivative; see `ALONG`."""
    _turn(tree, work, link, along, out, ALONG, True)


@kernel
def carry_direction(tree: Tree, work: Array, link: int, along: Array, out: Array) -> None:
    """Write a direction that is fixed to a link, base axes, in the first three of `out`."""
    if link == BASE:
        out[0], out[1], out[2] = along[0], along[1], along[2]
        return
    _carry(tree, work, link, along, out, 0, False)


@kernel
def _turn(tree: Tree, work: Array, link: int, along: Array, out: Array, first: int, moving: bool) -> None:
    """Write a direction that is fixed to a link, and if asked for its derivatives, from an entry on."""
    if link == BASE:
        for i in range(3):
            out[first + i], out[first + 3 + i], out[first + 6 + i] = along[i], 0.0, 0.0
        return
    _carry(tree, work, link, along, out, first, moving)


@kernel
def _carry(tree: Tree, work: Array, link: int, c: Array, out: Array, first: int, moving: bool) -> None:
    """Write a vector that is fixed to a link in base axes, and if asked for its derivatives, from an entry on."""
    w = work
    s = _slot(tree, work, link)
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


@kernel_inlined
def _slot(tree: Tree, work: Array, link: int) -> int:
    """Return where in the scratch a link is, or a frame that moves as it is told."""
    return int(tree.links[at.SCRATCH * tree.n + link]) if link >= 0 else work.shape[0] + (link + 1) * at.SCRATCHES


@kernel
def _along_joints(
    tree: Tree, work: Array, link: int, place: Array, sign: float, rows: LoopRows, k: int, count: int
) -> None:
    """Add to rows k, k + 1, ... what each joint adds to the velocity of a link's point along `rows.directions`.

    The point is that at `place`; its velocity is written there, see `VELOCITY`.
    """
    n, w, u, joint = tree.n, work, rows.directions, link
    p0, p1, p2, x, y, z = place[POINT], place[POINT + 1], place[POINT + 2], 0.0, 0.0, 0.0
    if link < BASE:
        s = _slot(tree, work, link)
        d0, d1, d2 = p0 - w[s + at.P0], p1 - w[s + at.P1], p2 - w[s + at.P2]
        o0, o1, o2 = w[s + at.O0], w[s + at.O1], w[s + at.O2]
        x, y, z = w[s + at.V0] + o1 * d2 - o2 * d1, w[s + at.V1] + o2 * d0 - o0 * d2, w[s + at.V2] + o0 * d1 - o1 * d0
    while joint >= 0:
        s = tree.links[at.SCRATCH * n + joint]
        z0, z1, z2 = w[s + at.Z0], w[s + at.Z1], w[s + at.Z2]
        if tree.links[at.REVOLUTE * n + joint] != 0:
            d0, d1, d2 = p0 - w[s + at.P0], p1 - w[s + at.P1], p2 - w[s + at.P2]
            z0, z1, z2 = z1 * d2 - z2 * d1, z2 * d0 - z0 * d2, z0 * d1 - z1 * d0
        rate = rows.v[joint]
        x, y, z = x + z0 * rate, y + z1 * rate, z + z2 * rate
        for r in range(count):
            rows.G[k + r, joint] += sign * (u[r, 0] * z0 + u[r, 1] * z1 + u[r, 2] * z2)
        joint = tree.links[at.PARENT * n + joint]
    place[VELOCITY], place[VELOCITY + 1], place[VELOCITY + 2] = x, y, z


@kernel
def _couple(tree: Tree, work: Array, link: int, a: Array, b: Array, sign: float, row: Array) -> None:
    """Add to a row what each joint that turns a link adds to the rate of u·w: its axis along w × u."""
    n, w, joint = tree.n, work, link
    c0 = a[ALONG + 1] * b[ALONG + 2] - a[ALONG + 2] * b[ALONG + 1]
    c1 = a[ALONG + 2] * b[ALONG] - a[ALONG] * b[ALONG + 2]
    c2 = a[ALONG] * b[ALONG + 1] - a[ALONG + 1] * b[ALONG]
    while joint >= 0:
        s = tree.links[at.SCRATCH * n + joint]
        if tree.links[at.REVOLUTE * n + joint] != 0:
            row[joint] += sign * (w[s + at.Z0] * c0 + w[s + at.Z1] * c1 + w[s + at.Z2] * c2)
        joint = tree.links[at.PARENT * n + joint]
