"""A surface as the loop asks it: a function called by address, with a memory of its own.

The loop writes the time and the tip's motion into the memory (`Ask`), calls the entry of the surface, and reads the
contact frame, the gap and what the tip moves relative to. A path that follows the surface asks the same entry. A plane
at rest needs none of it: its frame is constant (`closedloop.loop.step.locate`).

A ball rests on what is at a distance from the surface φ = 0, whatever function φ is. The nearest point x of the surface
to a point c, and c = x + g n(x), solve

    x − c + λ ∇φ(x) = 0,     φ(x) = 0,     g = λ |∇φ(x)|

by Newton's method from the first-order answer. As a function of c, g has the gradient n and the second derivatives
K (1 + g K)⁻¹, with the curvature K = (1 − n nᵀ) ∇∇φ (1 − n nᵀ)/|∇φ| at x: those of a surface parallel to the first (M.
P. do Carmo, Differential Geometry of Curves and Surfaces, Prentice-Hall 1976, §3-5). It has none where 1 + g K is not
positive: there a ball of radius g does not fit into the hollow.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import Entry, address_of, call_at, integers_at, vector_at
from closedloop.jit.kernel import entry_kernel, kernel
from closedloop.jit.parameters import parameter_block
from closedloop.jit.user_code import RAISED, function_of, member_entry
from closedloop.mechanics.surface.geometry import Pose, Touch, contact_geometry, into_surface_axes
from closedloop.mechanics.surface.motion import Move, SurfaceMotion, begin_move, displace
from closedloop.mechanics.surface.surface import Surface
from robot_models.cached import cached

# Newton steps at most, and the length of a step, m, that is rounding: relative to the distance from the origin too.
MOST_NEAREST, STEP_ROUNDING = 50, 1e-15


class Nearest(Block):
    """The search for the nearest point, in the surface's axes."""

    at: Annotated[Array, 3]  # x, m
    gradient: Annotated[Array, 3]
    hessian: Annotated[Array, 3, 3]
    factor: float  # λ
    step: Annotated[Array, 3]
    matrix: Annotated[Array, 3, 3]
    inverse: Annotated[Array, 3, 3]


@kernel
def begin_nearest(touch: Touch, near: Nearest) -> bool:
    """Write the first-order answer x, λ of a point whose level, gradient and Hessian `touch` has."""
    g, square = touch.gradient, 0.0
    for i in range(3):
        square += g[i] * g[i]
    if not 0.0 < square < math.inf:
        return False
    near.factor = touch.level / square
    for i in range(3):
        near.at[i] = touch.at[i] - near.factor * g[i]
    return True


@kernel
def improve_nearest(c: Array, level: float, near: Nearest) -> float:
    """Take a Newton step from x and λ, with φ, ∇φ and ∇∇φ at x; return its length, m, NaN where there is none."""
    A, B, g = near.matrix, near.inverse, near.gradient
    for i in range(3):
        for j in range(3):
            A[i, j] = near.factor * near.hessian[i, j] + (1.0 if i == j else 0.0)
    if not invert(A, B) > 0.0:
        return math.nan
    along, across = level, 0.0
    for i in range(3):
        y = z = 0.0
        for j in range(3):
            y -= B[i, j] * (near.at[j] - c[j] + near.factor * g[j])
            z += B[i, j] * g[j]
        near.step[i] = y
        along += g[i] * y
        across += g[i] * z
    change, size = along / across, 0.0
    for i in range(3):
        z = B[i, 0] * g[0] + B[i, 1] * g[1] + B[i, 2] * g[2]
        step = near.step[i] - change * z
        near.at[i] += step
        size += step * step
    near.factor += change
    return math.sqrt(size)


@kernel
def is_rounding(size: float, before: float, near: Nearest) -> bool:
    """Whether a Newton step of this length, m, is the last: it is rounding, or no longer shrinks near it."""
    x = near.at
    scale: float = STEP_ROUNDING * (1.0 + abs(x[0]) + abs(x[1]) + abs(x[2]))
    return size <= scale or (before <= size <= 1e4 * scale)


@kernel
def write_distance(near: Nearest, radius: float, touch: Touch) -> bool:
    """Write the distance less a radius, m, with gradient and Hessian, in place of φ; False where it has none."""
    g, size = near.gradient, 0.0
    for i in range(3):
        size += g[i] * g[i]
    size = math.sqrt(size)
    if not 0.0 < size < math.inf:
        return False
    n, K, A = touch.gradient, near.hessian, near.matrix
    gap = near.factor * size
    for i in range(3):
        n[i] = g[i] / size
    for k in range(2):  # (1 − n nᵀ) ∇∇φ (1 − n nᵀ)/|∇φ|: first the columns, then the rows
        for i in range(3):
            along = 0.0
            for j in range(3):
                along += n[j] * (K[i, j] if k == 0 else K[j, i])
            for j in range(3):
                if k == 0:
                    K[i, j] -= along * n[j]
                else:
                    K[j, i] -= along * n[j]
    for i in range(3):
        for j in range(3):
            K[i, j] /= size
            A[i, j] = gap * K[i, j] + (1.0 if i == j else 0.0)
    if not invert(A, near.inverse) > 0.0 or not A[0, 0] + A[1, 1] + A[2, 2] > 1.0:
        return False
    for i in range(3):
        for j in range(3):
            s = 0.0
            for m in range(3):
                s += K[i, m] * near.inverse[m, j]
            touch.hessian[i, j] = s
    touch.level = gap - radius
    return True


@kernel
def invert(A: Array, B: Array) -> float:
    """Write the inverse B of a matrix A (3, 3), and return its determinant; B is not finite where that is zero."""
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            B[j, i] = A[a, c] * A[b, d] - A[a, d] * A[b, c]
    det = A[0, 0] * B[0, 0] + A[0, 1] * B[1, 0] + A[0, 2] * B[2, 0]
    for i in range(3):
        for j in range(3):
            B[i, j] /= det
    return float(det)


# What the entry of a surface is asked for.
CONTACT, LEVEL = range(2)
# Its answers.
FOUND, NO_NORMAL = range(2)


class Links(Block):
    """Whole numbers, int64: where the memory is, its own address first, and what else is called."""

    address: int
    numbers: int  # address of the `Ask`
    total: int  # of its numbers
    size: int  # of the surface's parameters
    motion_size: int  # and of its motion's
    entries: int  # in each list of the surface's parameters
    motion_entries: int  # and of its motion's
    motion: int  # address of the entry of the motion, 0: the surface is at rest


class Ask(Block, sizes=("size", "motion_size")):
    """What a surface is asked, and what it answers."""

    time: float  # in, s, as the next two
    r: Annotated[Array, 3]  # position of the tip, m, base frame
    velocity: Annotated[Array, 3]  # ṙ, m/s, base frame
    frame: Annotated[Array, 3, 3]  # out: N, rows n, t1, t2, base frame
    origin: Annotated[Array, 3]  # of the surface at t = 0, m, base frame
    axes: Annotated[Array, 3, 3]  # rows x, y, z
    pose: Annotated[Array, Pose.count()]
    touch: Annotated[Array, Touch.count()]  # out
    move: Annotated[Array, Move.count()]
    par: Annotated[Array, Count.of("size")]
    motion_par: Annotated[Array, Count.of("motion_size")]
    bounds: Annotated[Array, 2]  # see `edge_distance`, as the next
    solid: Annotated[Array, 5]
    radius: float  # of a ball that touches in place of a point, m; φ is then the distance of its centre, less it
    near: Annotated[Array, Nearest.count()]


LINKS = Links.count()


@kernel
def ask_at(address: int) -> tuple[Links, Ask]:
    """Return the memory of a surface, by the address of its `Links`."""
    links = Links(integers_at(address, LINKS))
    return links, Ask(vector_at(links.numbers, links.total), links.size, links.motion_size)


class SurfaceMemory(NamedTuple):
    """The memory of a surface, made in Python: kept as long as its address is used."""

    links: Links
    ask: Ask

    @property
    def address(self) -> int:
        """Return what `ask_at` takes."""
        return int(self.links.address)


def make_memory(
    par: Array, motion_par: Array, entries: tuple[int, int], origin: Array, axes: Array, bounds: tuple[float, float],
    radius: float = 0.0, solid: tuple[float, ...] = (0.0,) * 5,
) -> SurfaceMemory:  # fmt: skip
    """Return the memory of a surface at rest.

    `par`, `motion_par`: the parameters of the surface and of its motion, see `closedloop.jit.parameters.pack`.
    `entries`: entries in each list of the surface's parameters, and of its motion's.
    `origin`, `axes`, (3,), (3, 3) arrays: of the surface at t = 0: m, and rows x, y, z; base frame.
    `bounds`: of its edge, see `closedloop.mechanics.surface.surface.Surface.bounds`.
    `radius`: of a ball that touches it, m; 0: a point does.
    `solid`: of a block that a point touches, see `closedloop.mechanics.surface.surface.Surface.solid`.
    """
    sizes = par.size, motion_par.size
    links, ask = Links(np.zeros(LINKS, dtype=np.int64)), Ask(np.zeros(Ask.count(*sizes)), *sizes)
    links.address, links.numbers, links.total = address_of(links.memory), address_of(ask.memory), ask.memory.size
    links.size, links.motion_size, links.entries, links.motion_entries = *sizes, *entries
    ask.par[:], ask.motion_par[:], ask.axes[:] = par, motion_par, axes
    ask.bounds[:], ask.radius, ask.solid[:] = bounds, radius, solid
    Pose(ask.pose).axes[:] = axes
    place_at(ask, origin)
    return SurfaceMemory(links, ask)


def place_at(ask: Ask, origin: Array) -> None:
    """Place a surface at t = 0 with its origin at `origin` (3,), m, base frame."""
    ask.origin[:] = Pose(ask.pose).origin[:] = origin


# A face of a block ends so far before its edge, m, where the next one is not nearest yet.
BEFORE_EDGE = 1e-9


@kernel
def edge_distance(at: Array, bounds: Array, solid: Array) -> float:
    """Return how far inside its edge a point of the surface is, m, negative outside.

    `at` (3,): the point, m, surface's axes.
    `bounds` (2,): half-lengths along x and y, m; of a round edge its radius and 0.
    `solid` (5,): of a block its first axis, two numbers, and half its edges, m, the last below the origin: where two
        faces are nearest, one of them ends. Zeros of another surface.
    """
    if solid[4] > 0.0:
        d0 = abs(solid[0] * at[0] + solid[1] * at[1]) - solid[2]
        d1, d2 = abs(solid[0] * at[1] - solid[1] * at[0]) - solid[3], abs(at[2] + solid[4]) - solid[4]
        return float(-max(min(d0, d1), min(max(d0, d1), d2)) - BEFORE_EDGE)
    if bounds[1] == 0.0:
        return float(bounds[0] - math.sqrt(at[0] * at[0] + at[1] * at[1]))
    return float(min(bounds[0] - abs(at[0]), bounds[1] - abs(at[1])))


@cached
def surface_entry(member: type[Surface]) -> Entry:
    """Return the entry of a surface, compiled when it is first needed.

    CONTACT     writes the pose, all of the touch, and the frame; the answer is NO_NORMAL where φ has no gradient
    LEVEL       writes the pose, and at, level, gradient and Hessian of the touch
    """
    Parameters, level = parameter_block(member), function_of(member, "level")
    is_distance = member.is_distance

    def entry(address: int, what: int) -> int:
        links, ask = ask_at(address)
        if links.motion != 0 and call_at(links.motion, address, 0) == RAISED:
            return RAISED
        pose, touch = Pose(ask.pose), Touch(ask.touch)
        into_surface_axes(pose, ask.r, touch)
        touch.level = level(touch.at, Parameters(ask.par, links.entries), touch.gradient, touch.hessian)
        if ask.radius > 0.0 and is_distance:
            touch.level -= ask.radius
        elif ask.radius > 0.0:
            near, size = Nearest(ask.near), math.inf
            if not begin_nearest(touch, near):
                return NO_NORMAL
            for _ in range(MOST_NEAREST):
                for i in range(3):
                    near.gradient[i] = 0.0
                    for j in range(3):
                        near.hessian[i, j] = 0.0
                value = level(near.at, Parameters(ask.par, links.entries), near.gradient, near.hessian)
                if size == 0.0:  # gradient and Hessian are those at the nearest point
                    break
                step = improve_nearest(touch.at, value, near)
                if not step < math.inf:
                    return NO_NORMAL
                size = 0.0 if is_rounding(step, size, near) else step
            if not write_distance(near, ask.radius, touch):
                return NO_NORMAL
        if what == CONTACT and not contact_geometry(pose, links.motion != 0, ask.r, ask.velocity, ask.frame, touch):
            return NO_NORMAL
        return FOUND

    entry.__name__ = entry.__qualname__ = f"entry_of_surface_{member.__name__}"
    return member_entry(entry, member)


@cached
def motion_entry(member: type[SurfaceMotion]) -> Entry:
    """Return the entry of a motion, which writes the pose at the time that is asked for."""
    Parameters, move = parameter_block(member), function_of(member, "move")

    def entry(address: int, what: int) -> int:
        links, ask = ask_at(address)
        moved = Move(ask.move)
        begin_move(moved)
        move(ask.time, Parameters(ask.motion_par, links.motion_entries), moved)
        displace(moved, ask.origin, ask.axes, Pose(ask.pose))
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_surface_motion_{member.__name__}"
    return member_entry(entry, member)


# Newton steps along the normal by which a point is put on a level of φ, and the distance at which it is on it, m.
MOST_STEPS, ON_LEVEL = 50, 1e-14
# A step that is no longer shrinking, and shorter than this, m, is the rounding of φ.
ROUNDING = 1e-9
ON_SURFACE, NOT_REACHED = 0, 1


@entry_kernel
def put_on_surface(
    entry: int, address: int, along: Array, level: float, times: Array, r: Array, velocity: Array, acceleration: Array
) -> int:
    """Move each point of a motion along a fixed direction onto a level of a surface that may move; and its derivatives.

    Returns how many points were put there: N, or fewer if the surface does not lie in that direction.

    `entry`, `address`: of the surface, and of its memory.
    `along` (3,): the direction, base frame.
    `level`: the φ that it is put on.
    `times` (N,): s.
    `r`, `velocity`, `acceleration`, (N, 3) arrays: read and overwritten: m, m/s and m/s², base frame.
    """
    _, ask = ask_at(address)
    pose, touch = Pose(ask.pose), Touch(ask.touch)
    for k in range(times.size):
        ask.time = times[k]
        reached, before = False, np.inf
        for i in range(3):
            ask.r[i] = r[k, i]
        for _ in range(MOST_STEPS):
            call_at(entry, address, LEVEL)
            slope = 0.0
            for i in range(3):
                turned = 0.0
                for j in range(3):
                    turned += pose.axes[i, j] * along[j]
                slope += touch.gradient[i] * turned
            step = (level - touch.level) / slope if slope > 0.0 else np.nan
            if not abs(step) < 1e6:
                break
            for i in range(3):
                ask.r[i] += step * along[i]
            size = abs(step)
            if size <= ON_LEVEL * (1.0 + abs(ask.r[0]) + abs(ask.r[1]) + abs(ask.r[2])) or before <= size < ROUNDING:
                reached = True
                break
            before = size
        if not reached:
            return k
        for what in range(2):  # the velocity first: what u̇ has beside N r̈ depends on it
            for i in range(3):
                ask.velocity[i] = velocity[k, i]
            if call_at(entry, address, CONTACT) != FOUND:
                return k
            across, short = 0.0, touch.carried[0] if what == 0 else -touch.turning[0]
            for i in range(3):
                across += ask.frame[0, i] * along[i]
                short -= ask.frame[0, i] * (velocity[k, i] if what == 0 else acceleration[k, i])
            for i in range(3):
                if what == 0:
                    velocity[k, i] += short / across * along[i]
                else:
                    acceleration[k, i] += short / across * along[i]
        for i in range(3):
            r[k, i] = ask.r[i]
    return times.size


@entry_kernel
def normals_on_surface(entry: int, address: int, times: Array, r: Array, velocity: Array) -> int:
    """Overwrite points of a motion by the surface's unit normals there, and its velocities by their rates.

    Returns how many points were asked for: N, or fewer if there is no normal at the next.

    `entry`, `address`: of the surface, and of its memory.
    `times` (N,): s.
    `r`, `velocity`, (N, 3) arrays: position, m, and velocity, m/s; overwritten by n and ṅ, 1/s. All in the base frame.
    """
    _, ask = ask_at(address)
    pose, touch = Pose(ask.pose), Touch(ask.touch)
    for k in range(times.size):
        ask.time = times[k]
        for i in range(3):
            ask.r[i], ask.velocity[i] = r[k, i], velocity[k, i]
        if call_at(entry, address, CONTACT) != FOUND:
            return k
        o, n = pose.spin, ask.frame[0]
        for i in range(3):  # how the point moves relative to the surface, base axes
            a, b = (i + 1) % 3, (i + 2) % 3
            spun = o[a] * (r[k, b] - pose.origin[b]) - o[b] * (r[k, a] - pose.origin[a])
            touch.carried[i] = velocity[k, i] - pose.velocity[i] - spun
        for i in range(3):  # ∇∇φ v/|∇φ|, surface's axes
            bend = 0.0
            for m in range(3):
                moved = pose.axes[m, 0] * touch.carried[0] + pose.axes[m, 1] * touch.carried[1]
                bend += touch.hessian[i, m] * (moved + pose.axes[m, 2] * touch.carried[2]) / touch.size
            touch.turning[i] = bend
        along = 0.0
        for i in range(3):
            along += touch.local[0, i] * touch.turning[i]
        for i in range(3):
            r[k, i] = n[i]
            a, b = (i + 1) % 3, (i + 2) % 3
            velocity[k, i] = o[a] * n[b] - o[b] * n[a]
            for m in range(3):
                velocity[k, i] += pose.axes[m, i] * (touch.turning[m] - along * touch.local[0, m])
    return times.size
