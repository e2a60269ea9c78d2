"""Eqs. 2, 3 and 24 with a closure that turns: a surface φ = 0 that is curved, moves, rubs or gives way.

The plane at rest of Eq. 11 leaves Ṙ, v₀ and a₀ of Eqs. 2–3 nearly empty. Here the columns of R are the three forces
along the contact frame n, t₁, t₂ through the tip; they turn with the surface and, where it is curved, as the tip goes
along it. v₀ and a₀ are the spatial velocity and acceleration of the surface. All at the base origin O:

    u = Rᵀ (vₙ − v₀),      u̇ = Ṙᵀ (vₙ − v₀) + Rᵀ (aₙ − a₀)

Derivatives of shapes are complex steps of what is written here, not formulas of their own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from validation.oracle.closure import constraint_matrix, solve_bordered
from validation.oracle.dynamics import bias, mass_matrix
from validation.oracle.engine import Oracle
from validation.oracle.kinematics import body_velocities, point_velocity, spatial_drift, spatial_jacobian, tip_position
from validation.oracle.spatial import Array, skew

STEP = 1e-30
"""Of complex steps, which have no truncation."""


@dataclass(frozen=True)
class Shape:
    """φ in the surface's axes and its gradient (3,), both functions of p (3,), which may be complex.

    hessian : (3,) → (3, 3); by default the complex step of the gradient
    """

    level: Callable[[Array], Array]
    gradient: Callable[[Array], Array]
    own_hessian: Callable[[Array], Array] | None = None

    def hessian(self, p: Array) -> Array:
        """Return ∇∇φ (3, 3)."""
        if self.own_hessian is not None:
            return self.own_hessian(p)
        return np.stack([np.imag(self.gradient(p + 1j * STEP * e)) / STEP for e in np.eye(3)])


def plane() -> Shape:
    """Return z = 0."""
    return Shape(lambda p: p[2], lambda p: np.array([0.0, 0.0, 1.0], dtype=np.asarray(p).dtype))


def round_body(radius: float, inside: bool = False, axis: Array | None = None) -> Shape:
    """Return a sphere, or with `axis` (3,) in the tangent plane a cylinder, through the origin with normal z there."""
    side = -1.0 if inside else 1.0
    across = np.eye(3) if axis is None else np.eye(3) - np.outer(axis, axis)
    centre = np.array([0.0, 0.0, -side * radius])

    def distance(p: Array) -> Array:
        d = across @ (p - centre)
        return np.asarray(np.sqrt(d @ d))

    return Shape(lambda p: side * (distance(p) - radius), lambda p: side * across @ (p - centre) / distance(p))


def ellipsoid(a: float, b: float, c: float) -> Shape:
    """Return an ellipsoid with the end of its semi-axis c at the origin; φ has a gradient of length one there."""
    weights = c / np.array([a, b, c]) ** 2
    centre = np.array([0.0, 0.0, -c])
    return Shape(lambda p: (weights @ (p - centre) ** 2 - c) / 2, lambda p: weights * (p - centre))


def height_field(heights: Array, spacing: float) -> Shape:
    """Return z less the cubic spline through heights (rows along y, columns along x), level at the grid's edges."""
    from scipy.interpolate import CubicSpline

    rows, columns = heights.shape
    y, x = (spacing * (np.arange(count) - (count - 1) / 2) for count in (rows, columns))
    along_x = CubicSpline(x, heights, axis=1, bc_type="clamped")

    def height(p: Array, i: int, j: int) -> float:
        return float(CubicSpline(y, along_x(p[0], i), bc_type="clamped")(p[1], j))

    middle = height(np.zeros(3), 0, 0)

    def hessian(p: Array) -> Array:
        xx, xy, yy = height(p, 2, 0), height(p, 1, 1), height(p, 0, 2)
        return -np.array([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, 0.0]])

    return Shape(
        lambda p: p[2] - height(p, 0, 0) + middle,
        lambda p: np.array([-height(p, 1, 0), -height(p, 0, 1), 1.0]),
        hessian,
    )


def frame_of(n: Array) -> Array:
    """Return rows n, t₁, t₂ (3, 3): the axes z, x, y turned by the least rotation that takes z to n (3,)."""
    k = skew(np.array([-n[1], n[0], 0.0 * n[0]]))
    turn = np.eye(3) + k + k @ k / (1.0 + n[2])
    return np.stack([n, turn[:, 0], turn[:, 1]])


@dataclass(frozen=True)
class Displacement:
    """A turn by an angle about an axis through a point of the base frame, then a shift, with their derivatives.

    angle : (3,) angle, rate and acceleration [rad], ...; axis, centre : (3,); shift : (3, 3) rows shift, rate and
    acceleration [m], ...
    """

    angle: Array
    axis: Array
    centre: Array
    shift: Array

    @property
    def rotation(self) -> Array:
        """The rotation (3, 3)."""
        k = skew(self.axis)
        return np.asarray(np.eye(3) + np.sin(self.angle[0]) * k + (1.0 - np.cos(self.angle[0])) * k @ k)

    def velocity(self) -> Array:
        """Return v₀ (6,) at O."""
        omega, pivot = self.axis * self.angle[1], self.centre + self.shift[0]
        return np.concatenate([omega, self.shift[1] - np.cross(omega, pivot)])

    def acceleration(self) -> Array:
        """Return a₀ (6,) at O, the rate of v₀."""
        omega, pivot = self.axis * self.angle[1], self.centre + self.shift[0]
        turning = self.axis * self.angle[2]
        return np.concatenate([turning, self.shift[2] - np.cross(turning, pivot) - np.cross(omega, self.shift[1])])


@dataclass(frozen=True)
class Touch:
    """The closure at one state: the rows A (3, n) and drift (3,) of u̇ = A q̈ + drift, u (3,), e [m], frame (3, 3).

    at : (3,) the tip in the surface's axes [m]; local : (3, 3) the contact frame in them
    """

    A: Array
    drift: Array
    u: Array
    error: float
    frame: Array
    at: Array
    local: Array


@dataclass(frozen=True)
class SurfaceContact:
    """A robot whose tip touches a surface.

    shape: φ
    origin, axes: (3,), (3, 3) of the surface before it is displaced; rows x, y, z, base frame
    displacement: how it is displaced, and moves
    gains: s_v, s_p of the stabiliser
    push: f of depth [m] and its rate [m/s], N; None of a rigid surface
    friction: Coulomb's μ
    """

    oracle: Oracle
    shape: Shape
    origin: Array
    axes: Array
    displacement: Displacement
    gains: tuple[float, float] = (0.0, 0.0)
    push: Callable[[float, float], float] | None = None
    friction: float = 0.0

    def surface_velocity(self) -> Array:
        """Return v₀ (6,) of Eq. 2."""
        return self.displacement.velocity()

    def surface_acceleration(self) -> Array:
        """Return a₀ (6,) of Eq. 3."""
        return self.displacement.acceleration()

    def frame_rate(self, axes: Array, local: Array, p: Array, going: Array) -> Array:
        """Return Ṅ (3, 3), base axes, of a tip at p that goes along the surface with `going` (3,), in its axes."""
        g = self.shape.gradient(p)
        n_rate = (np.eye(3) - np.outer(local[0], local[0])) @ self.shape.hessian(p) @ going / np.linalg.norm(g)
        along = np.imag(frame_of(local[0] + 1j * STEP * n_rate)) / STEP
        omega = self.displacement.axis * self.displacement.angle[1]
        return np.asarray(along @ axes + np.cross(omega, local @ axes))

    def touch(self, q: Array, v: Array) -> Touch:
        """Return the rows, by Eqs. 2 and 3."""
        tree, tip = self.oracle.tree, self.oracle.tip
        pose, body = self.oracle.pose(q), tree.frame(tip).body
        r = tip_position(tree, pose, tip)
        turn = self.displacement.rotation
        axes = self.axes @ turn.T
        origin = self.displacement.centre + self.displacement.shift[0] + turn @ (self.origin - self.displacement.centre)
        p = axes @ (r - origin)
        g = self.shape.gradient(p)
        size = float(np.linalg.norm(g))
        local = frame_of(g / size)
        v_n, v_0 = body_velocities(tree, pose, v)[body], self.surface_velocity()
        r_dot = point_velocity(v_n, r)
        N_dot = self.frame_rate(axes, local, p, axes @ (r_dot - point_velocity(v_0, r)))
        N = local @ axes
        R = constraint_matrix(N, r)
        # The rate of (r × n, n), as the tip and the frame move.
        R_dot = np.concatenate([N @ skew(r_dot).T + N_dot @ skew(r).T, N_dot], axis=1).T
        a_n = spatial_drift(tree, pose, v, body)
        drift = R_dot.T @ (v_n - v_0) + R.T @ (a_n - self.surface_acceleration())
        A = R.T @ spatial_jacobian(tree, pose, body)
        return Touch(A, drift, R.T @ (v_n - v_0), float(self.shape.level(p)) / size, N, p, local)

    def answer(self, q: Array, v: Array, torque: Array, anchor: Array | None = None) -> tuple[Array, Array, Touch]:
        """Return q̈ (n,) and the force F (3,) in the contact frame, with the rows it is from.

        anchor: (3,) where a tip that sticks is held, in the surface's axes [m]; None: it slides
        """
        touch = self.touch(q, v)
        pose = self.oracle.pose(q)
        H, forcing = mass_matrix(self.oracle.tree, pose), torque - bias(self.oracle.tree, pose, v)
        s_v, s_p = self.gains
        off = np.array([touch.error, 0.0, 0.0])
        if anchor is not None:
            off[1:] = touch.local[1:] @ (touch.at - anchor)
        b = -touch.drift - s_v * touch.u - s_p * off
        F = np.zeros(3)
        if self.push is not None:
            F[0] = self.push(-touch.error, -touch.u[0])
            if anchor is not None:
                q_dd, F[1:] = solve_bordered(H, forcing + touch.A[0] * F[0], touch.A[1:], b[1:])
                return q_dd, F, touch
            F[1:] = -self._slope(touch) * abs(F[0])
            return np.linalg.solve(H, forcing + touch.A.T @ F), F, touch
        if anchor is not None:
            q_dd, F = solve_bordered(H, forcing, touch.A, b)
            return q_dd, F, touch
        for sign in (1.0, -1.0):  # friction acts against slip, whether the closure pushes or pulls
            F = np.array([1.0, *(-sign * self._slope(touch))])
            n = len(H)
            matrix = np.block([[H, -(touch.A.T @ F)[:, None]], [touch.A[:1], np.zeros((1, 1))]])
            solution = np.linalg.solve(matrix, np.array([*forcing, b[0]]))
            if solution[n] * sign >= 0.0:
                break
        return solution[:n], F * solution[n], touch

    def _slope(self, touch: Touch) -> Array:
        """Return μ times the direction of slip (2,)."""
        speed = float(np.hypot(*touch.u[1:]))
        return np.asarray(self.friction * touch.u[1:] / speed) if self.friction else np.zeros(2)
