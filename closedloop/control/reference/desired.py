"""The desired motion and force of a scenario, and the table of them that the loop reads.

The joints' path follows from the tip's by inverse kinematics, of a redundant arm that of least norm: of the joint
velocities that move the tip along the path, q̇ = Jᵣ⁺ ṙ_des (Moore-Penrose) has the smallest norm. That differential
equation is integrated with RK4 from one knot to the next, the error of the tip is removed by least-norm Newton steps,
and the knots are joined by cubic Hermite polynomials whose derivative is q̇_des. On each segment of the path the
spacing of knots is halved until the tip of the interpolated path is within `PATH_TOLERANCE` of the path midway between
them. So the reference is one function of time, the same for every step size and integrator.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference import inverse_kinematics as ik
from closedloop.control.reference import path as paths
from closedloop.control.reference.tip_path import Segment, TipPath, refuse_beyond_edge, refuse_without_normal, seams
from closedloop.jit.blocks import Block, Count
from closedloop.jit.interim import call_once
from closedloop.jit.kernel import plain
from closedloop.mechanics.loops.bind import loop_memory
from closedloop.mechanics.loops.solve import along_path
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import work_size
from closedloop.mechanics.surface.placed import PlacedSurface
from robot_models.model import AT_LIMIT

N = Count.of("n")


class Reference(Block, sizes=("n",)):
    """What is desired of n joints, and of the tip in base axes; see `closedloop.loop.step.locate.in_contact_frame`."""

    q: Annotated[Array, N]  # rad (m)
    v: Annotated[Array, N]  # rad/s (m/s)
    position: Annotated[Array, 3]  # m
    velocity: Annotated[Array, 3]  # m/s
    acceleration: Annotated[Array, 3]  # m/s²
    force: float  # N


class TableRow(Block, sizes=("n",)):
    """A row of the table."""

    reference: Reference
    sensor: Annotated[Array, 4]  # see `closedloop.control.sensor.draws`


class DrawnRow(TableRow, sizes=("n",)):
    """A row of the table of an arm whose encoders are noisy."""

    draws: Annotated[Array, 2 * N]  # see `closedloop.control.sensor.encoder_draws`


FIRST_SPACING = 5e-4  # m of path between knots before any halving
SHORTEST = 1e-12  # s between knots
MOST_KNOTS = 20_000
# Of a tool held against a surface: by which factor intervals are multiplied before a part is halved, and the shortest
# part that is, as a share of its segment.
DOUBLED, SHORTEST_HALF = 4, 1e-6
# So many knots take as long interpreted, 1 to 3 ms each, with loops 5 to 30, as their kernel takes to be compiled.
FEW_KNOTS, FEW_WITH_LOOPS = 2_000, 1_000
DIFFERENCES = 257  # points at which a segment's acceleration is sampled to choose the first intervals


def follow(robot: Robot, q: Array, path: TipPath, held: paths.Orientation = paths.FREE_ORIENTATION) -> ik.JointPath:
    """Return the joint path whose tip runs along `path` from joint positions q (n,), at which the tip is at its start.

    With an orientation that is `held` it begins at the posture next to q that has it, if that is within a degree.

    Raises ScenarioError if the path leaves the workspace or the joint limits, with the first instant at which it does;
        or if the arm cannot hold the orientation, or is not near it at the start.
    """
    if held.rows != ik.POSITION:
        q = _aligned(robot, q, held)
    if path.segments and any(robot.support[j] for j in robot.model.balls):
        raise ScenarioError(
            f"reference.kind: the tip of {robot.model.name} depends on a ball joint, which has no drive and "
            'cannot follow a path: use kind = "hold"'
        )
    if not path.segments:
        return ik.JointPath.hold(q)
    parts: list[ik.JointPath] = []
    most, who = MOST_KNOTS, Follower.of(robot, q, held)
    with np.errstate(all="ignore"):  # what overflows is refused by name
        for segment in path.segments:
            part = _resolve(who, parts[-1].q[-1] if parts else q, segment, most, path.keys)
            most -= part.times.size - 1
            parts.append(part)
    return _joined(parts)


class Follower(NamedTuple):
    """Who follows a path: the arm, what is held of the tool's orientation, and its axes in the tip's link (3, 3)."""

    robot: Robot
    held: paths.Orientation
    axes: Array

    @classmethod
    def of(cls, robot: Robot, q: Array, held: paths.Orientation) -> "Follower":
        """Return who follows, of an arm that begins at joint positions q (n,)."""
        free = held.rows == ik.POSITION
        return cls(robot, held, np.zeros((3, 3)) if free else np.ascontiguousarray(held.in_link(robot, q)))

    def tip(self, segment: Segment, times: Array) -> Array:
        """Return position, m, velocity, m/s, the tool's axis and its rate, 1/s, (N, 12) at times (N,), s."""
        r, velocity, _ = segment.sample(times)
        return np.ascontiguousarray(np.hstack([r, velocity, self.held.axis_along(times, r, velocity)]))

    def walk(self, q: Array, times: Array, knots: Array, midway: Array) -> tuple[ik.Way, int, Array]:
        """Return what `walk` makes of knots and the places between them, from joint positions q (n,)."""
        robot, held, n = self.robot, self.held, self.robot.n
        limits = np.stack([robot.model.position_lower - AT_LIMIT, robot.model.position_upper + AT_LIMIT])
        way = ik.Way(
            times, knots, midway, held.rows, self.axes, np.ascontiguousarray(held.frame), limits,
            np.zeros((times.size, n)), np.zeros((times.size, n)),
        )  # fmt: skip
        way.q[0] = q
        sizes = n, held.rows, int(plain(work_size)(n))
        outcome, scratch = np.zeros(ik.OUTCOMES), np.zeros(ik.Scratch.count(*sizes))
        written: list[Array | NDArray[np.int64]] = [way.q, way.v, scratch, outcome]
        loops: tuple[Any, int] = 0, 0
        if robot.model.loops:
            memory = loop_memory(robot)
            written += [memory.rows.memory, memory.links.memory]
            loops = along_path, memory.address
        brief = times.size <= (FEW_WITH_LOOPS if robot.model.loops else FEW_KNOTS)
        reached: int = call_once(ik.walk, written, brief, robot.tree, scratch, way, outcome, *loops)
        return way, reached, outcome


def _aligned(robot: Robot, q: Array, held: paths.Orientation) -> Array:
    """Return the posture next to q (n,) in which the tip is at the same place and the tool is as it is to be held."""
    held.check_joints(robot, q)
    r, still = robot.position(q)[None], np.zeros((1, 3))
    target = np.hstack([r, still, held.axis_along(np.zeros(1), r, still)])
    with np.errstate(all="ignore"):
        way, _, outcome = Follower.of(robot, q, held).walk(
            q, np.array([0.0, 1.0]), np.repeat(target, 2, axis=0), target
        )
    angle = held.askew(robot, q)
    if outcome[ik.ENDED] == ik.REACHED and angle <= paths.ASKEW:
        return np.array(way.q[1])
    nearest = "another posture"
    if outcome[ik.ENDED] == ik.REACHED:
        nearest = f"start.q = {[round(float(x), 9) + 0.0 for x in way.q[1]]}"
    raise ScenarioError(
        f"{held.said}: the tool is turned {math.degrees(angle):.4g} degrees away from it at the start, and "
        f"{math.degrees(paths.ASKEW):g} degree is the most: start with {nearest}"
    )


def _joined(parts: list[ik.JointPath]) -> ik.JointPath:
    """Join paths end to end; where the velocity is continuous, their common knot is kept once."""
    once = [0] + [int(np.array_equal(a.v[-1], b.v[0])) for a, b in itertools.pairwise(parts)]
    times = np.concatenate([part.times[k:] for part, k in zip(parts, once, strict=True)])
    return ik.JointPath(
        np.maximum.accumulate(times),  # the last knot of a segment may be an ulp late
        np.concatenate([part.q[k:] for part, k in zip(parts, once, strict=True)]),
        np.concatenate([part.v[k:] for part, k in zip(parts, once, strict=True)]),
    )


def _resolve(who: Follower, q: Array, segment: Segment, most: int, keys: tuple[str, ...]) -> ik.JointPath:
    """Return the joint path along one segment, with as many knots as it needs; at most `most` intervals."""
    # Over h seconds a cubic errs by h⁴/384 times the fourth derivative, of which the tip's path gives a lower bound.
    times, gap = np.linspace(segment.start, segment.stop, DIFFERENCES, retstep=True)
    fourth = float(np.max(np.abs(np.diff(segment.sample(times)[2], n=2, axis=0)))) / gap**2
    needed = (segment.stop - segment.start) * (1.5 * fourth / (384 * ik.PATH_TOLERANCE)) ** 0.25
    wanted = max(1.0, segment.length / FIRST_SPACING, needed if math.isfinite(needed) else 1.0)
    first, whole = math.ceil(min(wanted, 1e300)), segment.stop - segment.start
    parts: list[ik.JointPath] = []
    for begin, end in itertools.pairwise([segment.start, *seams(who.held.surface, segment), segment.stop]):
        share = math.ceil(first * ((end - begin) / whole))
        parts.append(_between(who, parts[-1].q[-1] if parts else q, segment, (begin, end), share, most, keys))
        most -= parts[-1].times.size - 1
    return _joined(parts)


def _between(
    who: Follower, q: Array, segment: Segment, span: tuple[float, float], first: int, most: int, keys: tuple[str, ...]
) -> ik.JointPath:
    """Return the joint path between two instants of a segment, with `first` intervals or more.

    A tool that is held against a surface may have an acceleration that jumps. Knots are needed near the jumps alone:
    what some doublings do not resolve is halved.
    """
    intervals, begin, end = first, *span
    while True:
        path, worst = _through_knots(who, q, segment, span, intervals, most, keys)
        if worst <= ik.PATH_TOLERANCE:
            return path
        intervals *= 2
        shortest = SHORTEST_HALF * (segment.stop - segment.start)
        if who.held.surface is not None and intervals > DOUBLED * first and end - begin > shortest:
            middle, fewer = 0.5 * (begin + end), max(1, first // 2)
            before = _between(who, q, segment, (begin, middle), fewer, most, keys)
            left = most - before.times.size
            return _joined([before, _between(who, before.q[-1], segment, (middle, end), fewer, left, keys)])
        if intervals > most:
            raise ScenarioError(
                f"reference: the joint path cannot be resolved (off the path by {worst:.1e} m midway between "
                f"{intervals // 2} knots); it runs too close to a singular pose, too fast or too far"
            )


def _through_knots(
    who: Follower, q: Array, segment: Segment, span: tuple[float, float], intervals: int, most: int,
    keys: tuple[str, ...],
) -> tuple[ik.JointPath, float]:  # fmt: skip
    """Return the joint path through the knots, and the largest distance of the tip from its path midway, m.

    A path is refused at the first knot out of the workspace.
    """
    times = span[0] + (span[1] - span[0]) * (np.arange(min(intervals, most) + 1) / intervals)
    if span[1] < segment.stop:
        times[-1] = span[1]  # where the other half begins, to the last bit
    tips = who.tip(segment, np.concatenate([times, 0.5 * times[:-1] + 0.5 * times[1:]]))
    knots, midway = np.ascontiguousarray(tips[: times.size]), np.ascontiguousarray(tips[times.size :])
    if not (np.all(np.diff(times) > SHORTEST) and np.all(np.isfinite(knots)) and np.all(np.isfinite(midway[:, 3:]))):
        raise ScenarioError(
            f"reference: the motion from t = {span[0]:g} s to {span[1]:g} s cannot be resolved: it is too "
            "fast; give it more time"
        )
    way, reached, outcome = who.walk(q, times, knots, midway)
    if reached < times.size:
        h = float(times[reached] - times[reached - 1])
        raise _unreachable(who, way.q[reached - 1], float(times[reached - 1]), h, segment, keys)
    if intervals > most:
        raise ScenarioError(f"reference: the path takes more than {MOST_KNOTS} knots; make it shorter or slower")
    return ik.JointPath(times, way.q, way.v), float(outcome[ik.MIDWAY])


def _unreachable(
    who: Follower, q: Array, start: float, h: float, segment: Segment, keys: tuple[str, ...]
) -> ScenarioError:
    """Return the refusal with the first instant within h of `start` that is out of reach, by bisection to 1 µs."""
    low, high = 0.0, h
    reason = "the path cannot be followed"
    for _ in range(60):
        middle = 0.5 * (low + high)
        tip = who.tip(segment, start + middle * np.array([0.0, 0.5, 1.0]))
        way, _, outcome = who.walk(q, np.array([0.0, middle]), tip[[0, 2]], tip[1:2])
        if outcome[ik.ENDED] == ik.REACHED:
            low = middle
        else:
            high, reason = middle, _reason(who, way, int(outcome[ik.ENDED]))
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


def _reason(who: Follower, way: ik.Way, ended: int) -> str:
    """Return the reason why the second knot of a way was not reached."""
    robot = who.robot
    if ended == ik.BROKEN:
        return "the inverse kinematics broke down"
    if ended == ik.OFF and who.held.rows != ik.POSITION:
        return f"the tip cannot get there with its tool held ({who.held.said})"
    if ended == ik.OFF:
        return f"the tip cannot get there: the path leaves the workspace{_barred(robot, way.q[0], way.knots[1, :3])}"
    x, (lower, upper) = way.q[1], way.limits
    j = int(np.argmax((x < lower) | (x > upper)))
    low, high = robot.model.position_lower[j], robot.model.position_upper[j]
    return f"joint {robot.joint_names[j]} would leave its limits [{low:g}, {high:g}]"


def _barred(robot: Robot, q: Array, target: Array) -> str:
    """Return the directions of the way to `target` (3,), m, in which no joint moves the tip at q (n,), in words."""
    r, J = robot.position_and_jacobian(q)
    U, sizes, _ = np.linalg.svd(J)
    rank = int(np.sum(sizes > ik.RANK_TOLERANCE * sizes[0]))
    ways = [way for way in U[:, rank:].T if abs(float(way @ (target - r))) > 0.5 * ik.KNOT_TOLERANCE]
    if not ways:
        return ""
    named = [(way * np.sign(way[np.argmax(np.abs(way))])).round(4) + 0.0 for way in ways]
    return f" (no joint moves the tip along {' or '.join(str(way.tolist()) for way in named)} there)"


OUTWARDS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Motion:
    """The desired motion as a function of time."""

    tip: TipPath  # the tip's path, base frame
    joints: ik.JointPath  # the joints' path along it

    def table(self, instants: Array, spare: int = 0) -> Array:
        """Return the table at `instants` (P,), s, rows of `Reference` without a force; at a discontinuity with the
        right limit.

        `spare` columns of zeros are appended.
        """
        n = self.joints.q.shape[1]
        table = np.zeros((instants.size, Reference.count(n) + spare))
        self.joints.write(instants, table, 2)
        if type(self.tip) is TipPath and not self.tip.segments:  # it stays, and the other columns are zero
            table[:, Reference.place("position", n)] = self.tip.origin
            return table
        for name, x in zip(("position", "velocity", "acceleration"), self.tip.sample(instants), strict=True):
            table[:, Reference.place(name, n)] = x
        return table


@dataclass(frozen=True)
class Desired(Motion):
    """The desired motion and force as functions of time."""

    profile: paths.ForceProfile  # the desired force over time
    force: float  # law.force, N, which the profile starts from

    def table(self, instants: Array, spare: int = 0) -> Array:
        """Return the table of `Motion`, with the force."""
        table = super().table(instants, spare)
        table[:, Reference.place("force", self.joints.q.shape[1])] = paths.force_at(self.profile, self.force, instants)
        return table


def desired(
    reference: paths.Path, robot: Robot, surface: PlacedSurface, q: Array, duration: float = 0.0,
    axis: Array = OUTWARDS, radius: float = 0.0,
) -> Motion:  # fmt: skip
    """Return the desired motion of a robot that starts at joint positions q (n,).

    A surface that moves carries the tip for `duration`, s; `axis` (3,): the tool's, in the tip's frame, which an
    orientation may hold against the normal; `radius`: of the tool's round end, m.
    Raises ScenarioError if the path, or [reference], is at fault, or leaves surface, workspace or limits.
    """
    if robot.moved and reference.kind != "hold":
        raise ScenarioError(
            f"reference.kind = {reference.kind!r}: inverse kinematics follows no path with a robot that a "
            "[[mocap]] moves: leave [reference] out"
        )
    tip = paths.path_on(reference, robot.known_tip(robot.pinocchios(q))[0], surface, duration)
    if reference.on_surface != "no":
        refuse_without_normal(surface, tip)
        refuse_beyond_edge(surface, tip)
        paths.refuse_tool_too_large(surface, tip, radius)
    return Motion(tip, follow(robot, q, tip, paths.orientation_of(reference.orientation, axis, robot, q, surface)))
