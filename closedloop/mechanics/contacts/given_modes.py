"""Forces where it is known which contacts are free, slide or stick: linear equations, as long as no mode ends.

A contact that sticks has the three rows u̇ = b, one that slides u̇_n = b_n with F = f (1, −μ d), one that pulls as well
u̇_n = b_n with F_t = −c f − w. Rows that depend on others are found at run time; the forces are then not unique, and
those of least norm are taken (`closedloop.mechanics.contacts.least_norm`).
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, IMMOBILE, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE, SINGULAR
from closedloop.mechanics.contacts.friction import slide, write_limits
from closedloop.mechanics.contacts.least_norm import least_norm
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, RAY, SPRING_STICK, ContactLinks, Contacts
from closedloop.mechanics.contacts.mobility import write_mobility
from closedloop.mechanics.contacts.resistance import (
    add_turning,
    has_resistance,
    is_resistance,
    mode_of_resistance,
    moved_by_turning,
)
from closedloop.mechanics.contacts.shortest import (
    CONTRADICTS,
    SAME_ROW,
    independent_rows,
    shortest_solutions,
    solve_any_rank,
)
from closedloop.mechanics.contacts.soft import write_shared
from closedloop.mechanics.contacts.sticking import all_stick, shortest_sticking
from closedloop.mechanics.loops.solve import orthonormal_rows

# What is outside its cone by no more than this share of `rounding` is at its edge; by no more than so many times
# `rounding` it is neither outside nor pulls.
ON_EDGE, NEARLY = 1e-3, 10.0
# Impulses so many times those that are asked for are none: contacts are wedged, but for rounding. Speeds below the
# second, m/s, may be left to the stabiliser.
MOST_IMPULSE, NEGLIGIBLE = 1e3, 1e-7


@kernel
def sticks(c: Contacts, i: int) -> bool:
    """Whether contact i has three rows in the problem, not one."""
    return bool(c.problem.form[i] in (CONE, DOUBLE))


@kernel
def kinds_of_modes(links: ContactLinks, c: Contacts) -> None:
    """Write the kind of each contact by its mode, and F_t = −along f − viscous of one that slides."""
    write_limits(links, c)
    for i in range(links.k):
        c.problem.form[i] = OFF
        c.viscous[3 * i + 1], c.viscous[3 * i + 2] = 0.0, 0.0
        pulls = c.friction.pulls[i] != 0.0
        if is_resistance(c, i) and mode_of_resistance(c, i) == FREE:
            c.mode[i] = FREE  # whatever has opened its owner
        if c.mode[i] == STUCK and c.friction.sticks[i] != SPRING_STICK:
            c.problem.form[i] = DOUBLE if pulls else CONE
        elif pulls or c.mode[i] != FREE:
            c.problem.form[i] = LINE if pulls else RAY
            slide(links, c, i, c.mode[i] == STUCK)
    write_shared(links, c)


@kernel
def solve_modes(c: Contacts, k: int, inside: bool = True) -> int:
    """Write `rigid`, the force of the contacts in their modes, F with the stabiliser's part, and `rounding`.

    X, W, a, size, b, viscous, kind and along are read. Forces that are not unique are those of least norm inside the
    cones, if there are such. Where only the motion that they make is of use, `inside` is False: no cones are looked at.

    Returns OK; SINGULAR: the rows contradict each other; PAINLEVE: the only contact slides so that a larger force
    pulls it in.
    """
    most = 0.0
    for i in range(3 * k):
        c.rigid[i] = 0.0 - c.viscous[i]  # not -0.0
        c.F[i] = c.rigid[i]
        most = max(most, c.W[i, i])
    p = list_unknowns(c, k, most)
    c.problem.rounding = 0.0
    if p == 0:
        return OK
    if p == 1 and pulled_in(c, int(c.scratch.unknown[0]) // 3):
        return PAINLEVE
    asked = shortest_sticking(c, p) if all_stick(c, k, p) else 0.0 * most - 1.0
    found, shared = asked >= 0.0, False
    if not found:
        asked = write_system(c, k, p)
        rank = independent_rows(c, p)
        found = shared = rank < p and shortest_solutions(c, p, rank, asked)
    if found:
        write_forces(c, p)
        within = not inside or (inside_cones(c, k, c.rigid) and inside_cones(c, k, c.F))
        if within or shared:
            if not within:
                share_forces(c, k, p)
            c.problem.rounding = rounding_of(c, k, asked / most)
            return OK
        for i in range(3 * k):
            c.rigid[i] = 0.0 - c.viscous[i]
            c.F[i] = c.rigid[i]
        asked = write_system(c, k, p)
    for i in range(p):
        for j in range(p):
            c.scratch.unknowns[i, j] = c.scratch.system[i, j]
    rank = solve_any_rank(c.scratch.system, p, 2, c.scratch.column_order, c.scratch.solution, SAME_ROW)
    write_forces(c, p)
    if rank < p:
        for i in range(p):
            left = -c.scratch.sought[i]
            for j in range(p):
                left += c.scratch.unknowns[i, j] * c.scratch.solution[0, j]
            if not abs(left) <= CONTRADICTS * asked:
                return SINGULAR
        if inside:
            share_forces(c, k, p)
    c.problem.rounding = rounding_of(c, k, asked / most)
    return OK


@kernel
def rounding_of(c: Contacts, k: int, asked: float) -> float:
    """Return the force below which there is none, of those in `rigid` and the force that is asked for, N."""
    size = asked
    for i in range(3 * k):
        size = max(size, abs(c.rigid[i]))
    return 1e-10 * size


@kernel
def write_forces(c: Contacts, p: int) -> None:
    """Add to `rigid` and F what the unknowns in `solution` stand for."""
    for j in range(p):
        row = int(c.scratch.unknown[j])
        add_unknown(c, row, c.scratch.solution[0, j], c.rigid)
        add_unknown(c, row, c.scratch.solution[1, j], c.F)


@kernel
def inside_cones(c: Contacts, k: int, F: Array) -> bool:
    """Whether forces F press and are inside their cones, those of the contacts that only press."""
    for i in range(k):
        n, mu = 3 * i, c.mu[i]
        if c.problem.form[i] == RAY and F[n] < 0.0:
            return False
        if sticks(c, i):
            within = mu * mu * F[n] * F[n] - F[n + 1] * F[n + 1] - F[n + 2] * F[n + 2]
            if (c.problem.form[i] == CONE and F[n] < 0.0) or within < 0.0:
                return False
    return True


@kernel
def share_forces(c: Contacts, k: int, p: int) -> None:
    """Replace `rigid` and F, which are not unique, by the shortest that do the same; soft contacts keep theirs."""
    m = 3 * k
    span_rows(c, k, p)
    take_soft_out(c, k)
    for i in range(m):
        c.scratch.trial[i] = c.F[i] - c.rigid[i]
        c.problem.after[i] = c.scratch.trial[i]
    if not least_inside(c, k, c.rigid):
        least_norm(c, k, c.rigid, False)
    if not least_inside(c, k, c.F):
        for i in range(m):
            c.F[i] = c.problem.after[i] - c.viscous[i]
        least_norm(c, k, c.F, False)
        for i in range(m):
            c.F[i] += c.rigid[i] + c.viscous[i]
    put_soft_back(c, k)


@kernel
def take_soft_out(c: Contacts, k: int) -> None:
    """Keep the forces and the form of soft contacts, and let these be open."""
    for i in range(k):
        c.scratch.mu[i] = c.problem.form[i]
        for r in range(3 * i, 3 * i + 3 if c.soft[i] != 0.0 else 0):
            c.scratch.residuals[r], c.problem.q[r] = c.rigid[r], c.F[r]
            c.rigid[r], c.F[r] = -c.viscous[r], -c.viscous[r]
        if c.soft[i] != 0.0:
            c.problem.form[i] = OFF


@kernel
def put_soft_back(c: Contacts, k: int) -> None:
    """Write the forces and the form of soft contacts that `take_soft_out` has kept."""
    for i in range(k):
        for r in range(3 * i, 3 * i + 3 if c.soft[i] != 0.0 else 0):
            c.rigid[r], c.F[r] = c.scratch.residuals[r], c.problem.q[r]
        c.problem.form[i] = int(c.scratch.mu[i])


@kernel
def least_inside(c: Contacts, k: int, force: Array) -> bool:
    """Do `least_norm` inside the cones: of what also pulls, that of the sign of f that the force has, or the other."""
    pulls = False
    for i in range(k):
        c.friction.sense[i] = 1.0 if force[3 * i] >= 0.0 else -1.0
        pulls = pulls or c.problem.form[i] == DOUBLE
    if least_norm(c, k, force, True):
        return True
    for i in range(k):
        c.friction.sense[i] = -c.friction.sense[i]
    return pulls and least_norm(c, k, force, True)


@kernel
def keep_in_cones(c: Contacts, k: int) -> None:
    """Lessen the stabiliser's part of all forces by one factor, so that no force pulls or leaves its cone by it."""
    share = 1.0
    for i in range(k):
        if c.problem.form[i] == RAY or c.problem.form[i] == CONE:
            share = min(share, share_inside(c, i))
    if share < 1.0:
        for i in range(3 * k):
            c.F[i] = c.rigid[i] + share * (c.F[i] - c.rigid[i])
            if i % 3 == 0 and c.rigid[i] >= 0.0 > c.F[i] and c.friction.pulls[i // 3] == 0.0:
                c.F[i] = 0.0  # rounding


@kernel
def share_inside(c: Contacts, i: int) -> float:
    """Return the largest share <= 1 of the stabiliser's part of contact i with which its force is in its cone.

    1.0 where the force without that part is outside: the contact's mode ends there. 0.0 where that is hardly so.
    """
    n, mu = 3 * i, c.mu[i]
    f, grown = c.rigid[n], c.F[n] - c.rigid[n]
    if f < -c.problem.rounding:
        return 0.0 if f > -NEARLY * c.problem.rounding else 1.0
    share = 1.0 if c.F[n] >= 0.0 else max(0.0, f) / (max(0.0, f) - c.F[n])
    # The shortest of forces that are not unique is often at the cone's edge, but for rounding.
    if c.problem.form[i] == RAY or mu * c.F[n] + ON_EDGE * c.problem.rounding >= math.hypot(c.F[n + 1], c.F[n + 2]):
        return share
    r1, r2, d1, d2 = c.rigid[n + 1], c.rigid[n + 2], c.F[n + 1] - c.rigid[n + 1], c.F[n + 2] - c.rigid[n + 2]
    # The first root of (μ (f + s df))² − |F_t + s dF_t|², a parabola in s that is positive at 0.
    a, half = (mu * grown) * (mu * grown) - d1 * d1 - d2 * d2, mu * mu * f * grown - r1 * d1 - r2 * d2
    inside = (mu * f) * (mu * f) - r1 * r1 - r2 * r2
    if not inside > 0.0:
        return 0.0 if math.hypot(r1, r2) <= mu * f + NEARLY * c.problem.rounding else 1.0
    below = math.sqrt(max(0.0, half * half - a * inside)) - half
    return min(share, inside / below) if below > 0.0 else share


@kernel
def pulled_in(c: Contacts, i: int) -> bool:
    """Whether contact i, alone, slides so that a larger force does not push it out."""
    at = 3 * i
    own = c.W[at, at] - c.W[at, at + 1] * c.problem.along[i, 0] - c.W[at, at + 2] * c.problem.along[i, 1]
    own += moved_by_turning(c, at, i)
    return bool(
        c.problem.form[i] == RAY and not own > 1e-12 * (c.W[at, at] + c.W[at + 1, at + 1] + c.W[at + 2, at + 2])
    )


@kernel
def span_rows(c: Contacts, k: int, p: int) -> None:
    """Write in `Y` what of X the p equations of the unknowns see, in an orthonormal basis of their rows.

    Forces with the same Yᵀ F give the rows the same acceleration. They move the tree alike too, unless a contact
    slides: the friction of contacts that share a normal force otherwise is another.
    """
    n, has_friction = c.X.shape[1], False
    for i in range(k):
        slides = c.problem.along[i, 0] != 0.0 or c.problem.along[i, 1] != 0.0
        has_friction = has_friction or (c.problem.form[i] != OFF and slides)
    rank = n
    if has_friction:
        for r in range(p):
            for j in range(n):
                c.scratch.basis[r, j] = c.X[int(c.scratch.unknown[r]), j]
        rank = orthonormal_rows(c.scratch.basis, p, c.scratch.column_order, c.scratch.unknowns, c.scratch.sought)
    for i in range(3 * k):
        off = c.problem.form[i // 3] == OFF
        for j in range(n):
            c.scratch.Y[i, j] = 0.0 if has_friction or off else c.X[i, j]
        for r in range(rank if has_friction and not off else 0):
            for j in range(n):
                c.scratch.Y[i, r] += c.X[i, j] * c.scratch.basis[r, j]


@kernel
def stopping_impulses(c: Contacts, k: int) -> None:
    """Write in F the impulses that take the velocities `before` along the rows of the kinds; none if there are none."""
    for i in range(3 * k):
        c.problem.q[i], c.problem.after[i] = c.viscous[i], c.a[i]
        c.a[i], c.b[i], c.viscous[i] = c.before[i], 0.0, 0.0
    status = solve_modes(c, k, False)
    for i in range(3 * k):
        c.a[i], c.viscous[i] = c.problem.after[i], c.problem.q[i]
        c.F[i] = c.rigid[i] if status == OK else 0.0


@kernel
def stop(links: ContactLinks, c: Contacts, k: int) -> bool:
    """Do `stopping_impulses` and write `after`; return False where impulses are far larger than the little they stop.

    Rows of shapes that hardly differ, as of edges that cross beside a corner, are then moved by opposite impulses.
    Impulses and speeds are compared as roots of energies, so that those of a row count alike in all its units.
    """
    stopping_impulses(c, k)
    write_after(c, k)
    moves, before, most = 0.0, 0.0, 0.0
    for i in range(k):
        if c.problem.form[i] != OFF:
            for r in range(3 * i, 3 * i + (3 if sticks(c, i) else 1)):
                moves, root = max(moves, abs(c.before[r])), math.sqrt(c.W[r, r])
                before = max(before, abs(c.before[r]) / root if root > 0.0 else 0.0)
                most = max(most, abs(c.F[r]) * root)
    return bool(links.shapes == 0 or moves > NEGLIGIBLE or most <= MOST_IMPULSE * before)


@kernel
def write_after(c: Contacts, k: int) -> None:
    """Write in `after` the velocities u⁺ = u⁻ + W P that the impulses in F leave of `before`."""
    write_mobility(c, k)
    for i in range(3 * k):
        s = c.before[i]
        for j in range(3 * k):
            s += c.W[i, j] * c.F[j]
        c.problem.after[i] = s


@kernel
def energy_gained(c: Contacts, k: int) -> float:
    """Return the kinetic energy that the impulses give, Pᵀ(u⁻ + u⁺)/2, J; zero if it is rounding."""
    gained, size = 0.0, 0.0
    for i in range(3 * k):
        gained += 0.5 * c.F[i] * (c.before[i] + c.problem.after[i])
        size += abs(c.F[i]) * (abs(c.before[i]) + abs(c.problem.after[i]))
    return gained if abs(gained) > 1e-13 * size else 0.0


@kernel
def list_unknowns(c: Contacts, k: int, most: float) -> int:
    """Write which rows an active contact has: 3 i + 0, 1, 2; those that no joint moves are left out."""
    p = 0
    for i in range(k):
        if c.problem.form[i] == OFF:
            continue
        first, last = 0, 3 if sticks(c, i) else 1
        if is_resistance(c, i):
            first, last = 1, last if last == 3 else 1  # its normal force is its owner's
        for j in range(first, last):
            if c.W[3 * i + j, 3 * i + j] > IMMOBILE * 1e-6 * most:
                c.scratch.unknown[p] = 3 * i + j
                p += 1
    return p


@kernel
def add_unknown(c: Contacts, row: int, value: float, force: Array) -> None:
    """Add what an unknown stands for to a force: a component of one that sticks, f of one that slides."""
    force[row] += value
    i = row // 3
    if row % 3 == 0:
        add_turning(c, i, value, force)
    if not sticks(c, i):
        force[row + 1] -= c.problem.along[i, 0] * value
        force[row + 2] -= c.problem.along[i, 1] * value


@kernel
def write_system(c: Contacts, k: int, p: int) -> float:
    """Write the equations of the unknowns with −a and b on the right; return the size of the terms on the right."""
    write_mobility(c, k)
    asked, slides, viscous = 0.0, False, False
    W, S, unknown = c.W, c.scratch.system, c.scratch.unknown
    for q in range(p):
        i = int(unknown[q]) // 3
        slides = slides or not sticks(c, i) or has_resistance(c, i)
    for j in range(3 * k):
        viscous = viscous or c.viscous[j] != 0.0
    for r in range(p):
        row, s = int(unknown[r]), 0.0
        for j in range(3 * k if viscous else 0):
            if c.viscous[j] != 0.0:
                s -= W[row, j] * c.viscous[j]
        for q in range(p):
            S[r, q] = W[row, int(unknown[q])]
        for q in range(p if slides else 0):
            column = int(unknown[q])
            i = column // 3
            if not sticks(c, i):
                S[r, q] -= W[row, column + 1] * c.problem.along[i, 0] + W[row, column + 2] * c.problem.along[i, 1]
            if column % 3 == 0:
                S[r, q] += moved_by_turning(c, row, i)
        c.scratch.sought[r] = -c.a[row] - s
        S[r, p], S[r, p + 1] = c.scratch.sought[r], c.scratch.sought[r] + c.b[row]
        asked = max(asked, c.size[row] + abs(c.b[row]))
    return asked
