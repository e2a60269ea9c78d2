"""An engine as the grading sees it: what it answers itself, and what Eq. 1 and Eq. 24 make of its own terms.

An engine is an object with some of the methods of `validation.oracle.Oracle`; `free_acceleration`, `constrained` and
`impulse` of `validation.engines` are asked too. The rule for every quantity: the engine's own method if it has one;
else the equation of motion assembled from the engine's own H, C, J and drift; else it is not covered.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from validation.oracle.closure import impulse, solve_bordered
from validation.oracle.spatial import Array
from validation.oracle.tree import RobotModel

EngineFactory = Callable[[Any, str], object]
"""(robot, name of its tip) → an engine."""


class Unanswered(NotImplementedError):
    """The engine has no method that this quantity could come from."""


class Asked:
    """One engine, built anew for each tip that is asked for.

    factory: (robot, tip) → engine
    tip: link whose origin is the tip
    """

    def __init__(self, factory: EngineFactory, model: RobotModel, tip: str) -> None:
        self.factory, self.model, self.tip = factory, model, tip
        self.n = len(model.joint_names)
        self._engine = factory(model, tip)
        self._others: dict[str, Asked] = {}

    def at(self, tip: str) -> Asked:
        """Return the same engine with another link of the robot as its tip."""
        if tip not in self._others:
            self._others[tip] = Asked(self.factory, self.model, tip)
        return self._others[tip]

    def mass_matrix(self, q: Array) -> Array:
        """Return H (n, n)."""
        return self._ask("mass_matrix", q)

    def bias(self, q: Array, v: Array) -> Array:
        """Return C (n,), gravity included."""
        return self._ask("bias", q, v)

    def position(self, q: Array) -> Array:
        """Return the tip r (3,), base frame [m]."""
        return self._ask("position", q)

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n), base frame."""
        return self._ask("jacobian", q)

    def drift(self, q: Array, v: Array) -> Array:
        """Return J̇ᵣq̇ (3,), base frame [m/s²]."""
        return self._ask("drift", q, v)

    def coriolis_matrix(self, q: Array, v: Array) -> Array:
        """Return the Coriolis matrix of Christoffel symbols (n, n)."""
        return self._ask("coriolis_matrix", q, v)

    def gravity_term(self, q: Array) -> Array:
        """Return the gravity part of C (n,), which is C at rest."""
        return self._first(lambda: self._ask("gravity_term", q), lambda: self.bias(q, np.zeros(self.n)))

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return Q = H q̈ + C (n,)."""
        return self._first(
            lambda: self._ask("inverse_dynamics", q, v, a), lambda: self.mass_matrix(q) @ a + self.bias(q, v)
        )

    def forward_dynamics(self, q: Array, v: Array, torque: Array) -> Array:
        """Return q̈ (n,) of the arm that touches nothing."""
        return self._first(
            lambda: self._ask("forward_dynamics", q, v, torque),
            lambda: self._ask("free_acceleration", q, v, torque),
            lambda: np.linalg.solve(self.mass_matrix(q), torque - self.bias(q, v)),
        )

    def pressed(self, q: Array, v: Array, torque: Array, normal: Array) -> Array:
        """Return f [N] and then q̈, (1 + n,), of the tip that stays in its plane: Eq. 24, no stabiliser.

        normal: (3,) unit n, base frame; f is the force of the surface on the robot along it
        """
        b = float(-normal @ self.drift(q, v))

        def assembled() -> Array:
            a, f = solve_bordered(self.mass_matrix(q), torque - self.bias(q, v), normal @ self.jacobian(q), np.array(b))
            return np.concatenate([f, a])

        def own() -> Array:
            a, f = self._method("constrained")(q, v, torque, normal, b)
            return np.concatenate([[float(f)], np.asarray(a)])

        return self._first(own, assembled)

    def rebound(self, q: Array, v: Array, normal: Array, restitution: float) -> Array:
        """Return q̇⁺ (n,) after an impact along `normal` (3,)."""
        return self._first(
            lambda: np.asarray(self._method("impulse")(q, v, normal, restitution)[0]),
            lambda: impulse(self.mass_matrix(q), v, normal @ self.jacobian(q), restitution)[0],
        )

    def _method(self, name: str) -> Callable[..., Any]:
        method = getattr(self._engine, name, None)
        if method is None:
            raise Unanswered(f"it has no method {name}")
        return method

    def _ask(self, name: str, *state: Array) -> Array:
        return np.asarray(self._method(name)(*state), dtype=float)

    @staticmethod
    def _first(*ways: Callable[[], Array]) -> Array:
        """Return the first answer that the engine has; if there is none, say what was missing last."""
        for way in ways[:-1]:
            try:
                return way()
            except NotImplementedError:  # not this way: `Unanswered`, or `validation.engines.NotCovered`
                continue
        return ways[-1]()
