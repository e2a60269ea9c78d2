"""Two boxes that touch: the normal along which they overlap least, or are farthest apart, and the points between them.

The normal is that of a face of either box, or is at right angles to an edge of each (S. Gottschalk, M. C. Lin, D.
Manocha, SIGGRAPH 1996). Of a face the points are those of the face of the other box that is turned towards it, cut off
at its sides (I. E. Sutherland, G. W. Hodgman, Commun. ACM 17, 1974): eight at most. Of edges it is the point at which
they are nearest; and where their normal is nearly that of a face, what is less deep in that face, or above it, as it
may come down in a step. All depends on where the boxes are, and on nothing before.
"""

import math
from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.limits import MOST_OF, PARALLEL, SLIGHT

# As many points as two boxes touch in.
MOST_POINTS = 8
# The gap of a point that there is not, m.
NOWHERE = 1.0


class BoxPair(Block):
    """Two boxes, A and B, and where they touch; vectors are in base axes, if nothing else is said."""

    half_a: Annotated[Array, 3]  # in: half their edges, m
    half_b: Annotated[Array, 3]
    axes_a: Annotated[Array, 3, 3]  # rows
    axes_b: Annotated[Array, 3, 3]
    apart: Annotated[Array, 3]  # from the middle of B to that of A, m
    frames: Annotated[Array, MOST_POINTS, 3, 3]  # out, of each point: n, from B to A, t1, t2
    points: Annotated[Array, MOST_POINTS, 3]  # from the middle of B, m
    gaps: Annotated[Array, MOST_POINTS]  # m
    turn: Annotated[Array, 3, 3]  # scratch: products of the axes of the box with the face, and those of the other
    middle: Annotated[Array, 3]  # of the other box, in those axes
    polygon: Annotated[Array, MOST_POINTS, 3]  # along both sides of the face, and above it, m
    cut: Annotated[Array, MOST_POINTS, 3]


@kernel
def touch_boxes(p: BoxPair) -> tuple[int, float]:
    """Write frame, points and gaps; return how many points there are, and how far apart the boxes are along n, m.

    Where edges separate by less more than a face, or A's face by less more than B's, the first of these is taken: they
    are one direction then, but for rounding. Edges that do not cross are left out: faces that come down beside them
    touch elsewhere. Where there is no point the boxes are as far apart as along the best direction of all.
    """
    R, t, a, b, d = p.turn, p.middle, p.half_a, p.half_b, p.apart
    for i in range(3):
        B = row_of(p.axes_b, i)
        t[i] = B[0] * d[0] + B[1] * d[1] + B[2] * d[2]
        for j in range(3):
            A = row_of(p.axes_a, j)
            R[i, j] = B[0] * A[0] + B[1] * A[1] + B[2] * A[2]
    slight, best, axis = SLIGHT * min(a[0] + a[1] + a[2], b[0] + b[1] + b[2]), -math.inf, 0
    for i in range(3):
        apart = abs(t[i]) - b[i] - a[0] * abs(R[i, 0]) - a[1] * abs(R[i, 1]) - a[2] * abs(R[i, 2])
        if apart > best + slight:
            best, axis = apart, i
    for j in range(3):
        along = t[0] * R[0, j] + t[1] * R[1, j] + t[2] * R[2, j]
        apart = abs(along) - a[j] - b[0] * abs(R[0, j]) - b[1] * abs(R[1, j]) - b[2] * abs(R[2, j])
        if apart > best + slight:
            best, axis = apart, 3 + j
    furthest = best
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2, square = (j + 1) % 3, (j + 2) % 3, 1.0 - R[i, j] * R[i, j]
            if square < PARALLEL * PARALLEL:
                continue
            apart = abs(t[i2] * R[i1, j] - t[i1] * R[i2, j]) - b[i1] * abs(R[i2, j]) - b[i2] * abs(R[i1, j])
            apart = (apart - a[j1] * abs(R[i, j2]) - a[j2] * abs(R[i, j1])) / math.sqrt(square)
            furthest = max(furthest, apart)
            if apart > best + slight and touch_edges(p, i, j, apart):
                best, axis = apart, 6 + 3 * i + j
    if axis < 6:
        count = touch_face(p, axis % 3, axis >= 3, 0, -math.inf)
        return count, best if count > 0 else furthest
    touch_edges(p, (axis - 6) // 3, axis % 3, best)
    n, nearest, axis = p.frames[0, 0], MOST_OF, -1
    for k in range(6):
        face = row_of(p.axes_b, k) if k < 3 else row_of(p.axes_a, k - 3)
        along = abs(n[0] * face[0] + n[1] * face[1] + n[2] * face[2])
        if along > nearest:
            nearest, axis = along, k
    return (touch_face(p, axis % 3, axis >= 3, 1, best) if axis >= 0 else 1), best


@kernel
def touch_edges(p: BoxPair, i: int, j: int, apart: float) -> bool:
    """Write frame and point of edges along axis i of B and axis j of A that are so far apart, m; return if they cross.

    Where the point is beyond the end of an edge they do not: the boxes are then apart, and nothing comes closer there.
    """
    R, t, N = p.turn, p.middle, p.frames[0]
    i1, i2, c = (i + 1) % 3, (i + 2) % 3, R[i, j]
    size = math.sqrt(1.0 - c * c)
    n1, n2 = -R[i2, j] / size, R[i1, j] / size  # e_i × a_j, in axes of B
    sign = math.copysign(1.0, n1 * t[i1] + n2 * t[i2])
    n1, n2 = sign * n1, sign * n2
    # the middles of the two edges, in axes of B, of which that of B is 0 along i
    on1, on2 = math.copysign(p.half_b[i1], n1), math.copysign(p.half_b[i2], n2)
    x0, x1, x2 = t[i], t[i1] - on1, t[i2] - on2
    for k in range(3):
        if k != j:
            reach = math.copysign(p.half_a[k], n1 * R[i1, k] + n2 * R[i2, k])
            x0, x1, x2 = x0 - reach * R[i, k], x1 - reach * R[i1, k], x2 - reach * R[i2, k]
    along = x0 * R[i, j] + x1 * R[i1, j] + x2 * R[i2, j]
    on_a, on_b = (c * x0 - along) / (size * size), (x0 - c * along) / (size * size)
    E, U, V = row_of(p.axes_b, i), row_of(p.axes_b, i1), row_of(p.axes_b, i2)
    for k in range(3):
        N[0, k], N[1, k] = n1 * U[k] + n2 * V[k], E[k]
        p.points[0, k] = on_b * E[k] + on1 * U[k] + on2 * V[k]
    write_last_tangent(N)
    p.gaps[0] = apart
    return bool(abs(on_a) <= p.half_a[j] and abs(on_b) <= p.half_b[i])


@kernel
def write_last_tangent(N: Array) -> None:
    """Write t2 = n × t1."""
    for k in range(3):
        k1, k2 = (k + 1) % 3, (k + 2) % 3
        N[2, k] = N[0, k1] * N[1, k2] - N[0, k2] * N[1, k1]


@kernel
def touch_face(p: BoxPair, axis: int, of_a: bool, first: int, least: float) -> int:
    """Write frame, points and gaps of a face of A or B across this axis of it, from the point `first` on.

    Those alone whose gap is more than the least, m. Returns how many points there are then.
    """
    R, c, P = p.turn, p.middle, p.polygon
    face, other, axes, to_base = p.half_b, p.half_a, p.axes_b, 1.0
    if of_a:
        face, other, axes, to_base = p.half_a, p.half_b, p.axes_a, -1.0
        t0, t1, t2 = c[0], c[1], c[2]
        for j in range(3):
            c[j] = -(t0 * R[0, j] + t1 * R[1, j] + t2 * R[2, j])
        for i in range(3):
            for j in range(i):
                R[i, j], R[j, i] = R[j, i], R[i, j]
    side, u, v, most = math.copysign(1.0, c[axis]), (axis + 1) % 3, (axis + 2) % 3, 0
    for k in range(1, 3):
        if abs(R[axis, k]) > abs(R[axis, most]) + SLIGHT:
            most = k
    m1, m2 = (most + 1) % 3, (most + 2) % 3
    towards = -side * math.copysign(other[most], R[axis, most])
    for k in range(4):
        x = other[m1] if k in (0, 3) else -other[m1]
        y = other[m2] if k < 2 else -other[m2]
        P[k, 0] = c[u] + towards * R[u, most] + x * R[u, m1] + y * R[u, m2]
        P[k, 1] = c[v] + towards * R[v, most] + x * R[v, m1] + y * R[v, m2]
        P[k, 2] = side * (c[axis] + towards * R[axis, most] + x * R[axis, m1] + y * R[axis, m2]) - face[axis]
    count = 4
    for half in range(4):
        count = cut_polygon(p, count, half // 2, 1.0 if half % 2 == 0 else -1.0, face[u] if half < 2 else face[v])
    for m in range(count):
        if not P[m, 2] > least or first == MOST_POINTS:
            continue
        p.gaps[first], above, N = P[m, 2], side * (face[axis] + P[m, 2]), p.frames[first]
        for k in range(3):
            N[0, k], N[1, k] = to_base * side * axes[axis, k], axes[u, k]
            from_face = P[m, 0] * axes[u, k] + P[m, 1] * axes[v, k] + above * axes[axis, k]
            p.points[first, k] = from_face + (p.apart[k] if of_a else 0.0)
        write_last_tangent(N)
        first += 1
    return first


@kernel
def cut_polygon(p: BoxPair, count: int, along: int, sign: float, half: float) -> int:
    """Cut off of a polygon of so many corners what is beyond a side of the face; return how many corners it has."""
    P, kept = p.polygon, 0
    for k in range(count):
        now, next_one = row_of(P, k), row_of(P, (k + 1) % count)
        beyond, then = sign * now[along] - half, sign * next_one[along] - half
        if beyond <= 0.0 and kept < MOST_POINTS:
            for m in range(3):
                p.cut[kept, m] = now[m]
            kept += 1
        if (beyond <= 0.0) != (then <= 0.0) and kept < MOST_POINTS:
            share = beyond / (beyond - then)
            for m in range(3):
                p.cut[kept, m] = now[m] + share * (next_one[m] - now[m])
            kept += 1
    for k in range(kept):
        for m in range(3):
            P[k, m] = p.cut[k, m]
    return kept
