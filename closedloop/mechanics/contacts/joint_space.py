"""Contact impulses in joint space: as many unknowns as the tree has joints, however many contacts there are.

With X = L⁻¹Gᵀ of the contacts that take part and u = q + X y, y = Xᵀ P, the problem is that of
`closedloop.mechanics.contacts.unknown_modes`. A round of the proximal point method (R. T. Rockafellar, SIAM J.
Control Optim. 14, 1976) from P° solves

    P = the nearest in K to P° − ρ (u + μ|u_t| n),     y = Xᵀ P

for y by Newton's method: the augmented Lagrangian of P. Alart and A. Curnier (Comput. Methods Appl. Mech. Eng. 92,
1991). Its matrix 1 + ρ Xᵀ ∂Π J is that of the joints and never singular. As ρ grows from round to round few are needed.
Of forces that are not unique it takes, from P° = 0, nearly the shortest.

Without μ|u_t| y is the least of a convex function, which Newton's method with a search along its step finds from
anywhere. With it a round has to begin near its end: ρ is lessened until it does. Gauss and Seidel's method (M. Jean,
Comput. Methods Appl. Mech. Eng. 177, 1999) comes near a solution from farther away, if slowly.
"""

import math
from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.limits import (
    DEPENDENT,
    EXACT,
    FIRST_RHO,
    FOUND,
    HALVINGS,
    ITERATIONS,
    MOST_OF,
    NEAR,
    REFINEMENTS,
    SLIGHT,
    SMALL,
    STIFF,
    STIFFEST_RHO,
    TENTH,
    WIDENING,
)
from closedloop.mechanics.loops.solve import dot

N, K = Count.of("n"), Count.of("k")

# Normal impulses: one that only pushes; of a closure that holds; a function of its speed, P = given − falls u, not
# negative where it falls; and that of another contact, its owner.
PUSHES, HOLDS, GIVEN, OWNED = range(4)
# Those along the surface: in Coulomb's cone; in a known direction, P_t = −along P_n; and what sticks with any force.
IN_CONE, ALONG, STICKS = range(3)


class JointSpace(Block, sizes=("n", "k")):
    """The problem, of the contacts that take part alone, and what its solution uses."""

    normal: Annotated[Array, K]  # PUSHES, HOLDS, GIVEN or OWNED
    tangent: Annotated[Array, K]  # IN_CONE, ALONG or STICKS
    mu: Annotated[Array, K]
    ahead: Annotated[Array, K, 2]  # `along` of one that slides in a known direction
    associated: float  # 1: without μ|u_t| n, the least of a convex function (M. Anitescu, Math. Program. 105, 2006)
    given: Annotated[Array, K]  # normal impulse at no speed, N s, or the number of the owner
    falls: Annotated[Array, K]  # and what it is less by with the speed, kg
    first: Annotated[Array, K]  # of the joints that a contact moves, by their places
    end: Annotated[Array, K]
    X: Annotated[Array, 3 * K, N]
    q: Annotated[Array, 3 * K]  # m/s
    beside: Annotated[Array, K]  # of which that of w beside u⁺, in a time step: negative of a rebound
    P: Annotated[Array, 3 * K]  # in: where to start; out: impulses, N s
    u: Annotated[Array, 3 * K]  # m/s, with them
    mobility: Annotated[Array, K]  # the largest of each contact, 1/kg
    largest: float  # of all, 1/kg
    alike: float  # 1 if all contacts have the same ρ
    trial: Annotated[Array, 3 * K]
    before: Annotated[Array, 3 * K]  # P of the round before
    slope: Annotated[Array, K, 3, 3]  # ∂Π
    change: Annotated[Array, 3 * K]  # of u along a step
    along: Annotated[Array, K, 2]  # ∂(μ|u_t|)/∂u_t; of an owned one ∂P_t/∂P_n of its owner
    y: Annotated[Array, N]
    y_trial: Annotated[Array, N]
    off: Annotated[Array, N]  # y − Xᵀ Π
    held: float  # 1: y is to be `wanted`, see `find_least`
    wanted: Annotated[Array, N]
    step: Annotated[Array, N]
    matrix: Annotated[Array, N, N]
    row: Annotated[Array, 3, N]
    until: Annotated[Array, N]  # see `eliminate`
    order: Annotated[Array, N]  # the place of each joint in this problem, see `closedloop.mechanics.contacts.stepping`
    number: Annotated[Array, K]  # of each among all contacts
    packed_at: Annotated[Array, K]  # and of each of all in the problem, −1 if it takes no part
    residual: float  # as a share of `asked`
    asked: float  # the largest velocity at the step's beginning, or what smooth forces add to one, m/s


@kernel
def into_disc(x1: float, x2: float, radius: float, P: Array, slope: Array) -> float:
    """Write the nearest to (x1, x2) within a disc in P[1:], and its slope; return 1 if it is on the edge, else 0."""
    size = math.sqrt(x1 * x1 + x2 * x2)
    if size <= radius:
        P[1], P[2] = x1, x2
        slope[1, 1], slope[2, 2], slope[1, 2], slope[2, 1] = 1.0, 1.0, 0.0, 0.0
        return 0.0
    e1, e2, share = x1 / size, x2 / size, radius / size
    P[1], P[2] = radius * e1, radius * e2
    slope[1, 1], slope[2, 2] = share * e2 * e2, share * e1 * e1
    slope[1, 2] = slope[2, 1] = -share * e1 * e2
    return 1.0


@kernel
def into_cone_with_slope(x0: float, x1: float, x2: float, mu: float, P: Array, slope: Array) -> None:
    """Write the nearest point of Coulomb's cone to x in P (3,), and its slope (3, 3)."""
    size = math.sqrt(x1 * x1 + x2 * x2)
    for a in range(3):
        for b in range(3):
            slope[a, b] = 0.0
    P[0] = P[1] = P[2] = 0.0
    if mu * size <= -x0:
        return
    if size <= mu * x0:
        P[0], P[1], P[2] = x0, x1, x2
        slope[0, 0] = slope[1, 1] = slope[2, 2] = 1.0
        return
    share = 1.0 / (1.0 + mu * mu)
    f = share * (x0 + mu * size)
    P[0], slope[0, 0] = f, share
    if mu == 0.0:
        return
    e1, e2, radial, across = x1 / size, x2 / size, share * mu * mu, mu * f / size
    P[1], P[2] = mu * f * e1, mu * f * e2
    slope[0, 1] = slope[1, 0] = share * mu * e1
    slope[0, 2] = slope[2, 0] = share * mu * e2
    slope[1, 1], slope[2, 2] = radial * e1 * e1 + across * e2 * e2, radial * e2 * e2 + across * e1 * e1
    slope[1, 2] = slope[2, 1] = (radial - across) * e1 * e2


@kernel
def write_speed(s: JointSpace, i: int, y: Array) -> None:
    """Write u = q + X y of contact i."""
    x0, x1, x2 = row_of(s.X, 3 * i), row_of(s.X, 3 * i + 1), row_of(s.X, 3 * i + 2)
    u0, u1, u2 = s.q[3 * i], s.q[3 * i + 1], s.q[3 * i + 2]
    for j in range(int(s.first[i]), int(s.end[i])):
        u0, u1, u2 = u0 + x0[j] * y[j], u1 + x1[j] * y[j], u2 + x2[j] * y[j]
    s.u[3 * i], s.u[3 * i + 1], s.u[3 * i + 2] = u0, u1, u2


@kernel
def respond(s: JointSpace, i: int, rho: float, P: Array) -> None:
    """Write Π of contact i in P (3 a,), of its u and the impulse at the round's beginning, and its slope."""
    at, mu, slope, along, normal = 3 * i, s.mu[i], s.slope[i], s.along[i], s.normal[i]
    u0, u1, u2 = s.u[at], s.u[at + 1], s.u[at + 2]
    x0, x1, x2 = s.P[at] - rho * u0, s.P[at + 1] - rho * u1, s.P[at + 2] - rho * u2
    along[0] = along[1] = 0.0
    if normal == PUSHES and s.tangent[i] == IN_CONE:
        size, share = math.sqrt(u1 * u1 + u2 * u2), (1.0 - s.associated) * mu
        if size > 0.0:
            along[0], along[1] = share * u1 / size, share * u2 / size
        into_cone_with_slope(x0 - rho * share * size, x1, x2, mu, P[at : at + 3], slope)
        return
    for a in range(3):
        for b in range(3):
            slope[a, b] = 0.0
    P[at], f, sense = 0.0, 0.0, 1.0
    if normal == OWNED:
        f = max(P[3 * int(s.given[i])], 0.0) if s.tangent[i] == IN_CONE else P[3 * int(s.given[i])]
    elif normal == GIVEN:
        P[at] = s.given[i] - s.falls[i] * u0
        if s.falls[i] > 0.0:
            P[at], slope[0, 0] = max(P[at], 0.0), s.falls[i] / rho if P[at] > 0.0 else 0.0
    elif normal == HOLDS or x0 > 0.0:
        P[at], slope[0, 0] = x0, 1.0
    if normal != OWNED:
        f, sense = P[at], slope[0, 0]
    if s.tangent[i] == STICKS:
        P[at + 1], P[at + 2], slope[1, 1], slope[2, 2] = x1, x2, 1.0, 1.0
        return
    by1, by2 = -s.ahead[i, 0], -s.ahead[i, 1]
    if s.tangent[i] == ALONG:
        P[at + 1], P[at + 2] = by1 * f, by2 * f
    else:
        share = math.copysign(mu, f) * into_disc(x1, x2, mu * abs(f), P[at : at + 3], slope)
        size = math.sqrt(x1 * x1 + x2 * x2)
        by1, by2 = (share * x1 / size, share * x2 / size) if size > 0.0 else (0.0 * size, 0.0 * size)
    if normal == OWNED:
        along[0], along[1] = by1, by2
    else:
        slope[1, 0], slope[2, 0] = sense * by1, sense * by2


@kernel
def rho_of(s: JointSpace, i: int, stiffness: float) -> float:
    """Return ρ of contact i, kg: of its own mobility, or of the largest, for nearly the shortest of all impulses."""
    return float(stiffness / (s.largest if s.alike != 0.0 else s.mobility[i]))


@kernel
def write_off(s: JointSpace, a: int, n: int, stiffness: float, y: Array) -> float:
    """Write u, Π in `trial` and its slopes, and y − Xᵀ Π at y; return the square of that."""
    for i in range(a):
        write_speed(s, i, y)
        respond(s, i, rho_of(s, i, stiffness), s.trial)
    return add_off(s, a, n, y)


@kernel
def add_off(s: JointSpace, a: int, n: int, y: Array) -> float:
    """Write y − Xᵀ Π of the Π in `trial`; return the square of that."""
    for j in range(n):
        s.off[j] = y[j] if s.held == 0.0 else s.wanted[j]
    for i in range(a):
        p0, p1, p2 = s.trial[3 * i], s.trial[3 * i + 1], s.trial[3 * i + 2]
        if p0 == 0.0 and p1 == 0.0 and p2 == 0.0:
            continue
        x0, x1, x2 = row_of(s.X, 3 * i), row_of(s.X, 3 * i + 1), row_of(s.X, 3 * i + 2)
        for j in range(int(s.first[i]), int(s.end[i])):
            s.off[j] -= x0[j] * p0 + x1[j] * p1 + x2[j] * p2
    return float(dot(s.off, s.off, n))


@kernel
def add_rows(s: JointSpace, i: int, owner: int, rho: float) -> None:
    """Add ρ Xᵀ ∂Π J of contact i to the matrix, or, of an owned one, what its owner's normal impulse changes too."""
    M, J, slope, along = s.matrix, s.row, s.slope[i], s.along[i]
    first, end = int(s.first[owner]), int(s.end[owner])
    x0, x1, x2 = row_of(s.X, 3 * owner), row_of(s.X, 3 * owner + 1), row_of(s.X, 3 * owner + 2)
    e1, e2 = s.along[owner][0], s.along[owner][1]
    if s.normal[owner] != PUSHES:
        e1 = e2 = 0.0
    of, some = s.slope[owner], False
    for b in range(3):
        if owner == i:
            c0, c1, c2 = rho * slope[b, 0], rho * slope[b, 1], rho * slope[b, 2]
        else:  # the slope of the owner's normal impulse, times that of the owned one by it
            share = along[b - 1] * rho if b > 0 else 0.0
            c0, c1, c2 = share * of[0, 0], share * of[0, 1], share * of[0, 2]
        some = some or c0 != 0.0 or c1 != 0.0 or c2 != 0.0
        c1, c2, row = c1 + c0 * e1, c2 + c0 * e2, row_of(J, b)
        for j in range(first, end):
            row[j] = c0 * x0[j] + c1 * x1[j] + c2 * x2[j]
    if not some:  # it is open
        return
    for j in range(int(s.first[i]), int(s.end[i])):
        z0, z1, z2 = s.X[3 * i, j], s.X[3 * i + 1, j], s.X[3 * i + 2, j]
        if z0 == 0.0 and z1 == 0.0 and z2 == 0.0:
            continue
        to, j0, j1, j2 = row_of(M, j), row_of(J, 0), row_of(J, 1), row_of(J, 2)
        for m in range(first, end):
            to[m] += z0 * j0[m] + z1 * j1[m] + z2 * j2[m]


@kernel
def newton_step_of_joints(s: JointSpace, a: int, n: int, stiffness: float) -> None:
    """Write the step of Newton's method, of the slopes that are written, in `step`."""
    M, x, end = s.matrix, s.step, 0
    for j in range(n):
        x[j], s.until[j] = -s.off[j], j + 1.0
    for i in range(a):
        first = int(s.first[i])
        s.until[first] = max(s.until[first], s.end[i])
    for j in range(n):
        end = max(end, int(s.until[j]))
        s.until[j] = end
        for m in range(j, end):
            M[j, m] = M[m, j] = 0.0
        M[j, j] = 1.0 if s.held == 0.0 else DEPENDENT
    for i in range(a):
        add_rows(s, i, i, rho_of(s, i, stiffness))
        if s.normal[i] == OWNED:
            owner = int(s.given[i])
            add_rows(s, i, owner, rho_of(s, owner, stiffness))
    eliminate(M, x, s.until, n)


@kernel
def eliminate(M: Array, x: Array, until: Array, n: int) -> None:
    """Solve M x = b, with b in x (n,), by elimination without pivots; M (n, n) is overwritten.

    Row and column j of M have no entries from `until[j]` on, which never falls with j. What has no pivot is left out.
    M is that of a positive definite form, or a round that has no use of its solution is taken back.
    """
    for k in range(n):
        end, top = int(until[k]), row_of(M, k)
        inverse = 1.0 / top[k] if top[k] != 0.0 else 0.0
        for i in range(k + 1, end):
            row = row_of(M, i)
            share = row[k] * inverse
            if share == 0.0:
                continue
            for j in range(k + 1, end):
                row[j] -= share * top[j]
            x[i] -= share * x[k]
    for i in range(n - 1, -1, -1):
        row, left = row_of(M, i), x[i]
        for j in range(i + 1, int(until[i])):
            left -= row[j] * x[j]
        x[i] = left / row[i] if row[i] != 0.0 else 0.0


@kernel
def add_impulse(s: JointSpace, i: int) -> None:
    """Add Xᵀ P of contact i to y."""
    for r in range(3 * i, 3 * i + 3):
        p = s.P[r]
        for j in range(int(s.first[i]), int(s.end[i]) if p != 0.0 else 0):
            s.y[j] += s.X[r, j] * p


@kernel
def residual_of(s: JointSpace, a: int, n: int) -> float:
    """Write y = Xᵀ P and u of it; return by how much P is off its nearest at ρ = 1, as a share of `asked`."""
    for j in range(n):
        s.y[j] = 0.0
    for i in range(a):
        add_impulse(s, i)
    worst = 0.0
    for i in range(a):
        write_speed(s, i, s.y)
        respond(s, i, 1.0 / s.mobility[i], s.trial)
        for r in range(3 * i, 3 * i + 3):
            worst = max(worst, abs(s.trial[r] - s.P[r]) * s.mobility[i])
            if not abs(s.trial[r]) < math.inf:
                return math.inf
    return worst / s.asked if s.asked > 0.0 else worst


@kernel
def solve_in_joint_space(s: JointSpace, a: int, n: int, first: float) -> bool:
    """Write P and u of the a contacts but for rounding, from P, with the first ρ; return whether they are found.

    Rounds end when they no longer lessen the residual. Where rows nearly depend on others that is more than rounding:
    the rest would take forces without bound.
    """
    stiffness, before = first, math.inf
    for _ in range(ITERATIONS):
        s.residual = residual_of(s, a, n)
        stalls = stiffness == STIFFEST_RHO and MOST_OF * before < s.residual <= SLIGHT
        if s.residual <= EXACT or stalls or 0.5 * before < s.residual <= 10.0 * EXACT:
            return True
        slow, before = s.residual > max(0.5 * before, STIFF * EXACT), s.residual
        if not s.residual < math.inf:
            return False
        do_round(s, a, n, stiffness, False, SMALL)
        stiffness = min(WIDENING * stiffness, STIFFEST_RHO if slow else STIFF)
    s.residual = residual_of(s, a, n)
    return bool(s.residual <= FOUND)


@kernel
def solve_step(s: JointSpace, a: int, n: int, enough: float = SLIGHT) -> bool:
    """Write P and u of the a contacts of a time step, from P, to a residual; return whether they are found.

    By rounds from P; where these fail, by rounds after sweeps, which come near a solution from anywhere, if slowly.
    """
    for attempt in range(REFINEMENTS):
        for _ in range(ITERATIONS if attempt > 0 else 0):
            sweep(s, a)
        do_rounds(s, a, n, enough)
        if s.residual <= NEAR:
            break
    return bool(s.residual <= NEAR)


@kernel
def do_rounds(s: JointSpace, a: int, n: int, enough: float) -> None:
    """Do rounds until the residual is `enough`: ρ grows where Newton's steps are whole, falls where the residual grows.

    Of contacts whose rows depend on each other one may have to open: the residual stays until its impulse is gone. What
    a round leaves of its equations counts 1/ρ of that in impulses.
    """
    stiffness = FIRST_RHO
    s.residual = residual_of(s, a, n)
    for _ in range(ITERATIONS):
        if s.residual <= enough or not s.residual < math.inf:
            break
        before = s.residual
        for r in range(3 * a):
            s.before[r] = s.P[r]
        whole = do_round(s, a, n, stiffness, False, min(TENTH * stiffness, WIDENING))
        s.residual = residual_of(s, a, n)
        if not MOST_OF * s.residual <= before:
            for r in range(3 * a):
                s.P[r] = s.before[r]
            s.residual = residual_of(s, a, n)
            stiffness /= WIDENING * WIDENING
            if stiffness < 1.0:
                break
        elif whole:
            stiffness = min(WIDENING * stiffness, STIFFEST_RHO)


@kernel
def sweep(s: JointSpace, a: int) -> None:
    """Give each contact in turn the impulse that is nearest, with y: Gauss and Seidel's method."""
    for i in range(a):
        first, end, square = int(s.first[i]), int(s.end[i]), 0.0
        for r in range(3 * i, 3 * i + 3):
            x = row_of(s.X, r)
            square += dot(x[first:end], x[first:end], end - first)
        write_speed(s, i, s.y)
        respond(s, i, 1.0 / square, s.trial)
        for r in range(3 * i, 3 * i + 3):
            change, x = s.trial[r] - s.P[r], row_of(s.X, r)
            s.P[r] = s.trial[r]
            for j in range(first, end if change != 0.0 else first):
                s.y[j] += x[j] * change


@kernel
def find_exactly(s: JointSpace, a: int, n: int, again: bool = False) -> bool:
    """Write P and u of the a contacts but for rounding; return whether they are found: nearly all are.

    From no impulses, with the ρ of all and with their own; where Newton's method does not come from there, along the
    solutions of problems that lie between the associated one, which is convex, and that of Coulomb's friction; and then
    from where sweeps come. That takes long, and is not tried `again` where it just failed.
    """
    s.associated, s.alike = 0.0, 1.0
    for attempt in range(2):
        start_at_rest(s, a, n)
        if solve_in_joint_space(s, a, n, FIRST_RHO if attempt == 0 else 1.0):
            return True
        s.alike = 0.0
    if again:
        return False
    start_at_rest(s, a, n)
    s.associated = 1.0
    solve_step(s, a, n)
    for i in range(ITERATIONS):
        s.associated = 1.0 - (i + 1.0) / ITERATIONS
        s.residual = residual_of(s, a, n)
        do_round(s, a, n, STIFFEST_RHO, False)
    if solve_in_joint_space(s, a, n, 1.0):
        return True
    start_at_rest(s, a, n)
    for _ in range(REFINEMENTS):
        for _ in range(ITERATIONS):
            sweep(s, a)
        do_rounds(s, a, n, FOUND)
        if s.residual <= SLIGHT and solve_in_joint_space(s, a, n, FIRST_RHO):
            return True
    return False


@kernel
def find_least(s: JointSpace, a: int, n: int) -> float:
    """Write the shortest P in the cones with Xᵀ P = `wanted`; or one with the nearest, and return how far that is, N s.

    It is Π(X λ), the nearest in the cones, of a λ for which Newton's method starts at the last y / −ρ: that of the
    shortest outside. Of bilateral contacts and resistances P is in the cones, and nearly the shortest. Where the cones
    just reach `wanted`, or do not, λ has no bound: the nearest is then that of rounds from P = 0.
    """
    s.held, s.associated, s.alike, size = 1.0, 1.0, 1.0, dot(s.wanted, s.wanted, n)
    for j in range(n):
        s.y[j] *= -s.largest
    for r in range(3 * a):
        s.P[r], s.q[r] = 0.0, 0.0
    s.residual, s.asked = FOUND, math.sqrt(size * s.largest)
    do_round(s, a, n, 1.0, False, SMALL * SMALL)
    s.held = 0.0
    if dot(s.off, s.off, n) <= DEPENDENT * DEPENDENT * size:
        return 0.0
    for r in range(3 * a):
        i, row = r // 3, row_of(s.X, r)
        for j in range(int(s.first[i]), int(s.end[i])):
            s.q[r] -= row[j] * s.wanted[j]
    start_at_rest(s, a, n)
    stiffness, before = FIRST_RHO, math.inf
    for _ in range(ITERATIONS):
        s.residual = residual_of(s, a, n)
        stalls = stiffness == STIFFEST_RHO and s.residual > MOST_OF * before
        if s.residual <= EXACT or stalls or not s.residual < math.inf:
            break
        before = s.residual
        do_round(s, a, n, stiffness)
        stiffness = min(WIDENING * stiffness, STIFFEST_RHO)
    residual_of(s, a, n)
    for j in range(n):
        s.off[j] = s.y[j] - s.wanted[j]
    off = dot(s.off, s.off, n)
    return math.sqrt(off / s.largest) if off > DEPENDENT * DEPENDENT * size else 0.0


@kernel
def differentiate(s: JointSpace, a: int, n: int) -> None:
    """Give the P that is found, and u, its derivatives: each round leaves a share of what they are off."""
    for _ in range(REFINEMENTS):
        write_off(s, a, n, STIFF, s.y)
        newton_step_of_joints(s, a, n, STIFF)
        for j in range(n):
            s.y[j] += s.step[j]
        write_off(s, a, n, STIFF, s.y)
        for r in range(3 * a):
            s.P[r] = s.trial[r]
    residual_of(s, a, n)


@kernel
def start_at_rest(s: JointSpace, a: int, n: int) -> None:
    """Write no impulses."""
    for r in range(3 * a):
        s.P[r] = 0.0
    for j in range(n):
        s.y[j] = 0.0


@kernel
def is_wedged(s: JointSpace, a: int, most: float = STIFF) -> bool:
    """Whether impulses are so many times those that are asked for: by default larger than `solve_softly` finds.

    Those of contacts that are wedged have no bound, and are in balance only where the bodies are.
    """
    largest = 0.0
    for i in range(a):
        for r in range(3 * i, 3 * i + 3 if s.normal[i] != GIVEN else 0):
            largest = max(largest, abs(s.P[r]) * s.mobility[i])
    return bool(largest > most * s.asked)


@kernel
def solve_softly(s: JointSpace, a: int, n: int, rounds: int = 1) -> bool:
    """Write P and u of contacts that are compliant, by 1/ρ, without μ|u_t| n; return whether they are numbers.

    The first round, from P = 0, has one solution, whatever the rows. Each that follows makes contacts stiffer, until
    impulses are larger than contacts which are wedged may have.
    """
    s.associated, s.alike = 1.0, 0.0
    start_at_rest(s, a, n)
    for done in range(rounds):
        s.residual = FOUND if done == 0 else residual_of(s, a, n)  # the first round is to leave as little
        if not s.residual < math.inf or (done > 0 and (s.residual <= FOUND or is_wedged(s, a))):
            break
        for r in range(3 * a):
            s.before[r] = s.P[r]
        do_round(s, a, n, STIFF)
    if is_wedged(s, a):
        for r in range(3 * a):
            s.P[r] = s.before[r]
    s.residual = residual_of(s, a, n)
    return bool(s.residual < math.inf)


@kernel
def do_round(s: JointSpace, a: int, n: int, stiffness: float, convex: bool = True, leaves: float = TENTH) -> bool:
    """Do a round of the proximal point method: write the P that is nearest, from P, and y and u of it.

    Of its equations it leaves a share. If it is convex there is a search along each step of Newton's method; else that
    is halved until less is off. Returns whether none was.
    """
    most, whole = 0.0, True
    for i in range(a):
        most = max(most, s.mobility[i])
    left = leaves * max(s.residual, FOUND) * s.asked / (stiffness * math.sqrt(most))
    square = write_off(s, a, n, stiffness, s.y)
    for _ in range(ITERATIONS):
        if square <= left * left:
            break
        newton_step_of_joints(s, a, n, stiffness)
        last = square
        if convex:
            slope, square = search(s, a, n, stiffness)
            if not (square < last or slope < -EXACT * EXACT * dot(s.y, s.y, n)):
                break
            continue
        share = 1.0
        for _ in range(HALVINGS):
            for j in range(n):
                s.y_trial[j] = s.y[j] + share * s.step[j]
            square = write_off(s, a, n, stiffness, s.y_trial)
            if square < (1.0 - 0.2 * share) * last:
                break
            share, whole = 0.5 * share, False
        if not square < last:
            write_off(s, a, n, stiffness, s.y)
            break
        for j in range(n):
            s.y[j] = s.y_trial[j]
    for r in range(3 * a):
        s.P[r] = s.trial[r]
    return whole


@kernel
def search(s: JointSpace, a: int, n: int, stiffness: float) -> tuple[float, float]:
    """Go along the step to where what is off is across it: the least, there, of a convex function with `off` as slope.

    Writes y, u, Π and `off` there; returns the slope along the step where it began, and the square of what is off.
    """
    began, square, share, low, high = dot(s.off, s.step, n), dot(s.step, s.step, n), 1.0, 0.0, math.inf
    growth = dot(s.y, s.step, n)
    for i in range(a):
        at, x0, x1, x2 = 3 * i, row_of(s.X, 3 * i), row_of(s.X, 3 * i + 1), row_of(s.X, 3 * i + 2)
        c0 = c1 = c2 = 0.0
        for j in range(int(s.first[i]), int(s.end[i])):
            c0, c1, c2 = c0 + x0[j] * s.step[j], c1 + x1[j] * s.step[j], c2 + x2[j] * s.step[j]
        s.change[at], s.change[at + 1], s.change[at + 2] = c0, c1, c2
    gone = 0.0
    for _ in range(HALVINGS):
        slope, steeper = growth + share * square, square
        for i in range(a):
            at, rho, J = 3 * i, rho_of(s, i, stiffness), s.slope[i]
            for r in range(at, at + 3):
                s.u[r] += (share - gone) * s.change[r]
            respond(s, i, rho, s.trial)
            c0, c1, c2 = s.change[at], s.change[at + 1], s.change[at + 2]
            slope -= s.trial[at] * c0 + s.trial[at + 1] * c1 + s.trial[at + 2] * c2
            steeper += rho * (
                c0 * (J[0, 0] * c0 + J[0, 1] * c1 + J[0, 2] * c2)
                + c1 * (J[1, 0] * c0 + J[1, 1] * c1 + J[1, 2] * c2)
                + c2 * (J[2, 0] * c0 + J[2, 1] * c1 + J[2, 2] * c2)
            )
        gone = share
        if not abs(slope) > TENTH * abs(began):
            break
        low, high = (low, share) if slope > 0.0 else (share, high)
        share = share - slope / steeper if steeper > 0.0 else math.inf
        if not low < share < high:
            share = 0.5 * (low + high) if high < math.inf else 2.0 * low
    for j in range(n):
        s.y[j] += gone * s.step[j]
    return began, add_off(s, a, n, s.y)
