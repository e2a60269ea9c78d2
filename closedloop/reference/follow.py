"""From the tip's path to the joints' path: least-norm inverse kinematics.

An arm of more joints than a point path needs could follow it in many ways. It follows with the least joint motion:
among the joint velocities that move the tip along the path, q̇ = Jᵣ⁺ ṙ_des (Moore-Penrose) has the smallest norm. That
differential equation is integrated with RK4 from one knot to the next, the tip put back on the path by
least-norm Newton steps, and the knots joined by cubic Hermite polynomials whose derivative is q̇_des. On each piece of
the path knots are halved until the tip of the interpolated path is within `PATH_TOLERANCE` of the path midway between
them. So the reference is one function of time, the same for every step size and integrator.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ScenarioError
from closedloop.reference.joint_path import JointPath
from closedloop.reference.least_norm import RANK_TOLERANCE, least_norm
from closedloop.reference.tip_path import Piece, TipPath
from closedloop.robot.pinocchio import Robot

Array = NDArray[np.float64]

PATH_TOLERANCE = 1e-10  # m; a hundredth of the closure error that the stabiliser leaves
FIRST_SPACING = 5e-4  # m of path between knots before any halving
SHORTEST = 1e-12  # s between knots
MOST_KNOTS = 20_000
DIFFERENCES = 257  # places at which a piece's acceleration is looked at before it is cut


def follow(robot: Robot, q: Array, path: TipPath) -> JointPath:
    """Return the joint path whose tip runs along `path` from joint positions q (n,), at which the tip is at its start.

    Raises
    ------
    ScenarioError
        If the path leaves the workspace or the joint limits, with the first instant at which it does.
    """
    if not path.pieces:
        return JointPath.hold(q)
    parts: list[JointPath] = []
    room = MOST_KNOTS
    with np.errstate(all="ignore"):  # what overflows is refused by name
        for piece in path.pieces:
            part = _resolve(robot, parts[-1].q[-1] if parts else q, piece, room, path.keys)
            room -= part.times.size - 1
            parts.append(part)
    return _joined(parts)


def _joined(parts: list[JointPath]) -> JointPath:
    """Join paths end to end; where the velocity does not jump, their common knot is there once."""
    once = [0] + [int(np.array_equal(a.v[-1], b.v[0])) for a, b in itertools.pairwise(parts)]
    times = np.concatenate([part.times[k:] for part, k in zip(parts, once, strict=True)])
    return JointPath(
        np.maximum.accumulate(times),  # the last knot of a piece may be an ulp late
        np.concatenate([part.q[k:] for part, k in zip(parts, once, strict=True)]),
        np.concatenate([part.v[k:] for part, k in zip(parts, once, strict=True)]),
    )


def _resolve(robot: Robot, q: Array, piece: Piece, room: int, keys: tuple[str, ...]) -> JointPath:
    """Return the joint path along one piece, with as many knots as it needs; at most `room` intervals."""
    intervals = _first_intervals(piece)
    while True:
        path = _through_knots(robot, q, piece, intervals, room, keys)
        middles = 0.5 * (path.times[:-1] + path.times[1:])
        halfway, targets = path.sample(middles)[0], piece.sample(middles)[0]
        worst = float(np.max(np.abs(np.array([robot.position(h) for h in halfway]) - targets)))
        if worst <= PATH_TOLERANCE:
            return path
        intervals *= 2
        if intervals > room:
            raise ScenarioError(
                f"reference: the joint path cannot be resolved (off the path by {worst:.1e} m midway between "
                f"{intervals // 2} knots); it runs too close to a singular pose, too fast or too far"
            )


def _first_intervals(piece: Piece) -> int:
    """Return into how many intervals a piece is cut at first.

    A cubic over h seconds is off by h⁴/384 times the fourth derivative of what it interpolates. That of the tip's path,
    from differences of its acceleration, says what the joints' path will need at least.
    """
    times, gap = np.linspace(piece.start, piece.stop, DIFFERENCES, retstep=True)
    fourth = float(np.max(np.abs(np.diff(piece.sample(times)[2], n=2, axis=0)))) / gap**2
    needed = (piece.stop - piece.start) * (1.5 * fourth / (384 * PATH_TOLERANCE)) ** 0.25
    wanted = max(1.0, piece.length / FIRST_SPACING, needed if math.isfinite(needed) else 1.0)
    return math.ceil(min(wanted, 1e300))


def _through_knots(robot: Robot, q: Array, piece: Piece, intervals: int, room: int, keys: tuple[str, ...]) -> JointPath:
    """Walk from knot to knot; a path that leaves the workspace is refused on the way, however long it is."""
    times = piece.start + (piece.stop - piece.start) * (np.arange(min(intervals, room) + 1) / intervals)
    places, rates, _ = piece.sample(times)
    midway = piece.sample(0.5 * (times[:-1] + times[1:]))[1]
    if not (
        np.all(np.diff(times) > SHORTEST) and np.all(np.isfinite(places)) and np.all(np.isfinite([*rates, *midway]))
    ):
        raise ScenarioError(
            f"reference: the motion from t = {piece.start:g} s to {piece.stop:g} s cannot be resolved: it is too fast; "
            "give it more time"
        )
    qs = [q.copy()]
    vs = [least_norm(robot.position_and_jacobian(q)[1], rates[0])]
    for k in range(times.size - 1):
        h = float(times[k + 1] - times[k])
        reached = _advance(robot, qs[-1], vs[-1], h, midway[k], rates[k + 1], places[k + 1])
        if isinstance(reached, str):
            raise _unreachable(robot, qs[-1], vs[-1], float(times[k]), h, piece, keys)
        qs.append(reached[0])
        vs.append(reached[1])
    if intervals > room:
        raise ScenarioError(f"reference: the path takes more than {MOST_KNOTS} knots; make it shorter or slower")
    return JointPath(times, np.array(qs), np.array(vs))


def _advance(
    robot: Robot, q: Array, v: Array, h: float, midway: Array, rate: Array, target: Array
) -> tuple[Array, Array] | str:
    """Return joint positions and velocities h seconds on from q and v (n,), or why there are none.

    `midway` and `rate` (3,) are the tip's velocity after h/2 and h, m/s; `target` (3,) its place after h, m.
    """
    try:
        slopes = [v]
        for share, wanted in ((0.5, midway), (0.5, midway), (1.0, rate)):
            x = q + h * share * slopes[-1]
            if not np.isfinite(x).all():
                return "the inverse kinematics broke down"
            slopes.append(least_norm(robot.position_and_jacobian(x)[1], wanted))
        x = q + h / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        r, J = robot.position_and_jacobian(x)
        for _ in range(20):
            error = target - r
            if np.abs(error).max() < 1e-14:
                break
            move = least_norm(J, error)
            x = x + move
            r, J = robot.position_and_jacobian(x)
            if np.abs(move).max() < 1e-15:
                break
        velocity = least_norm(J, rate)
    except np.linalg.LinAlgError:
        return "the inverse kinematics broke down"
    if not (np.isfinite(x).all() and np.isfinite(velocity).all()):
        return "the inverse kinematics broke down"
    if np.abs(target - r).max() > 0.1 * PATH_TOLERANCE:
        return f"the tip cannot get there: the path leaves the workspace{_barred(robot, q, target)}"
    model = robot.model
    outside = (x < model.position_lower) | (x > model.position_upper)
    if outside.any():
        j = int(np.argmax(outside))
        limits = f"[{model.position_lower[j]:g}, {model.position_upper[j]:g}]"
        return f"joint {robot.joint_names[j]} would be at {x[j]:.4f}, outside its limits {limits}"
    return x, velocity


def _unreachable(
    robot: Robot, q: Array, v: Array, start: float, h: float, piece: Piece, keys: tuple[str, ...]
) -> ScenarioError:
    """Return the refusal with the first instant within h of `start` that is out of reach, by bisection to 1 µs."""
    low, high = 0.0, h
    reason = "the path cannot be followed"
    for _ in range(60):
        middle = 0.5 * (low + high)
        places, rates, _ = piece.sample(start + middle * np.array([0.5, 1.0]))
        reached = _advance(robot, q, v, middle, rates[0], rates[1], places[1])
        if isinstance(reached, str):
            high, reason = middle, reached
        else:
            low = middle
        if high - low < 1e-6:
            break
    where = np.array2string(
        piece.sample(np.array([start + high]))[0][0], precision=4, separator=", ", suppress_small=True
    )
    by = f" ({', '.join(keys)})" if keys else ""
    return ScenarioError(
        f"reference: unreachable from t = {start + high:.4f} s on, at {where} m: {reason}; "
        f"shorten the path{by} or start elsewhere (start.q)"
    )


def _barred(robot: Robot, q: Array, target: Array) -> str:
    """Return in words which directions of the way to `target` (3,), m, no joint moves the tip in, at q (n,)."""
    r, J = robot.position_and_jacobian(q)
    U, sizes, _ = np.linalg.svd(J)
    rank = int(np.sum(sizes > RANK_TOLERANCE * sizes[0]))
    ways = [way for way in U[:, rank:].T if abs(float(way @ (target - r))) > 0.05 * PATH_TOLERANCE]
    if not ways:
        return ""
    named = [(way * np.sign(way[np.argmax(np.abs(way))])).round(4) + 0.0 for way in ways]
    return f" (no joint moves the tip along {' or '.join(str(way.tolist()) for way in named)} there)"
