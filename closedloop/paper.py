"""The paper, in the paper's words: an arm whose tip is held to the plane n·r = d by the force f of Eq. 24.

Pinocchio gives H, C, r, Jᵣ and J̇ᵣq̇, numpy does the rest, one equation a line. A test compares every row with the
simulator. `python -m closedloop.paper` draws Figs. 4 to 7 into out/. SI units, base frame; f > 0 pushes along +n.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

import robot_models

Array = NDArray[Any]

# The paper gives neither posture, path nor gains; these are wam_slide's. The other numbers are the paper's.
FORCE, STEP, DAMPING_RATIO, TIME_CONSTANT = 10.0, 1e-3, 0.707, 1e-3
START, STOP, VELOCITY, NORMAL = 0.5, 6.5, np.array([0.0, 0.01, 0.0]), np.array([0.0, 0.0, 1.0])
Q0, KP, KD = np.array([np.pi / 2, 1.9, 0.0, -0.85]), np.array([900, 900, 400, 300]), np.array([60, 60, 30, 20])


class Arm:
    """Pinocchio's terms of the WAM."""

    def __init__(self) -> None:
        self.model = robot_models.load("wam4").pinocchio_model()
        self.data, self.tip = self.model.createData(), self.model.getFrameId("tip")

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n) of the tip (Eqs. 13, 16)."""
        return pin.computeFrameJacobian(self.model, self.data, q, self.tip, pin.LOCAL_WORLD_ALIGNED)[:3]

    def terms(self, q: Array, v: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return H (n, n), C (n,) (Eq. 8), r (3,) (Eq. 15), Jᵣ (3, n) and J̇ᵣq̇ (3,) (Eqs. 17, 18) at q, v (n,)."""
        H = np.triu(pin.crba(self.model, self.data, q)) + np.triu(self.data.M, 1).T
        C = pin.nonLinearEffects(self.model, self.data, q, v).copy()
        pin.forwardKinematics(self.model, self.data, q, v, np.zeros(v.size))
        r = pin.updateFramePlacement(self.model, self.data, self.tip).translation.copy()
        drift = pin.getFrameClassicalAcceleration(self.model, self.data, self.tip, pin.LOCAL_WORLD_ALIGNED).linear
        return H, C, r, self.jacobian(q), drift


def path(arm: Arm, t: Array) -> tuple[Array, Array]:
    """Return q_des, q̇_des (N, n): q̇ = Jᵣ⁺ṙ, the least velocity, integrated by RK4 between knots that cubics join."""
    h, knots, q = (STOP - START) / 120, [], Q0
    for _ in range(121):
        k1 = np.linalg.pinv(arm.jacobian(q)) @ VELOCITY
        k2 = np.linalg.pinv(arm.jacobian(q + h / 2 * k1)) @ VELOCITY
        k3 = np.linalg.pinv(arm.jacobian(q + h / 2 * k2)) @ VELOCITY
        k4 = np.linalg.pinv(arm.jacobian(q + h * k3)) @ VELOCITY
        knots.append((q, k1))
        q = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    k = np.clip(((t - START) / h).astype(int), 0, 119)
    (q0, v0), (q1, v1) = np.swapaxes(np.array(knots)[k], 0, 1), np.swapaxes(np.array(knots)[k + 1], 0, 1)
    s = np.clip((t - START) / h - k, 0, 1)[:, None]
    wanted = q0 + s * s * (3 - 2 * s) * (q1 - q0) + h * s * (1 - s) * ((1 - s) * v0 - s * v1)
    rate = 6 * s * (1 - s) * (q1 - q0) / h + (1 - s) * (1 - 3 * s) * v0 + s * (3 * s - 2) * v1
    return wanted, rate * ((t >= START) & (t < STOP))[:, None]


def slide(stabilised: bool = True, duration: float = 8.0) -> tuple[Array, Array, Array, Array]:
    """Return t (N,), q (N, n), f (N,) and e (N,) of the paper's simulation."""
    arm, n, t = Arm(), NORMAL, np.arange(round(duration / STEP) + 1) * STEP
    s_v, s_p = stabilised * 2 * DAMPING_RATIO / TIME_CONSTANT, stabilised / TIME_CONSTANT**2  # Eq. 22
    q, v, d, rows = Q0, 0 * Q0, n @ arm.terms(Q0, 0 * Q0)[2], []  # Eq. 11
    for q_des, v_des in zip(*path(arm, t), strict=True):
        H, C, r, J, drift = arm.terms(q, v)  # steps 1 to 3
        A = n @ J
        e, rate = n @ r - d, A @ v  # Eqs. 19, 20
        b_s = -n @ drift - s_v * rate - s_p * e  # Eq. 23
        Q = KP * (q_des - q) + KD * (v_des - v) + C - A * FORCE  # Eq. 33
        *qdd, minus_f = np.linalg.solve(np.block([[H, A[:, None]], [A, 0.0]]), [*(Q - C), b_s])  # Eq. 24
        rows.append((q, -minus_f, e))
        v = v + STEP * np.array(qdd)
        q = q + STEP * v
    qs, f, es = map(np.array, zip(*rows, strict=True))
    return t, qs, f, es


def draw(file: Path) -> None:
    """Draw Figs. 4 to 7 into a file, and print the range and the end of what each shows."""
    import matplotlib.pyplot as plt

    (t, q, f, e), (_, _, _, drift), arm = slide(), slide(stabilised=False), Arm()
    y = 1e3 * np.array([arm.terms(x, 0 * x)[2] for x in q]), f, 1e9 * e, 1e9 * drift
    shown = "x, y, z of the tip [mm]", "contact force f [N]", "e [nm], stabilised", "e [nm], not stabilised"
    figure, panels = plt.subplots(4, 1, figsize=(8, 11), layout="constrained")
    for k in range(4):
        panels[k].plot(t, y[k])
        panels[k].set(title=f"Fig. {k + 4}", ylabel=shown[k], xlabel="t [s]")
        print(f"Fig. {k + 4}  {shown[k]}: {y[k].min():.4g} to {y[k].max():.4g}, at the end {np.round(y[k][-1], 6)}")
    panels[0].legend(panels[0].lines, "xyz")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    draw(Path("out/paper/figures_4_to_7.png"))
