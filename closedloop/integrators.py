"""Fixed-step integrators: a tableau, an order, a source; one kernel advances them all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.kernel import kernel_inlined

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Integrator:
    """An explicit Runge-Kutta scheme, or the semi-implicit Euler scheme.

    Attributes
    ----------
    order : int
        Order of the global error on a smooth problem.
    nodes : tuple of float
        Where in the step, as a share of h, each stage is evaluated.
    a : tuple of rows
        Weights of the earlier stages in each stage's state; row s has s entries.
    b : tuple of float
        Weights of the stages in the step.
    semi_implicit : bool
        Whether the position advances with the new velocity.
    source : str
        Where the scheme is published.
    """

    order: int
    nodes: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    semi_implicit: bool
    source: str

    @property
    def stages(self) -> int:
        """Evaluations of the equation of motion per step."""
        return len(self.b)

    def tableau(self) -> Array:
        """Return the (S + 1, S) array that `advance` reads: row s holds stage s's weights, the last row b."""
        table = np.zeros((self.stages + 1, self.stages))
        for s, row in enumerate(self.a):
            table[s, : len(row)] = row
        table[-1] = self.b
        return table


INTEGRATORS: dict[str, Integrator] = {
    "semi_implicit_euler": Integrator(
        order=1,
        nodes=(0.0,),
        a=((),),
        b=(1.0,),
        semi_implicit=True,
        source="v⁺ = v + h q̈(q, v), q⁺ = q + h v⁺; Hairer, Lubich, Wanner, Geometric Numerical Integration, I.1",
    ),
    "explicit_euler": Integrator(
        order=1,
        nodes=(0.0,),
        a=((),),
        b=(1.0,),
        semi_implicit=False,
        source="v⁺ = v + h q̈(q, v), q⁺ = q + h v",
    ),
    "rk4": Integrator(
        order=4,
        nodes=(0.0, 0.5, 0.5, 1.0),
        a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
        b=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
        semi_implicit=False,
        source="Kutta 1901; Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.1",
    ),
}

# Schemes that choose their own steps, in `closedloop.engines.adaptive`; the loop evaluates one state at a time for
# them.
ADAPTIVE: dict[str, Integrator] = {
    "dop853": Integrator(
        order=8,
        nodes=(0.0,),
        a=((),),
        b=(1.0,),
        semi_implicit=False,
        source="Prince and Dormand 1981 as DOP853; Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, "
        "II.5 and II.6; stepped by scipy.integrate",
    ),
}


@kernel_inlined
def advance(
    stage: int, h: float, semi_implicit: bool, piece: bool, tableau: Array, begin: Array, stages: Array,
    qdd: Array, dz: Array, q: Array, v: Array, z: Array,
) -> None:  # fmt: skip
    """Move the state (q, q̇, z) from this stage's to the next stage's, or after the last stage to the step's end.

    Parameters
    ----------
    stage : int
        The stage whose derivatives q̈ (n,) and ż (k,) are given.
    h : float
        Step, s.
    semi_implicit, piece : bool
        The semi-implicit scheme: q advances with the new q̇; in a piece of a step, after an event, with the mean of the
        old and the new, so that a bounce shorter than the step falls back with the speed it rose with.
    tableau : (S + 1, S) array
        See `Integrator.tableau`.
    begin : (2 n + k,) array
        q, q̇ and z at the beginning of the step.
    stages : (S, 2 n + k) array
        Derivatives of the state at each stage so far, of which this stage's are written.
    q, v, z : (n,), (n,), (k,) arrays
        In: this stage's state. Out: the next one's.
    """
    n, k = q.shape[0], z.shape[0]
    if semi_implicit:
        for j in range(n):
            old = v[j]
            v[j] += h * qdd[j]
            q[j] += h * (0.5 * (old + v[j]) if piece else v[j])
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
