"""Edges that cross: an edge of a link against the edges of a box, or a rod, of the link that it touches.

Edge 1 is c1 = p1 + s1 e1, |s1| <= L1, of the one link, edge 2 likewise of the other, with unit vectors e; in the axes
of the other link, and with ω, ω̇ and the motion of p1 relative to it,

    n = ± e1 × e2/|e1 × e2|,   c1 − c2 = g n of the nearest points,   gap = g − ρ1 − ρ2

with ρ what rounds either edge off, as of a capsule. The material at the contact has u = ṗ1 + ω × r, r = s1 e1 − ρ1 n,
and u̇ = p̈1 + ω̇ × r + ω × ṙ, where ṡ1 follows from d/dt(c1 − c2) = d/dt(g n) along e2 × n. The tangents are t1 = e2
and t2 = n × e2, so that ṫ1 = 0.

Of two convex bodies two edges can touch only if n points out of both faces at edge 2 and into both at edge 1: the arcs
of their normals cross (D. Gregorius, Game Developers Conference, 2013). An edge crosses at most two edges of a convex
body: a contact is with that which it crosses first, or last.
"""

import math

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import integers_at, row_of, vector_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.contacts.memory import Contacts
from closedloop.mechanics.contacts.rolling import EDGE, EDGE_2, OF_EDGE_2, Shapes, turn_against
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.limits import BEYOND_EDGE, PARALLEL
from closedloop.mechanics.loops.memory import NOTHING, LoopLinks, LoopRows, tree_at
from closedloop.mechanics.loops.rows import carry_direction, locate_point

# Numbers of edge 1: e1, L1, its two sides, ρ1, ρ2, whether the last crossing is meant, how many edges 2 there are, and
# the contact of the same edge with the other crossing, 0 if there is none; and how deep edges may cross, m: deeper they
# are on opposite sides of a box.
E1, L1, SIDES1, ROUND1, ROUND2, LAST, COUNT, PARTNER, DEEP = 0, 3, 4, 10, 11, 12, 13, 14, 15
# And of each edge 2: p2, e2, L2, and its sides.
P2, E2, L2, SIDES2 = 0, 3, 6, 7
# In `chosen`: no other edge is near.
NONE = -1.0
# The gap of edges none of which crosses, m; and how many edges a box has, four along each of its axes in turn.
APART, COUNT_OF_BOX = 1.0, 12


@kernel
def cross_edges(edge: Array, k: int, x: Array, e1: Array, side1: Array, side2: Array, N: Array, at: Array) -> None:
    """Write how edge 1 crosses edge k of the others: N, rows n, t1, t2, and `at`: gap, how far inside, s1, |e1 × e2|.

    `edge` (EDGE,).
    `x`, `e1`, `side1`, `side2`, (3,) arrays: middle of edge 1, m, its direction, and its sides, axes of the link with
        the others.
    `N` (3, 3).
    `at` (4,).
    """
    b = EDGE_2 + OF_EDGE_2 * k
    e2, other1, other2 = (
        edge[b + E2 : b + E2 + 3],
        edge[b + SIDES2 : b + SIDES2 + 3],
        edge[b + SIDES2 + 3 : b + OF_EDGE_2],
    )
    x0, x1, x2 = x[0] - edge[b + P2], x[1] - edge[b + P2 + 1], x[2] - edge[b + P2 + 2]
    m0, m1, m2 = e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2], e1[0] * e2[1] - e1[1] * e2[0]
    size = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    at[3] = size
    if size < PARALLEL:
        at[0], at[1], at[2] = APART, -1.0, 0.0
        return
    n0, n1, n2 = m0 / size, m1 / size, m2 / size
    gap = n0 * x0 + n1 * x1 + n2 * x2
    out = dot(other1, n0, n1, n2) + dot(other2, n0, n1, n2) if is_sharp(other1) else gap
    if out < 0.0:
        n0, n1, n2, gap = -n0, -n1, -n2, -gap
    along1, along2 = e1[0] * x0 + e1[1] * x1 + e1[2] * x2, e2[0] * x0 + e2[1] * x1 + e2[2] * x2
    c = e1[0] * e2[0] + e1[1] * e2[1] + e1[2] * e2[2]
    s1, s2 = (c * along2 - along1) / (size * size), (along2 - c * along1) / (size * size)
    N[0, 0], N[0, 1], N[0, 2] = n0, n1, n2
    N[1, 0], N[1, 1], N[1, 2] = e2[0], e2[1], e2[2]
    N[2, 0], N[2, 1], N[2, 2] = n1 * e2[2] - n2 * e2[1], n2 * e2[0] - n0 * e2[2], n0 * e2[1] - n1 * e2[0]
    inside1 = inside_end(edge[L1], s1, e1, other1, other2, n0, n1, n2)
    inside2 = inside_end(edge[b + L2], s2, e2, side1, side2, -n0, -n1, -n2)
    if gap < -edge[DEEP]:
        gap, inside1 = APART, -1.0
    at[0], at[1], at[2] = gap - edge[ROUND1] - edge[ROUND2], min(inside1, inside2), s1


@kernel
def inside_end(length: float, s: float, e: Array, side1: Array, side2: Array, n0: float, n1: float, n2: float) -> float:
    """Return how far inside the nearer end of an edge a crossing is, m, and n between the sides of the other edge.

    Where the edge ends at the other one it rests on the face that n is nearest to, if it lies over it: it crosses then
    until it is BEYOND_EDGE beyond. Otherwise it comes from beside that face, or stands on it: it does not cross yet.
    """
    inside = length - abs(s)
    if not is_sharp(side1):
        return inside + BEYOND_EDGE
    out1, out2 = dot(side1, n0, n1, n2), dot(side2, n0, n1, n2)
    leaves = math.copysign(1.0, s) * dot(side2 if out1 >= out2 else side1, e[0], e[1], e[2])
    inside += BEYOND_EDGE if leaves >= 0.0 else -BEYOND_EDGE
    return float(min(inside, out1 + PARALLEL, out2 + PARALLEL))


@kernel_inlined
def dot(v: Array, n0: float, n1: float, n2: float) -> float:
    """Return the product of v (3,) with n."""
    return float(v[0] * n0 + v[1] * n1 + v[2] * n2)


@kernel_inlined
def is_sharp(side: Array) -> bool:
    """Whether an edge has sides, as that of a box; the rod of a capsule has none."""
    return bool(side[0] != 0.0 or side[1] != 0.0 or side[2] != 0.0)


@kernel
def turned(axes: Array, v: Array, out: Array) -> None:
    """Write v (3,), in the axes of which the columns of `axes` are, in those of its rows."""
    for a in range(3):
        out[a] = axes[a, 0] * v[0] + axes[a, 1] * v[1] + axes[a, 2] * v[2]


@kernel
def may_cross(joints: LoopLinks, rows: LoopRows, shapes: Shapes, i: int) -> bool:
    """Whether the edge of contact i reaches, along each axis of the box that has the others, within DEEP of the box.

    What crosses an edge of the box no higher than that above it does. The middle of the edge is located.
    """
    edge, k, e, u = row_of(shapes.edge, i), 3 * i - 3, shapes.wander, shapes.carried
    if edge[COUNT] < COUNT_OF_BOX:
        return True
    tree, work = tree_at(joints), vector_at(joints.scratch, joints.scratch_size)
    sides, x, e1 = integers_at(joints.bound, 3 * joints.m), rows.error[k : k + 3], shapes.turning
    carry_direction(tree, work, sides[joints.m + k], edge[E1 : E1 + 3], e)
    for r in range(3):
        carry_direction(tree, work, sides[2 * joints.m + k], row_of(rows.along_b, k + r), u)
        e1[r] = u[0] * e[0] + u[1] * e[1] + u[2] * e[2]
    beside = edge[DEEP] + edge[ROUND1] + edge[ROUND2]
    for axis in range(3):
        b = EDGE_2 + OF_EDGE_2 * 4 * axis
        a0, a1, a2 = edge[b + E2], edge[b + E2 + 1], edge[b + E2 + 2]
        reach = edge[b + L2] + edge[L1] * abs(dot(e1, a0, a1, a2)) + beside
        if abs(dot(x, a0, a1, a2)) > reach:
            return False
    return True


@kernel
def choose_crossing(shapes: Shapes, i: int, x: Array, free: bool, taken: int) -> None:
    """Write `frame`, `crossing`, `chosen` of contact i, x (3,) m the middle of its edge; a closed one keeps its edge.

    The axes of the link that has the edge are written. The edge with the number `taken`, if not −1, is that of another
    contact.
    """
    edge, at, N = row_of(shapes.edge, i), shapes.crossing, shapes.frame[i]
    e1, side1, side2 = shapes.wander, shapes.carried, shapes.turning
    turned(shapes.axes, edge[E1 : E1 + 3], e1)
    turned(shapes.axes, edge[SIDES1 : SIDES1 + 3], side1)
    turned(shapes.axes, edge[SIDES1 + 3 : SIDES1 + 6], side2)
    best, first, sign = -1, math.inf, -1.0 if edge[LAST] != 0.0 else 1.0
    count, crossed = int(edge[COUNT]), 0
    for k in range(count if free else 0):
        cross_edges(edge, k, x, e1, side1, side2, N, at)
        if at[1] >= 0.0 and k != taken:
            crossed += 1
            if sign * at[2] < first:
                best, first = k, sign * at[2]
    if free and (best < 0 or (edge[LAST] != 0.0 and crossed < 2 and taken < 0)):
        at[0], at[1] = APART, -1.0
        return
    if free:
        shapes.chosen[i] = best
    cross_edges(edge, int(shapes.chosen[i]), x, e1, side1, side2, N, at)


@kernel
def write_edge_rows(joints: LoopLinks, rows: LoopRows, shapes: Shapes, c: Contacts, i: int) -> None:
    """Write the rows of contact i, of edges; those of the middle of its edge, along x, y, z, are located already."""
    k, at, N, edge = 3 * i - 3, shapes.crossing, shapes.frame[i], row_of(shapes.edge, i)
    partner = int(edge[PARTNER])
    if c.mode[i] == FREE:
        same = 0 < partner < i and c.mode[partner] == FREE  # the same edge has just been looked at
        if rows.written[k] == NOTHING or (
            (shapes.chosen[partner] == NONE) if same else not may_cross(joints, rows, shapes, i)
        ):
            shapes.chosen[i] = NONE
            leave_apart(joints, c, i)
            return
        shapes.chosen[i] = 0.0
        locate_point(joints, rows, k, 3)
    turn_against(joints, rows, k, shapes)
    x, v, a = rows.error[k : k + 3], rows.rate[k : k + 3], rows.drift[k : k + 3]
    taken = int(shapes.chosen[partner]) if partner > 0 and c.mode[partner] != FREE else -1
    choose_crossing(shapes, i, x, c.mode[i] == FREE, taken)
    n = 3 * i
    c.inside[i], c.located[n], c.located[n + 1], c.located[n + 2] = at[1], at[0], 0.0, 0.0
    if at[3] < PARALLEL or at[0] > 0.5 * APART:
        leave_apart(joints, c, i)
        return
    e1, w, r, reach = shapes.wander, shapes.spin, shapes.spin_rate, row_of(shapes.reach, i)
    b2 = EDGE_2 + OF_EDGE_2 * int(shapes.chosen[i]) + E2
    y0, y1, y2 = edge[b2], edge[b2 + 1], edge[b2 + 2]
    s1, size, round1 = at[2], at[3], edge[ROUND1]
    g = at[0] + round1 + edge[ROUND2]
    n0, n1, n2 = N[0, 0], N[0, 1], N[0, 2]
    d0, d1, d2 = w[1] * e1[2] - w[2] * e1[1], w[2] * e1[0] - w[0] * e1[2], w[0] * e1[1] - w[1] * e1[0]  # ė1
    sign = (
        1.0
        if n0 * (e1[1] * y2 - e1[2] * y1) + n1 * (e1[2] * y0 - e1[0] * y2) + n2 * (e1[0] * y1 - e1[1] * y0) > 0.0
        else -1.0
    )
    z0, z1, z2 = d1 * y2 - d2 * y1, d2 * y0 - d0 * y2, d0 * y1 - d1 * y0
    along = n0 * z0 + n1 * z1 + n2 * z2
    f0, f1, f2 = (
        sign * (z0 - along * n0) / size,
        sign * (z1 - along * n1) / size,
        sign * (z2 - along * n2) / size,
    )  # ṅ
    q0, q1, q2 = y1 * n2 - y2 * n1, y2 * n0 - y0 * n2, y0 * n1 - y1 * n0  # e2 × n
    slide = g * (q0 * f0 + q1 * f1 + q2 * f2)
    slide -= q0 * (v[0] + s1 * d0) + q1 * (v[1] + s1 * d1) + q2 * (v[2] + s1 * d2)
    slide /= q0 * e1[0] + q1 * e1[1] + q2 * e1[2]  # ṡ1
    r0, r1, r2 = s1 * e1[0] - round1 * n0, s1 * e1[1] - round1 * n1, s1 * e1[2] - round1 * n2
    reach[0], reach[1], reach[2] = r0, r1, r2
    h0 = slide * e1[0] + s1 * d0 - round1 * f0
    h1 = slide * e1[1] + s1 * d1 - round1 * f1
    h2 = slide * e1[2] + s1 * d2 - round1 * f2
    u0, u1, u2 = v[0] + w[1] * r2 - w[2] * r1, v[1] + w[2] * r0 - w[0] * r2, v[2] + w[0] * r1 - w[1] * r0
    a0 = a[0] + r[1] * r2 - r[2] * r1 + w[1] * h2 - w[2] * h1
    a1 = a[1] + r[2] * r0 - r[0] * r2 + w[2] * h0 - w[0] * h2
    a2 = a[2] + r[0] * r1 - r[1] * r0 + w[0] * h1 - w[1] * h0
    for b in range(3):
        N0, N1, N2 = N[b, 0], N[b, 1], N[b, 2]
        c.u[n + b] = N0 * u0 + N1 * u1 + N2 * u2
        c.drift[n + b] = N0 * a0 + N1 * a1 + N2 * a2
        for j in range(joints.n):
            t0, t1, t2 = shapes.turns[0, j], shapes.turns[1, j], shapes.turns[2, j]
            x0, x1, x2 = rows.G[k, j] + t1 * r2 - t2 * r1, rows.G[k + 1, j] + t2 * r0 - t0 * r2, 0.0
            x2 = rows.G[k + 2, j] + t0 * r1 - t1 * r0
            c.G[n + b, j] = N0 * x0 + N1 * x1 + N2 * x2
    c.drift[n] += f0 * u0 + f1 * u1 + f2 * u2
    m0, m1, m2 = f1 * y2 - f2 * y1, f2 * y0 - f0 * y2, f0 * y1 - f1 * y0  # ṫ2
    c.drift[n + 2] += m0 * u0 + m1 * u1 + m2 * u2


@kernel
def leave_apart(joints: LoopLinks, c: Contacts, i: int) -> None:
    """Write contact i as one of edges that do not cross."""
    c.inside[i] = -1.0
    for r in range(3 * i, 3 * i + 3):
        c.located[r], c.u[r], c.drift[r] = APART if r == 3 * i else 0.0, 0.0, 0.0
        for j in range(joints.n if c.near[i] != 0.0 else 0):
            c.G[r, j] = 0.0


def reach_of_edges(edge: Array) -> float:
    """Return how far the middle of edge 1 may be from that of the others where some cross, m, by numbers (EDGE,)."""
    own, others = edge[L1] + edge[DEEP] + edge[ROUND1] + edge[ROUND2], 0.0
    for k in range(int(edge[COUNT])):
        b = EDGE_2 + OF_EDGE_2 * k
        others = max(others, float(np.linalg.norm(edge[b + P2 : b + P2 + 3]) + edge[b + L2]))
    return float(own + others)


def edges_of(section: ContactSection, rotation: Array) -> Array:
    """Return the numbers (EDGE,) of a contact of edges.

    `rotation` (3, 3): axes of its frame `link` as columns, in its link's own axes.
    """
    pair, found = section.edge, np.zeros(EDGE)
    assert pair is not None
    half = rotation @ np.array(pair.half)
    found[E1 : E1 + 3], found[L1] = half / np.linalg.norm(half), np.linalg.norm(half)
    if pair.sides is not None:
        found[SIDES1 : SIDES1 + 6] = np.concatenate([rotation @ np.array(side) for side in pair.sides])
    found[ROUND1], found[ROUND2], found[LAST] = section.radius, pair.onto_radius, float(pair.crossing == "last")
    axes = [np.array(axis) for axis in pair.onto]
    if len(axes) == 1:
        edges = [(np.zeros(3), axes[0], np.zeros(6))]
    else:
        edges = []
        for a, h in enumerate(axes):
            u, w = axes[(a + 1) % 3], axes[(a + 2) % 3]
            for x in (-1.0, 1.0):
                for y in (-1.0, 1.0):
                    sides = np.concatenate([x * u / np.linalg.norm(u), y * w / np.linalg.norm(w)])
                    edges.append((x * u + y * w, h, sides))
    found[COUNT], found[DEEP] = len(edges), min(np.linalg.norm(axis) for axis in axes)
    for k, (place, h, sides) in enumerate(edges):
        b, length = EDGE_2 + OF_EDGE_2 * k, np.linalg.norm(h)
        found[b + P2 : b + P2 + 3], found[b + E2 : b + E2 + 3], found[b + L2] = place, h / length, length
        found[b + SIDES2 : b + SIDES2 + 6] = sides
    return found
