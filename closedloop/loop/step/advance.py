"""One kernel that advances the state by any fixed-step scheme of `closedloop.mechanics.integrators`."""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel_inlined
from closedloop.loop.step.memory import Work


@kernel_inlined
def advance(stage: int, h: float, semi_implicit: bool, substep: bool, tableau: Array, w: Work) -> None:
    """Move the state (q, q̇, z) from this stage's to the next stage's, or after the last stage to the step's end.

    Parameters
    ----------
    stage : int
        The stage whose derivatives q̈ (n,) and ż (k,) are given.
    h : float
        Step, s.
    semi_implicit, substep : bool
        The semi-implicit scheme: q advances with the new q̇; in a substep after an event with the mean of the old and
        the new, so that a bounce shorter than the step returns with the speed at which it rose.
    tableau : (S + 1, S) array
        See `closedloop.mechanics.integrators.Scheme.tableau`.
    w : Work
        In: `begin` (2 n + k,), q, q̇ and z at the beginning of the step; q, v and z of this stage, and its `qdd` and
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
