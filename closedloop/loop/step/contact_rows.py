"""Where the contacts of the links are: their gaps, velocities, rows and mobility, and what the stabiliser asks for.

A contact with a surface that is curved or moves has rows x, y, z of the frame that carries it, which are turned into n,
t1, t2 of the surface at the point; a stop of a joint has the row ± q̇ of it, one of a tendon likewise.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at, integers_at, row_of, vector_at
from closedloop.jit.kernel import kernel
from closedloop.jit.user_code import RAISED
from closedloop.loop.step.locate import flows, off_anchor
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.loop.step.tendons import joint_limits, part_of, rate_along, stops_of
from closedloop.mechanics.closure.contact_force import FREE, baumgarte_acceleration
from closedloop.mechanics.closure.solve import NO_NORMAL, OK, forward_substitute, forward_substitute_three
from closedloop.mechanics.contacts.edges import write_edge_rows
from closedloop.mechanics.contacts.friction import take_states, write_delayed
from closedloop.mechanics.contacts.memory import ContactLinks, Contacts, joints_of, joints_rub
from closedloop.mechanics.contacts.mobility import own_mobilities
from closedloop.mechanics.contacts.modes import near, touches
from closedloop.mechanics.contacts.resistance import is_resistance
from closedloop.mechanics.contacts.resistance_rows import write_resistances
from closedloop.mechanics.contacts.rolling import (
    APART,
    has_edge,
    is_idle,
    roll_on_plane,
    roll_on_surface,
    rolls,
    shapes_at,
)
from closedloop.mechanics.contacts.soft import write_soft_forces
from closedloop.mechanics.limits import FAST, LARGEST_TURN
from closedloop.mechanics.loops.memory import ROWS, LoopRows, loops_at, tree_at
from closedloop.mechanics.loops.rows import ALONG, POINT, locate_rows, move_point, turn_direction
from closedloop.mechanics.loops.solve import leave_free
from closedloop.mechanics.surface.contact import CONTACT, FOUND, ask_at, edge_distance
from closedloop.mechanics.surface.geometry import Touch


@kernel
def locate_contacts(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> int:
    """Write rows, own mobility and free acceleration of the contacts, and what the stabiliser asks for.

    Those of a contact that is open, and not about to close, are zero: it costs its gap.

    Returns OK, or NO_NORMAL where a surface has none.
    """
    n = links.n
    if locate_points(links, c, w, constants, state) != OK:
        return NO_NORMAL
    locate_stops(links, c, w, constants)
    for i in range(3):
        c.located[i] = w.tip.gap if i == 0 else off_anchor(w, state, i)
        c.u[i], c.drift[i], c.a[i], c.carried[i], c.turning[i] = w.tip.u[i], w.tip.drift_c[i], w.tip.a[i], 0.0, 0.0
    c.friction.pulls[0] = 1.0 if state.settings.unilateral == 0 and c.mode[0] != FREE else 0.0
    c.past_edge[0] = state.past_edge
    c.inside[0] = w.tip.inside if state.surface.entry != 0 else math.inf
    for j in range(n):
        c.load[j] = c.problem.pushed[j] = w.y[j]
    for i in range(links.joints):
        if is_resistance(c, i):
            takes_part = c.near[int(c.friction.resistance.owner[i])] != 0.0
        else:
            takes_part = near(c, i) or (i == 0 and state.settings.unilateral == 0)
        if takes_part or c.near[i] != 0.0:
            write_mobility_rows(c, i, takes_part, w, state)
        c.near[i] = 1.0 if takes_part else 0.0
    if state.event.stepping == 0:
        own_mobilities(c, links.joints)
    for i in range(links.joints):
        for j in range(3 * i, 3 * i + 3 if c.near[i] != 0.0 else 0):
            off = c.located[j]
            if j > 3 * i and i > 0 and not asked(links, i):
                c.at[j] = c.located[j]
                off -= c.anchor[j]
            if j > 3 * i and links.shapes != 0 and wanders(links, i):
                off = 0.0  # what rolls without slip does not stay where it stuck
            c.b[j] = baumgarte_acceleration(constants.s_v, constants.s_p, c.u[j], off)
    take_states(links, c, w.z)
    write_delayed(c, w.time, constants.h, state.row - 1)
    if state.event.stepping == 0:
        write_soft_forces(links, c)
    return int(OK)


@kernel
def locate_points(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> int:
    """Write gaps, velocities and rows of the contacts of links; return OK, or NO_NORMAL where a surface has none."""
    joints, rows = loops_at(links.rows)
    for j in range(links.n):
        rows.q[j], rows.v[j] = w.q[j], w.v[j]
    for i in range(1, links.points):
        parted = c.mode[i] == FREE and c.friction.pulls[i] == 0.0
        rows.clear[3 * (i - 1)] = clear_gap(links, c, i) if parted else math.inf
        rows.beyond[3 * (i - 1)] = c.gaps.extent[i] + c.step.reach if parted else math.inf
    locate_rows(joints, rows)
    for i in range(1, links.points if links.shapes != 0 else 0):
        shapes = shapes_at(links.shapes)
        if rolls(shapes, i) and not asked(links, i) and not has_edge(shapes, i):
            if c.mode[i] == FREE and links.undecided == 0:
                shapes.rim.stands[i] = 0.0
            seats = links.undecided != 0 and touches(links, c, i)
            roll_on_plane(joints, rows, shapes, i, resolution(constants, state) * (1.0 if seats else 0.0))
    for i in range(1, links.points):
        if links.shapes != 0 and has_edge(shapes_at(links.shapes), i):
            write_edge_rows(joints, rows, shapes_at(links.shapes), c, i)
        else:
            take_rows(links, c, rows, i)
            foot = links.shapes != 0 and c.mode[i] == FREE and state.event.stepping == 0
            if foot and is_idle(shapes_at(links.shapes), c, i, resolution(constants, state)):
                c.located[3 * i] = APART
    for i in range(1, links.points if links.surfaces != 0 else 0):
        written = rows.written[3 * i - 3] == ROWS
        if asked(links, i) and not turn_to_surface(links, c, i, written, w.time, constants.h, state):
            return int(NO_NORMAL)
    if links.joints > links.points + links.stops:
        write_resistances(joints, rows, shapes_at(links.shapes), links, c)
    return int(OK)


@kernel
def take_rows(links: ContactLinks, c: Contacts, rows: LoopRows, i: int) -> None:
    """Take gap, place and velocity of contact i from its rows, and if these are written, what they are."""
    r, n = 3 * i - 3, 3 * i
    for a in range(3):
        c.located[n + a], c.u[n + a] = rows.error[r + a], rows.rate[r + a]
        if rows.written[r] != ROWS:
            continue
        c.drift[n + a] = rows.drift[r + a]
        to, of = row_of(c.G, n + a), row_of(rows.G, r + a)
        first, end = joints_of(c, i)
        for j in range(first, end):
            to[j] = of[j]


@kernel
def resolution(constants: Constants, state: State) -> float:
    """Return the length of a step, s, that discs which lie nearly flat are resolved by."""
    return LARGEST_TURN / FAST if state.settings.adaptive != 0 else constants.h


@kernel
def clear_gap(links: ContactLinks, c: Contacts, i: int) -> float:
    """Return the gap above which contact i, which has parted, is open: its rows are then not needed, only it.

    Of a surface that is asked for its normal, and of what rolls, they are at any gap.

    Of edges none are needed until some may cross, see `closedloop.mechanics.contacts.edges.write_edge_rows`.
    """
    if asked(links, i):
        return math.inf
    if links.shapes != 0 and has_edge(shapes_at(links.shapes), i):
        return -math.inf
    return math.inf if links.shapes != 0 and rolls(shapes_at(links.shapes), i) else c.step.reach


@kernel
def wanders(links: ContactLinks, i: int) -> bool:
    """Whether the place of contact i moves over the bodies while they do not slip."""
    shapes = shapes_at(links.shapes)
    return bool(rolls(shapes, i) or has_edge(shapes, i))


@kernel
def write_mobility_rows(c: Contacts, i: int, near: bool, w: Work, state: State) -> None:
    """Write X = L⁻¹Gᵀ of contact i, less what loops bind, and its free acceleration; zeros if it is not near."""
    at, (first, end) = 3 * i, joints_of(c, i)
    ends = integers_at(state.addresses.group_ends, state.n)
    for r in range(3):
        X, G = row_of(c.X, at + r), row_of(w.tip.A, r) if i == 0 else row_of(c.G, at + r)
        for j in range(first, end):
            if i == 0:
                c.G[r, j] = G[j]
            X[j] = (w.tip.X[r, j] if i == 0 else G[j]) if near else 0.0
    if not near:
        for r in range(at, at + 3):
            c.size[r] = 0.0
            if i > 0:
                c.a[r] = c.drift[r]
            for j in range(3):
                c.S[i, r - at, j] = 0.0
        return
    group = end if i == 0 else first
    while group < end:
        forward_substitute_three(w.L, c.X, at, group, ends[group])
        group = ends[group]
    x0, x1, x2 = row_of(c.X, at), row_of(c.X, at + 1), row_of(c.X, at + 2)
    d0, d1, d2 = c.drift[at], c.drift[at + 1], c.drift[at + 2]
    if i > 0:
        a0, a1, a2 = d0, d1, d2
        for j in range(first, end):
            y = w.y[j]
            a0, a1, a2 = a0 + x0[j] * y, a1 + x1[j] * y, a2 + x2[j] * y
        c.a[at], c.a[at + 1], c.a[at + 2] = a0, a1, a2
    if state.loops.entry != 0 and i > 0:
        bound, loops = loops_at(state.loops.at)
        for r in range(at, at + 3):
            leave_free(bound, loops, row_of(c.X, r))
    size0, size1, size2 = abs(d0), abs(d1), abs(d2)
    for j in range(first, end):
        y = w.y[j]
        size0, size1, size2 = size0 + abs(x0[j] * y), size1 + abs(x1[j] * y), size2 + abs(x2[j] * y)
    c.size[at], c.size[at + 1], c.size[at + 2] = size0, size1, size2


@kernel
def asked(links: ContactLinks, i: int) -> bool:
    """Whether the surface of contact i is asked for its normal."""
    return bool(links.surfaces != 0 and integers_at(links.surfaces, 2 * links.k)[2 * i] != 0)


@kernel
def turn_to_surface(
    links: ContactLinks, c: Contacts, i: int, written: bool, time: float, h: float, state: State
) -> bool:
    """Turn what is written of a contact from the axes of the frame that carries its surface to n, t1, t2 of that.

    Returns False where there is no normal, or a contact that touches comes to where there is none within the step h, s.
    """
    where, n = integers_at(links.surfaces, 2 * links.k), 3 * i
    own, ask = ask_at(where[2 * i + 1])
    ask.time = time
    for j in range(3):
        ask.r[j], ask.velocity[j] = c.located[n + j], c.u[n + j]
    answer = call_at(where[2 * i], own.address, CONTACT)
    if answer != FOUND:
        links.raised = 1 if answer == RAISED else 0
        return False
    touch, N = Touch(ask.touch), ask.frame
    c.inside[i] = edge_distance(touch.at, ask.bounds, ask.solid)
    if c.mode[i] != FREE and touch.growth * h < -1.0:
        return False
    first, end = joints_of(c, i)
    for j in range(first, end if written else first):
        g0, g1, g2 = c.G[n, j], c.G[n + 1, j], c.G[n + 2, j]
        for a in range(3):
            c.G[n + a, j] = N[a, 0] * g0 + N[a, 1] * g1 + N[a, 2] * g2
    d0, d1, d2 = (c.drift[n], c.drift[n + 1], c.drift[n + 2]) if written else (0.0, 0.0, 0.0)
    c.located[n] = touch.level / touch.size
    if c.mode[i] != FREE and 0.0 <= c.inside[i] < c.located[n]:  # left over the edge: the next face is near
        c.inside[i] = -c.located[n]
    for a in range(3):
        c.carried[n + a], c.turning[n + a], c.at[n + a] = touch.carried[a], touch.turning[a], touch.at[a]
        c.u[n + a] = N[a, 0] * ask.velocity[0] + N[a, 1] * ask.velocity[1] + N[a, 2] * ask.velocity[2]
        c.u[n + a] -= touch.carried[a]
        c.drift[n + a] = N[a, 0] * d0 + N[a, 1] * d1 + N[a, 2] * d2 + touch.turning[a]
        if a > 0:
            c.located[n + a] = 0.0
            for j in range(0 if flows(touch) else 3):
                c.located[n + a] += touch.local[a, j] * (touch.at[j] - c.anchor[n + j])
    if links.shapes != 0 and rolls(shapes_at(links.shapes), i):
        joints, rows = loops_at(links.rows)
        roll_on_surface(joints, rows, shapes_at(links.shapes), c, ask, i)
    return True


@kernel
def locate_stops(links: ContactLinks, c: Contacts, w: Work, constants: Constants) -> None:
    """Write rows, gaps and rates of the stops: of a joint, or a tendon, that is at none the nearer of its two."""
    for i in range(links.points, links.points + links.stops):
        at, r = 3 * i, int(c.joint[i])
        lower, upper = stops_of(constants, r)
        place = rate_along(constants, r, w.q)
        low, high = place - lower, upper - place
        if c.mode[i] == FREE:
            c.side[i] = 1.0 if low <= high else -1.0
        c.located[at] = low if c.side[i] > 0.0 else high
        c.u[at] = c.side[i] * rate_along(constants, r, w.v)
        for j in range(links.n):
            c.G[at, j] = c.side[i] * part_of(constants, r, j)


@kernel
def place_contacts(links: ContactLinks, c: Contacts, w: Work) -> None:
    """Write the axes of the contacts and where they are, base axes, at the state that was located last."""
    joints, rows = loops_at(links.rows)
    tree, work = tree_at(joints), vector_at(joints.scratch, joints.scratch_size)
    sides = integers_at(joints.bound, 3 * joints.m)
    for j in range(3):
        c.event.point[0, j] = w.r[j]
        for i in range(3):
            c.event.axes[i, j] = w.tip.frame[i, j]
    a, b = row_of(rows.motions, 0), row_of(rows.motions, 1)
    for r in range(joints.m):
        move_point(tree, work, sides[joints.m + r], row_of(rows.at_a, r), a)
        turn_direction(tree, work, sides[2 * joints.m + r], row_of(rows.along_b, r), b)
        for j in range(3):
            c.event.axes[3 + r, j], c.event.point[1 + r // 3, j] = b[ALONG + j], a[POINT + j]
    for i in range(1, links.points if links.shapes != 0 else 0):
        reach = row_of(shapes_at(links.shapes).reach, i)  # before the axes are turned to those of a curved surface
        for j in range(3):
            for m in range(3):
                c.event.point[i, j] += reach[m] * c.event.axes[3 * i + m, j]
    for i in range(1, links.points if links.shapes != 0 else 0):
        if has_edge(shapes_at(links.shapes), i):
            turn_axes(c, i, shapes_at(links.shapes).frame[i])
    for i in range(1, links.points if links.surfaces != 0 else 0):
        if asked(links, i):
            _, ask = ask_at(integers_at(links.surfaces, 2 * links.k)[2 * i + 1])
            turn_axes(c, i, ask.frame)
    for i in range(links.points, links.points + links.stops):
        for j in range(3):
            c.event.point[i, j] = w.r[j]


@kernel
def turn_axes(c: Contacts, i: int, N: Array) -> None:
    """Turn the axes x, y, z of contact i to n, t1, t2, the rows of N (3, 3)."""
    for j in range(3):
        x, y, z = c.event.axes[3 * i, j], c.event.axes[3 * i + 1, j], c.event.axes[3 * i + 2, j]
        for axis in range(3):
            c.event.axes[3 * i + axis, j] = N[axis, 0] * x + N[axis, 1] * y + N[axis, 2] * z


@kernel
def locate_joints(links: ContactLinks, c: Contacts, w: Work, constants: Constants, state: State) -> None:
    """Write what stands for the dry friction of each joint, and each tendon, in the search for modes.

    It is a contact whose normal force is the largest torque d that friction can give, N m (N), and whose slip is

        q̇/h + q̈        so that |F_t| <= d, and F_t holds the joint at the end of a step, or is against its motion

    the condition of `closedloop.loop.step.joint_friction`. Its normal force is known, as that of a soft contact.
    """
    first, n = links.joints, links.n
    if not joints_rub(links):
        return
    joint_limits(w, constants, state)
    for i in range(first, links.k):
        joint, at = i - first, 3 * i
        for r in range(at, at + 3):
            c.a[r], c.b[r], c.drift[r], c.viscous[r] = 0.0, 0.0, 0.0, 0.0
            for m in range(n):
                c.X[r, m] = 0.0
        for m in range(n):
            c.X[at + 1, m] = part_of(constants, joint, m)
        c.near[i], c.mu[i] = 1.0, 1.0
        forward_substitute(w.L, row_of(c.X, at + 1), 0, n)
        if state.loops.entry != 0:
            bound, loops = loops_at(state.loops.at)
            leave_free(bound, loops, row_of(c.X, at + 1))
        c.a[at + 1], c.size[at + 1] = rate_along(constants, joint, w.v) / constants.h, 0.0
        for m in range(n):
            c.a[at + 1] += c.X[at + 1, m] * c.problem.pushed[m]
            c.size[at + 1] += abs(c.X[at + 1, m] * c.load[m])
        c.problem.known[i] = w.joint_friction.limit[i - first]
    if state.event.stepping != 0:
        for i in range(first, links.k):
            c.u[3 * i + 1] = rate_along(constants, i - first, w.v)
    else:
        own_mobilities(c, links.k)


@kernel
def forget_joints(links: ContactLinks, c: Contacts) -> None:
    """Take out what `locate_joints` has written."""
    for i in range(links.joints, links.k):
        c.near[i] = 0.0
        for r in range(3 * i, 3 * i + 3):
            c.F[r], c.a[r] = 0.0, 0.0
            for m in range(links.n):
                c.X[r, m] = 0.0
