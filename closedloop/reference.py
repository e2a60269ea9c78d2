"""The desired motion: a path of the tip, turned into q_des(t) and q̇_des(t) once, before the run.

A 4-joint arm has one degree of freedom more than a point path needs. It is resolved by least joint motion: among the
joint velocities that move the tip along the path, q̇ = Jᵣ⁺ ṙ_des (Moore-Penrose) has the smallest norm. That
differential equation is integrated with RK4 from one knot to the next, the tip put back on the path by
least-norm Newton steps, and the knots joined by cubic Hermite polynomials whose derivative is q̇_des. Knots are
halved until the tip of the interpolated path is within `PATH_TOLERANCE` of the straight line midway between them. So
the reference is one smooth function of time, the same for every step size and integrator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ScenarioError
from closedloop.robot import Robot

Array = NDArray[np.float64]

PATH_TOLERANCE = 1e-10  # m; a hundredth of the closure error that the stabiliser leaves
FIRST_SPACING = 5e-4  # m of path between knots before any halving
MOST_KNOTS = 20_000
# Singular values of Jᵣ below this share of the largest count as zero: the arm cannot move the tip that way.
RANK_TOLERANCE = 1e-6


@dataclass(frozen=True)
class JointPath:
    """q_des(t) and q̇_des(t): at rest before `times[0]`, a cubic Hermite spline over the knots, at rest after the last.

    Attributes
    ----------
    times : (K,) array
        Knots, s, increasing.
    q, v : (K, n) arrays
        Joint positions, rad (m), and velocities, rad/s (m/s), at the knots.
    """

    times: Array
    q: Array
    v: Array

    def sample(self, t: Array) -> tuple[Array, Array]:
        """Return q_des and q̇_des, each (N, n), at times t (N,), s.

        A velocity that jumps at the path's start or end has its later value there.
        """
        t = np.asarray(t, dtype=np.float64)
        q, v = np.tile(self.q[0], (t.size, 1)), np.zeros((t.size, self.q.shape[1]))
        if self.times.size == 1:
            return q, v
        instant = 1e-9 * (self.times[-1] - self.times[0])  # i·h and a knot's time may differ by rounding
        q[t >= self.times[-1] - instant] = self.q[-1]
        inside = (t >= self.times[0] - instant) & (t < self.times[-1] - instant)
        k = np.clip(np.searchsorted(self.times, t[inside] + instant, side="right") - 1, 0, self.times.size - 2)
        h = (self.times[k + 1] - self.times[k])[:, None]
        s = (t[inside] - self.times[k])[:, None] / h
        q0, q1, v0, v1 = self.q[k], self.q[k + 1], h * self.v[k], h * self.v[k + 1]
        rise = q1 - q0
        a, b = 3 * rise - 2 * v0 - v1, v0 + v1 - 2 * rise
        q[inside] = q0 + s * (v0 + s * (a + s * b))
        v[inside] = (v0 + s * (2 * a + s * 3 * b)) / h
        return q, v


def hold(q: Array) -> JointPath:
    """Return the path that stays at joint positions q (n,)."""
    return JointPath(np.zeros(1), q[None, :].copy(), np.zeros((1, q.size)))


def follow_line(robot: Robot, q: Array, direction: Array, speed: float, start: float, stop: float) -> JointPath:
    """Return the joint path whose tip runs straight from its place at q, at constant speed.

    Parameters
    ----------
    robot : Robot
        The arm.
    q : (n,) array
        Joint positions at `start`.
    direction : (3,) array
        Unit vector of the tip's motion, base frame.
    speed : float
        Tip speed, m/s; negative runs backwards.
    start, stop : float
        Instants between which the tip moves, s.

    Raises
    ------
    ScenarioError
        If the path leaves the workspace or the joint limits, with the first instant at which it does.
    """
    origin = robot.position(q)
    velocity = speed * direction

    def tip(t: float) -> Array:
        return origin + velocity * (t - start)

    intervals = max(1, math.ceil(min(abs(speed) * (stop - start) / FIRST_SPACING, 1e300)))
    while True:
        path = _through_knots(robot, q, start, stop, intervals, tip, velocity)
        times = path.times
        middles = 0.5 * (times[:-1] + times[1:])
        halfway, _ = path.sample(middles)
        worst = max(float(np.max(np.abs(robot.position(h) - tip(t)))) for h, t in zip(halfway, middles, strict=True))
        if worst <= PATH_TOLERANCE:
            return path
        intervals *= 2
        if intervals > MOST_KNOTS:
            raise ScenarioError(
                f"reference: the joint path cannot be resolved (off the line by {worst:.1e} m midway between "
                f"{intervals // 2} knots); it runs too close to a singular pose or too fast"
            )


def _through_knots(
    robot: Robot, q: Array, start: float, stop: float, intervals: int, tip: Callable[[float], Array], velocity: Array
) -> JointPath:
    """Walk from knot to knot; a path that leaves the workspace is refused on the way, however long it is."""
    times, qs, vs = [start], [q.copy()], [_least_norm(robot.position_and_jacobian(q)[1], velocity)]
    for k in range(1, intervals + 1):
        t = start + (stop - start) * (k / intervals)
        reached = _advance(robot, qs[-1], times[-1], t, tip, velocity)
        if isinstance(reached, str):
            raise _unreachable(robot, qs[-1], times[-1], t, tip, velocity)
        if k > MOST_KNOTS:
            raise ScenarioError(f"reference: the path takes more than {MOST_KNOTS} knots; make it shorter or slower")
        times.append(t)
        qs.append(reached)
        vs.append(_least_norm(robot.position_and_jacobian(reached)[1], velocity))
    return JointPath(np.array(times), np.array(qs), np.array(vs))


def _advance(
    robot: Robot, q: Array, t0: float, t1: float, tip: Callable[[float], Array], velocity: Array
) -> Array | str:
    """Return the joint positions at t1 reached from q at t0, or why there are none."""
    h = t1 - t0
    try:
        slopes: list[Array] = []
        for share in (0.0, 0.5, 0.5, 1.0):
            x = q + h * share * slopes[-1] if slopes else q
            slopes.append(_least_norm(robot.position_and_jacobian(x)[1], velocity))
        x = q + h / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        target = tip(t1)
        for _ in range(20):
            r, J = robot.position_and_jacobian(x)
            error = target - r
            if np.max(np.abs(error)) < 1e-14:
                break
            move = _least_norm(J, error)
            x = x + move
            if np.max(np.abs(move)) < 1e-15:
                break
    except np.linalg.LinAlgError:
        return "the inverse kinematics broke down"
    if not np.all(np.isfinite(x)):
        return "the inverse kinematics broke down"
    miss = float(np.max(np.abs(target - robot.position(x))))
    if miss > 0.1 * PATH_TOLERANCE:
        return "the tip cannot get there: the path leaves the workspace"
    model = robot.model
    for j in range(robot.n):
        low, high = model.position_lower[j], model.position_upper[j]
        if not low <= x[j] <= high:
            return f"joint {robot.joint_names[j]} would be at {x[j]:.4f}, outside its limits [{low:g}, {high:g}]"
    return x


def _unreachable(
    robot: Robot, q: Array, t0: float, t1: float, tip: Callable[[float], Array], velocity: Array
) -> ScenarioError:
    """Return the refusal with the first instant in (t0, t1] that cannot be reached, found by bisection to 1 µs."""
    low, high = t0, t1
    reason = "the path cannot be followed"
    for _ in range(60):
        middle = 0.5 * (low + high)
        reached = _advance(robot, q, t0, middle, tip, velocity)
        if isinstance(reached, str):
            high, reason = middle, reached
        else:
            low = middle
        if high - low < 1e-6:
            break
    where = np.array2string(tip(high), precision=4, separator=", ", suppress_small=True)
    return ScenarioError(
        f"reference: unreachable from t = {high:.4f} s on, at {where} m: {reason}; "
        "shorten the path (reference.stop, reference.speed) or start elsewhere (start.q)"
    )


def _least_norm(J: Array, velocity: Array) -> Array:
    """Return the smallest joint velocity that gives the tip this velocity as nearly as it can: Jᵣ⁺ ṙ."""
    return np.asarray(np.linalg.lstsq(J, velocity, rcond=RANK_TOLERANCE)[0])
