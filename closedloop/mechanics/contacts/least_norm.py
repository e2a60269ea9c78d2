"""Of forces that are not unique those of least norm, inside the cones.

Forces F that move the tree alike have the same sum s = Xᵀ F. The shortest of them in the cones is F = Π(X λ), with Π
the nearest point of the cones and λ the solution of

    Xᵀ Π(X λ) = s

the gradient of a convex function, found by the generalised Newton method (L. Qi and J. Sun, Math. Program. 58, 1993).
If there is none, no forces inside the cones do it.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.joint_space import eliminate
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, Contacts
from closedloop.mechanics.contacts.resistance import has_resistance, is_resistance
from closedloop.mechanics.contacts.shared_cone import add_shared_slope, nearest_shared

# Newton steps; what may be left of the sum, of its size, when it is found, and if that was all that could be had.
STEPS, FOUND, NEAR, HALVINGS = 60, 1e-14, 1e-11, 30


@kernel
def least_norm(c: Contacts, k: int, force: Array, inside: bool) -> bool:
    """Replace a force (3 k,) by the shortest with the same sum; return whether there is one.

    With `inside` it is in the cones of its contacts, as `kind`, mu and along have them; else in the spaces that they
    span.
    """
    n, m = c.scratch.Y.shape[1], 3 * k
    size, scale = 0.0, 0.0
    for j in range(n):
        c.scratch.sum[j], c.scratch.multiplier[j] = 0.0, 0.0
    for i in range(m):
        subtract(c.scratch.sum, -(force[i] + c.viscous[i]), row_of(c.scratch.Y, i), n)
    for j in range(n):
        size = max(size, abs(c.scratch.sum[j]))
    for i in range(m):
        scale = max(scale, c.S[i // 3, i % 3, i % 3])
    if not size > 0.0 or not scale > 0.0:
        for i in range(m):
            force[i] = -c.viscous[i]
        return True
    left, now = 0.0, 0.0
    for phase in range(2 if inside else 1):  # the shortest of all forces is the first guess
        spans = phase == 0
        left = project_all(c, k, c.scratch.multiplier, spans)
        for _ in range(STEPS):
            if left <= FOUND * size:
                break
            newton(c, k, spans, scale)
            share, before, slope = 1.0, value_of(c, k), 0.0
            for j in range(n):
                slope += c.scratch.solution[0, j] * c.scratch.solution[1, j]
                c.scratch.sum_trial[j] = c.scratch.multiplier[j]
            for _ in range(HALVINGS):
                for j in range(n):
                    c.scratch.multiplier[j] = c.scratch.sum_trial[j] + share * c.scratch.solution[0, j]
                now = project_all(c, k, c.scratch.multiplier, spans)
                if now < 0.5 * left or value_of(c, k) <= before - 1e-4 * share * slope:
                    break
                share *= 0.5
            if now >= left and left <= NEAR * size:
                for j in range(n):
                    c.scratch.multiplier[j] = c.scratch.sum_trial[j]
                left = project_all(c, k, c.scratch.multiplier, spans)
                break
            left = now
    if not left <= NEAR * size:
        return False
    for i in range(m):
        force[i] = c.scratch.trial[i] - c.viscous[i]
    for i in range(k):  # a resistance has the normal force of its contact
        if is_resistance(c, i):
            force[3 * i] = force[3 * int(c.friction.resistance.owner[i])] if c.problem.form[i] != OFF else 0.0
    return True


@kernel
def project_all(c: Contacts, k: int, multiplier: Array, spans: bool) -> float:
    """Write `trial` = Π(X λ), and s − Xᵀ Π(X λ) as the second row of `solution`; return its largest number."""
    n, m = c.scratch.Y.shape[1], 3 * k
    for i in range(m):
        s, row = 0.0, row_of(c.scratch.Y, i)
        for j in range(n if c.problem.form[i // 3] != OFF else 0):
            s += row[j] * multiplier[j]
        c.scratch.best[i], c.scratch.trial[i] = s, s
    for i in range(k):
        F, kind = c.scratch.trial[3 * i : 3 * i + 3], c.problem.form[i]
        if kind == OFF:
            F[0], F[1], F[2] = 0.0, 0.0, 0.0
        elif is_resistance(c, i):
            F[0] = 0.0  # the rest is written with its owner's
        elif has_resistance(c, i):
            nearest_shared(c, i, c.scratch.best, spans, c.scratch.trial)
        elif kind in (CONE, DOUBLE):
            if kind == DOUBLE:
                F[0] *= c.friction.sense[i]
            if not spans:
                into_cone(F, c.mu[i])
            if kind == DOUBLE:
                F[0] *= c.friction.sense[i]
        else:
            c1, c2 = c.problem.along[i, 0], c.problem.along[i, 1]
            f = (F[0] - c1 * F[1] - c2 * F[2]) / (1.0 + c1 * c1 + c2 * c2)
            if f < 0.0 and kind < LINE and not spans:
                f = 0.0
            F[0], F[1], F[2] = f, -c1 * f, -c2 * f
    left, worst = row_of(c.scratch.solution, 1), 0.0
    for j in range(n):
        left[j] = c.scratch.sum[j]
    for i in range(m):
        if c.problem.form[i // 3] != OFF:
            subtract(left, c.scratch.trial[i], row_of(c.scratch.Y, i), n)
    for j in range(n):
        worst = max(worst, abs(left[j]))
    return worst


@kernel
def value_of(c: Contacts, k: int) -> float:
    """Return the convex function whose gradient is −`solution[1]`, where `project_all` was asked last."""
    total = 0.0
    for i in range(3 * k):
        total += 0.5 * c.scratch.trial[i] * c.scratch.trial[i]
    for j in range(c.scratch.Y.shape[1]):
        total -= c.scratch.sum[j] * c.scratch.multiplier[j]
    return total


@kernel
def newton(c: Contacts, k: int, spans: bool, scale: float) -> None:
    """Write the step (Xᵀ DΠ X + ε)⁻¹(s − Xᵀ Π(X λ)) as the first row of `solution`; ε only makes it unique."""
    n, S = c.scratch.Y.shape[1], c.scratch.system
    for j in range(n):
        for i in range(n):
            S[j, i] = 0.0
        S[j, j] = 1e-11 * scale
    for i in range(k):
        if c.problem.form[i] == OFF or is_resistance(c, i):
            continue
        if has_resistance(c, i):
            add_shared_slope(c, i, c.scratch.best, spans, c.scratch.trial, c.scratch.Y, S)
            continue
        if not write_slope(c, i, spans):
            continue
        for a in range(3):
            for b in range(3):
                d = c.scratch.slope[a, b]
                if d != 0.0:
                    x, y = row_of(c.scratch.Y, 3 * i + a), row_of(c.scratch.Y, 3 * i + b)
                    for j in range(n):
                        if x[j] != 0.0:
                            subtract(row_of(S, j), -d * x[j], y, n)
    for j in range(n):
        c.scratch.solution[0, j] = c.scratch.solution[1, j]
    eliminate(S, row_of(c.scratch.solution, 0), n)


@kernel
def write_slope(c: Contacts, i: int, spans: bool) -> bool:
    """Write the derivative (3, 3) of the projection of contact i, where `project_all` was asked; False if zero."""
    D, kind = c.scratch.slope, c.problem.form[i]
    for a in range(3):
        for b in range(3):
            D[a, b] = 1.0 if a == b else 0.0
    x0, x1, x2, sense = c.scratch.best[3 * i], c.scratch.best[3 * i + 1], c.scratch.best[3 * i + 2], 1.0
    if kind == DOUBLE:
        sense = c.friction.sense[i]
        x0 *= sense
    mu, size = c.mu[i], math.hypot(x1, x2)
    v0, v1, v2, turn = 1.0, -c.problem.along[i, 0], -c.problem.along[i, 1], 0.0
    if kind in (CONE, DOUBLE):
        if spans or size <= mu * x0:
            return True
        if mu * size <= -x0:
            return False
        v1, v2 = mu * x1 / size, mu * x2 / size
        turn = mu * (x0 + mu * size) / (1.0 + mu * mu) / size
    elif kind < LINE and not spans and not c.scratch.trial[3 * i] > 0.0:
        return False
    length = v0 * v0 + v1 * v1 + v2 * v2
    for a in range(3):
        for b in range(3):
            left = v0 if a == 0 else (v1 if a == 1 else v2)
            right = v0 if b == 0 else (v1 if b == 1 else v2)
            D[a, b] = left * right / length
    if turn > 0.0:
        e1, e2 = -x2 / size, x1 / size
        D[1, 1] += turn * e1 * e1
        D[1, 2] += turn * e1 * e2
        D[2, 1] += turn * e1 * e2
        D[2, 2] += turn * e2 * e2
    for j in range(1, 3):
        D[0, j] *= sense
        D[j, 0] *= sense
    return True


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
def subtract(x: Array, share: float, y: Array, p: int) -> None:
    """Subtract from the first p numbers of x a share of those of y."""
    if share != 0.0:
        for j in range(p):
            x[j] -= share * y[j]
