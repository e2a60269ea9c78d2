"""Time stepping: one problem of impulses for each step, and no events within it.

With G and the velocities u of a step's beginning, and the smooth forces held,

    u⁺ = u + h X L⁻¹(Q − C) + W P,     P ∈ K,     w + μ|u⁺_t| n ∈ K*,     Pᵀ(w + μ|u⁺_t| n) = 0,

    w = u⁺ + g/h n        of a contact with the gap g >= 0, which may close and does not sink in,
    w = u⁺                of one that is g < 0 deep,
    w = u⁺ - u' n         of one that strikes within the step and rebounds, u'² = e² u² but for what gravity does

and then q⁺ = q + h (q̇⁺ + L⁻ᵀ y) (J. J. Moreau, in Nonsmooth Mechanics and Applications, Springer, 1988; M. Jean,
Comput. Methods Appl. Mech. Eng. 177, 1999; the gap of D. E. Stewart and J. C. Trinkle, Int. J. Numer. Methods Eng. 39,
1996). With e the gap at the step's end, y = Xₙᵀ P is the shortest that puts back a tenth of what is deep, and nothing
into a surface: e/h + Xₙ y >= 0, or e/(10 h) + Xₙ y >= 0 where e < 0. It leaves no velocity, and has no friction.

The scheme is of first order, and costs the same however many contacts close, open, stick or slip. The forces of a step
are P/h: an impact is a large force of one step. Resistances and the dry friction of joints are in the same problem; a
soft contact presses with the force at the step's end, of the tangent of its law, so that no stiffness is too large for
the step.

Such steps follow, too, where modes change too often within a step of another integrator, until they stay
(`closedloop.loop.step.contacts.begin_stepping`).
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE
from closedloop.mechanics.contacts.joint_space import (
    ALONG,
    GIVEN,
    HOLDS,
    IN_CONE,
    OWNED,
    PUSHES,
    JointSpace,
    do_round,
    is_wedged,
    solve_softly,
    solve_step,
    start_at_rest,
)
from closedloop.mechanics.contacts.memory import INSIDE, ContactLinks, Contacts, joints_of
from closedloop.mechanics.contacts.resistance import is_resistance
from closedloop.mechanics.contacts.rolling import has_edge, shapes_at
from closedloop.mechanics.contacts.soft import force_at, soft_gap
from closedloop.mechanics.limits import FOUND, HALVINGS, HOVERING, SLIGHT, STICK_SPEED, STIFF, TENTH


@kernel
def look_ahead(c: Contacts, k: int, h: float) -> None:
    """Write the gap within which contacts take part in a step of h, s, by the velocities of the step before.

    Two contacts may come towards each other. In the first step there are no velocities yet, and all take part.
    """
    fastest = 0.0
    for i in range(3 * k):
        fastest = max(fastest, abs(c.u[i]))
    c.step.reach = HOVERING + 2.0 * h * (fastest + c.step.gained)


@kernel
def begin_step(links: ContactLinks, c: Contacts, load: Array, h: float, rest_speed: float) -> tuple[int, bool]:
    """Write F = P/h of a step of h, s, and the modes that it means.

    Returns OK, or PAINLEVE if none were found, and whether all modes are as they were.

    `load` (n,): L⁻¹(Q − C), less what loops bind.
    `rest_speed`: below which contacts without one of their own do not rebound, m/s.
    """
    s, n = c.stepping, links.n
    order_joints(c, s, links.k, n)
    a = write_problem(links, c, load, h, rest_speed, 1.0)
    s.associated = s.alike = 0.0
    rebounds = some_rebound(s, a)
    found = a == 0 or solve_step(s, a, n, FOUND if rebounds else SLIGHT)
    if rebounds and not (found and adds_no_energy(s, a)):
        found = lessen_restitution(links, c, load, h, rest_speed)
    if not found or is_wedged(s, a):
        write_problem(links, c, load, h, rest_speed, 0.0)
        if not solve_softly(s, a, n):
            return PAINLEVE, False
        c.problem.off = max(c.problem.off, s.residual)
    steady = True
    for i in range(links.k):
        at, pressed = int(s.packed_at[i]), 0.0
        for r in range(3):
            f = s.P[3 * at + r] / h if at >= 0 else 0.0
            c.F[3 * i + r] = c.rigid[3 * i + r] = c.step.force[3 * i + r] = f
        before = c.mode[i]
        if c.friction.pulls[i] == 0.0:
            c.mode[i] = FREE
        if at >= 0:
            pressed = abs(s.P[3 * at]) if s.normal[at] != OWNED else s.P[3 * int(s.given[at])]
        if pressed > 0.0:
            held = math.hypot(s.P[3 * at + 1], s.P[3 * at + 2]) < INSIDE * s.mu[at] * pressed
            c.mode[i] = STUCK if held else PRESSED
        steady = steady and c.mode[i] == before
    put_back(links, c, a, h)
    return OK, steady


@kernel
def some_rebound(s: JointSpace, a: int) -> bool:
    """Whether a contact is to rebound."""
    some = False
    for i in range(a):
        some = some or s.beside[i] < 0.0
    return some


@kernel
def adds_no_energy(s: JointSpace, a: int) -> bool:
    """Whether the impulses, but for springs', add none to the kinetic energy: Pᵀ(u + u⁺)/2 with u without them, J."""
    added, size = 0.0, 0.0
    for i in range(a):
        for r in range(0 if s.normal[i] <= HOLDS else 1, 3):
            beside = s.beside[i] if r == 0 else 0.0
            free, after = s.q[3 * i + r] - beside, s.u[3 * i + r] - beside
            added += s.P[3 * i + r] * (free + after)
            size += abs(s.P[3 * i + r]) * (abs(free) + abs(after))
    return bool(added <= FOUND * size)


@kernel
def lessen_restitution(links: ContactLinks, c: Contacts, load: Array, h: float, rest_speed: float) -> bool:
    """Lessen all rebounds of the step by one factor, the largest with which the impulses add no energy, or by all.

    Newton's law with friction creates energy (T. R. Kane, 1984), and where contacts are opposite each other, or
    friction pulls them in, there need be no impulses: `closedloop.mechanics.contacts.impact` does likewise. Returns
    whether they were found.
    """
    s, n, low, high = c.stepping, links.n, 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        a = write_problem(links, c, load, h, rest_speed, middle)
        if solve_step(s, a, n, FOUND) and adds_no_energy(s, a):
            low = middle
        else:
            high = middle
    return bool(solve_step(s, write_problem(links, c, load, h, rest_speed, low), n, FOUND))


@kernel
def put_back(links: ContactLinks, c: Contacts, a: int, h: float) -> None:
    """Write h y in `shift`, of the a contacts that are packed with their velocities after the step, if any is deep."""
    s, deepest = c.stepping, 0.0
    for i in range(a):
        gap, pushes = c.located[3 * int(s.number[i])], s.normal[i] == PUSHES
        e = s.u[3 * i] * h + (min(gap, 0.0) if pushes else gap)  # a gap is in u already
        if s.normal[i] > HOLDS:
            s.normal[i], s.given[i], s.falls[i], e = GIVEN, 0.0, 0.0, 0.0
        deepest = max(deepest, -e if pushes else abs(e))
        s.q[3 * i], s.q[3 * i + 1], s.q[3 * i + 2] = (e if pushes and e >= 0.0 else TENTH * e) / h, 0.0, 0.0
        s.tangent[i], s.ahead[i, 0], s.ahead[i, 1] = ALONG, 0.0, 0.0
    c.step.shifts = 1.0 if deepest > HOVERING else 0.0
    if c.step.shifts != 0.0:
        s.associated, s.residual = 1.0, FOUND
        start_at_rest(s, a, links.n)
        do_round(s, a, links.n, STIFF)
        for j in range(links.n):
            c.step.shift[j] = h * s.y[int(s.order[j])]


@kernel
def write_problem(links: ContactLinks, c: Contacts, load: Array, h: float, rest_speed: float, share: float) -> int:
    """Write the contacts that take part, packed, with rebounds times `share`; return their number."""
    s, a, n, gained = c.stepping, 0, links.n, 0.0
    s.asked = s.held = 0.0
    for i in range(links.k):
        s.packed_at[i] = -1.0
        if c.near[i] == 0.0:
            c.gaps.cleared[i] = 0.0  # when it comes near again `belongs_here` says whether from above
            continue
        if not takes_part(links, c, i, h, s, a):
            continue
        s.number[a], s.mu[a] = i, c.mu[i]
        first, end = joints_of(c, i)
        low, high = n, 0
        for j in range(first, end):
            if c.X[3 * i, j] != 0.0 or c.X[3 * i + 1, j] != 0.0 or c.X[3 * i + 2, j] != 0.0:
                low, high = min(low, int(s.order[j])), max(high, int(s.order[j]) + 1)
        s.first[a], s.end[a], s.mobility[a] = low, high, 0.0
        for r in range(3):
            from_row, to_row, square, growth = row_of(c.X, 3 * i + r), row_of(s.X, 3 * a + r), 0.0, 0.0
            for j in range(low, high):
                to_row[j] = 0.0
            for j in range(first, end):
                x = from_row[j]
                if x != 0.0:
                    to_row[int(s.order[j])] = x
                square += x * x
                growth += x * load[j]
            s.mobility[a] = max(s.mobility[a], square)
            s.q[3 * a + r] = c.u[3 * i + r] + h * growth
            s.asked, gained = max(s.asked, abs(c.u[3 * i + r])), max(gained, h * abs(growth))
            s.P[3 * a + r] = h * c.step.force[3 * i + r]
        if not s.mobility[a] > 0.0:
            continue
        if c.soft[i] != 0.0 and not write_softness(links, c, i, s, a, h):
            continue
        s.beside[a] = 0.0
        if s.normal[a] <= HOLDS:
            beside = allowed(c, i, s.q[3 * a], h, rest_speed)
            s.beside[a] = beside * share if beside < 0.0 else beside
            s.q[3 * a] += s.beside[a]
        s.packed_at[i] = a
        a += 1
    c.step.gained = gained if a > 0 else c.step.gained
    s.asked = max(s.asked, c.step.gained)
    return a


@kernel
def takes_part(links: ContactLinks, c: Contacts, i: int, h: float, s: JointSpace, a: int) -> bool:
    """Write the kind of contact i as number a of the problem, and its normal impulse, if that is given."""
    s.normal[a], s.tangent[a], s.given[a], s.falls[a] = GIVEN if c.soft[i] != 0.0 else PUSHES, IN_CONE, 0.0, 0.0
    if i >= links.joints:
        s.normal[a], s.given[a] = GIVEN, h * c.problem.known[i]
        return bool(s.given[a] > 0.0)
    if is_resistance(c, i):
        s.normal[a], s.given[a] = OWNED, s.packed_at[int(c.friction.resistance.owner[i])]
        return bool(s.given[a] >= 0.0)
    if c.friction.pulls[i] != 0.0 and c.soft[i] == 0.0:
        s.normal[a] = HOLDS
    return bool(c.friction.pulls[i] != 0.0 or belongs_here(links, c, i))


@kernel
def write_softness(links: ContactLinks, c: Contacts, i: int, s: JointSpace, a: int, h: float) -> bool:
    """Write the normal impulse of soft contact i at the end of the step by its speed there; whether there is any.

    It is that of the tangent of its law f(depth, rate) where it would be without a force.
    """
    u, gap = s.q[3 * a], soft_gap(c, i)
    f = force_at(links, i, -gap - h * u, -u)
    if not f > 0.0:
        return False
    s.falls[a] = h * max(f - force_at(links, i, -gap - h * (u + STICK_SPEED), -u - STICK_SPEED), 0.0) / STICK_SPEED
    s.given[a] = h * f + s.falls[a] * u
    return True


@kernel
def belongs_here(links: ContactLinks, c: Contacts, i: int) -> bool:
    """Whether contact i is at its own surface: nearer to it than to its edge when it came, and not beyond that since.

    What comes from beside, or edges that begin to cross, may be deep below it at once; then another contact is nearer.
    Edges belong to each other where they have come from above within a step.
    """
    edges = links.shapes != 0 and has_edge(shapes_at(links.shapes), i)
    if c.inside[i] < 0.0:
        c.gaps.cleared[i] = 0.0
    elif c.located[3 * i] >= -(min(c.inside[i], c.step.reach) if edges else c.inside[i]):
        c.gaps.cleared[i] = 1.0
    return bool(c.gaps.cleared[i] != 0.0)


@kernel
def allowed(c: Contacts, i: int, coming: float, h: float, rest_speed: float) -> float:
    """Return what is added to the velocity of contact i along its normal, m/s, for the w of the problem.

    A rebound begins at the gap g and ends at g + h u⁺: u⁺ has the energy e² of what would have been at the surface.
    """
    gap, u, slowest = c.located[3 * i], c.u[3 * i], c.rest_speed[i] if c.rest_speed[i] > 0.0 else rest_speed
    if c.friction.pulls[i] != 0.0:
        return 0.0
    g = max(u - coming, 0.0) / h  # what accelerates it towards the surface, m/s²
    left = c.restitution[i] ** 2 * (u * u + 2.0 * g * gap) - 2.0 * g * gap
    rebound = math.sqrt(g * g * h * h + left) - g * h if left > 0.0 else 0.0
    if rebound > slowest and u < 0.0 and gap + h * coming <= 0.0:
        return float(-rebound)
    return float(max(gap, 0.0) / h)


@kernel
def order_joints(c: Contacts, s: JointSpace, k: int, n: int) -> None:
    """Write the place of each joint: bodies that touch stand near each other, so that the matrix has a narrow band.

    The order is that of E. Cuthill and J. McKee (ACM National Conference, 1969), reversed (J. A. George, 1971), of the
    groups of joints, and of the contacts that are near. A step of twenty boxes in a bin takes half of the time with it.
    Groups go by their first joint; `matrix` is scratch: whom each has beside it.
    """
    degree, length, queue = row_of(s.row, 0), row_of(s.row, 1), row_of(s.row, 2)
    for j in range(n):
        degree[j], s.order[j] = 0.0, -1.0
    for i in range(k):
        one, other = int(c.moves.first[i]), int(c.moves.again[i])
        if c.near[i] != 0.0 and other > one:
            length[one], length[other] = c.moves.upto[i] - one, c.moves.end[i] - other
            stand_beside(s, one, other)
            stand_beside(s, other, one)
    place = n
    while True:
        first = -1
        for j in range(n):
            if degree[j] > 0.0 and s.order[j] < 0.0 and (first < 0 or degree[j] < degree[first]):
                first = j
        if first < 0:
            break
        queue[0], done, found, s.order[first] = first, 0, 1, n
        while done < found:
            group, done = int(queue[done]), done + 1
            place -= int(length[group])
            for j in range(int(length[group])):
                s.order[group + j] = place + j
            other = next_beside(s, group)
            while other >= 0:
                queue[found], found, s.order[other] = other, found + 1, n
                other = next_beside(s, group)
    for j in range(n - 1, -1, -1):
        if s.order[j] < 0.0:
            place -= 1
            s.order[j] = place


@kernel
def next_beside(s: JointSpace, group: int) -> int:
    """Return the group that touches fewest, of those without a place that stand beside this one; or -1."""
    degree, found = row_of(s.row, 0), -1
    for m in range(int(degree[group])):
        other = int(s.matrix[group, m])
        if s.order[other] < 0.0 and (found < 0 or degree[other] < degree[found]):
            found = other
    return found


@kernel
def stand_beside(s: JointSpace, one: int, other: int) -> None:
    """Note that a group touches another, once."""
    count = int(s.row[0, one])
    for m in range(count):
        if s.matrix[one, m] == other:
            return
    s.matrix[one, count], s.row[0, one] = other, count + 1.0
