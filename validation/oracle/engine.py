"""The oracle as an engine: the functions of this package behind the method names that every engine has.

The paper's closed loop by hand: law, closure, one dense solve and a semi-implicit Euler step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from validation.oracle import dynamics, kinematics
from validation.oracle.closure import closure_error, closure_rate, solve_bordered, stabilised_drift, stabiliser_gains
from validation.oracle.kinematics import Pose, forward_kinematics
from validation.oracle.spatial import Array, skew
from validation.oracle.tree import GROUND, RobotModel, Tree, UnsupportedModel, read_urdf


@dataclass(frozen=True)
class Terms:
    """The quantities of Eq. 24 at one state (q, v), base frame.

    mass_matrix H (n, n); bias C (n,); position r (3,) [m]; jacobian Jᵣ (3, n); drift J̇ᵣq̇ (3,) [m/s²]
    """

    mass_matrix: Array
    bias: Array
    position: Array
    jacobian: Array
    drift: Array


class Oracle:
    """The robot by the paper's own equations, slow and plain.

    q (n,) [rad or m], v (n,), a (n,) and torque (n,) are in the column order of the tree; they may be
    complex, so that a result can be differentiated by a complex step (and, except in `forward_dynamics`,
    mpmath numbers).
    """

    complex_step = True

    def __init__(self, tree: Tree, tip: str) -> None:
        tree.frame(tip)  # an unknown tip is refused here rather than at the first call
        self.tree = tree
        self.tip = tip

    @classmethod
    def from_model(cls, model: RobotModel, tip: str | None = None) -> Oracle:
        """Read a robot that is described in URDF; without `tip`, its own."""
        tip = model.tip if tip is None else tip
        if tip is None:
            raise UnsupportedModel("the robot names no tip of its own: name one")
        return cls(read_urdf(model), tip)

    def pose(self, q: Array) -> Pose:
        """Return the bodies at q, which the pure functions of `kinematics` and `dynamics` take."""
        return forward_kinematics(self.tree, q)

    def terms(self, q: Array, v: Array) -> Terms:
        """Return H, C, r, Jᵣ and J̇ᵣq̇ at one state, the bodies placed once."""
        return _terms(self, self.pose(q), np.asarray(v))

    def mass_matrix(self, q: Array) -> Array:
        """Return H (n, n), armature included."""
        return dynamics.mass_matrix(self.tree, self.pose(q))

    def bias(self, q: Array, v: Array) -> Array:
        """Return C (n,): Coriolis, centrifugal and gravity."""
        return dynamics.bias(self.tree, self.pose(q), v)

    def gravity_term(self, q: Array) -> Array:
        """Return the gravity part of C (n,)."""
        return dynamics.gravity_term(self.tree, self.pose(q))

    def coriolis_matrix(self, q: Array, v: Array) -> Array:
        """Return the Coriolis matrix (n, n) of Christoffel symbols."""
        return dynamics.coriolis_matrix(self.tree, self.pose(q), v)

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return Q (n,) for accelerations a."""
        return dynamics.inverse_dynamics(self.tree, self.pose(q), v, a)

    def pushed_inverse_dynamics(self, q: Array, v: Array, a: Array, force: Array) -> Array:
        """Return Q (n,) of Eq. 12, H q̈ + C = Q + Jᵣᵀ F, for accelerations a while F = `force` (3,) pushes the tip [N].

        F is in the base frame; the paper's is n f, along the normal n of the surface.
        """
        pose, body = self.pose(q), self.tree.frame(self.tip).body
        couple = skew(kinematics.tip_position(self.tree, pose, self.tip)) @ force
        push = np.zeros((self.tree.size, 6), dtype=couple.dtype)
        if body != GROUND:
            push[body] = np.concatenate([couple, force])
        return dynamics.inverse_dynamics(self.tree, pose, v, a, push=push)

    def forward_dynamics(self, q: Array, v: Array, torque: Array) -> Array:
        """Return q̈ (n,) of the free arm."""
        return dynamics.forward_dynamics(self.tree, self.pose(q), v, torque)

    def kinetic_energy(self, q: Array, v: Array) -> Array:
        """Return T [J], drives included."""
        return dynamics.kinetic_energy(self.tree, self.pose(q), v)

    def potential_energy(self, q: Array) -> Array:
        """Return U [J]."""
        return dynamics.potential_energy(self.tree, self.pose(q))

    def position(self, q: Array) -> Array:
        """Return the tip r (3,), base frame [m]."""
        return kinematics.tip_position(self.tree, self.pose(q), self.tip)

    def spatial_jacobian(self, q: Array) -> Array:
        """Return J (6, n) of the tip's body at the base origin, angular rows first (Eq. 25)."""
        return kinematics.spatial_jacobian(self.tree, self.pose(q), self.tree.frame(self.tip).body)

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n), base frame."""
        pose = self.pose(q)
        r = kinematics.tip_position(self.tree, pose, self.tip)
        J = kinematics.spatial_jacobian(self.tree, pose, self.tree.frame(self.tip).body)
        return kinematics.translational_jacobian(J, r)

    def drift(self, q: Array, v: Array) -> Array:
        """Return J̇ᵣq̇ (3,), base frame [m/s²]."""
        return _drift(self, self.pose(q), np.asarray(v))


def _terms(oracle: Oracle, pose: Pose, v: Array) -> Terms:
    """Collect the terms of one pose."""
    tree, body = oracle.tree, oracle.tree.frame(oracle.tip).body
    r = kinematics.tip_position(tree, pose, oracle.tip)
    return Terms(
        mass_matrix=dynamics.mass_matrix(tree, pose),
        bias=dynamics.bias(tree, pose, v),
        position=r,
        jacobian=kinematics.translational_jacobian(kinematics.spatial_jacobian(tree, pose, body), r),
        drift=_drift(oracle, pose, v),
    )


def _drift(oracle: Oracle, pose: Pose, v: Array) -> Array:
    """Return J̇ᵣq̇ (3,) from the spatial J̇q̇ of the tip's body (Eq. 18)."""
    tree, body = oracle.tree, oracle.tree.frame(oracle.tip).body
    r = kinematics.tip_position(tree, pose, oracle.tip)
    velocity = kinematics.spatial_jacobian(tree, pose, body) @ v
    return kinematics.point_acceleration(kinematics.spatial_drift(tree, pose, v, body), velocity, r)


@dataclass(frozen=True)
class Law:
    """The constants of the control law, Eq. 33.

    kp, kd : (n,) [N m/rad], [N m s/rad]
    force : f_des, the press that is asked for [N]
    start : the time from which the PD part acts [s]; before it the arm is only pressed and held up
    """

    kp: Array
    kd: Array
    force: float
    start: float = 0.0


@dataclass(frozen=True)
class Closure:
    """What holds the tip to the plane.

    normal : (3,) base frame, at length one
    offset : d [m]; None is the plane through the tip at the start
    stabiliser : damping ratio ζ and time constant T [s]; None solves ë = 0
    """

    normal: Array
    offset: float | None = None
    stabiliser: tuple[float, float] | None = None


@dataclass(frozen=True)
class Slide:
    """A run; row k is the state at time t_k and the force, torque and acceleration that belong to that state.

    time (N,) [s]; q, v, acceleration, torque (N, n); position (N, 3) [m]; contact_force (N,) f of the surface
    on the robot along +n [N]; closure_error (N,) e [m]; closure_rate (N,) ė [m/s]
    """

    time: Array
    q: Array
    v: Array
    acceleration: Array
    torque: Array
    position: Array
    contact_force: Array
    closure_error: Array
    closure_rate: Array


def control_law(
    law: Law, t: float, q: Array, v: Array, q_des: Array, v_des: Array, normal: Array, terms: Terms
) -> Array:
    """Return Q = −K_p (q − q_des) − K_d (q̇ − q̇_des) + C + Jᵣᵀ n (−f_des) (Eq. 33).

    t: [s]; q, v, q_des, v_des: (n,); normal: (3,) unit n, base frame; terms: of (q, v)
    Returns (n,) [N m] or [N].
    """
    torque = terms.bias + terms.jacobian.T @ normal * -law.force
    if t >= law.start:
        torque = torque - law.kp * (q - q_des) - law.kd * (v - v_des)
    return np.asarray(torque)


def simulate_slide(
    oracle: Oracle, *, q: Array, v: Array, q_des: Array, v_des: Array, step: float, law: Law, closure: Closure
) -> Slide:
    """Slide the tip along a plane: at each t_k Eq. 33, Eq. 23, Eq. 24, then v⁺ = v + h q̈, q⁺ = q + h v⁺.

    q, v: (n,) the state at t = 0; complex, as gains and force may be, for derivatives by a complex step
    q_des, v_des: (N, n), made
    step: h [s]
    """
    dtype = np.result_type(np.float64, q, v, law.kp, law.kd, law.force)
    q, v, normal = np.array(q, dtype=dtype), np.array(v, dtype=dtype), np.asarray(closure.normal, dtype=float)
    offset = closure.offset
    if not np.isclose(normal @ normal, 1.0, rtol=1e-12):
        raise ValueError(f"normal {normal.tolist()} must have length one")
    rows, n = np.shape(q_des)
    gains = (0.0, 0.0) if closure.stabiliser is None else stabiliser_gains(*closure.stabiliser)
    out = Slide(
        time=np.arange(rows) * step,
        **{name: np.zeros((rows, n), dtype=dtype) for name in ("q", "v", "acceleration", "torque")},
        **{name: np.zeros(rows, dtype=dtype) for name in ("contact_force", "closure_error", "closure_rate")},
        position=np.zeros((rows, 3), dtype=dtype),
    )
    for k, t in enumerate(out.time):
        terms = oracle.terms(q, v)
        if offset is None:
            offset = float(normal @ terms.position)
        error = closure_error(normal, offset, terms.position)
        rate = closure_rate(normal, terms.jacobian, v)
        torque = control_law(law, t, q, v, q_des[k], v_des[k], normal, terms)
        b = stabilised_drift(normal @ terms.drift, error, rate, gains)
        a, f = solve_bordered(terms.mass_matrix, torque - terms.bias, normal @ terms.jacobian, b)
        out.q[k], out.v[k], out.acceleration[k], out.torque[k] = q, v, a, torque
        out.position[k], out.contact_force[k] = terms.position, f[0]
        out.closure_error[k], out.closure_rate[k] = error, rate
        v = v + step * a
        q = q + step * v
    return out
