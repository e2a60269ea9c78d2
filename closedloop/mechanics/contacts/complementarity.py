"""All contacts together: forces in Coulomb's cones, and the velocities or accelerations that go with them.

With F = (f, F_t) of each contact, u = q + W F of all of them and the mobility W = X Xᵀ, the problem is

    F ∈ K,   u + μ|u_t| n ∈ K*,   Fᵀ(u + μ|u_t| n) = 0,        K = {|F_t| <= μ f},  K* its dual

(G. de Saxcé and Z.-Q. Feng, Math. Comput. Model. 28, 1998): no force off the surface, within the cone where it
sticks, and on its edge against the slip where it slides. q is the velocity before an impact, with what restitution
adds to it, and F an impulse; or q is the acceleration without contacts and F a force. Contacts that slide already
have a direction: F = f (1, −μ d), f >= 0, u_n >= 0, f u_n = 0.

The quick method is in two parts, which alternate until the residual is rounding: projected Gauss-Seidel (F. Jourdan, P.
Alart and M. Jean, Comput. Methods Appl. Mech. Eng. 155, 1998) to come near, and the generalised Newton method of
P. Alart and A. Curnier (Comput. Methods Appl. Mech. Eng. 92, 1991) on the equations

    f = max(0, f − ρ u_n),    F_t = the nearest to F_t − ρ u_t with no more than μ max(0, f − ρ u_n)

(of a contact that also pulls: u_n = 0, and no more than μ|f|)

(review: V. Acary, M. Brémond and O. Huber, in Advanced Topics in Nonsmooth Dynamics, Springer, 2018).
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.continuation import follow_path, force_size
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, Contacts
from closedloop.mechanics.contacts.mobility import pack, unpack
from closedloop.mechanics.contacts.shortest import DEPENDENT, solve_any_rank

# The residual, of the largest force, at which a problem is solved; what it must have been in the end, of the force that
# is asked for: feet of one body contradict each other by as much as they are off their surface, so that there may be no
# better one; and so many times that force is none: contacts that are wedged have a residual of rounding with any.
SOLVED, ACCEPTED, WEDGED = 1e-14, 1e-9, 1e6
# Inner forces count for what is accepted up to so many times what is asked for.
INNER = 100.0
# Sweeps of Gauss and Seidel's method before Newton's, at first; it doubles from round to round.
SWEEPS, MOST_SWEEPS, ROUNDS, NEWTON_STEPS, HALVINGS = 10, 160, 2, 30, 12
# A residual above the first, of the force that is asked for, is made less by so many steps with the third for ρ.
ROUGH, POLISHING, OTHER_PENALTY = 1e-13, 10, 0.1
# Mobility of contacts that give way a little, of the largest.
SOFTNESS = 1e-7
# The same where it becomes less: at first, by which factor, how often, and rounds after which nothing depends on it.
SOFTEST, LESS_SOFT, HARDER, PROXIMAL = 1e-3, 1e-2, 2, 3
# Rounds at the end of a path, where the solution is near.
LAST_ROUNDS = 9
# Where paths start, one after the other, see `start_path`.
STARTS = (2.0, 5.0, 1.0, 40.0)
# Sweeps where nothing else finds what is known to exist.
LONG_SWEEPS = 2000


@kernel
def velocities(c: Contacts, k: int, F: Array, u: Array) -> None:
    """Write u = q + W F."""
    for i in range(3 * k):
        s, row = c.problem.q[i], row_of(c.W, i)
        for j in range(3 * k):
            s += row[j] * F[j]
        u[i] = s


@kernel
def into_cone(F: Array, mu: float) -> None:
    """Replace F (3,) by the nearest point of the cone |F_t| <= μ f."""
    f, size = F[0], math.hypot(F[1], F[2])
    if size <= mu * f:
        return
    if mu * size <= -f:
        F[0], F[1], F[2] = 0.0, 0.0, 0.0
        return
    f = (f + mu * size) / (1.0 + mu * mu)
    F[0], F[1], F[2] = f, mu * f * F[1] / size, mu * f * F[2] / size


@kernel
def scale_of(c: Contacts, i: int, largest: float) -> float:
    """Return ρ of contact i, kg: the inverse of its mobility, times `penalty`."""
    most = max(c.W[3 * i, 3 * i], c.W[3 * i + 1, 3 * i + 1], c.W[3 * i + 2, 3 * i + 2])
    return float(c.problem.penalty / (most if most > 1e-9 * largest else largest))


@kernel
def largest_mobility(c: Contacts, k: int) -> float:
    """Return the largest number on the diagonal of W, 1/kg."""
    largest = 0.0
    for i in range(3 * k):
        largest = max(largest, c.W[i, i])
    return largest


@kernel
def size_of_q(c: Contacts, k: int) -> float:
    """Return the largest number of q of the contacts that take part: what open ones have does not count."""
    asked = 0.0
    for j in range(3 * k):
        if c.problem.form[j // 3] != OFF:
            asked = max(asked, abs(c.problem.q[j]))
    return asked


@kernel
def write_residuals(c: Contacts, k: int, F: Array, largest: float) -> float:
    """Write what the equations of Alart and Curnier are off at F, N, and u there; return the largest."""
    velocities(c, k, F, c.problem.after)
    worst, r, u = 0.0, c.scratch.residuals, c.problem.after
    for i in range(k):
        n, t, s = 3 * i, 3 * i + 1, 3 * i + 2
        kind, rho = c.problem.form[i], scale_of(c, i, largest)
        if kind == OFF:
            r[n], r[t], r[s] = F[n], F[t], F[s]
        elif kind in (CONE, DOUBLE):
            level = abs(F[n]) if kind == DOUBLE else max(0.0, F[n] - rho * u[n])
            x1, x2, g = F[t] - rho * u[t], F[s] - rho * u[s], c.mu[i] * level
            size = math.hypot(x1, x2)
            r[n] = rho * u[n] if kind == DOUBLE else F[n] - level
            if size <= g:
                r[t], r[s] = rho * u[t], rho * u[s]
            else:
                r[t], r[s] = F[t] - g * x1 / size, F[s] - g * x2 / size
        else:
            r[n] = rho * u[n] if kind == LINE else F[n] - max(0.0, F[n] - rho * u[n])
            r[t], r[s] = F[t] + c.problem.along[i, 0] * F[n], F[s] + c.problem.along[i, 1] * F[n]
        for j in range(n, n + 3):
            if not abs(r[j]) < math.inf:
                return math.inf
            worst = max(worst, abs(r[j]))
    return worst


@kernel
def sweep(c: Contacts, k: int, F: Array, largest: float) -> None:
    """Do one sweep of Gauss and Seidel's method: each contact once, with the forces of the others as they are."""
    u = c.scratch.vector
    for i in range(k):
        n, kind = 3 * i, c.problem.form[i]
        if kind == OFF:
            F[n], F[n + 1], F[n + 2] = 0.0, 0.0, 0.0
            continue
        for _ in range(3 if kind in (CONE, DOUBLE) else 1):
            for j in range(3):
                s, row = c.problem.q[n + j], row_of(c.W, n + j)
                for m in range(3 * k):
                    s += row[m] * F[m]
                u[j] = s
            if kind == CONE:
                rho, mu = 1.0 / (c.W[n, n] + c.W[n + 1, n + 1] + c.W[n + 2, n + 2] + 1e-12 * largest), c.mu[i]
                u[0] += mu * math.hypot(u[1], u[2])
                for j in range(3):
                    u[j] = F[n + j] - rho * u[j]
                into_cone(u, mu)
                F[n], F[n + 1], F[n + 2] = u[0], u[1], u[2]
            elif kind == DOUBLE:
                if c.W[n, n] > 1e-9 * largest:
                    F[n] -= u[0] / c.W[n, n]
                rho = 1.0 / (c.W[n + 1, n + 1] + c.W[n + 2, n + 2] + 1e-12 * largest)
                u[1], u[2] = F[n + 1] - rho * u[1], F[n + 2] - rho * u[2]
                size, most = math.hypot(u[1], u[2]), c.mu[i] * abs(F[n])
                share = most / size if size > most else 1.0
                F[n + 1], F[n + 2] = share * u[1], share * u[2]
            else:
                c1, c2 = c.problem.along[i, 0], c.problem.along[i, 1]
                mobility = c.W[n, n] - c.W[n, n + 1] * c1 - c.W[n, n + 2] * c2
                if mobility > 1e-9 * largest:
                    f = F[n] - u[0] / mobility
                    F[n] = f if kind == LINE else max(0.0, f)
                F[n + 1], F[n + 2] = -c1 * F[n], -c2 * F[n]


@kernel
def newton_step(c: Contacts, k: int, F: Array, largest: float) -> None:
    """Write the step of Newton's method at F, whose residuals are written, as the first row of `solution`."""
    m, S, u = 3 * k, c.scratch.system, c.problem.after
    for i in range(k):
        n, t, s = 3 * i, 3 * i + 1, 3 * i + 2
        kind, rho = c.problem.form[i], scale_of(c, i, largest)
        for row in range(n, n + 3):
            for j in range(m):
                S[row, j] = 0.0
            S[row, m] = -c.scratch.residuals[row]
        if kind >= LINE or (kind != OFF and F[n] - rho * u[n] > 0.0):
            for j in range(m):
                S[n, j] = rho * c.W[n, j]
        else:
            S[n, n] = 1.0
        if kind in (CONE, DOUBLE):
            level = abs(F[n]) if kind == DOUBLE else max(0.0, F[n] - rho * u[n])
            sense, own = (math.copysign(1.0, F[n]), 0.0) if kind == DOUBLE else (1.0, rho)
            x1, x2, g = F[t] - rho * u[t], F[s] - rho * u[s], c.mu[i] * level
            size = math.hypot(x1, x2)
            if size <= g and g > 0.0:
                for j in range(m):
                    S[t, j], S[s, j] = rho * c.W[t, j], rho * c.W[s, j]
            else:
                S[t, t], S[s, s] = 1.0, 1.0
                if g > 0.0:
                    d1, d2, turn = x1 / size, x2 / size, g / size
                    for j in range(m):
                        y1 = (1.0 if j == t else 0.0) - rho * c.W[t, j]
                        y2 = (1.0 if j == s else 0.0) - rho * c.W[s, j]
                        y0 = c.mu[i] * ((sense if j == n else 0.0) - own * c.W[n, j])
                        across = turn * (d1 * y2 - d2 * y1)
                        S[t, j] -= d1 * y0 - d2 * across
                        S[s, j] -= d2 * y0 + d1 * across
        else:
            S[t, t], S[s, s] = 1.0, 1.0
            if kind != OFF:
                S[t, n], S[s, n] = c.problem.along[i, 0], c.problem.along[i, 1]
    solve_any_rank(S, m, 1, c.scratch.column_order, c.scratch.solution, DEPENDENT)


@kernel
def solve_from_here(c: Contacts, k: int, sweeps: int, rounds: int, inner: float = 0.0) -> bool:
    """Do `solve_contacts` by the two methods in turns, from F, with so many sweeps of the first at first.

    The residual may be a share of `inner`, N, too, not of what is asked for alone: the forces in a tower that is
    pressed are many times that.
    """
    largest, m, F, best, accepted = largest_mobility(c, k), 3 * k, c.F, math.inf, 0.0
    if not largest > 0.0:
        largest = 1.0
    size = size_of_q(c, k) / largest
    inner = min(max(inner, size), INNER * size)
    for j in range(m):
        c.scratch.best[j] = F[j]
    count = sweeps
    for attempt in range(rounds):
        c.problem.penalty = 10.0 ** ((attempt + 1) // 2 * (1 - 2 * (attempt % 2)))  # 1, 0.1, 10, 0.01 ...
        best = math.inf
        for _ in range(count):
            sweep(c, k, F, largest)
        worst = write_residuals(c, k, F, largest)
        for _ in range(NEWTON_STEPS):
            scale = size
            for j in range(m):
                scale = max(scale, abs(F[j]))
            if worst < best:
                best = worst
                for j in range(m):
                    c.scratch.best[j] = F[j]
            if worst <= SOLVED * scale or not worst < math.inf:
                break
            c.problem.steps += 1.0
            newton_step(c, k, F, largest)
            share, before = 1.0, worst
            for _ in range(HALVINGS):
                for j in range(m):
                    c.scratch.trial[j] = F[j] + share * c.scratch.solution[0, j]
                worst = write_residuals(c, k, c.scratch.trial, largest)
                if worst < (1.0 - 0.1 * share) * before:
                    break
                share *= 0.5
            if not worst < before:
                if attempt % 2 == 0:
                    break
                for j in range(m):  # a residual may have to grow before it shrinks
                    c.scratch.trial[j] = F[j] + c.scratch.solution[0, j]
                worst = write_residuals(c, k, c.scratch.trial, largest)
            if before <= ACCEPTED * inner and worst > 0.5 * before:
                break  # what is left is rounding
            for j in range(m):
                F[j] = c.scratch.trial[j]
        for j in range(m):
            F[j] = c.scratch.best[j]
        c.problem.penalty = 1.0
        best = write_residuals(c, k, F, largest)
        accepted = max(ACCEPTED * inner, SOLVED * force_size(F, m))
        if best <= accepted:
            break
        count = min(max(2 * count, SWEEPS), MOST_SWEEPS)
    c.problem.residual = best
    return bool(best <= accepted and force_size(F, m) <= WEDGED * size)


@kernel
def polish(c: Contacts, k: int) -> None:
    """Reduce the residual at F, which is found, by full steps of Newton's method; F stays where they do not.

    Where W is singular a step of the shorter ones along the line stops at 1e-10 of the force.
    """
    largest, m, best = largest_mobility(c, k), 3 * k, c.problem.residual
    if not best * largest > ROUGH * size_of_q(c, k):
        return
    for j in range(m):
        c.scratch.best[j] = c.F[j]
    for _ in range(POLISHING):
        c.problem.penalty = OTHER_PENALTY
        write_residuals(c, k, c.F, largest)
        newton_step(c, k, c.F, largest)
        for j in range(m):
            c.F[j] += c.scratch.solution[0, j]
        c.problem.penalty = 1.0
        worst = write_residuals(c, k, c.F, largest)
        if not worst < math.inf:
            break
        if worst < best:
            best = worst
            for j in range(m):
                c.scratch.best[j] = c.F[j]
    for j in range(m):
        c.F[j] = c.scratch.best[j]
    c.problem.residual = write_residuals(c, k, c.F, largest)


@kernel
def soften(c: Contacts, k: int) -> None:
    """Write F near that of contacts that give way a little: of forces that are not unique nearly the shortest.

    The modes are then those of the forces that follow, and what is symmetric stays so.
    """
    largest = largest_mobility(c, k)
    for i in range(3 * k):
        c.problem.diagonal[i] = c.W[i, i]
        c.W[i, i] += SOFTNESS * largest
    solve_from_here(c, k, SWEEPS, ROUNDS)
    for i in range(3 * k):
        c.W[i, i] = c.problem.diagonal[i]


@kernel
def harden(c: Contacts, k: int, inner: float) -> None:
    """Write the F of contacts that give way all alike, and ever less: one F, wherever it starts, but for rounding.

    Feet of one body share their forces in many ways, or in one that hardly differs from others: Newton's method does
    not find it from anywhere, and rounding decides where it ends. Contacts that give way much share them in one, and as
    they give way less the modes change one by one. The last rounds are those of the proximal point (R. T. Rockafellar,
    SIAM J. Control Optim. 14, 1976), with ε (F − F_last) for ε F: they leave nothing of ε.
    """
    softness, steps = SOFTEST * largest_mobility(c, k), c.problem.steps
    for i in range(3 * k):
        c.problem.diagonal[i], c.problem.given_q[i] = c.W[i, i], c.problem.q[i]
    for done in range(HARDER + PROXIMAL):
        for i in range(3 * k):
            c.W[i, i] = c.problem.diagonal[i] + softness
        solve_from_here(c, k, 0, ROUNDS, inner)
        softness *= LESS_SOFT if done < HARDER else 1.0
        for i in range(3 * k if done >= HARDER else 0):
            c.problem.q[i] = c.problem.given_q[i] - softness * c.F[i]
    c.problem.steps = steps  # which counts what this does once
    for i in range(3 * k):
        c.W[i, i], c.problem.q[i] = c.problem.diagonal[i], c.problem.given_q[i]


@kernel
def keep_better(c: Contacts, k: int, least: float) -> float:
    """Keep F if its `residual` is below the least so far; return the least."""
    if not c.problem.residual < least:
        return least
    for j in range(3 * k):
        c.scratch.closest[j] = c.F[j]
    return float(c.problem.residual)


@kernel
def take_kept(c: Contacts, k: int) -> None:
    """Write F that was kept, `residual` and `after` there."""
    for j in range(3 * k):
        c.F[j] = c.scratch.closest[j]
    c.problem.residual = write_residuals(c, k, c.F, largest_mobility(c, k))


@kernel
def solve_contacts(c: Contacts, k: int, starts: int = len(STARTS)) -> bool:
    """Write F and `after`, u = q + W F, of the contacts whose `kind` is not OFF; return whether they were found.

    `residual` is what the equations are off, of forces; if they were not found F is what is off least. Starts from F;
    W, q, kind, mu and along are read. `starts` is from how many points paths are followed, where the quick method does
    not find them.
    """
    a = pack(c, k)
    soften(c, a)
    found = solve_from_here(c, a, 0, 1)
    least = keep_better(c, a, math.inf)
    if not found:
        for i in range(3 * a):
            c.F[i] = 0.0
        found = solve_from_here(c, a, SWEEPS, ROUNDS)
        least = keep_better(c, a, least)
    for i in range(0 if found else starts):
        found = found or (follow_path(c, a, STARTS[i]) and solve_from_here(c, a, 0, LAST_ROUNDS))
        least = keep_better(c, a, least)
    if found:
        polish(c, a)
    else:
        take_kept(c, a)
    unpack(c, k, a)
    if a < k:
        velocities(c, k, c.F, c.problem.after)
    return found


@kernel
def sweep_long(c: Contacts, k: int) -> None:
    """Write F by sweeps of Gauss and Seidel's method alone, from none, and `residual` there."""
    largest = largest_mobility(c, k)
    for i in range(3 * k):
        c.F[i] = 0.0
    for _ in range(LONG_SWEEPS):
        sweep(c, k, c.F, largest)
    c.problem.penalty = 1.0
    c.problem.residual = write_residuals(c, k, c.F, largest)


@kernel
def solve_impulses(c: Contacts, k: int, starts: int = len(STARTS)) -> bool:
    """Do `solve_contacts` for a problem of velocities, which has a solution; if not found, F is what is off least.

    Where forces are not unique Newton's method takes the shortest of what sticks, be it outside its cone by a little;
    sweeps find one inside.
    """
    if solve_contacts(c, k, starts):
        return True
    if starts < len(STARTS):
        return False
    least = keep_better(c, k, math.inf)
    sweep_long(c, k)
    least = keep_better(c, k, least)
    if solve_from_here(c, k, 0, LAST_ROUNDS):
        return True
    take_kept(c, k)
    return False
