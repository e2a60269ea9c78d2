"""The controllers inside the arm: springs at the joints or at the end effector, with dampers that fit them.

    τ = f + D (q̇_d − q̇) + C        joints: f = K (q_d − q)        end effector: f = Jᵀ K_x e + springs of the rest

K_x e is of the end effector's distance from its wanted pose; along motions that do not move it, weak springs pull to
q_d.
The dampers belong to the modes of H and K, H V = 1, K V = H V Λ: D = H V diag(2 ζ √λ) Vᵀ H (A. Albu-Schäffer, C. Ott,
U. Frese, G. Hirzinger, ICRA 2003). The torque is held for a period h: a mode quicker than that allows is as stiff and
as damped as it can be, λ <= 1/h², 2 ζ √λ <= 1/h. No torque is larger than the effort limit of its joint.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from closedloop.base.arrays import Array
from closedloop.serve.franka.arm import Arm, turned
from closedloop.serve.franka.description import JOINTS

# How far a joint may move, rad, and a stiffness change, as a share, until the modes are found anew.
MOVED = 0.01
# Damping ratio ζ; and the stiffness along motions that do not move the end effector, N m/rad.
DAMPING_RATIO, REST_STIFFNESS = 0.7, 20.0


class Impedance:
    """The springs that the client has set: N m/rad at the joints (7,), N/m and N m/rad at the end effector (6,)."""

    def __init__(self, arm: Arm, period: float) -> None:
        self._arm, self._h = arm, period
        self._modes: tuple[Array, Array, Array, Array] | None = None
        self._most = arm.robot.model.effort_limit
        self.joints = np.array([3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0])
        self.end_effector = np.array([3000.0, 3000.0, 3000.0, 300.0, 300.0, 300.0])

    def at_joints(self, q: Array, v: Array, q_d: Array, dq_d: Array) -> Array:
        """Return the torque (7,), N m, with gravity, of springs at the joints."""
        return self._torque(q, v, dq_d, self.joints * (q_d - q), np.diag(self.joints))

    def at_end_effector(self, q: Array, v: Array, q_d: Array, dq_d: Array, T_d: Array) -> Array:
        """Return the torque (7,), N m, with gravity, of springs between the end effector and T_d (4, 4)."""
        T, J = self._arm.end_effector(q)
        e = np.concatenate((T_d[:3, 3] - T[:3, 3], turned(T[:3, :3], T_d[:3, :3])))
        rest = REST_STIFFNESS * (np.eye(JOINTS) - np.linalg.pinv(J) @ J)
        stiffness = J.T @ (self.end_effector[:, None] * J) + rest
        return self._torque(q, v, dq_d, J.T @ (self.end_effector * e) + rest @ (q_d - q), stiffness)

    def _torque(self, q: Array, v: Array, dq_d: Array, f: Array, K: Array) -> Array:
        at = self._modes
        if at is None or abs(q - at[0]).max() > MOVED or abs(K - at[1]).max() > MOVED * at[1].max():
            H = self._arm.robot.mass_matrix(q)
            squares, V = eigh(K, H)
            squares, P = np.maximum(squares, 0.0), H @ V
            damping = np.minimum(2.0 * DAMPING_RATIO * np.sqrt(squares), 1.0 / self._h)
            softer = 1.0 / np.maximum(1.0, squares * self._h * self._h)
            at = self._modes = q, K, P * softer @ V.T, P * damping @ P.T
        _, _, spring, damper = at
        C = self._arm.robot.inverse_dynamics(q, v, np.zeros(JOINTS))
        found: Array = np.clip(spring @ f + damper @ (dq_d - v) + C, -self._most, self._most)
        return found
