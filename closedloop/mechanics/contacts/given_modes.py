"""Forces where it is known which contacts are free, slide or stick: linear equations, as long as no mode ends.

A contact that sticks has the three rows u̇ = b, one that slides u̇_n = b_n with F = f (1, −μ d), one that pulls as well
u̇_n = b_n with F_t = −c f − w. With these rows R of X = L⁻¹Gᵀ, what the unknowns x do to the joints, y = Cᵀ x, obeys

    R y = s,     s = b − a

Rows that depend on others are found at run time: y is then that of the span of R, of least squares where the rows
contradict each other by rounding. Forces are then not unique, and those of least norm are taken, xᵀ D x with D the
squares of what the unknowns stand for:

    y = (RᵀR)⁻¹ Rᵀ s,     x = D⁻¹ C z,     CᵀD⁻¹C z = y

These are equations of the joints alone, however many contacts there are. Elimination keeps to what is not zero: bodies
on each other couple neighbours. Where the shortest are outside the cones the shortest inside are taken, if there are
any (`closedloop.mechanics.contacts.joint_space.find_least`).
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE, IMMOBILE, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE, SINGULAR
from closedloop.mechanics.contacts.friction import slide, write_limits
from closedloop.mechanics.contacts.joint_space import OWNED, find_least
from closedloop.mechanics.contacts.memory import (
    CONE,
    DOUBLE,
    LINE,
    OFF,
    RAY,
    SPRING_STICK,
    ContactLinks,
    Contacts,
    GivenModes,
    joints_of,
)
from closedloop.mechanics.contacts.mobility import added, force_size, write_motion
from closedloop.mechanics.contacts.resistance import (
    add_turning,
    is_resistance,
    mode_of_resistance,
    resistance_of,
    square_of_turning,
    turns_with,
)
from closedloop.mechanics.contacts.soft import write_shared
from closedloop.mechanics.contacts.unknown_modes import is_known, pack_contacts
from closedloop.mechanics.limits import (
    DEPENDENT,
    EXACT,
    FOUND,
    MOST_GROWTH,
    NEAR,
    REFINEMENTS,
    SLIGHT,
    SMALL,
    STICK_SPEED,
    STIFF,
)
from closedloop.mechanics.loops.solve import orthonormal_basis


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
def solve_modes(links: ContactLinks, c: Contacts, inside: bool = True) -> int:
    """Write `rigid`, the force of the contacts in their modes, F with the stabiliser's part, and `rounding`.

    X, a, size, b, viscous, known, form and along are read. Forces that are not unique are those of least norm inside
    the cones, if there are such. Where only the motion that they make is of use, `inside` is False: no cones are looked
    at.

    Returns OK; SINGULAR: the rows contradict each other, or rounding is in the way; PAINLEVE: the only contact slides
    so that a larger force pulls it in.
    """
    k, g, most, asked = links.k, c.given, 0.0, 0.0
    for i in range(k):
        for r in range(3 if c.problem.form[i] != OFF else 0):
            most = max(most, c.S[i, r, r])
            if r == 0 or sticks(c, i):
                asked = max(asked, c.size[3 * i + r] + abs(c.b[3 * i + r]))
    write_known(links, c)
    p = list_unknowns(links, c, most)
    c.problem.rounding, c.problem.beyond = rounding_of(c, k, asked / most) if most > 0.0 else 0.0, 0.0
    if p == 0:
        return OK
    if p == 1 and pulled_in(c, int(g.row[0]) // 3):
        return PAINLEVE
    write_motion(c, k, c.rigid)
    for q in range(p):
        row = int(g.row[q])
        g.left[0, q] = -c.a[row] - added(c, row)
        g.left[1, q] = g.left[0, q] + c.b[row]
    write_rows(c, p)
    found = moved_joints(c, p, asked) and spread(c, p)
    for q in range(p if found else 0):
        add_unknown(c, int(g.row[q]), g.x[0, q], c.rigid)
        add_unknown(c, int(g.row[q]), g.x[1, q], c.F)
    if not found:
        return SINGULAR
    if inside and p > g.rank and not (inside_cones(c, k, c.rigid) and inside_cones(c, k, c.F)):
        share_forces(links, c)
    c.problem.rounding = rounding_of(c, k, asked / most)
    return OK


@kernel
def rounding_of(c: Contacts, k: int, asked: float) -> float:
    """Return the force below which there is none, of those in `rigid` and the force that is asked for, N."""
    return DEPENDENT * max(asked, force_size(c.rigid[: 3 * k]))


@kernel
def write_known(links: ContactLinks, c: Contacts) -> None:
    """Write in `rigid` and F what is known of the forces: the normal force of soft contacts, with what goes with it."""
    for r in range(3 * links.k):
        c.rigid[r] = 0.0 - c.viscous[r]  # not -0.0
    for i in range(links.k):
        if is_known(links, c, i) and c.problem.form[i] != OFF:
            add_unknown(c, 3 * i, c.problem.known[i], c.rigid)
    for r in range(3 * links.k):
        c.F[r] = c.rigid[r]


@kernel
def list_unknowns(links: ContactLinks, c: Contacts, most: float) -> int:
    """Write which rows an active contact has, 3 i + 0, 1, 2, and D⁻¹; those that no joint moves are left out."""
    p, g = 0, c.given
    for i in range(links.k):
        if c.problem.form[i] == OFF:
            continue
        first, last, stuck = 0, 3, sticks(c, i)
        if is_resistance(c, i) or is_known(links, c, i):
            first = 1  # its normal force is its owner's, or known
        if not stuck:
            last = 1
        for j in range(first, last):
            if c.S[i, j, j] > IMMOBILE * SLIGHT * most:
                square = 1.0
                if not stuck:
                    along = row_of(c.problem.along, i)
                    square += along[0] * along[0] + along[1] * along[1]
                if j == 0:
                    square += square_of_turning(c, i)
                g.row[p], g.weight[p], g.plain[p] = 3 * i + j, 1.0 / square, 1.0 if square == 1.0 else 0.0
                p += 1
    return p


@kernel
def write_rows(c: Contacts, p: int) -> None:
    """Write R and C of p unknowns, as they are, or along an orthonormal basis of R where this has fewer than n."""
    g, n, slides = c.given, c.X.shape[1], False
    for q in range(p):
        row = int(g.row[q])
        i = row // 3
        first, end = joints_of(c, i)
        g.first[q], g.end[q] = first, end
        of, to, column = row_of(c.X, row), row_of(g.R, q), row_of(g.C, q)
        for j in range(first, end):
            to[j] = column[j] = of[j]
        if g.plain[q] == 0.0:
            slides = True
            if not sticks(c, i):
                add_tangents(c, column, i, i)
            for which in range(2):
                s = resistance_of(c, i, which)
                if row % 3 == 0 and turns_with(c, s):
                    add_tangents(c, column, s, i)
    g.rank, g.slides, g.whole = n, 1.0 if slides else 0.0, 1.0
    if p >= n and factor(g, g.factor, g.R, p, n, False):
        return
    g.whole = 0.0
    for q in range(p):
        for j in range(n):
            g.basis[q, j] = g.R[q, j] if g.first[q] <= j < g.end[q] else 0.0
    g.rank = orthonormal_basis(g.basis, p, n, NEAR)
    for q in range(p):
        along_basis(g, row_of(g.R, q), int(g.first[q]), int(g.end[q]))
        along_basis(g, row_of(g.C, q), int(g.first[q]), int(g.end[q]))
        g.first[q], g.end[q] = 0, g.rank


@kernel
def add_tangents(c: Contacts, column: Array, s: int, i: int) -> None:
    """Add to the column of contact i what tangents of contact s, itself or its resistance, do with its force."""
    first, end = joints_of(c, i)
    c1, c2, x1, x2 = c.problem.along[s, 0], c.problem.along[s, 1], row_of(c.X, 3 * s + 1), row_of(c.X, 3 * s + 2)
    for j in range(first, end):
        column[j] -= c1 * x1[j] + c2 * x2[j]


@kernel
def along_basis(g: GivenModes, row: Array, first: int, end: int) -> None:
    """Replace a row, zero but from `first` to `end`, by its components along the basis."""
    for m in range(int(g.rank)):
        of, s = row_of(g.basis, m), 0.0
        for j in range(first, end):
            s += row[j] * of[j]
        g.along[m] = s
    for m in range(int(g.rank)):
        row[m] = g.along[m]


@kernel
def factor(g: GivenModes, M: Array, A: Array, p: int, n: int, weighted: bool) -> bool:
    """Write Cholesky's factor of AᵀA, or of AᵀD⁻¹A, and where it is not zero; return False if it is singular.

    It stands below the diagonal and above it; on it are the reciprocals.
    """
    for i in range(n):
        g.begins[i], g.until[i] = i, i + 1
    for q in range(p):
        first, end = int(g.first[q]), int(g.end[q])
        for j in range(first, end):
            g.begins[j], g.until[j] = min(g.begins[j], first), max(g.until[j], end)
    for i in range(n):
        row = row_of(M, i)
        for j in range(int(g.begins[i]), i + 1):
            row[j] = 0.0
    for q in range(p):
        x, first, end = row_of(A, q), int(g.first[q]), int(g.end[q])
        for i in range(first, end):
            share, to = x[i] * (g.weight[q] if weighted else 1.0), row_of(M, i)
            for j in range(first, i + 1):
                to[j] += share * x[j]
    for j in range(n):  # column by column: the entries of one do not wait for each other
        of = row_of(M, j)
        square = whole = of[j]
        for t in range(int(g.begins[j]), j):
            square -= of[t] * of[t]
        if not square > DEPENDENT * whole:
            return False
        of[j] = 1.0 / math.sqrt(square)
        for i in range(j + 1, int(g.until[j])):
            row, begin, left = row_of(M, i), int(g.begins[i]), 0.0
            if begin <= j:
                left = row[j]
                for t in range(max(begin, int(g.begins[j])), j):
                    left -= row[t] * of[t]
                left *= of[j]
                row[j] = left
            of[i] = left
    return True


@kernel
def solve_factored(g: GivenModes, M: Array, n: int) -> None:
    """Overwrite both rows of `change` with M⁻¹ of them."""
    a, b = row_of(g.change, 0), row_of(g.change, 1)
    for i in range(n):
        row = row_of(M, i)
        x, y = a[i] * row[i], b[i] * row[i]
        a[i], b[i] = x, y
        for t in range(i + 1, int(g.until[i])):
            a[t] -= row[t] * x
            b[t] -= row[t] * y
    for i in range(n - 1, -1, -1):
        row = row_of(M, i)
        x, y = a[i] * row[i], b[i] * row[i]
        a[i], b[i] = x, y
        for t in range(int(g.begins[i]), i):
            a[t] -= row[t] * x
            b[t] -= row[t] * y


@kernel
def moved_joints(c: Contacts, p: int, asked: float) -> bool:
    """Write y of both right-hand sides, `left`, as `moved`; return whether R y agrees with them."""
    g, n = c.given, int(c.given.rank)
    if g.whole == 0.0 and not factor(g, g.factor, g.R, p, n, False):
        return False
    size_a, size_b, worst = largest_of(g.left, 0, p), largest_of(g.left, 1, p), 0.0
    for j in range(n):
        g.moved[0, j], g.moved[1, j] = 0.0, 0.0
    for _ in range(REFINEMENTS):
        for j in range(n):
            g.change[0, j], g.change[1, j] = 0.0, 0.0
        for q in range(p):
            row, a, b = row_of(g.R, q), g.left[0, q], g.left[1, q]
            for j in range(int(g.first[q]), int(g.end[q])):
                g.change[0, j] += a * row[j]
                g.change[1, j] += b * row[j]
        solve_factored(g, g.factor, n)
        for j in range(n):
            g.moved[0, j] += g.change[0, j]
            g.moved[1, j] += g.change[1, j]
        for q in range(p):
            row, a, b = row_of(g.R, q), g.left[0, q], g.left[1, q]
            for j in range(int(g.first[q]), int(g.end[q])):
                a -= row[j] * g.change[0, j]
                b -= row[j] * g.change[1, j]
            g.left[0, q], g.left[1, q] = a, b
        before, worst_a, worst_b = worst, largest_of(g.left, 0, p), largest_of(g.left, 1, p)
        worst = max(worst_a, worst_b)
        if (worst_a <= EXACT * size_a and worst_b <= EXACT * size_b) or 0.5 * before < worst <= before:
            break  # or they contradict each other, by as much
    return bool(worst <= SMALL * asked)


@kernel
def largest_of(rows: Array, side: int, p: int) -> float:
    """Return the size of the largest of the first p numbers of a row."""
    most = 0.0
    for q in range(p):
        most = max(most, abs(rows[side, q]))
    return most


@kernel
def spread(c: Contacts, p: int) -> bool:
    """Write the shortest x with Cᵀ x = y, of both rows of `moved`; return whether they are exact, but for rounding."""
    g, n = c.given, int(c.given.rank)
    M = g.factor
    if g.slides != 0.0:
        M = g.other
        if not factor(g, M, g.C, p, n, True):
            return False
    size_a, size_b, worst = largest_of(g.moved, 0, n), largest_of(g.moved, 1, n), math.inf
    for q in range(p):
        g.x[0, q], g.x[1, q] = 0.0, 0.0
    for j in range(n):
        g.z[0, j], g.z[1, j] = 0.0, 0.0
        g.change[0, j], g.change[1, j] = g.moved[0, j], g.moved[1, j]
    for _ in range(REFINEMENTS):
        solve_factored(g, M, n)
        for j in range(n):
            g.z[0, j] += g.change[0, j]
            g.z[1, j] += g.change[1, j]
        for q in range(p):
            row, a, b = row_of(g.C, q), 0.0, 0.0
            for j in range(int(g.first[q]), int(g.end[q])):
                a += row[j] * g.change[0, j]
                b += row[j] * g.change[1, j]
            g.x[0, q] += g.weight[q] * a
            g.x[1, q] += g.weight[q] * b
        for j in range(n):
            g.change[0, j], g.change[1, j] = g.moved[0, j], g.moved[1, j]
        for q in range(p):
            row, a, b = row_of(g.C, q), g.x[0, q], g.x[1, q]
            for j in range(int(g.first[q]), int(g.end[q])):
                g.change[0, j] -= a * row[j]
                g.change[1, j] -= b * row[j]
        worst_a, worst_b = largest_of(g.change, 0, n), largest_of(g.change, 1, n)
        worst = max(worst_a / size_a if size_a > 0.0 else worst_a, worst_b / size_b if size_b > 0.0 else worst_b)
        if worst <= EXACT:
            break
    return bool(worst <= FOUND)


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
def share_forces(links: ContactLinks, c: Contacts) -> None:
    """Replace `rigid` and F, which are not unique, by the shortest inside the cones that do the same, if there are any.

    Where there are none `beyond` says how far off the nearest are: it grows from zero as the modes end. They are taken
    as far as that is `borne`, and by modes that were just found as far as these may be off; beyond that motion goes on
    as it was, with forces outside, until the end of the modes is located. Normal forces that are known keep theirs, and
    so does what goes with them.
    """
    k, size = links.k, force_size(c.rigid)
    for r in range(3 * k):
        c.scratch.trial[r], c.scratch.best[r] = c.F[r] - c.rigid[r], c.rigid[r]
    for i in range(k):
        c.scratch.mu[i] = c.problem.form[i]
        c.problem.form[i] = OFF if is_known(links, c, i) else c.problem.form[i]
    c.problem.beyond = find_inside(links, c, 0, c.rigid)
    if c.problem.sought != 0.0:
        c.problem.borne = min(MOST_GROWTH * c.problem.beyond, SLIGHT * size)
    if c.problem.beyond > max(c.problem.rounding, c.problem.borne):
        for r in range(3 * k):
            c.rigid[r] = c.scratch.best[r]
    elif find_inside(links, c, 1, c.F) > 0.0:
        for r in range(3 * k):
            c.F[r] = c.rigid[r] + c.scratch.trial[r]
    for i in range(k):
        c.problem.form[i] = int(c.scratch.mu[i])


@kernel
def find_inside(links: ContactLinks, c: Contacts, side: int, force: Array) -> float:
    """Replace forces (3 k,) by the shortest inside the cones that do the same; return how far the nearest are off, N.

    They do the same if they give the rows the same acceleration: along the basis of these, where they are fewer than n.
    They move the tree alike too, unless a contact slides: the friction of contacts that share a normal force otherwise
    is another.
    """
    s, g = c.stepping, c.given
    a, m, whole = pack_contacts(links, c, 0.0), int(g.rank), g.whole != 0.0
    for j in range(m):
        s.wanted[j], s.y[j] = 0.0, g.z[side, j]
    for r in range(3 * a):
        i, row, at = r // 3, row_of(s.X, r), 3 * int(s.number[r // 3]) + r % 3
        first, end = int(s.first[i]), int(s.end[i])
        if not whole:
            along_basis(g, row, first, end)
            first, end = 0, m
        for j in range(first, end):
            s.wanted[j] += row[j] * (force[at] + c.viscous[at])
    for i in range(0 if whole else a):
        s.first[i], s.end[i] = 0, m
    off = float(find_least(s, a, m))
    for i in range(a):
        at = 3 * int(s.number[i])
        for r in range(3):
            force[at + r] = s.P[3 * i + r] - c.viscous[at + r]
        if s.normal[i] == OWNED:
            force[at] = force[3 * int(s.number[int(s.given[i])])]
    return off


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
        return 1.0
    share = 1.0 if c.F[n] >= 0.0 else max(0.0, f) / (max(0.0, f) - c.F[n])
    # The shortest of forces that are not unique is often at the cone's edge, but for rounding.
    if c.problem.form[i] == RAY or mu * c.F[n] + SMALL * c.problem.rounding >= math.hypot(c.F[n + 1], c.F[n + 2]):
        return share
    r1, r2, d1, d2 = c.rigid[n + 1], c.rigid[n + 2], c.F[n + 1] - c.rigid[n + 1], c.F[n + 2] - c.rigid[n + 2]
    # The first root of (μ (f + s df))² − |F_t + s dF_t|², a parabola in s that is positive at 0.
    a, half = (mu * grown) * (mu * grown) - d1 * d1 - d2 * d2, mu * mu * f * grown - r1 * d1 - r2 * d2
    inside = (mu * f) * (mu * f) - r1 * r1 - r2 * r2
    if not inside > 0.0:
        return 0.0 if math.hypot(r1, r2) <= mu * f + c.problem.rounding else 1.0
    below = math.sqrt(max(0.0, half * half - a * inside)) - half
    return min(share, inside / below) if below > 0.0 else share


@kernel
def pulled_in(c: Contacts, i: int) -> bool:
    """Whether contact i, alone, slides so that a larger force does not push it out."""
    S, row, own = c.S[i], row_of(c.X, 3 * i), 0.0
    first, end = joints_of(c, i)
    own = S[0, 0] - S[0, 1] * c.problem.along[i, 0] - S[0, 2] * c.problem.along[i, 1]
    for which in range(2):
        s = resistance_of(c, i, which)
        for j in range(first, end if turns_with(c, s) else first):
            turned = c.X[3 * s + 1, j] * c.problem.along[s, 0] + c.X[3 * s + 2, j] * c.problem.along[s, 1]
            own -= row[j] * turned
    return bool(c.problem.form[i] == RAY and not own > EXACT * (S[0, 0] + S[1, 1] + S[2, 2]))


@kernel
def stopping_impulses(links: ContactLinks, c: Contacts) -> None:
    """Write in F the impulses that take the velocities `before` along the rows of the kinds; none if there are none."""
    k = links.k
    for r in range(3 * k):
        c.problem.q[r], c.problem.after[r] = c.viscous[r], c.a[r]
        c.a[r], c.b[r], c.viscous[r] = c.before[r], 0.0, 0.0
    for i in range(k):
        c.scratch.mu[i], c.problem.known[i] = c.problem.known[i], 0.0
    status = solve_modes(links, c, False)
    for r in range(3 * k):
        c.a[r], c.viscous[r] = c.problem.after[r], c.problem.q[r]
        c.F[r] = c.rigid[r] if status == OK else 0.0
    for i in range(k):
        c.problem.known[i] = c.scratch.mu[i]


@kernel
def stop(links: ContactLinks, c: Contacts) -> bool:
    """Do `stopping_impulses` and write `after`; return False where impulses are far larger than the little they stop.

    Rows of shapes that hardly differ, as of edges that cross beside a corner, are then moved by opposite impulses.
    Impulses and speeds are compared as roots of energies, so that those of a row count alike in all its units.
    """
    stopping_impulses(links, c)
    k = links.k
    write_after(c, k)
    moves, before, most = 0.0, 0.0, 0.0
    for i in range(k):
        if c.problem.form[i] != OFF:
            for r in range(3 * i, 3 * i + (3 if sticks(c, i) else 1)):
                moves, root = max(moves, abs(c.before[r])), math.sqrt(c.S[i, r % 3, r % 3])
                before = max(before, abs(c.before[r]) / root if root > 0.0 else 0.0)
                most = max(most, abs(c.F[r]) * root)
    return bool(links.shapes == 0 or moves > STICK_SPEED or most <= STIFF * before)


@kernel
def write_after(c: Contacts, k: int) -> None:
    """Write in `after` the velocities u⁺ = u⁻ + W P that the impulses in F leave of `before`."""
    write_motion(c, k, c.F)
    for r in range(3 * k):
        c.problem.after[r] = c.before[r] + added(c, r)


@kernel
def energy_gained(c: Contacts, k: int) -> float:
    """Return the kinetic energy that the impulses give, Pᵀ(u⁻ + u⁺)/2, J; zero if it is rounding."""
    gained, size = 0.0, 0.0
    for i in range(3 * k):
        gained += 0.5 * c.F[i] * (c.before[i] + c.problem.after[i])
        size += abs(c.F[i]) * (abs(c.before[i]) + abs(c.problem.after[i]))
    return gained if abs(gained) > EXACT * size else 0.0


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
