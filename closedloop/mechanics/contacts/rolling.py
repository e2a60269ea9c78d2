"""The rows of contacts at which a round shape touches: those of its centre, moved to the place that touches.

The centre's rows come along axes of the body that has the surface, see `closedloop.mechanics.loops.rows`. Velocity and
acceleration of the material at the contact differ from the centre's by ω × r and ω̇ × r + ω × ṙ, with ω relative to the
surface (`closedloop.mechanics.contacts.shapes`).
"""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.calls import integers_at, row_of, vector_at
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import Contacts
from closedloop.mechanics.contacts.shapes import RADIUS, Shapes, lowest_point, wandering
from closedloop.mechanics.contacts.standing import left_of_rolling, see_tilt, stand, take_seat
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, tree_at
from closedloop.mechanics.loops.rows import ALONG, turn_direction
from closedloop.mechanics.robot.tree import Tree
from closedloop.mechanics.robot.tree import layout as at
from closedloop.mechanics.surface.contact import Ask
from closedloop.mechanics.surface.geometry import Pose, Touch, normal_rate, tangent_rates


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
            slip[a] += touch.local[m, a] * (N[m, 0] * v[0] + N[m, 1] * v[1] + N[m, 2] * v[2] - touch.carried[m])
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
