"""One step of the state by any fixed-step scheme, on the manifold of ball joints, with the decay of states of friction.

States of friction that decay by themselves, ż = g − a z: a step takes the decay exactly, however fast it is.

Bristles of a fast slip decay within microseconds, where an explicit step would need a h < 2.8. With a and g of the
stages a scheme has exponentials of sums of them, see `closedloop.mechanics.integrators.Scheme.first`:

    z⁺ = E₂ E₁ z,   E z = e^(−s) z + (1 − e^(−s))/s p,   s = h Σ wᵢ aᵢ,   p = h Σ wᵢ gᵢ

It is a commutator-free scheme of the group of such maps. All other states move as they do without it, and so the order
of the scheme holds for all together (E. Celledoni, A. Marthinsen, B. Owren, Future Generation Computer Systems 19,
2003). With s = 0 it is the Runge-Kutta scheme.

A rotation vector is not advanced by adding to it. A link that turns by θ in all, and then by u in its own axes, has
turned by θ ∘ u = log(exp θ exp u). From the beginning of a step, with the angular velocity ω in the link's axes,

    u̇ = dexp⁻¹(u, ω) = ω + u × ω/2 + c u × (u × ω),    c = 1/u² - (1 + cos u)/(2 u sin u) with u = |u|

A Runge-Kutta scheme advances u by its own weights, and θ by u: the scheme of Runge, Kutta and Munthe-Kaas, of the same
order (H. Munthe-Kaas, Applied Numerical Mathematics 29, 1999). The semi-implicit scheme has u = h ω⁺. The orientation
is as accurate as the rotation's arithmetic whatever happens: its quaternion has length one to rounding.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.loop.step.memory import Constants, Work
from closedloop.mechanics.robot.tree.layout import turn

# Some weights are negative. Where a changes so much in a step that an exponential would grow by more than e to this,
# both are one, which is of order 2.
MOST_GROWTH = 1.0


@kernel
def keep_decays(stage: int, w: Work) -> None:
    """Keep a and g of this stage, from ż, z and `decays.rate`."""
    for j in range(w.z.shape[0]):
        w.decays.rates[stage, j] = w.decays.rate[j]
        w.decays.driven[stage, j] = w.dz[j] + w.decays.rate[j] * w.z[j]


@kernel
def advance_decaying(stage: int, h: float, tableau: Array, w: Work) -> None:
    """Overwrite those z that decay with their values at the next stage, or at the step's end, h of the step, s."""
    n, first = w.q.shape[0], w.decays.first
    for j in range(w.z.shape[0]):
        s1 = s2 = p1 = p2 = fastest = 0.0
        for i in range(stage + 1):
            a, g = h * w.decays.rates[i, j], h * w.decays.driven[i, j]
            early = first[stage + 1, i]
            late = tableau[stage + 1, i] - early
            s1, p1 = s1 + early * a, p1 + early * g
            s2, p2 = s2 + late * a, p2 + late * g
            fastest = max(fastest, a)
        if fastest > 0.0:
            z = w.start.state[2 * n + j]
            if min(s1, s2) < -MOST_GROWTH:
                w.z[j] = decayed(z, s1 + s2, p1 + p2)
            else:
                w.z[j] = decayed(decayed(z, s1, p1), s2, p2)


@kernel
def decayed(z: float, s: float, p: float) -> float:
    """Return e^(−s) z + (1 − e^(−s))/s p."""
    return math.exp(-s) * z + (-math.expm1(-s) / s * p if abs(s) > 1e-300 else p)


@kernel_inlined
def advance(stage: int, h: float, semi_implicit: bool, substep: bool, tableau: Array, w: Work) -> None:
    """Move the state (q, q̇, z) from this stage's to the next stage's, or after the last stage to the step's end.

    `stage`: the stage whose derivatives q̈ (n,) and ż (k,) are given.
    `h`: step, s.
    `semi_implicit`, `substep`: the semi-implicit scheme: q advances with the new q̇; in a substep after an event with
        the mean of the old and the new, so that a bounce shorter than the step returns with the speed at which it rose.
    `tableau` (S + 1, S): see `closedloop.mechanics.integrators.Scheme.tableau`.
    `w`: in: `begin` (2 n + k,), q, q̇ and z at the beginning of the step; q, v and z of this stage, and its `qdd` and
        `dz`; `stages` (S, 2 n + k), the derivatives of the state at each stage so far. Written: this stage's
        derivatives, and q, v and z of the next.
    """
    begin, stages, qdd, dz, q, v, z = w.start.state, w.stages, w.qdd, w.dz, w.q, w.v, w.z
    n, k = q.shape[0], z.shape[0]
    if semi_implicit:
        for j in range(n):
            old = v[j]
            v[j] += h * qdd[j]
            q[j] += h * (0.5 * (old + v[j]) if substep else v[j])
        for j in range(k):
            z[j] += h * dz[j]
        return
    for j in range(n):
        stages[stage, j] = v[j]
        stages[stage, n + j] = qdd[j]
    for j in range(k):
        stages[stage, 2 * n + j] = dz[j]
    for j in range(2 * n + k):
        x = 0.0
        for i in range(stage + 1):
            x += tableau[stage + 1, i] * stages[i, j]
        x = begin[j] + h * x
        if j < n:
            q[j] = x
        elif j < 2 * n:
            v[j - n] = x
        else:
            z[j - 2 * n] = x


# Below this angle the series for c is exact to rounding, rad.
SMALL = 0.1


@kernel
def turn_rate(u0: float, u1: float, u2: float, v: Array, j: int, rate: Array, i: int) -> None:
    """Write dexp⁻¹(u, ω), rad/s, to `rate` from entry i on, with ω in v from entry j on."""
    square = u0 * u0 + u1 * u1 + u2 * u2
    if square < SMALL * SMALL:
        c = (1.0 + square * (1.0 / 60.0 + square * (1.0 / 2520.0 + square * (1.0 / 100800.0)))) / 12.0
    else:
        size = math.sqrt(square)
        c = (1.0 - 0.5 * size * math.cos(0.5 * size) / math.sin(0.5 * size)) / square
    v0, v1, v2 = v[j], v[j + 1], v[j + 2]
    a0, a1, a2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    rate[i] = v0 + 0.5 * a0 + c * (u1 * a2 - u2 * a1)
    rate[i + 1] = v1 + 0.5 * a1 + c * (u2 * a0 - u0 * a2)
    rate[i + 2] = v2 + 0.5 * a2 + c * (u0 * a1 - u1 * a0)


@kernel
def turned_within(w: Work, tableau: Array, stage: int, h: float, j: int) -> tuple[float, float, float]:
    """Return by what the ball joint from coordinate j on has turned at a stage, by the rates of those before it."""
    x = y = z = 0.0
    for i in range(stage):
        weight = h * tableau[stage, i]
        x += weight * w.stages[i, j]
        y += weight * w.stages[i, j + 1]
        z += weight * w.stages[i, j + 2]
    return x, y, z


@kernel
def advance_on_manifold(
    stage: int, h: float, semi_implicit: bool, substep: bool, tableau: Array, w: Work, constants: Constants
) -> None:
    """Do what `closedloop.loop.step.advance.advance` does, with ball joints; see there."""
    n, begin, stages, v = w.q.shape[0], w.start.state, w.stages, w.v
    advance(stage, h, semi_implicit, substep, tableau, w)
    for j in range(n):
        if constants.turns[j] == 0.0:
            continue
        if semi_implicit:
            part, old = (0.5, 0.5) if substep else (1.0, 0.0)
            u0 = h * (part * v[j] + old * begin[n + j])
            u1 = h * (part * v[j + 1] + old * begin[n + j + 1])
            u2 = h * (part * v[j + 2] + old * begin[n + j + 2])
        else:
            u0, u1, u2 = turned_within(w, tableau, stage, h, j)
            turn_rate(u0, u1, u2, stages[stage], j, stages[stage], j)
            u0, u1, u2 = turned_within(w, tableau, stage + 1, h, j)
        turn(w.q, j, begin, j, u0, u1, u2)


@kernel
def move(w: Work, constants: Constants) -> None:
    """Move the position by the small step in `column` (n,), rad (m), of ball joints in their links' axes."""
    q, step = w.q, w.scratch.column
    for j in range(q.shape[0]):
        if constants.turns[j] == 1.0:
            turn(q, j, q, j, step[j], step[j + 1], step[j + 2])
        elif not (j > 0 and constants.turns[j - 1] == 1.0) and not (j > 1 and constants.turns[j - 2] == 1.0):
            q[j] += step[j]
