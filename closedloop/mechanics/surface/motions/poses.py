"""[surface_motion] kind = "poses": through poses at given instants, at rest before the first and after the last.

Position p and rotation vector φ (from the first orientation, continuous from pose to pose) are quintic splines of time
with zero velocity and acceleration at both ends, so that both have four continuous derivatives. With θ = |φ|,

    ω = φ̇ + a φ × φ̇ + b φ × (φ × φ̇),      a = (1 − cos θ)/θ²,    b = (θ − sin θ)/θ³

Source: G. S. Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 2012, section 10.8 (SO(3)).
"""

import math
from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from closedloop.base.errors import ScenarioError
from closedloop.base.sections import PLACE, Instant, Number
from closedloop.mechanics.surface.motion import SurfaceMotion

Place = Annotated[Number, PLACE]
Pose = tuple[Place, Place, Place, Number, Number, Number, Number]

# Numbers of a segment: six coefficients of each of p and φ, the highest first.
SEGMENT, ORDER = 36, 6
# Below this angle, rad, what has differences of nearly equal numbers is summed as a series.
SMALL = 0.1
# A smaller one, rad, has no axis to speak of.
SAME = 1e-9
# Instants that are closer than this share of the whole do not determine a spline; and s, of the whole.
CLOSEST, SHORTEST = 1e-9, 1e-9


class Poses(SurfaceMotion):
    """Anything whose poses are known at some instants: a gripper, a conveyor with stops, a mocap body of MuJoCo.

    The surface moves as a body does that has these poses, from the first of them; between two poses it turns by less
    than half a turn.
    """

    times: tuple[Instant, ...] = Field(description="instants of the poses, s, ascending; two or more")
    poses: tuple[Pose, ...] = Field(
        description="lists [x, y, z, qw, qx, qy, qz], one for each instant, of a position, m, and a quaternion of any "
        "length, base frame"
    )

    @field_validator("times")
    @classmethod
    def _in_order(cls, value: tuple[float, ...]) -> Any:
        """Refuse fewer than two instants, and those that do not ascend."""
        if len(value) < 2:
            raise ValueError("must be two instants or more")
        for before, after in pairwise(value):
            if not after > before:
                raise ValueError(f"{after:g} s must be later than the instant before it, {before:g} s")
        return value

    @field_validator("poses")
    @classmethod
    def _have_orientations(cls, value: tuple[tuple[float, ...], ...]) -> Any:
        """Refuse quaternions of length zero."""
        for pose in value:
            if not 0.0 < math.hypot(*pose[3:]) < math.inf:
                raise ValueError(f"{list(pose)}: its quaternion must not be zero")
        return value

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        """Refuse another number of poses than of instants."""
        if len(self.poses) != len(self.times):
            raise ValueError(f"poses must be as many as times, {len(self.times)}, and not {len(self.poses)}")
        return self

    def list_length(self) -> int:
        """Return the length of what `resolved` gives."""
        return SEGMENT * (len(self.poses) - 1) + 3

    def resolved(self) -> dict[str, Any]:
        """Return the instants, s, the last one repeated, and the segments of the spline with where they begin, m.

        Raises ScenarioError if two instants are too close, or all.
        """
        from scipy.interpolate import make_interp_spline
        from scipy.spatial.transform import Rotation

        poses = np.array(self.poses)
        turned = poses[:, [4, 5, 6, 3]]
        turns = Rotation.from_quat(turned / np.max(np.abs(turned), axis=1, keepdims=True))  # no square overflows
        angles = (turns * turns[0].inv()).as_rotvec()
        for k in range(1, len(angles)):  # of the rotation vectors of an orientation the nearest to the one before
            size = float(np.linalg.norm(angles[k]))
            axis = _direction(angles[k] if size > SAME else angles[k - 1])
            angles[k] = axis * (size + 2.0 * np.pi * np.round((axis @ angles[k - 1] - size) / (2.0 * np.pi)))
        rest = [(1, np.zeros(6)), (2, np.zeros(6))]
        path = np.hstack([poses[:, :3] - poses[0, :3], angles])
        whole = self.times[-1] - self.times[0]
        times = (np.array(self.times) - self.times[0]) / whole
        if whole < SHORTEST or np.min(np.diff(times)) < CLOSEST:
            raise ScenarioError(
                f"surface_motion.times: two instants are closer than {CLOSEST:g} of the whole, {whole:.4g} s, or than "
                f"{SHORTEST:g} s: leave one of them out"
            )
        spline = make_interp_spline(times, path, k=ORDER - 1, bc_type=(rest, rest))
        taylor = [spline.derivative(j)(times[:-1]) / math.factorial(j) / whole**j for j in reversed(range(ORDER))]
        more = (self.times[-1],) * (self.list_length() - len(times))
        return {"times": (*self.times, *more), "poses": (*np.stack(taylor, axis=2).ravel(), *poses[0, :3])}

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write shift, angle and spin at t, s."""
        c, times = par.poses, par.times
        end = c.shape[0] - 3
        k, last = 0, end // SEGMENT - 1
        t = min(max(t, times[0]), times[last + 1])
        while k < last:
            middle = (k + last + 1) // 2
            if times[middle] <= t:
                k = middle
            else:
                last = middle - 1
        x = t - times[k]
        for i in range(6):
            first = SEGMENT * k + ORDER * i
            value, rate, half = 0.0, 0.0, 0.0  # half the second derivative: Horner's scheme of the Taylor expansion
            for j in range(ORDER):
                half = half * x + rate
                rate = rate * x + value
                value = value * x + c[first + j]
            if i < 3:
                m.centre[i] = c[end + i]
                m.shift[i], m.shift_rate[i], m.shift_acceleration[i] = value, rate, 2.0 * half
            else:
                m.axis[i - 3], m.spin[i - 3], m.spin_rate[i - 3] = value, rate, 2.0 * half
        p, v, a = m.axis, m.spin, m.spin_rate
        square = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
        angle = math.sqrt(square)
        if angle < SMALL:
            one = 0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0))
            two = 1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0))
            # the derivatives of both by square/2
            one_rate = -1.0 / 12.0 + square * (1.0 / 180.0 - square * (1.0 / 6720.0 - square / 453600.0))
            two_rate = -1.0 / 60.0 + square * (1.0 / 1260.0 - square * (1.0 / 60480.0 - square / 4989600.0))
        else:
            sine = math.sin(angle) / angle
            one, two = (1.0 - math.cos(angle)) / square, (1.0 - sine) / square
            one_rate, two_rate = (sine - 2.0 * one) / square, (one - 3.0 * two) / square
        along = p[0] * v[0] + p[1] * v[1] + p[2] * v[2]
        across = p[0] * a[0] + p[1] * a[1] + p[2] * a[2]
        fast = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        c0, c1, c2 = p[1] * v[2] - p[2] * v[1], p[2] * v[0] - p[0] * v[2], p[0] * v[1] - p[1] * v[0]  # φ × φ̇
        d0, d1, d2 = p[1] * a[2] - p[2] * a[1], p[2] * a[0] - p[0] * a[2], p[0] * a[1] - p[1] * a[0]  # φ × φ̈
        for i in range(3):
            cross, change = (c0, d0) if i == 0 else (c1, d1) if i == 1 else (c2, d2)
            twice = p[i] * along - v[i] * square  # φ × (φ × φ̇)
            # φ̇ × (φ × φ̇) = φ |φ̇|² − φ̇ (φ·φ̇), and φ × (φ × φ̈)
            more = p[i] * fast - v[i] * along + p[i] * across - a[i] * square
            m.spin_rate[i] = a[i] + one * change + two * more + along * (one_rate * cross + two_rate * twice)
            m.spin[i] = v[i] + one * cross + two * twice
        m.angle = angle
        for i in range(3):
            m.axis[i] = m.axis[i] / angle if angle > 0.0 else (1.0 if i == 2 else 0.0)


def _direction(angle: Any) -> Any:
    """Return the direction of a rotation vector; z of none."""
    size = float(np.linalg.norm(angle))
    return angle / size if size > 0.0 else np.array([0.0, 0.0, 1.0])
