"""Round shapes that touch a plane: where on a body the contact is, and how that place wanders while the body rolls.

About a point of its link a shape is given by half axes h_i, at most three, and a radius ρ: all points Σ a_i h_i with
Σ a_i² <= 1, and what is within ρ of them. A radius alone is a ball, three half axes an ellipsoid, two a disc, whose
edge is a cylinder's rim. With M = Σ h_i h_iᵀ the lowest point along a unit normal n is

    r = −M n/√(nᵀM n) − ρ n          (R. T. Rockafellar, Convex Analysis, Princeton 1970, §13: the support function)

n is fixed in the body of the plane. Relative to that body the shape turns with ω, so that M turns with it, and

    ṙ = ω × r + D (ω × n),     D = M/s − (M n)(M n)ᵀ/s³ + ρ 1,     s = √(nᵀM n)

The material of the shape at the contact has u = u_c + ω × r, of its centre's velocity u_c, and
u̇ = u̇_c + ω̇ × r + ω × ṙ.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import address_of, integers_at, vector_at
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.sections import THIN, ContactSection

N, K = Count.of("n"), Count.of("k")
# Numbers of a shape: M (xx, xy, xz, yy, yz, zz), m², in the link's axes, and ρ, m.
SHAPE = 7
RADIUS = 6
# Numbers of a contact of edges, see `closedloop.mechanics.contacts.edges`: of its own edge, and of 12 others.
EDGE_2, OF_EDGE_2, COUNT_OF_EDGES = 16, 13, 13
EDGE = EDGE_2 + 12 * OF_EDGE_2
# A disc whose axis is tilted from the normal by less than this, rad, lies flat: its edge has no lowest point.
FLAT = 1e-9


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
    rim: Rims  # what of the shapes is flat, see `closedloop.mechanics.contacts.standing`
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

    Parameters
    ----------
    shape : (7,) array
    axes : (3, 3) array
        Those of the link that has the shape, as columns, in the axes of n and r.
    """
    m0 = axes[0, 0] * n[0] + axes[1, 0] * n[1] + axes[2, 0] * n[2]
    m1 = axes[0, 1] * n[0] + axes[1, 1] * n[1] + axes[2, 1] * n[2]
    m2 = axes[0, 2] * n[0] + axes[1, 2] * n[1] + axes[2, 2] * n[2]
    p0 = shape[0] * m0 + shape[1] * m1 + shape[2] * m2
    p1 = shape[1] * m0 + shape[3] * m1 + shape[4] * m2
    p2 = shape[2] * m0 + shape[4] * m1 + shape[5] * m2
    square = m0 * p0 + m1 * p1 + m2 * p2
    widest = shape[0] + shape[3] + shape[5]
    s = math.sqrt(square) if square > FLAT * FLAT * widest else 0.0
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
