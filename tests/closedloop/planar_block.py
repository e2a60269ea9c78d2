"""A rigid block on two feet in a plane over a floor, by other code: rigid contacts, Coulomb's friction, restitution.

Modes of the feet are found by trying them all (free, sticking, slipping left or right). Between events the motion is
integrated by scipy. A foot that strikes alone has Routh's impulses (E. J. Routh, 1905) up to Newton's u⁺ = −e u⁻; one
that strikes while the other is closed has Newton's law for both together, with friction against the slip afterwards,
and e lessened by one factor where that would create energy. Rebounds slower than `rest_speed` are none.
"""

from itertools import product

import numpy as np
from scipy.integrate import solve_ivp

G, CLOSED, STILL = 9.81, 1e-9, 1e-9


class Block:
    """A block of 1 kg with half sides a and h, m."""

    def __init__(self, a, h, mu, e, rest_speed=1e-4):
        self.feet, self.mu, self.e, self.rest_speed = np.array([[a, -h], [-a, -h]]), mu, e, rest_speed
        self.inverse = np.diag([1.0, 1.0, 3.0 / (a * a + h * h)])
        self.weight = np.array([0.0, -G, 0.0])
        self.energy = lambda q, v: 0.5 * v @ (v / np.diag(self.inverse)) + G * q[1]

    def feet_at(self, q, v):
        """Return gaps (2,), rows J (4, 3) as n, t of each foot, their velocities (4,), and what v adds to J q̈ (4,)."""
        c, s = np.cos(q[2]), np.sin(q[2])
        J, drift = np.zeros((4, 3)), np.zeros(4)
        gaps = np.zeros(2)
        for i, (x, z) in enumerate(self.feet):
            rx, rz = c * x + s * z, -s * x + c * z
            gaps[i] = q[1] + rz
            J[2 * i], J[2 * i + 1] = (0.0, 1.0, -rx), (1.0, 0.0, rz)
            drift[2 * i], drift[2 * i + 1] = -(v[2] ** 2) * rz, -(v[2] ** 2) * rx
        return gaps, J, J @ v, drift

    def solve(self, W, q, closed, u_t, want):
        """Return P (4,) and modes with u⁺ = q + W P: of a foot that touches u_n⁺ >= want_n, and Coulomb's law for u_t⁺.

        `u_t` (2,) is the slip that friction is against, where a foot has one already; else it is u_t⁺.
        """
        best = None
        scale = np.max(np.abs(q)) + 1e-12
        for modes in product(*(("free", "stick", 1, -1) if near else ("free",) for near in closed)):
            A, b, rows = np.eye(4), np.zeros(4), np.eye(4)
            for i, mode in enumerate(modes):
                if mode == "free":
                    continue
                A[2 * i], b[2 * i] = W[2 * i], want[i] - q[2 * i]
                if mode == "stick":
                    A[2 * i + 1], b[2 * i + 1] = W[2 * i + 1], -q[2 * i + 1]
                else:
                    A[2 * i + 1] = rows[2 * i + 1] + mode * self.mu * rows[2 * i]
            P = np.linalg.lstsq(A, b, rcond=1e-12)[0]
            if np.max(np.abs(A @ P - b)) > 1e-9 * scale:
                continue
            after, off = q + W @ P, 0.0
            for i, mode in enumerate(modes):
                n, t = 2 * i, 2 * i + 1
                if not closed[i]:
                    continue
                if mode == "free":
                    off = max(off, want[i] - after[n])
                    continue
                off = max(off, -P[n] * W[n, n], (abs(P[t]) - self.mu * P[n]) * W[t, t])
                moving = abs(u_t[i]) > STILL
                if mode == "stick":
                    off = max(off, np.inf if moving else 0.0)
                else:
                    off = max(off, -mode * (u_t[i] if moving else after[t]))
            if best is None or off < best[0]:
                best = off, P, modes
        if best[0] > 1e-6 * scale:
            raise RuntimeError(f"no modes fit: {best}")
        return best[1], best[2]

    def strike(self, q, v):
        """Return the velocity after the feet that come together have struck."""
        gaps, J, u, _ = self.feet_at(q, v)
        closed, W = gaps <= CLOSED, J @ self.inverse @ J.T
        closing = closed & (u[::2] < -1e-11)
        bounce = np.where(closing & (-self.e * u[::2] >= self.rest_speed), -self.e * u[::2], 0.0)
        if closed.sum() == 1:
            P = self.alone(W, u, int(np.argmax(closed)), bounce)
        else:
            P, share = self.solve(W, u, closed, np.zeros(2), bounce)[0], 1.0
            low, high = 0.0, 1.0
            if P @ (u + u + W @ P) > 1e-15:
                for _ in range(50):
                    share = 0.5 * (low + high)
                    P = self.solve(W, u, closed, np.zeros(2), share * bounce)[0]
                    low, high = (low, share) if P @ (u + u + W @ P) > 0.0 else (share, high)
                P = self.solve(W, u, closed, np.zeros(2), low * bounce)[0]
        return v + self.inverse @ J.T @ P

    def alone(self, W, u, i, bounce):
        """Return the impulses of foot i, which strikes alone: straight pieces along the normal impulse."""
        n, t = 2 * i, 2 * i + 1
        S, x = W[np.ix_([n, t], [n, t])], u[[n, t]].copy()
        P = np.zeros(2)
        for _ in range(4):
            hold = S[1, 0] / S[1, 1]
            if abs(x[1]) > 1e-14:
                d = np.array([1.0, -self.mu * np.sign(x[1])])
            else:
                d = np.array([1.0, -hold if abs(hold) <= self.mu else -self.mu * np.sign(hold)])
            rate = S @ d
            end = (bounce[i] - x[0]) / rate[0] if rate[0] > 0.0 else np.inf
            stop = -x[1] / rate[1] if abs(x[1]) > 1e-14 and x[1] * rate[1] < 0.0 else np.inf
            step = min(end, stop)
            P, x = P + step * d, x + step * rate
            if step == stop:
                x[1] = 0.0
            else:
                break
        found = np.zeros(4)
        found[[n, t]] = P
        return found

    def accelerate(self, q, v):
        """Return q̈ and the forces (4,), with the modes of the feet."""
        gaps, J, u, drift = self.feet_at(q, v)
        closed = (gaps <= CLOSED) & (np.abs(u[::2]) <= 1e-8)
        free = J @ self.weight + drift
        W = J @ self.inverse @ J.T
        F, modes = self.solve(W, free, closed, u[1::2], np.zeros(2))
        return self.weight + self.inverse @ J.T @ F, F, modes

    def forces_in(self, modes, q, v):
        """Return q̈ and the forces (4,) in these modes."""
        _, J, _, drift = self.feet_at(q, v)
        free, W = J @ self.weight + drift, J @ self.inverse @ J.T
        A, b = np.eye(4), np.zeros(4)
        for i, mode in enumerate(modes):
            n, t = 2 * i, 2 * i + 1
            if mode == "free":
                continue
            A[n], b[n] = W[n], -free[n]
            if mode == "stick":
                A[t], b[t] = W[t], -free[t]
            else:
                A[t, n] = mode * self.mu
        F = np.linalg.lstsq(A, b, rcond=1e-12)[0]
        return self.weight + self.inverse @ J.T @ F, F

    def comes_to_rest(self, q, v, most=60.0):
        """Return the instant of the last strike before the block stands still, s, and all instants of strikes."""
        q, v, time, strikes = np.array(q, float), np.array(v, float), 0.0, []
        while time < most:
            gaps, _, u, _ = self.feet_at(q, v)
            if np.any((gaps <= CLOSED) & (u[::2] < -1e-11)):
                v = self.strike(q, v)
                strikes.append(time)
                if len(strikes) > 20000:
                    raise RuntimeError("too many strikes")
            _, _, modes = self.accelerate(q, v)
            if np.max(np.abs(v)) < 1e-7 and "free" not in modes and 1 not in modes and -1 not in modes:
                return strikes[-1], strikes
            q, v, time = self.move(q, v, time, modes)
        raise RuntimeError("it does not come to rest")

    def move(self, q, v, time, modes):
        """Return state and time at the next event in these modes."""

        def rates(_, y):
            return np.r_[y[3:], self.forces_in(modes, y[:3], y[3:])[0]]

        events = []

        def watch(value, direction):
            def event(t, y):
                return value(y[:3], y[3:]) if t > time else direction * -1.0

            event.terminal, event.direction = True, direction
            events.append(event)

        for i, mode in enumerate(modes):
            n, t = 2 * i, 2 * i + 1
            if mode == "free":
                watch(lambda q, v, i=i: self.feet_at(q, v)[0][i], -1)
                continue
            watch(lambda q, v, n=n: self.forces_in(modes, q, v)[1][n], -1)
            if mode == "stick":

                def left(q, v, n=n, t=t):
                    F = self.forces_in(modes, q, v)[1]
                    return self.mu * F[n] - abs(F[t])

                watch(left, -1)
            else:
                watch(lambda q, v, t=t, mode=mode: mode * self.feet_at(q, v)[2][t], -1)
        done = solve_ivp(
            rates, (time, time + 1.0), np.r_[q, v], "DOP853", events=events, rtol=1e-11, atol=1e-13, max_step=0.02
        )
        y, time = done.y[:, -1], done.t[-1]
        q, v = y[:3].copy(), y[3:].copy()
        gaps, J, u, _ = self.feet_at(q, v)
        held = [2 * i for i, mode in enumerate(modes) if mode != "free"]
        slow = [mode == "stick" or (mode != "free" and abs(u[2 * i + 1]) < 1e-9) for i, mode in enumerate(modes)]
        held += [2 * i + 1 for i in range(2) if slow[i]]
        if held:  # what the integrator leaves of closed feet
            K = J[held]
            v = v - self.inverse @ K.T @ np.linalg.pinv(K @ self.inverse @ K.T) @ (K @ v)
            rows = [2 * i for i, mode in enumerate(modes) if mode != "free"]
            K = J[rows]
            q = q - self.inverse @ K.T @ np.linalg.pinv(K @ self.inverse @ K.T) @ gaps[[r // 2 for r in rows]]
        return q, v, time
