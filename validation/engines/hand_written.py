# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`
"""The hand-written oracle under the names that all engines have."""

import numpy as np

from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.oracle import Oracle, UnsupportedModel
from validation.oracle.closure import closure_error, closure_rate, impulse, solve_bordered, stabilised_drift
from validation.oracle.spatial import Array


class HandWritten(Engine):
    """The paper's equations in base coordinates (`validation.oracle`), the judge of all others.

    Joint order: the robot's own. Frames: everything about the base origin, along base axes. Armature: on the
    diagonal of H. Gravity: in C, as the force that an upward base acceleration would ask for. Sign of f: positive
    along +n on the robot. Constraint: one row A = nᵀJᵣ in the dense bordered matrix of Eq. 24. Reads URDF only.
    Accuracy: rounding of 6 × 6 products, taken about the base origin; times the condition number of the bordered
    matrix in q̈ and f.
    """

    name = "oracle"
    covers = frozenset(METHODS)

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        try:
            self.oracle = Oracle.from_model(robot, tip)
        except UnsupportedModel as error:
            raise CannotBuild(str(error)) from error

    def mass_matrix(self, q: Array) -> Array:
        return self.oracle.mass_matrix(q)

    def bias(self, q: Array, v: Array) -> Array:
        return self.oracle.bias(q, v)

    def gravity_term(self, q: Array) -> Array:
        return self.oracle.gravity_term(q)

    def position(self, q: Array) -> Array:
        return self.oracle.position(q)

    def jacobian(self, q: Array) -> Array:
        return self.oracle.jacobian(q)

    def drift(self, q: Array, v: Array) -> Array:
        return self.oracle.drift(q, v)

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        return self.oracle.forward_dynamics(q, v, torque)

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        terms = self.oracle.terms(q, v)
        a, f = solve_bordered(terms.mass_matrix, torque - terms.bias, normal @ terms.jacobian, np.array([b]))
        return a, float(f[0])

    def stabilised(self, q: Array, v: Array, normal: Array, offset: float, gains: Array) -> float:
        J = self.oracle.jacobian(q)
        e, rate = closure_error(normal, offset, self.oracle.position(q)), closure_rate(normal, J, v)
        return float(stabilised_drift(normal @ self.oracle.drift(q, v), e, rate, (gains[0], gains[1])))

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        after, p = impulse(self.oracle.mass_matrix(q), v, normal @ self.oracle.jacobian(q), restitution)
        return after, float(p[0])
