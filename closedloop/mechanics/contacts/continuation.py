"""Forces in Coulomb's cones along a path from a problem whose solution is known, where no quick method finds them.

With y = (μ f, F_t) and z = ρ (u_n/μ + |u_t|, u_t) of each contact, the problem of
`closedloop.mechanics.contacts.complementarity` is y ∈ Q, z ∈ Q, yᵀz = 0 with the cone Q = {|x_t| <= x_0}, whose Jordan
algebra gives every x two eigenvalues x_0 ± |x_t|. The path has

    y = p(x), z = p(−x):  y ∘ z = τ² e,      p(λ) = (λ + √(λ² + 4τ²))/2 of each eigenvalue,  |u_t| -> √(|u_t|² + τ²/ρ²)

(M. Fukushima, Z.-Q. Luo and P. Tseng, SIAM J. Optim. 12, 2002). Of a contact that slides already, or has no friction,
f and ρ u_n + τ take the place of y and z. One that also pulls, and may stick, is followed without friction: the path
leads near enough. At τ0 any x0 solves the problem whose residual is less by R(x0, τ0); the path is R(x, τ) = (τ/τ0)
R(x0, τ0), from there to τ = 0. It is followed by its arc length (E. L. Allgower and K. Georg, Numerical Continuation
Methods, 1990), for it may turn back to larger τ in between.

Where q is a velocity that joints can have and friction is Coulomb's alone, as in an impact without restitution, forces
are bounded for every τ > 0: Fᵀ(W F + q) + τ Σ f is, and q and W F belong to velocities of the same joints. The path
then ends nowhere but at τ = 0, so that there is a solution. (Existence: V. Acary, F. Cadoux, C. Lemaréchal and J.
Malick, ZAMM 91, 2011.) Otherwise its forces may grow beyond all bounds: that is how a problem without solution shows.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import CONE, LINE, OFF, Contacts
from closedloop.mechanics.contacts.shortest import solve_any_rank

# Where the path ends, of τ0, and where it may, if rounding stops it; force and τ, of τ0, from which it will not return.
END, NEAR_END, MOST_FORCE, MOST_TAU = 1e-7, 1e-3, 1e6, 50.0
# Steps; length of the first, the longest and the shortest; corrections in each, and when one is done.
STEPS, FIRST, LONGEST, SHORTEST, CORRECTIONS, ON_PATH = 300, 0.3, 2.0, 1e-7, 5, 1e-8


@kernel
def positive_part(x: float, tau: float) -> tuple[float, float, float]:
    """Return p(x) and its derivatives with respect to x and τ."""
    root = math.hypot(x, 2.0 * tau)
    p = 0.5 * (x + root) if x > 0.0 else 2.0 * tau * tau / (root - x)
    return p, p / root, 2.0 * tau / root


@kernel
def smooth_part(x: Array, sign: float, tau: float, y: Array, D: Array, by_tau: Array) -> None:
    """Write y = p(± x) (3,) of the cone Q, its derivative (3, 3) with respect to ± x, and with respect to τ (3,)."""
    size = math.hypot(x[1], x[2])
    d1, d2 = (sign * x[1] / size, sign * x[2] / size) if size > 0.0 else (1.0, 0.0)
    p1, g1, t1 = positive_part(sign * x[0] - size, tau)
    p2, g2, t2 = positive_part(sign * x[0] + size, tau)
    turn = (p2 - p1) / (2.0 * size) if size > 0.0 else g1
    mean, half = 0.5 * (g1 + g2), 0.5 * (g2 - g1)
    y[0], y[1], y[2] = 0.5 * (p1 + p2), 0.5 * (p2 - p1) * d1, 0.5 * (p2 - p1) * d2
    by_tau[0], by_tau[1], by_tau[2] = 0.5 * (t1 + t2), 0.5 * (t2 - t1) * d1, 0.5 * (t2 - t1) * d2
    D[0, 0], D[0, 1], D[0, 2], D[1, 0], D[2, 0] = mean, half * d1, half * d2, half * d1, half * d2
    D[1, 1] = mean * d1 * d1 + turn * d2 * d2
    D[2, 2] = mean * d2 * d2 + turn * d1 * d1
    D[1, 2] = D[2, 1] = (mean - turn) * d1 * d2


@kernel
def write_pairs(c: Contacts, k: int, x: Array, tau: float) -> None:
    """Write `trial`, the forces F at x, and z into `residuals`, with their derivatives by x and by τ."""
    for i in range(k):
        n = 3 * i
        F, by_x, by_tau = c.scratch.trial[n : n + 3], c.path.force[n : n + 3], c.path.force_rate[n : n + 3]
        z, dz, z_rate = c.scratch.residuals[n : n + 3], c.path.gap[n : n + 3], c.path.gap_rate[n : n + 3]
        if c.problem.form[i] == CONE and c.mu[i] > 0.0:
            smooth_part(x[n : n + 3], 1.0, tau, F, by_x, by_tau)
            smooth_part(x[n : n + 3], -1.0, tau, z, dz, z_rate)
            F[0] /= c.mu[i]
            by_tau[0] /= c.mu[i]
            for j in range(3):
                by_x[0, j] /= c.mu[i]
            continue
        by_x[:], dz[:], z[:], z_rate[:] = 0.0, 0.0, 0.0, 0.0
        f, slope, rate = x[n], 1.0, 0.0
        if c.problem.form[i] == OFF:
            f, slope = 0.0, 0.0
        elif c.problem.form[i] < LINE:
            f, slope, rate = positive_part(x[n], tau)
            z[0], dz[0, 0], z_rate[0] = positive_part(-x[n], tau)
        for j in range(3):
            share = 1.0 if j == 0 else (0.0 if c.problem.form[i] == CONE else -c.problem.along[i, j - 1])
            F[j], by_x[j, 0], by_tau[j] = share * f, share * slope, share * rate


@kernel
def write_path(c: Contacts, k: int, x: Array, log_tau: float, tau0: float) -> float:
    """Write what x is off the path at τ = τ0 e^log_tau, and its derivatives into `system`; return the largest.

    Divided by τ0, as the columns for x / τ0 and log τ are.
    """
    m, S, share = 3 * k, c.scratch.system, math.exp(log_tau)
    tau = share * tau0
    write_pairs(c, k, x, tau)
    for row in range(m):
        c.problem.after[row], S[row, m] = c.problem.q[row], 0.0
        for j in range(k):
            n = 3 * j
            for b in range(3):
                c.problem.after[row] += c.W[row, n + b] * c.scratch.trial[n + b]
                S[row, m] += c.W[row, n + b] * c.path.force_rate[n + b]
            for b in range(3):
                s = 0.0
                for a in range(3):
                    s += c.W[row, n + a] * c.path.force[n + a, b]
                S[row, n + b] = s
    worst = 0.0
    for i in range(k):
        write_rows(c, i, x, tau, m)
        for row in range(3 * i, 3 * i + 3):
            c.scratch.residuals[row] = (c.scratch.residuals[row] - share * c.path.start[row]) / tau0
            S[row, m] = S[row, m] * share - share * c.path.start[row] / tau0
            if not abs(c.scratch.residuals[row]) < math.inf:
                return math.inf
            worst = max(worst, abs(c.scratch.residuals[row]))
    return worst


@kernel
def write_rows(c: Contacts, i: int, x: Array, tau: float, m: int) -> None:
    """Write the three equations of contact i, z − ρ (...), and their derivatives, where `system` has those of u."""
    S, n, rho, u = c.scratch.system, 3 * i, c.path.scale[i], c.problem.after
    rough = c.problem.form[i] == CONE and c.mu[i] > 0.0
    if rough:
        small = tau / rho
        slip = math.hypot(math.hypot(u[n + 1], u[n + 2]), small)
        for j in range(m + 1):
            S[n, j] = S[n, j] / c.mu[i] + (u[n + 1] * S[n + 1, j] + u[n + 2] * S[n + 2, j]) / slip
        S[n, m] += small / rho / slip
    value = u[n] / c.mu[i] + slip if rough else u[n]
    for row in range(n, n + 3):
        if row == n or rough:
            for j in range(m + 1):
                S[row, j] *= rho
            c.scratch.residuals[row] = rho * (value if row == n else u[row]) - c.scratch.residuals[row]
            S[row, m] -= c.path.gap_rate[row]
            for j in range(3):
                S[row, n + j] += c.path.gap[row, j]
        if (row == n and c.problem.form[i] == OFF) or (row > n and not rough):
            for j in range(m + 1):
                S[row, j] = 0.0
            S[row, row], c.scratch.residuals[row] = 1.0, x[row]
    if not rough and c.problem.form[i] != OFF and c.problem.form[i] < LINE:
        c.scratch.residuals[n] += tau
        S[n, m] += 1.0


@kernel
def solve_bordered(c: Contacts, m: int, right: float) -> None:
    """Solve the m equations of `system` and one that gives the part along the path's tangent, `right`."""
    for j in range(m + 1):
        c.scratch.system[m, j] = c.path.tangent[j]
    for row in range(m):
        c.scratch.system[row, m + 1] = -c.scratch.residuals[row] if right == 0.0 else 0.0
    c.scratch.system[m, m + 1] = right
    solve_any_rank(c.scratch.system, m + 1, 1, c.scratch.column_order, c.scratch.solution, 0.0)


@kernel
def turn_tangent(c: Contacts, m: int) -> None:
    """Write the unit tangent of the path, with the sense of the last one."""
    solve_bordered(c, m, 1.0)
    length = 0.0
    for j in range(m + 1):
        length = math.hypot(length, c.scratch.solution[0, j])
    for j in range(m + 1):
        c.path.tangent[j] = c.scratch.solution[0, j] / length


@kernel
def start_path(c: Contacts, k: int, apart: float) -> float:
    """Write the first point of the path, its tangent's sense, scales and the residual there; return τ0.

    There y and z are τ0 divided by `apart`, and multiplied by it.
    """
    m, largest, tau0 = 3 * k, 0.0, 0.0
    for j in range(m):
        largest = max(largest, c.W[j, j])
    for i in range(k):
        n = 3 * i
        most = max(c.W[n, n], c.W[n + 1, n + 1], c.W[n + 2, n + 2])
        c.path.scale[i] = 1.0 / (most if most > 1e-9 * largest else largest)
        for j in range(n, n + 3):
            tau0 = max(tau0, c.path.scale[i] * abs(c.problem.q[j]))
    for j in range(m + 1):
        c.path.point[j], c.path.tangent[j] = 0.0, 0.0
    for j in range(m):
        c.path.start[j] = 0.0
    for i in range(k):
        c.path.point[3 * i] = (
            tau0 * (1.0 / apart - apart) if c.problem.form[i] < LINE and c.problem.form[i] != OFF else 0.0
        )
    c.path.tangent[m] = -1.0
    write_path(c, k, c.path.point, 0.0, tau0)
    for j in range(m):
        c.path.start[j] = c.scratch.residuals[j] * tau0
    return tau0


@kernel
def force_size(F: Array, m: int) -> float:
    """Return the largest of the numbers of F, infinite if one is no number."""
    size = 0.0
    for j in range(m):
        if not abs(F[j]) < math.inf:
            return math.inf
        size = max(size, abs(F[j]))
    return size


@kernel
def follow_path(c: Contacts, k: int, apart: float) -> bool:
    """Write F near a solution; return False if the path leads nowhere. See `start_path` for `apart`."""
    m, length = 3 * k, FIRST
    tau0 = start_path(c, k, apart)
    if not 0.0 < tau0 < math.inf:
        return False
    x, after = c.path.point, c.path.trial
    for _ in range(STEPS):
        write_path(c, k, x, x[m], tau0)
        most = force_size(c.scratch.trial, m)
        if most > MOST_FORCE * tau0 or x[m] > math.log(MOST_TAU):
            return False
        for j in range(m):
            c.F[j] = c.scratch.trial[j]
        if x[m] <= math.log(END):
            return True
        turn_tangent(c, m)
        if length * abs(c.path.tangent[m]) > LONGEST:
            length = LONGEST / abs(c.path.tangent[m])
        corrections = CORRECTIONS
        while corrections == CORRECTIONS:
            for j in range(m):
                after[j] = x[j] + length * tau0 * c.path.tangent[j]
            after[m] = x[m] + length * c.path.tangent[m]
            corrections = correct(c, k, tau0)
            if corrections == CORRECTIONS:
                length *= 0.4
                if not length > SHORTEST:
                    return bool(x[m] <= math.log(NEAR_END))
        if corrections <= 2:
            length = min(2.0 * length, max(LONGEST, most / tau0))  # a path to infinity is long, and straight
        for j in range(m + 1):
            x[j] = after[j]
    return False


@kernel
def correct(c: Contacts, k: int, tau0: float) -> int:
    """Bring `path_trial` onto the path by Newton's method, across the tangent; return its steps, or CORRECTIONS."""
    m, before = 3 * k, math.inf
    for step in range(CORRECTIONS):
        off = write_path(c, k, c.path.trial, c.path.trial[m], tau0)
        if off <= ON_PATH:
            return step
        if not off <= 0.5 * before:
            break
        before = off
        solve_bordered(c, m, 0.0)
        for j in range(m):
            c.path.trial[j] += tau0 * c.scratch.solution[0, j]
        c.path.trial[m] = min(c.path.trial[m] + c.scratch.solution[0, m], 10.0)
    return CORRECTIONS
