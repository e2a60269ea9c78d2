"""Round shapes that touch: where, the rows of such contacts, and a disc that lies nearly flat.

Round shapes that touch a plane: where on a body the contact is, and how that place wanders while the body rolls.

About a point of its link a shape is given by half axes h_i, at most three, and a radius ρ: all points Σ a_i h_i with
Σ a_i² <= 1, and what is within ρ of them. A radius alone is a ball, three half axes an ellipsoid, two a disc, whose
edge is a cylinder's rim. With M = Σ h_i h_iᵀ the lowest point along a unit normal n is

    r = −M n/√(nᵀM n) − ρ n          (R. T. Rockafellar, Convex Analysis, Princeton 1970, §13: the support function)

n is fixed in the body of the plane. Relative to that body the shape turns with ω, so that M turns with it, and

    ṙ = ω × r + D (ω × n),     D = M/s − (M n)(M n)ᵀ/s³ + ρ 1,     s = √(nᵀM n)

The material of the shape at the contact has u = u_c + ω × r, of its centre's velocity u_c, and
u̇ = u̇_c + ω̇ × r + ω × ṙ.

A disc that lies nearly flat: its edge rolls on the lowest point, or stands on one that is fixed to it.

With a the unit axis, t = a − (a·n) n its part along the plane, |t| the sine of the tilt, and ṫ its rate, the lowest
point is R t/|t| from the centre. Where t changes by about itself within a step it goes anywhere: it turns by |ṫ|/|t|,
without bound, and where t passes zero it jumps to the other side, with another velocity. Rows that go with it would do
work that nothing supplies. A disc with

    X |t| < h |ṫ| + X t0

stands: what was its lowest point is a point of the body, as its feet are (`closedloop.scenario.arm`). Where
another has come to be deeper it goes on, with an impact, to the next corner of a polygon in the edge: to a point as
high as the one it stood on, beyond the lowest. It rolls where the tilt is resolved and the lowest point is the one it
stands on. A foot is a point of the edge, and no contact while the edge rolls.

The centre's rows come along axes of the body that has the surface, see `closedloop.mechanics.loops.rows`. Velocity and
acceleration of the material at the contact differ from the centre's by ω × r and ω̇ × r + ω × ṙ, with ω relative to the
surface.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import address_of, integers_at, row_of, vector_at
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.contacts.memory import ContactLinks, Contacts
from closedloop.mechanics.contacts.modes import CAME
from closedloop.mechanics.contacts.sections import THIN, ContactSection
from closedloop.mechanics.limits import (
    AGAIN,
    FOUND,
    HOVERING,
    MOST_OF,
    NEAR,
    OFF_SURFACE,
    SHARE_DEEPER,
    SLIGHT,
    SURELY,
    TENTH,
)
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, tree_at
from closedloop.mechanics.loops.rows import ALONG, turn_direction
from closedloop.mechanics.robot.tree import Tree
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.surface.contact import Ask
from closedloop.mechanics.surface.geometry import Pose, Touch, normal_rate, tangent_rates

N, K = Count.of("n"), Count.of("k")
# Numbers of a shape: M (xx, xy, xz, yy, yz, zz), m², in the link's axes, and ρ, m.
SHAPE = 7
RADIUS = 6
# Numbers of a contact of edges, see `closedloop.mechanics.contacts.edges`: of its own edge, and of 12 others.
EDGE_2, OF_EDGE_2, COUNT_OF_EDGES = 16, 13, 13
EDGE = EDGE_2 + 12 * OF_EDGE_2


class ShapeLinks(Block):
    """Whole numbers, int64: where the memory is, its own address first."""

    address: int
    numbers: int  # address of the `Shapes`
    total: int  # of its numbers
    n: int  # joints
    k: int  # contacts, as many as those of `closedloop.mechanics.contacts.memory`


class Rims(Block, sizes=("k",)):
    """The shapes that are discs: how each is tilted, and on which point of its edge it stands, in axes of its link."""

    radius: Annotated[Array, K]  # the largest half axis, m; zero of other shapes
    axis: Annotated[Array, K, 3]
    foot_of: Annotated[Array, K]  # of a point of a disc's edge: the contact of that edge; 0 of other points
    stands: Annotated[Array, K]  # 1 while the disc stands on the point `seat`
    seat: Annotated[Array, K, 3]  # from its centre, m
    tilt: Annotated[Array, K]  # sine of the angle between axis and normal
    tilt_rate: Annotated[Array, K]  # of the axis' part along the plane, 1/s
    lowest: Annotated[Array, K, 3]  # while it stands, the lowest point, from its centre, m
    apart: Annotated[Array, K]  # and the cosine of the angle between the two


class Shapes(Block, sizes=("n", "k")):
    """The shapes of k contacts, and where each touches; then what the contact asked about last is made of.

    All but `shape` is in axes of the plane, n, t1, t2, or in axes x, y, z of the frame that carries another surface.
    """

    shape: Annotated[Array, K, SHAPE]  # zeros of a point
    edge: Annotated[Array, K, EDGE]  # zeros of what is no edge
    frame: Annotated[Array, K, 3, 3]  # of edges: n, t1, t2
    chosen: Annotated[Array, K]  # and which of the others it crosses
    crossing: Annotated[Array, 4]  # gap, m, how far inside, m, s1, m, and |e1 × e2| of the crossing asked about last
    reach: Annotated[Array, K, 3]  # r, from the centre to the contact, m
    spins: Annotated[Array, N]  # 1 of a joint that turns what is symmetric about its axis, a wheel
    rim: Rims  # what of the shapes is flat
    turns: Annotated[Array, 3, N]  # rows of ω relative to the frame that carries the surface: ω = turns q̇
    spin: Annotated[Array, 3]  # ω, rad/s
    spin_rate: Annotated[Array, 3]  # its rate at q̈ = 0, rad/s²
    carried: Annotated[Array, 3]  # of ω what a surface that turns by itself has, and what its turning adds to the rate
    turning: Annotated[Array, 3]
    wander: Annotated[Array, 3]  # ṙ, m/s
    normal: Annotated[Array, 3]
    axes: Annotated[Array, 3, 3]  # of the link that has the shape, as columns
    directions: Annotated[Array, 3, 3]  # the rows' directions, in base axes


SHAPE_LINKS = ShapeLinks.count()


@kernel
def shapes_at(address: int) -> Shapes:
    """Return the memory of the shapes of contacts, by the address of its `ShapeLinks`."""
    links = ShapeLinks(integers_at(address, SHAPE_LINKS))
    return Shapes(vector_at(links.numbers, links.total), links.n, links.k)


class ShapeMemory(NamedTuple):
    """The memory of the shapes of contacts, made in Python: kept as long as its address is used."""

    links: ShapeLinks
    shapes: Shapes

    @property
    def address(self) -> int:
        """Return what `shapes_at` takes."""
        return int(self.links.address)


def make_shape_memory(n: int, shapes: Array, edges: Array | None = None) -> ShapeMemory:
    """Return the memory of the shapes (k, SHAPE) of k contacts of a tree of n joints, and of their edges (k, EDGE)."""
    k = len(shapes)
    links, found = ShapeLinks(np.zeros(SHAPE_LINKS, dtype=np.int64)), Shapes(np.zeros(Shapes.count(n, k)), n, k)
    links.address, links.numbers, links.total = address_of(links.memory), address_of(found.memory), found.memory.size
    links.n, links.k = n, k
    found.shape[:], found.edge[:] = shapes, 0.0 if edges is None else edges
    for i, shape in enumerate(shapes):
        squares, axes = np.linalg.eigh(square_of(shape))
        if np.sum(squares > THIN * THIN * squares[-1]) == 2:
            found.rim.radius[i], found.rim.axis[i] = math.sqrt(squares[-1]), axes[:, 0]
    return ShapeMemory(links, found)


def square_of(shape: Array) -> Array:
    """Return M (3, 3), m², of a shape (7,)."""
    M = np.zeros((3, 3))
    M[np.triu_indices(3)] = shape[:RADIUS]
    return M + np.triu(M, 1).T


@kernel
def rolls(shapes: Shapes, i: int) -> bool:
    """Whether at contact i a round shape touches, and not a point."""
    s = shapes.shape
    return bool(s[i, RADIUS] > 0.0 or s[i, 0] + s[i, 3] + s[i, 5] > 0.0)


@kernel
def has_edge(shapes: Shapes, i: int) -> bool:
    """Whether contact i is of edges."""
    return bool(shapes.edge[i, COUNT_OF_EDGES] > 0.0)


def shape_of(section: ContactSection, rotation: Array) -> Array:
    """Return the shape (7,) of a contact, in the axes of which those of its frame are the columns of `rotation`."""
    shape, M = np.zeros(SHAPE), np.zeros((3, 3))
    for half in section.half_axes or ():
        turned = rotation @ np.array(half)
        M += np.outer(turned, turned)
    shape[:RADIUS] = M[np.triu_indices(3)]
    shape[RADIUS] = section.radius
    return shape


@kernel
def lowest_point(shape: Array, axes: Array, n: Array, r: Array) -> float:
    """Write r (3,), from the shape's centre to its lowest point along the unit normal n (3,), m, and return s, m.

    `shape` (7,).
    `axes` (3, 3): those of the link that has the shape, as columns, in the axes of n and r.
    """
    m0 = axes[0, 0] * n[0] + axes[1, 0] * n[1] + axes[2, 0] * n[2]
    m1 = axes[0, 1] * n[0] + axes[1, 1] * n[1] + axes[2, 1] * n[2]
    m2 = axes[0, 2] * n[0] + axes[1, 2] * n[1] + axes[2, 2] * n[2]
    p0 = shape[0] * m0 + shape[1] * m1 + shape[2] * m2
    p1 = shape[1] * m0 + shape[3] * m1 + shape[4] * m2
    p2 = shape[2] * m0 + shape[4] * m1 + shape[5] * m2
    square = m0 * p0 + m1 * p1 + m2 * p2
    widest = shape[0] + shape[3] + shape[5]
    s = math.sqrt(square) if square > FOUND * FOUND * widest else 0.0
    share = 1.0 / s if s > 0.0 else 0.0
    for i in range(3):
        r[i] = -share * (axes[i, 0] * p0 + axes[i, 1] * p1 + axes[i, 2] * p2) - shape[RADIUS] * n[i]
    return s


@kernel
def wandering(shape: Array, axes: Array, n: Array, s: float, r: Array, spin: Array, rate: Array) -> None:
    """Write ṙ (3,), m/s, of the lowest point of a shape that turns with `spin` (3,), rad/s; see `lowest_point`."""
    k0 = spin[1] * n[2] - spin[2] * n[1]
    k1 = spin[2] * n[0] - spin[0] * n[2]
    k2 = spin[0] * n[1] - spin[1] * n[0]
    c0 = axes[0, 0] * k0 + axes[1, 0] * k1 + axes[2, 0] * k2
    c1 = axes[0, 1] * k0 + axes[1, 1] * k1 + axes[2, 1] * k2
    c2 = axes[0, 2] * k0 + axes[1, 2] * k1 + axes[2, 2] * k2
    p0 = shape[0] * c0 + shape[1] * c1 + shape[2] * c2
    p1 = shape[1] * c0 + shape[3] * c1 + shape[4] * c2
    p2 = shape[2] * c0 + shape[4] * c1 + shape[5] * c2
    radius = shape[RADIUS]
    rate[0] = spin[1] * r[2] - spin[2] * r[1] + radius * k0
    rate[1] = spin[2] * r[0] - spin[0] * r[2] + radius * k1
    rate[2] = spin[0] * r[1] - spin[1] * r[0] + radius * k2
    if s == 0.0:
        return
    # M n is −s (r + ρ n), and nᵀM (ω × n) its product with ω × n
    along = 0.0
    for i in range(3):
        k = k0 if i == 0 else (k1 if i == 1 else k2)
        along -= s * (r[i] + radius * n[i]) * k
    for i in range(3):
        turned = axes[i, 0] * p0 + axes[i, 1] * p1 + axes[i, 2] * p2
        rate[i] += turned / s + (r[i] + radius * n[i]) * along / (s * s)


# A foot that is no contact is so far, m.
APART = 1.0


@kernel
def see_tilt(shapes: Shapes, i: int) -> None:
    """Write tilt and tilt_rate of contact i, of a disc; its axes and its spin against the plane are written."""
    rim, axes, w = shapes.rim, shapes.axes, shapes.spin
    a0 = axes[0, 0] * rim.axis[i, 0] + axes[0, 1] * rim.axis[i, 1] + axes[0, 2] * rim.axis[i, 2]
    a1 = axes[1, 0] * rim.axis[i, 0] + axes[1, 1] * rim.axis[i, 1] + axes[1, 2] * rim.axis[i, 2]
    a2 = axes[2, 0] * rim.axis[i, 0] + axes[2, 1] * rim.axis[i, 1] + axes[2, 2] * rim.axis[i, 2]
    rim.tilt[i] = math.hypot(a1, a2)
    rim.tilt_rate[i] = math.hypot(w[2] * a0 - w[0] * a2, w[0] * a1 - w[1] * a0)


@kernel
def stand(shapes: Shapes, i: int, r: Array, wander: Array) -> None:
    """Write r and ṙ of the point that contact i stands on, in place of its lowest, and where that is."""
    rim, axes, w, radius = shapes.rim, shapes.axes, shapes.spin, shapes.shape[i, RADIUS]
    lowest = r[0] + radius
    for a in range(3):
        rim.lowest[i, a] = axes[0, a] * lowest + axes[1, a] * r[1] + axes[2, a] * r[2]
    for a in range(3):
        r[a] = axes[a, 0] * rim.seat[i, 0] + axes[a, 1] * rim.seat[i, 1] + axes[a, 2] * rim.seat[i, 2]
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        wander[a] = w[b] * r[d] - w[d] * r[b]
    rim.apart[i] = r[0] / lowest if lowest < 0.0 else 1.0
    r[0] -= radius


@kernel
def take_seat(shapes: Shapes, i: int, r: Array) -> None:
    """Let contact i stand on its lowest point r."""
    rim, axes = shapes.rim, shapes.axes
    for a in range(3):
        at = r[0] + shapes.shape[i, RADIUS]
        rim.seat[i, a] = axes[0, a] * at + axes[1, a] * r[1] + axes[2, a] * r[2]
    rim.stands[i] = 1.0


@kernel
def left_of_rolling(shapes: Shapes, i: int, h: float) -> float:
    """Return what is left of the tilt until contact i cannot roll in steps of h, s: negative where it cannot."""
    return float(MOST_OF * (shapes.rim.tilt[i] - SLIGHT) - h * shapes.rim.tilt_rate[i])


@kernel
def stands_on_feet(shapes: Shapes, c: Contacts, i: int) -> bool:
    """Whether three feet or more of the disc of contact i are closed."""
    feet = 0
    for j in range(c.mode.shape[0]):
        feet += 1 if int(shapes.rim.foot_of[j]) == i and c.mode[j] != FREE else 0
    return bool(feet >= 3)


@kernel
def left_of_standing(shapes: Shapes, c: Contacts, i: int, h: float) -> float:
    """Return what is left until contact i, which stands, rolls or stands on another point: negative once it does.

    A soft one beside three feet stays: its spring would raise each point that it goes to, and then go to the opposite.
    """
    rim = shapes.rim
    if c.soft[i] != 0.0 and stands_on_feet(shapes, c, i):
        return APART
    size, deeper = rim.radius[i] * rim.tilt[i], rim.radius[i] * rim.tilt[i] * (1.0 - rim.apart[i])
    limit, tilt = h * rim.tilt_rate[i] + MOST_OF * SLIGHT, MOST_OF * rim.tilt[i]
    rolls = max(AGAIN * limit - tilt, deeper - NEAR * size - OFF_SURFACE)
    return float(min(rolls, SURELY * limit - tilt, OFF_SURFACE + SHARE_DEEPER * size - deeper))


@kernel
def is_idle(shapes: Shapes, c: Contacts, j: int, h: float) -> bool:
    """Whether contact j, open, is a foot of a disc whose edge rolls; or, of soft ones, the edge beside three feet."""
    if c.soft[j] != 0.0:
        return bool(shapes.rim.radius[j] > 0.0 and stands_on_feet(shapes, c, j))
    i = int(shapes.rim.foot_of[j])
    return bool(i > 0 and c.mode[i] != FREE and shapes.rim.stands[i] == 0.0 and left_of_rolling(shapes, i, h) >= 0.0)


@kernel
def rim_margin(links: ContactLinks, c: Contacts, h: float) -> float:
    """Return the least of what is left to discs that are closed until they stand, or stand otherwise."""
    shapes, least = shapes_at(links.shapes), math.inf
    for i in range(1, links.points):
        if shapes.rim.radius[i] > 0.0 and c.mode[i] != FREE:
            stands = shapes.rim.stands[i] != 0.0
            least = min(least, left_of_standing(shapes, c, i, h) if stands else left_of_rolling(shapes, i, h))
    return float(least)


@kernel
def some_stand(links: ContactLinks, c: Contacts) -> bool:
    """Whether a disc stands on its edge or on its feet."""
    shapes, stands = shapes_at(links.shapes), False
    for i in range(1, links.points):
        on_foot = shapes.rim.foot_of[i] > 0.0 and c.mode[i] != FREE
        stands = stands or on_foot or (shapes.rim.stands[i] != 0.0 and c.mode[i] != FREE)
    return stands


@kernel
def longest_roll(links: ContactLinks, c: Contacts) -> float:
    """Return how long the next substep may be, s, for discs that roll."""
    shapes, longest = shapes_at(links.shapes), math.inf
    for i in range(1, links.points):
        turns = shapes.rim.radius[i] > 0.0 and c.mode[i] != FREE and shapes.rim.stands[i] == 0.0
        if turns and shapes.rim.tilt_rate[i] > 0.0:
            longest = min(longest, TENTH * shapes.rim.tilt[i] / shapes.rim.tilt_rate[i])
    return float(longest)


@kernel
def leave_seats(links: ContactLinks, c: Contacts, h: float) -> bool:
    """Let discs stand on the next point, or roll, where they do no longer stand as they did; whether there are any.

    What rolls again has no feet. A soft contact that goes to a deeper point has the force there that it had.
    """
    shapes, left = shapes_at(links.shapes), False
    rim = shapes.rim
    for i in range(1, links.points):
        if rim.stands[i] == 0.0 or c.mode[i] == FREE or left_of_standing(shapes, c, i, h) >= 0.0:
            continue
        left = True
        size = rim.radius[i] * rim.tilt[i]
        deeper = (1.0 - rim.apart[i]) * size
        on = OFF_SURFACE + SHARE_DEEPER * size < deeper
        if c.soft[i] != 0.0 and not (on and rim.apart[i] > MOST_OF):
            c.gaps.unloaded[i] -= deeper
        if on:
            seat_next(shapes, i)
            continue
        rim.stands[i] = 0.0
        for j in range(1, links.points):
            if rim.foot_of[j] == i and c.mode[j] != FREE and c.soft[i] == 0.0:
                c.mode[j], c.gaps.cleared[j], c.gaps.floor[j] = FREE, 0.0, min(c.located[3 * j], 0.0)
    return left


@kernel
def seat_next(shapes: Shapes, i: int) -> None:
    """Let contact i stand on the next point: in coordinates in which the edge is a circle, beyond the lowest."""
    rim, of_lowest, of_last = shapes.rim, 1.0, 0.0
    if MOST_OF < rim.apart[i] < 1.0:
        angle = math.acos(rim.apart[i])
        of_lowest, of_last = math.sin((1.0 + MOST_OF) * angle), math.sin(MOST_OF * angle)
        of_lowest, of_last = of_lowest / math.sin(angle), of_last / math.sin(angle)
    for a in range(3):
        rim.seat[i, a] = of_lowest * rim.lowest[i, a] - of_last * rim.seat[i, a]


@kernel
def rest_on_feet(links: ContactLinks, c: Contacts) -> None:
    """Open the edge of a disc that stands on its feet: it is a fourth point of the same plane.

    Not of a soft one: what its springs carry does not go elsewhere at once. One that comes beside fewer feet, inside
    the surface, begins without force.
    """
    shapes = shapes_at(links.shapes)
    for i in range(1, links.points):
        came = shapes.rim.radius[i] > 0.0 and c.soft[i] != 0.0 and c.event.happened[i] == CAME
        if came and c.located[3 * i] < -HOVERING:
            c.gaps.unloaded[i] = c.located[3 * i]
        if shapes.rim.stands[i] == 0.0 or c.mode[i] == FREE or c.soft[i] != 0.0:
            continue
        if stands_on_feet(shapes, c, i):
            c.mode[i], c.gaps.cleared[i], c.gaps.floor[i] = FREE, 0.0, min(c.located[3 * i], 0.0)


@kernel
def roll_on_plane(joints: LoopLinks, rows: LoopRows, shapes: Shapes, i: int, seats: float) -> None:
    """Move the rows of contact i, with a plane at rest in the frame against, to the lowest point of its shape.

    The rows are n, t1 and t2 of the centre, which are located already. A disc that may begin to stand where steps of
    `seats`, s, do not resolve its tilt, 0.0 for none, does; one that stands is at the point that it stands on.
    """
    k, n, shape = 3 * i - 3, shapes.normal, row_of(shapes.shape, i)
    turn_against(joints, rows, k, shapes)
    r, spin, rate, wander = row_of(shapes.reach, i), shapes.spin, shapes.spin_rate, shapes.wander
    n[0], n[1], n[2] = 1.0, 0.0, 0.0
    s = lowest_point(shape, shapes.axes, n, r)
    wandering(shape, shapes.axes, n, s, r, spin, wander)
    if shapes.rim.radius[i] > 0.0:
        see_tilt(shapes, i)
        if shapes.rim.stands[i] == 0.0 and seats > 0.0 and left_of_rolling(shapes, i, seats) < 0.0:
            take_seat(shapes, i, r)
        if shapes.rim.stands[i] != 0.0:
            stand(shapes, i, r, wander)
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        rows.error[k + a] += r[a]
        rows.rate[k + a] += spin[b] * r[d] - spin[d] * r[b]
        rows.drift[k + a] += rate[b] * r[d] - rate[d] * r[b] + spin[b] * wander[d] - spin[d] * wander[b]
        for j in range(joints.n):
            rows.G[k + a, j] += shapes.turns[b, j] * r[d] - shapes.turns[d, j] * r[b]


@kernel
def roll_on_surface(joints: LoopLinks, rows: LoopRows, shapes: Shapes, c: Contacts, ask: Ask, i: int) -> None:
    """Move the rows of contact i, with a surface that is curved or moves, from a ball's centre to where it touches.

    The rows are turned to n, t1 and t2 already. With r = −ρ n, and ω relative to the surface, u_1 = −ρ ω·t2 and
    u_2 = ρ ω·t1 are added to the centre's velocity, and their rates; t1 and t2 turn with the surface and along it.
    """
    at_n = 3 * i
    turn_against(joints, rows, at_n - 3, shapes)
    radius, u, carried = shapes.shape[i, RADIUS], c.u[at_n : at_n + 3], c.carried[at_n : at_n + 3]
    turn_on_surface(shapes, ask)
    for a in range(3):
        shapes.reach[i, a] = -radius * ask.frame[0, a]
    G, turning, drift = c.G[at_n : at_n + 3], c.turning[at_n : at_n + 3], c.drift[at_n : at_n + 3]
    move_to_ball(shapes, radius, G, u, carried, turning, drift)


@kernel
def move_to_ball(
    shapes: Shapes, radius: float, G: Array, u: Array, carried: Array, turning: Array, drift: Array
) -> None:
    """Move rows n, t1 and t2 from a ball's centre to where it touches, of the turning in `shapes`; see the above."""
    spin, own = shapes.spin, shapes.carried
    for a in range(1, 3):
        t, sign = 3 - a, -radius if a == 1 else radius
        for j in range(shapes.turns.shape[1]):
            G[a, j] += sign * shapes.turns[t, j]
        carried[a] += sign * own[t]
        u[a] += sign * (spin[t] - own[t])
        turning[a] += sign * shapes.turning[t]
        drift[a] += sign * (shapes.turning[t] + shapes.spin_rate[t])


@kernel
def turn_on_surface(shapes: Shapes, ask: Ask) -> None:
    """Turn what `turn_against` has written for a contact to n, t1 and t2 of a surface that is curved or moves.

    It has been asked about the centre of what touches. Written too: of ω what the surface has by itself, and what
    turning of n, t1 and t2, with the surface and along it, adds to the rate of ω relative to the surface.
    """
    touch, pose, N, v = Touch(ask.touch), Pose(ask.pose), ask.frame, ask.velocity
    spin, rate = shapes.spin, shapes.spin_rate
    slip, along, turned = shapes.wander, shapes.normal, row_of(shapes.axes, 0)
    for a in range(3):
        slip[a] = 0.0  # the velocity relative to the surface, in the surface's axes
        for m in range(3):
            slip[a] += touch.local[m, a] * (
                N[m, 0] * v[0] + N[m, 1] * v[1] + N[m, 2] * v[2] - touch.carried[m] + touch.flow[m]
            )
    normal_rate(slip, touch, along)
    for a in range(3):
        turned[a] = 0.0  # ω relative to the surface, in its axes
        for m in range(3):
            turned[a] += pose.axes[a, m] * (spin[m] - pose.spin[m])
    bend1, bend2 = tangent_rates(along, turned, touch)
    bend0 = along[0] * turned[0] + along[1] * turned[1] + along[2] * turned[2]
    w, s = spin, pose.spin
    c0, c1, c2 = w[1] * s[2] - w[2] * s[1], w[2] * s[0] - w[0] * s[2], w[0] * s[1] - w[1] * s[0]  # ω × s
    for a in range(3):
        x, y, z = N[a, 0], N[a, 1], N[a, 2]
        bend = bend0 if a == 0 else (bend1 if a == 1 else bend2)
        shapes.carried[a] = x * s[0] + y * s[1] + z * s[2]
        turning = bend - (x * pose.spin_rate[0] + y * pose.spin_rate[1] + z * pose.spin_rate[2])
        shapes.turning[a] = turning + x * c0 + y * c1 + z * c2
    w0, w1, w2, r0, r1, r2 = w[0], w[1], w[2], rate[0], rate[1], rate[2]
    for a in range(3):
        x, y, z = N[a, 0], N[a, 1], N[a, 2]
        w[a], rate[a] = x * w0 + y * w1 + z * w2, x * r0 + y * r1 + z * r2
    for j in range(shapes.turns.shape[1]):
        g0, g1, g2 = shapes.turns[0, j], shapes.turns[1, j], shapes.turns[2, j]
        for a in range(3):
            shapes.turns[a, j] = N[a, 0] * g0 + N[a, 1] * g1 + N[a, 2] * g2


@kernel
def turn_against(joints: LoopLinks, rows: LoopRows, k: int, shapes: Shapes) -> None:
    """Write how the link with the shape of rows k to k + 2 turns relative to that with the surface, and its axes.

    In components along the rows' directions u, which turn with the latter: ω·u, (α_a − α_b + ω_a × ω_b)·u at q̈ = 0.
    """
    tree, work, u = tree_at(joints), vector_at(joints.scratch, joints.scratch_size), shapes.directions
    sides, out = integers_at(joints.bound, 3 * joints.m), row_of(rows.motions, 0)
    one, other = sides[joints.m + k], sides[2 * joints.m + k]
    for r in range(3):
        turn_direction(tree, work, other, row_of(rows.along_b, k + r), out)
        for m in range(3):
            u[r, m] = out[ALONG + m]
        for j in range(joints.n):
            shapes.turns[r, j] = 0.0
    _add_turns(tree, work, one, 1.0, shapes)
    _add_turns(tree, work, other, -1.0, shapes)
    a, b = shapes.spin, shapes.spin_rate  # ω of either link, base axes, until they are written below
    e, f = shapes.wander, shapes.normal
    _angular(tree, work, one, a, e)
    _angular(tree, work, other, b, f)
    e0 = e[0] - f[0] + a[1] * b[2] - a[2] * b[1]
    e1 = e[1] - f[1] + a[2] * b[0] - a[0] * b[2]
    e2 = e[2] - f[2] + a[0] * b[1] - a[1] * b[0]
    w0, w1, w2 = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    for r in range(3):
        shapes.spin[r] = u[r, 0] * w0 + u[r, 1] * w1 + u[r, 2] * w2
        shapes.spin_rate[r] = u[r, 0] * e0 + u[r, 1] * e1 + u[r, 2] * e2
    x0, x1, x2, z0, z1, z2 = 1.0, 0.0, 0.0, 0.0, 0.0, 1.0
    if one >= 0:
        s = tree.links[at.SCRATCH * tree.n + one]
        x0, x1, x2 = work[s + at.X0], work[s + at.X1], work[s + at.X2]
        z0, z1, z2 = work[s + at.Z0], work[s + at.Z1], work[s + at.Z2]
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    for r in range(3):
        shapes.axes[r, 0] = u[r, 0] * x0 + u[r, 1] * x1 + u[r, 2] * x2
        shapes.axes[r, 1] = u[r, 0] * y0 + u[r, 1] * y1 + u[r, 2] * y2
        shapes.axes[r, 2] = u[r, 0] * z0 + u[r, 1] * z1 + u[r, 2] * z2


@kernel
def _add_turns(tree: Tree, work: Array, link: int, sign: float, shapes: Shapes) -> None:
    """Add to the rows of ω what each joint that turns a link adds."""
    n, u, joint = tree.n, shapes.directions, link
    while joint >= 0:
        i = joint
        s = tree.links[at.SCRATCH * n + i]
        if tree.links[at.REVOLUTE * n + i] != 0:
            z0, z1, z2 = work[s + at.Z0], work[s + at.Z1], work[s + at.Z2]
            for r in range(3):
                shapes.turns[r, i] += sign * (u[r, 0] * z0 + u[r, 1] * z1 + u[r, 2] * z2)
        joint = tree.links[at.PARENT * n + i]


@kernel
def _angular(tree: Tree, work: Array, link: int, spin: Array, rate: Array) -> None:
    """Write the angular velocity of a link, rad/s, and its acceleration at q̈ = 0, rad/s², base axes."""
    for m in range(3):
        spin[m], rate[m] = 0.0, 0.0
    if link >= 0:
        s = tree.links[at.SCRATCH * tree.n + link]
        spin[0], spin[1], spin[2] = work[s + at.O0], work[s + at.O1], work[s + at.O2]
        rate[0], rate[1], rate[2] = work[s + at.A0], work[s + at.A1], work[s + at.A2]
