"""Fixed-step integrators: a tableau, an order, a source; one kernel advances them all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import kernel

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


@kernel
def advance(
    stage: int, h: float, semi_implicit: bool, tableau: Array, qdd: Array, stages: Array, q: Array, v: Array
) -> None:
    """Move (q, v) from this stage's state to the next stage's, or after the last stage to the next step's.

    Parameters
    ----------
    stage : int
        The stage whose acceleration `qdd` (n,) is.
    h : float
        Step, s.
    tableau : (S + 1, S) array
        See `Integrator.tableau`.
    stages : (2 S + 2, n) array
        q̇ and q̈ of each stage so far, of which this stage's are written, then q and v at the beginning of the step,
        written at stage 0.
    q, v : (n,) arrays
        In: this stage's state. Out: the next one's.
    """
    n = q.shape[0]
    if semi_implicit:
        for j in range(n):
            v[j] += h * qdd[j]
            q[j] += h * v[j]
        return
    start = 2 * tableau.shape[1]
    if stage == 0:
        for j in range(n):
            stages[start, j] = q[j]
            stages[start + 1, j] = v[j]
    for j in range(n):
        stages[2 * stage, j] = v[j]
        stages[2 * stage + 1, j] = qdd[j]
    for j in range(n):
        dq = 0.0
        dv = 0.0
        for k in range(stage + 1):
            dq += tableau[stage + 1, k] * stages[2 * k, j]
            dv += tableau[stage + 1, k] * stages[2 * k + 1, j]
        q[j] = stages[start, j] + h * dq
        v[j] = stages[start + 1, j] + h * dv
