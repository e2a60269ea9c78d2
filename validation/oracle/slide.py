"""The paper's closed loop by hand: law, closure, one dense solve and a semi-implicit Euler step."""

from dataclasses import dataclass

import numpy as np

from validation.oracle.closure import (
    closure_error,
    closure_rate,
    solve_bordered,
    stabilised_drift,
    stabiliser_gains,
)
from validation.oracle.engine import Oracle, Terms
from validation.oracle.spatial import Array


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
    oracle: Oracle,
    *,
    q: Array,
    v: Array,
    q_des: Array,
    v_des: Array,
    step: float,
    law: Law,
    closure: Closure,
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
