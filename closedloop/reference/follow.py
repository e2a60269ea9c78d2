"""From the tip's path to the joints' path: least-norm inverse kinematics.

For a redundant arm the joint motion is that of least norm: of the joint velocities that move the tip along the path,
q̇ = Jᵣ⁺ ṙ_des (Moore-Penrose) has the smallest norm. That differential equation is integrated with RK4 from one knot to
the next, the error of the tip is removed by least-norm Newton steps, and the knots are joined by cubic Hermite
polynomials whose derivative is q̇_des. On each segment of the path the spacing of knots is halved until the tip of the
interpolated path is within `PATH_TOLERANCE` of the path midway between them. So the reference is one function of time,
the same for every step size and integrator.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from closedloop.errors import ScenarioError
from closedloop.jit.interpreted import call_once
from closedloop.reference.inverse_kinematics import (
    BROKEN,
    ENDED,
    KNOT_TOLERANCE,
    MIDWAY,
    OFF,
    OUTCOMES,
    PATH_TOLERANCE,
    REACHED,
    Way,
    scratch_size,
    walk,
)
from closedloop.reference.joint_path import JointPath
from closedloop.reference.least_norm import RANK_TOLERANCE
from closedloop.reference.tip_path import Segment, TipPath
from closedloop.robot.pinocchio import Robot

Array = NDArray[np.float64]

FIRST_SPACING = 5e-4  # m of path between knots before any halving
SHORTEST = 1e-12  # s between knots
MOST_KNOTS = 20_000
FEW_KNOTS = 2_000  # take as long interpreted, 1 to 3 ms each, as the inverse kinematics takes to be compiled
DIFFERENCES = 257  # points at which a segment's acceleration is sampled to choose the first intervals


def follow(robot: Robot, q: Array, path: TipPath) -> JointPath:
    """Return the joint path whose tip runs along `path` from joint positions q (n,), at which the tip is at its start.

    Raises
    ------
    ScenarioError
        If the path leaves the workspace or the joint limits, with the first instant at which it does.
    """
    if not path.segments:
        return JointPath.hold(q)
    parts: list[JointPath] = []
    most = MOST_KNOTS
    with np.errstate(all="ignore"):  # what overflows is refused by name
        for segment in path.segments:
            part = _resolve(robot, parts[-1].q[-1] if parts else q, segment, most, path.keys)
            most -= part.times.size - 1
            parts.append(part)
    return _joined(parts)


def _joined(parts: list[JointPath]) -> JointPath:
    """Join paths end to end; where the velocity is continuous, their common knot is kept once."""
    once = [0] + [int(np.array_equal(a.v[-1], b.v[0])) for a, b in itertools.pairwise(parts)]
    times = np.concatenate([part.times[k:] for part, k in zip(parts, once, strict=True)])
    return JointPath(
        np.maximum.accumulate(times),  # the last knot of a segment may be an ulp late
        np.concatenate([part.q[k:] for part, k in zip(parts, once, strict=True)]),
        np.concatenate([part.v[k:] for part, k in zip(parts, once, strict=True)]),
    )


def _resolve(robot: Robot, q: Array, segment: Segment, most: int, keys: tuple[str, ...]) -> JointPath:
    """Return the joint path along one segment, with as many knots as it needs; at most `most` intervals."""
    intervals = _first_intervals(segment)
    while True:
        path, worst = _through_knots(robot, q, segment, intervals, most, keys)
        if worst <= PATH_TOLERANCE:
            return path
        intervals *= 2
        if intervals > most:
            raise ScenarioError(
                f"reference: the joint path cannot be resolved (off the path by {worst:.1e} m midway between "
                f"{intervals // 2} knots); it runs too close to a singular pose, too fast or too far"
            )


def _first_intervals(segment: Segment) -> int:
    """Return the number of intervals to begin with on a segment.

    The error of a cubic over h seconds is h⁴/384 times the fourth derivative. That of the tip's path, from differences
    of its acceleration, gives a lower bound for the joints' path.
    """
    times, gap = np.linspace(segment.start, segment.stop, DIFFERENCES, retstep=True)
    fourth = float(np.max(np.abs(np.diff(segment.sample(times)[2], n=2, axis=0)))) / gap**2
    needed = (segment.stop - segment.start) * (1.5 * fourth / (384 * PATH_TOLERANCE)) ** 0.25
    wanted = max(1.0, segment.length / FIRST_SPACING, needed if math.isfinite(needed) else 1.0)
    return math.ceil(min(wanted, 1e300))


def _through_knots(
    robot: Robot, q: Array, segment: Segment, intervals: int, most: int, keys: tuple[str, ...]
) -> tuple[JointPath, float]:
    """Return the joint path through the knots, and the largest distance of the tip from its path midway, m.

    A path is refused at the first knot out of the workspace.
    """
    times = segment.start + (segment.stop - segment.start) * (np.arange(min(intervals, most) + 1) / intervals)
    knots, midway = _tip(segment, times), _tip(segment, 0.5 * times[:-1] + 0.5 * times[1:])
    if not (np.all(np.diff(times) > SHORTEST) and np.all(np.isfinite(knots)) and np.all(np.isfinite(midway[:, 3:]))):
        raise ScenarioError(
            f"reference: the motion from t = {segment.start:g} s to {segment.stop:g} s cannot be resolved: it is too "
            "fast; give it more time"
        )
    way, reached, outcome = _walk(robot, q, times, knots, midway)
    if reached < times.size:
        h = float(times[reached] - times[reached - 1])
        raise _unreachable(robot, way.q[reached - 1], float(times[reached - 1]), h, segment, keys)
    if intervals > most:
        raise ScenarioError(f"reference: the path takes more than {MOST_KNOTS} knots; make it shorter or slower")
    return JointPath(times, way.q, way.v), float(outcome[MIDWAY])


def _tip(segment: Segment, times: Array) -> Array:
    """Return the tip's position, m, and velocity, m/s, (N, 6) at times (N,), s."""
    return np.ascontiguousarray(np.hstack(segment.sample(times)[:2]))


def _walk(robot: Robot, q: Array, times: Array, knots: Array, midway: Array) -> tuple[Way, int, Array]:
    """Return what `walk` makes of knots and the places between them, from joint positions q (n,)."""
    limits = np.stack([robot.model.position_lower, robot.model.position_upper])
    way = Way(times, knots, midway, limits, np.zeros((times.size, robot.n)), np.zeros((times.size, robot.n)))
    way.q[0] = q
    outcome, work = np.zeros(OUTCOMES), np.zeros(scratch_size(robot.n))
    brief = times.size <= FEW_KNOTS
    reached: int = call_once(walk, (way.q, way.v, work, outcome), brief, robot.tree, work, way, outcome)
    return way, reached, outcome


def _unreachable(
    robot: Robot, q: Array, start: float, h: float, segment: Segment, keys: tuple[str, ...]
) -> ScenarioError:
    """Return the refusal with the first instant within h of `start` that is out of reach, by bisection to 1 µs."""
    low, high = 0.0, h
    reason = "the path cannot be followed"
    for _ in range(60):
        middle = 0.5 * (low + high)
        tip = _tip(segment, start + middle * np.array([0.0, 0.5, 1.0]))
        way, _, outcome = _walk(robot, q, np.array([0.0, middle]), tip[[0, 2]], tip[1:2])
        if outcome[ENDED] == REACHED:
            low = middle
        else:
            high, reason = middle, _reason(robot, way, int(outcome[ENDED]))
        if high - low < 1e-6:
            break
    where = np.array2string(
        segment.sample(np.array([start + high]))[0][0], precision=4, separator=", ", suppress_small=True
    )
    by = f" ({', '.join(keys)})" if keys else ""
    return ScenarioError(
        f"reference: unreachable from t = {start + high:.4f} s on, at {where} m: {reason}; "
        f"shorten the path{by} or start elsewhere (start.q)"
    )


def _reason(robot: Robot, way: Way, ended: int) -> str:
    """Return the reason why the second knot of a way was not reached."""
    if ended == BROKEN:
        return "the inverse kinematics broke down"
    if ended == OFF:
        return f"the tip cannot get there: the path leaves the workspace{_barred(robot, way.q[0], way.knots[1, :3])}"
    x, (lower, upper) = way.q[1], way.limits
    j = int(np.argmax((x < lower) | (x > upper)))
    return f"joint {robot.joint_names[j]} would be at {x[j]:.4f}, outside its limits [{lower[j]:g}, {upper[j]:g}]"


def _barred(robot: Robot, q: Array, target: Array) -> str:
    """Return the directions of the way to `target` (3,), m, in which no joint moves the tip at q (n,), in words."""
    r, J = robot.position_and_jacobian(q)
    U, sizes, _ = np.linalg.svd(J)
    rank = int(np.sum(sizes > RANK_TOLERANCE * sizes[0]))
    ways = [way for way in U[:, rank:].T if abs(float(way @ (target - r))) > 0.5 * KNOT_TOLERANCE]
    if not ways:
        return ""
    named = [(way * np.sign(way[np.argmax(np.abs(way))])).round(4) + 0.0 for way in ways]
    return f" (no joint moves the tip along {' or '.join(str(way.tolist()) for way in named)} there)"
