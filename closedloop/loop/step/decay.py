"""States of friction that decay by themselves, ż = g − a z: a step takes the decay exactly, however fast it is.

Bristles of a fast slip decay within microseconds, where an explicit step would need a h < 2.8. With a and g of the
stages a scheme has exponentials of sums of them, see `closedloop.mechanics.integrators.Scheme.first`:

    z⁺ = E₂ E₁ z,   E z = e^(−s) z + (1 − e^(−s))/s p,   s = h Σ wᵢ aᵢ,   p = h Σ wᵢ gᵢ

It is a commutator-free scheme of the group of such maps. All other states move as they do without it, and so the order
of the scheme holds for all together (E. Celledoni, A. Marthinsen, B. Owren, Future Generation Computer Systems 19,
2003). With s = 0 it is the Runge-Kutta scheme.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.loop.step.memory import Work

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
