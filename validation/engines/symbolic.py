# ruff: noqa: D102 - what a method returns is said once, in `interface.Engine`
"""The ground truth: Lagrange's equations derived by sympy and evaluated in fifty digits by mpmath."""

from typing import Any

import numpy as np

from validation.engines.interface import METHODS, CannotBuild, Engine, Robot
from validation.engines.lagrangian import BITS, Values, derive
from validation.oracle.spatial import Array

MOST_JOINTS = 4


class Symbolic(Engine):
    """Lagrange's equations, with nothing of any multibody algorithm in them.

    From the text by a reader of its own: the centre of mass c and the rotation R of every link, as polynomials in
    cos qᵢ and sin qᵢ (or qᵢ, if prismatic), which sympy multiplies and differentiates.
    T = Σ ½ m ċ·ċ + ½ tr(Ṙ Σ Ṙᵀ) + ½ armature q̇², where Σ = ½ tr(I) 1 − I is the second moment of the link's
    mass about its centre, so that not even an angular velocity is needed; U = −Σ m g·c.
    H_ij = ∂²T/∂q̇_i∂q̇_j; C_i = Σ_jk (∂H_ij/∂q_k − ½ ∂H_jk/∂q_i) q̇_j q̇_k + ∂U/∂q_i; Jᵣ = ∂r/∂q;
    J̇ᵣq̇ = Σ_jk ∂²r/∂q_j∂q_k q̇_j q̇_k. Numbers have 60 digits; results are rounded once, at the end, and `exact`
    hands out all digits.

    Joint order: the robot's own, by name. Frames: base axes. Armature: a term of T. Gravity: a term of U. Sign of f:
    positive along +n on the robot. Constraint and impact: the bordered system of Eq. 24. The decimals of the text
    count as the doubles that every other engine reads.

    Accuracy: correctly rounded; 50 digits of the 60 survive a condition number of 1e10.
    """

    name = "symbolic"
    package = "sympy"
    install = 'pip install "sympy>=1.13" "mpmath>=1.3"'
    covers = frozenset(METHODS)

    def __init__(self, robot: Robot, tip: str) -> None:
        super().__init__(robot, tip)
        if robot.format != "urdf":
            raise CannotBuild(f"it reads URDF only, this robot is {robot.format!r}")
        if self.n > MOST_JOINTS:
            raise CannotBuild(f"{self.n} joints: the expressions are generated for at most {MOST_JOINTS}")
        if robot.locked:
            raise CannotBuild("it locks no joints")
        self._made = derive(
            robot.text,
            tip,
            tuple(robot.joint_names),
            tuple(float(x) for x in robot.armature),
            tuple(float(x) for x in robot.gravity),
        )

    def exact(self, method: str, *arguments: Any) -> Any:
        """Return a method's result as mpmath numbers: a matrix, or for `constrained` and `impulse` a pair."""
        import mpmath

        with mpmath.workprec(BITS):
            q, *others = [mpmath.matrix(np.atleast_1d(x).tolist()) for x in arguments]
            at = Values(self._made, q)
            return getattr(self, f"_{method}")(at, *others)

    def mass_matrix(self, q: Array) -> Array:
        return _matrix(self.exact("mass_matrix", q))

    def bias(self, q: Array, v: Array) -> Array:
        return _vector(self.exact("bias", q, v))

    def gravity_term(self, q: Array) -> Array:
        return _vector(self.exact("bias", q, np.zeros(self.n)))

    def position(self, q: Array) -> Array:
        return _vector(self.exact("position", q))

    def jacobian(self, q: Array) -> Array:
        return _matrix(self.exact("jacobian", q))

    def drift(self, q: Array, v: Array) -> Array:
        return _vector(self.exact("drift", q, v))

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        return _vector(self.exact("free_acceleration", q, v, torque))

    def stabilised(self, q: Array, v: Array, normal: Array, offset: float, gains: Array) -> float:
        return float(self.exact("stabilised", q, v, normal, offset, gains))

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        a, f = self.exact("constrained", q, v, torque, normal, b)
        return _vector(a), float(f)

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        after, p = self.exact("impulse", q, v, normal, restitution)
        return _vector(after), float(p)

    def _mass_matrix(self, at: Values) -> Any:
        return at.matrix("H")

    def _bias(self, at: Values, v: Any) -> Any:
        import mpmath

        slopes, C = [at.matrix(f"H{k}") for k in range(self.n)], at.matrix("U")
        for i in range(self.n):
            C[i] += mpmath.fsum(slopes[k][i, j] * v[j] * v[k] for j in range(self.n) for k in range(self.n))
            C[i] -= (v.T * slopes[i] * v)[0] / 2
        return C

    def _position(self, at: Values) -> Any:
        return at.matrix("r")

    def _jacobian(self, at: Values) -> Any:
        return at.matrix("J")

    def _drift(self, at: Values, v: Any) -> Any:
        import mpmath

        return sum((at.matrix(f"J{k}") * v * v[k] for k in range(self.n)), mpmath.zeros(3, 1))

    def _free_acceleration(self, at: Values, v: Any, torque: Any) -> Any:
        import mpmath

        return mpmath.lu_solve(at.matrix("H"), torque - self._bias(at, v))

    def _stabilised(self, at: Values, v: Any, normal: Any, offset: Any, gains: Any) -> Any:
        e = (normal.T * self._position(at))[0] - offset[0]
        rate = (normal.T * at.matrix("J") * v)[0]
        return -(normal.T * self._drift(at, v))[0] - gains[0] * rate - gains[1] * e

    def _constrained(self, at: Values, v: Any, torque: Any, normal: Any, b: Any) -> Any:
        return _bordered(at.matrix("H"), torque - self._bias(at, v), normal.T * at.matrix("J"), b[0])

    def _impulse(self, at: Values, v: Any, normal: Any, restitution: Any) -> Any:
        A, H = normal.T * at.matrix("J"), at.matrix("H")
        return _bordered(H, H * v, A, -restitution[0] * (A * v)[0])


def _bordered(H: Any, forcing: Any, A: Any, b: Any) -> tuple[Any, Any]:
    """Solve H x − Aᵀ f = forcing, A x = b."""
    import mpmath

    n = H.rows
    matrix, right = mpmath.zeros(n + 1), mpmath.zeros(n + 1, 1)
    matrix[:n, :n], matrix[:n, n], matrix[n, :n] = H, -A.T, A
    right[:n, 0], right[n, 0] = forcing, b
    solution = mpmath.lu_solve(matrix, right)
    return solution[:n, 0], solution[n, 0]


def _matrix(x: Any) -> Array:
    return np.array(x.tolist(), dtype=float)


def _vector(x: Any) -> Array:
    return np.array([float(entry) for entry in x])
