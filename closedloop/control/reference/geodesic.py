"""A path laid onto a surface without stretching it: as it is drawn when the plane of the path rolls along the surface.

A plane that rolls without slip and without spin about the normal keeps lengths and angles, so the tip runs along the
surface exactly as fast as the path says, a straight line becomes a geodesic, corners keep their angle, and a curve its
curvature within the surface. With (x, y) the path in the plane, s its parameter, and e₁, e₂ two tangents,

    r' = x' e₁ + y' e₂,      eᵢ' = −(eᵢ·n') n,      n' = (1 − n nᵀ) ∇∇φ r'/|∇φ|

which for a straight line is the equation of a geodesic, and eᵢ are carried along parallel to themselves (M. do Carmo,
Differential Geometry of Curves and Surfaces, 4-4). It is integrated by DOP853 from knot to knot; at each knot the point
is put back onto the surface and the tangents into its plane. Between knots the path is the polynomial of degree 5 with
their r, r' and r'', which is checked midway: where it is off, the point midway becomes a knot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.tip_path import Curve, Segment
from closedloop.mechanics.surface.along import carry, shape_at
from closedloop.mechanics.surface.placed import PlacedSurface

# Tolerances of a step of DOP853, and of the polynomials midway between knots: m, and as a share of the speed.
RELATIVE, ABSOLUTE = 1e-11, 1e-14
MIDWAY, SPEED_MIDWAY = 1e-12, 1e-10
# Knots to begin with, one each so many m; and when to give up: where so many, evenly spread, would not do.
SPACING, FEWEST, MOST = 0.01, 8, 4096
# Longest curve, m: the inverse kinematics follows none that is longer.
LONGEST = 10.0
# Newton steps that put a point back, from no farther than an integration step is off.
TENTH = 3


@dataclass(frozen=True)
class Rolled:
    """A curve on a surface, as `closedloop.control.reference.tip_path.Curve`."""

    polynomials: tuple[Any, Any, Any]  # r, m, r' and r'' as functions of the parameter
    first: Array  # (3,): r at the start

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        r, slope, bend = (each(s) for each in self.polynomials)
        return r - self.first, slope, bend


@dataclass(frozen=True)
class CarriedSegment(Segment):
    """A segment on a surface that moves: drawn on it as it lies at t = 0, and carried along."""

    surface: PlacedSurface

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return r, ṙ and r̈ as `Segment.sample` does."""
        times = np.asarray(t, dtype=np.float64)
        return carry(self.surface, times, super().sample(times))


class Rolling:
    """The plane of a path that rolls along a surface.

    Parameters
    ----------
    origin : (3,) array
        Where the path begins, m, base frame; it keeps to the level of φ there.

    Raises
    ------
    ScenarioError
        If the surface has no normal there.
    """

    def __init__(self, surface: PlacedSurface, origin: Array) -> None:
        start = surface.touching(origin)
        self._shape, self._level = shape_at(surface), start.level
        self._plane: Array = surface.frame[1:]
        self.r, self.tangents = np.array(origin), start.frame[1:].copy()

    def roll(self, curve: Curve, duration: float, length: float) -> Rolled:
        """Roll along a curve in the plane from where the last one ended.

        Parameters
        ----------
        curve : Curve
            In the tangent plane at the surface's origin; what leads out of it is left out.
        duration : float
            Up to which its parameter goes.
        length : float
            Its length, m, about.

        Raises
        ------
        ScenarioError
            If it leaves the surface, or is too long, or bent too sharply to be resolved.
        """
        from scipy.interpolate import BPoly

        if not length <= LONGEST:
            raise ScenarioError(
                f"reference: a motion of {length:.4g} m is too long to be laid onto the surface as a geodesic, of "
                f"{LONGEST:g} m at most; make it shorter"
            )
        count, pace = max(FEWEST, math.ceil(min(length / SPACING, MOST))), length / duration
        finest = 0.75 * duration / (count * 2 ** int(math.log2(MOST / count)))
        before, s = (self.r, self.tangents), np.linspace(0.0, duration, 2 * count + 1)
        while True:
            self.r, self.tangents = before
            points = self._through(curve, s, pace)
            r: Any = BPoly.from_derivatives(s[::2], points[::2])
            pieces = (r, r.derivative(), r.derivative(2))
            off, wrong = (np.max(np.abs(pieces[i](s[1::2]) - points[1::2, i]), axis=1) for i in range(2))
            reach, fastest = (float(np.max(np.abs(points[:, i]))) for i in range(2))
            far = np.flatnonzero((off > MIDWAY * (1.0 + reach)) | (wrong > SPEED_MIDWAY * fastest))
            if far.size == 0:
                return Rolled(pieces, points[0, 0].copy())
            half = s[2 * far + 1] - s[2 * far]
            if np.min(half) < finest:
                at = 2 * far[np.argmin(half)] + 1
                raise ScenarioError(
                    f"reference: after {pace * s[at]:.4g} m the path cannot be laid onto the surface as a geodesic: "
                    f"it, or the surface, is bent too sharply, at {np.round(points[at, 0], 4).tolist()} m"
                )
            s = np.sort(np.concatenate([s, s[2 * far] + 0.5 * half, s[2 * far + 1] + 0.5 * half]))

    def _through(self, curve: Curve, s: Array, pace: float) -> Array:
        """Return r, r' and r'' at each parameter of s (K,), (K, 3, 3); `pace` is the path's length by s, m."""
        points = np.empty((s.size, 3, 3))
        for k in range(s.size):
            if k:
                self._step(self._rate(curve, pace * s[k - 1]), s[k - 1], s[k])
            self._put_back(pace * s[k])
            y = np.concatenate([self.r, self.tangents.ravel()])
            velocity = self._rate(curve, pace * s[k])(s[k], y)[:3]
            _, _, bend = (self._plane @ each[0] for each in curve(s[k : k + 1]))
            n, turning, _, _ = self._shape(self.r, velocity)
            points[k] = self.r, velocity, bend @ self.tangents - n * (turning @ velocity)
        return points

    def _rate(self, curve: Curve, done: float) -> Callable[[float, Array], Array]:
        """Return the right-hand side for DOP853; `done`, m, of the path are behind."""

        def rate(s: float, y: Array) -> Array:
            tangents = y[3:].reshape(2, 3)
            velocity = (self._plane @ curve(np.array([s]))[1][0]) @ tangents
            n, turning, _, _ = self._shape(y[:3], velocity)
            if not np.all(np.isfinite(n)):
                raise _left(y[:3], done)
            return np.concatenate([velocity, np.outer(-(tangents @ turning), n).ravel()])

        return rate

    def _step(self, rate: Callable[[float, Array], Array], begin: float, end: float) -> None:
        from scipy.integrate import DOP853

        y = np.concatenate([self.r, self.tangents.ravel()])
        solver: Any = DOP853(rate, begin, y, end, rtol=RELATIVE, atol=ABSOLUTE, first_step=end - begin)
        while solver.status == "running":
            solver.step()
        self.r, self.tangents = solver.y[:3].copy(), solver.y[3:].reshape(2, 3).copy()

    def _put_back(self, done: float) -> None:
        """Put the point onto its level of φ, and the tangents into the plane there, at right angles."""
        for _ in range(TENTH):
            n, _, level, size = self._shape(self.r, np.zeros(3))
            if not np.all(np.isfinite(n)):
                raise _left(self.r, done)
            self.r = self.r - (level - self._level) / size * n
        first = self.tangents[0] - (self.tangents[0] @ n) * n
        first /= np.linalg.norm(first)
        self.tangents = np.array([first, np.cross(n, first)])


def _left(r: Array, done: float) -> ScenarioError:
    return ScenarioError(
        f"reference: after {done:.4g} m the path leaves the surface, at {np.round(r, 4).tolist()} m; make it shorter, "
        "or the surface larger"
    )
