"""The input of a control law at one instant."""

from __future__ import annotations

from typing import NamedTuple

from closedloop.base.arrays import Array


class LawInput(NamedTuple):
    """The state of the arm, its terms, the reference, and the reading of the force sensor.

    Contact frame: axes n (out of the surface), t1, t2; the three numbers of every (3,) array are in that order, unless
    it is said to be in base axes.

    With `[encoder]` the state is computed from the encoders' readings. With `[model_error]` the terms are those of the
    controller's own model. With `[transmission]` H includes the motors. See docs/real_arm.md.

    Attributes
    ----------
    t : float
        Time, s.
    q, v : (n,) arrays
        Joint positions, rad (m), and velocities.
    H : (n, n) array
        Mass matrix.
    C : (n,) array
        Bias torque (Coriolis, centrifugal, gravity), N m.
    L : (n, n) array
        Lower Cholesky factor of H whose diagonal holds reciprocals, see `closedloop.mechanics.closure.solve.cholesky`.
    A : (3, n) array
        Tip Jacobian, contact frame: u = A q̇. Its first row is nᵀJᵣ.
    X : (3, n) array
        L⁻¹Aᵀ, transposed.
    S : (3, 3) array
        A H⁻¹Aᵀ, the tip's mobility, 1/kg; positive semi-definite.
    drift : (3,) array
        Ȧ q̇, m/s².
    p, u : (3,) arrays
        Tip position, m, and velocity, m/s.
    r : (3,) array
        Tip position, m, base axes.
    J : (3, n) array
        Tip Jacobian Jᵣ, base axes.
    Jdot_v : (3,) array
        J̇ᵣq̇, m/s², base axes.
    frame : (3, 3) array
        The contact frame: rows n, t1, t2, base axes; p = frame r.
    q_des, v_des : (n,) arrays
        Desired joint motion.
    qdd_des : (n,) array
        Desired joint acceleration, rad/s² (m/s²), where `reference.orientation` holds the tool; else zero.
    p_des, u_des, a_des : (3,) arrays
        Desired motion of the tip, m, m/s, m/s².
    f_des : float
        Desired contact force, N, of the surface on the tip along +n.
    f_measured : float
        Latest reading of the force sensor, N, as modelled by [sensor]; it belongs to an earlier instant.
    pressed : float
        1 while the tip is in contact, else 0.
    scratch : array
        Scratch, (n² + 3 n + 224,); it is not kept from call to call.
    """

    t: float
    q: Array
    v: Array
    H: Array
    C: Array
    L: Array
    A: Array
    X: Array
    S: Array
    drift: Array
    p: Array
    u: Array
    r: Array
    J: Array
    Jdot_v: Array
    frame: Array
    q_des: Array
    v_des: Array
    qdd_des: Array
    p_des: Array
    u_des: Array
    a_des: Array
    f_des: float
    f_measured: float
    pressed: float
    scratch: Array
