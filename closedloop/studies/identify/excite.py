"""A motion that identifies parameters: Fourier series of all joints within their limits, best for what is asked.

    q_j(t) = q_j0 + Σ_l a_jl sin(lωt)/(lω) − b_jl cos(lωt)/(lω),    ω = 2π/T,    from rest to rest

With torques of known noise the covariance of base parameters follows from the regressor alone, so that a motion can be
judged before it is made. What becomes least is the mean logarithm of the variances of the parameters asked for, or of
all of them. Source: J. Swevers, C. Ganseman, D. Tükel, J. De Schutter, H. Van Brussel, Optimal robot excitation and
identification, IEEE Trans. Robotics and Automation 13 (1997) 730-740.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, needs
from closedloop.studies.identify.regressor import FRICTION, LOAD, BaseParameters, Regressor, Terms, base_parameters

if TYPE_CHECKING:
    from os import PathLike

    import pandas

    from robot_models import RobotModel

# Instants at which a motion is judged, and of the fine table that its limits are kept on.
JUDGED, FINE = 120, 600
# Random motions that are drawn, and steps that improve the best of them.
DRAWN, STEPS = 60, 25
# Half of the range of a joint without limits, rad (m); a speed where none is given, rad/s (m/s).
RANGE, SPEED = np.pi / 2.0, 1.0
# Time in which a joint may reach its top speed, s, if no acceleration is given.
RISE = 0.25
# Noise of torques where none is given, over the effort limit, or N m (N) without one.
NOISE, NO_EFFORT = 0.01, 1.0
# An information matrix below this, relative, does not tell a parameter.
UNTOLD = 1e-12


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion, and how accurately a log of it would identify the parameters.

    `time` (N,): s.
    `q`, `v`, `a` (N, n): positions, rad (m), velocities and accelerations; at rest at both ends.
    `names`, `units`: of the base parameters.
    `half` (b,): expected half of the 95 % interval of each; infinite if the motion does not identify it.
    `target`: parameters for which the motion is designed.
    `drawn` (b,): the same as `half`, for the median of random motions within the same limits.
    `condition`: of the regressor with columns of length one.
    """

    robot: RobotModel
    time: Array
    q: Array
    v: Array
    a: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    half: Array
    target: tuple[str, ...]
    drawn: Array
    condition: float

    def to_pandas(self) -> pandas.DataFrame:
        """Return the motion as a table: time, and q, v, a of each joint."""
        needs("pandas")
        import pandas

        columns = {"time": self.time}
        for kind, x in (("q", self.q), ("v", self.v), ("a", self.a)):
            columns |= {f"{kind}_{name}": x[:, j] for j, name in enumerate(self.robot.joint_names)}
        return pandas.DataFrame(columns)

    def lines(self) -> list[str]:
        """Return what the motion identifies, in words."""
        told = [
            f"{self.robot.name}: {self.time[-1]:.4g} s, from rest to rest; condition {self.condition:.3g}",
            "expected half of the 95 % interval (of the median random motion within the same limits)",
        ]
        for name, unit, half, drawn in zip(self.names, self.units, self.half, self.drawn, strict=True):
            mark = "*" if name in self.target else " "
            value = f"{half:.3g} {unit}" if np.isfinite(half) else "not identified"
            told.append(f"{mark} {name:24} {value:>20} ({drawn:.3g})")
        return told


@arguments_checked()
def excite(
    robot: RobotModel | str | PathLike[str], target: Sequence[str] = (), *, duration: float = 10.0, harmonics: int = 5,
    rate: float = 100.0, noise: ArrayLike | None = None, acceleration: ArrayLike | None = None, share: float = 0.9,
    friction: Sequence[str] = FRICTION, drive_inertia: bool = True, seed: int = 0,
) -> Excitation:  # fmt: skip
    """Design a motion from whose log parameters of a robot can be identified best.

    Parameters
    ----------
    robot : RobotModel, or what `robot_models.load` takes
    target : sequence of str
        Base parameters, such as "dry_J1"; all of them if empty.
    duration : float
        s, one period.
    harmonics : int
        Number of harmonics of the series, at least 3.
    rate : float
        Rows per second of the log that is expected, and of the motion returned, Hz.
    noise : float or (n,), optional
        Standard deviation of the white noise of the torques in a row, N m (N); 1 % of the effort limit if left out.
    acceleration : float or (n,), optional
        Largest acceleration, rad/s²; if left out, that which reaches the top speed in 0.25 s.
    share : float
        Share of the limits of position and speed that the motion uses.
    friction, drive_inertia
        Friction and drive inertia of each joint, as in `closedloop.identify`.
    seed : int
        Seed of the random motions with which the search begins.

    Raises
    ------
    ModelError
        If an argument is wrong, the robot has loops, or a target is no base parameter.
    """
    import robot_models
    from robot_models import RobotModel

    model = robot if isinstance(robot, RobotModel) else robot_models.load(robot)
    if model.loops:
        raise ModelError(f"{model.name} has closed loops: only a tree can be excited")
    if set(model.joint_types) & {"free", "ball"}:
        raise ModelError(f"{model.name} has free or ball joints: they have no drive that could excite them")
    for name, value, low, high in (
        ("duration", duration, 0.1, 1e4), ("harmonics", harmonics, 3, 50), ("rate", rate, 1.0, 1e5),
        ("share", share, 0.01, 1.0),
    ):  # fmt: skip
        if not low <= value <= high:
            raise ModelError(f"{name} is {value!r}: it must be from {low:g} to {high:g}")
    if LOAD in friction:
        raise ModelError(f"friction is {LOAD!r}: it depends on the torque, not on the motion; leave it out")
    regressor = Regressor(model, Terms(tuple(friction), drive_inertia))
    base = base_parameters(regressor)
    names = tuple(regressor.names[k] for k in base.kept)
    asked = _asked(target, names, base, regressor)
    series = _Series(model, duration, harmonics, acceleration, share)
    effort = np.asarray(model.effort_limit, dtype=np.float64)
    usual = np.where(np.isfinite(effort) & (effort > 0.0), NOISE * effort, NO_EFFORT)
    sigma = usual if noise is None else _positive("noise", noise, model.n)
    rows_per_row = duration * rate / JUDGED

    def variances(coefficients: Array) -> tuple[Array, Array]:
        q, v, a = series.motion(coefficients, JUDGED)
        W = regressor.rows(q, v, a)[:, :, base.kept] / sigma[:, None]
        slow = np.abs(v) <= regressor.terms.slow * np.abs(v).max(axis=0)
        W[slow] = 0.0  # these torques do not count, see `Regressor.certain`
        flat = W.reshape(-1, len(names)) * np.sqrt(rows_per_row)
        # The variance by least squares of rows with noise 1, of each parameter; infinite where none is told.
        size = np.linalg.norm(flat, axis=0)
        there = size > 0.0
        values, vectors = np.linalg.eigh((flat[:, there] / size[there]).T @ (flat[:, there] / size[there]))
        told = values > UNTOLD * values.max(initial=0.0)
        found = np.full(len(size), np.inf)
        inside = (vectors[:, told] ** 2 / values[told]).sum(axis=1)
        inside[(vectors[:, ~told] ** 2).sum(axis=1) > 1e-6] = np.inf
        found[there] = inside / size[there] ** 2
        return found, flat

    def cost(coefficients: Array) -> float:
        found = variances(coefficients)[0]
        return float(np.log(np.minimum(found[asked], 1e30)).mean())

    rng = np.random.default_rng(seed)
    draws = rng.normal(size=(DRAWN, series.size))
    costs = [cost(draw) for draw in draws]
    best = minimize(cost, draws[int(np.argmin(costs))], method="L-BFGS-B", options={"maxiter": STEPS}).x
    random = np.median([np.sqrt(variances(draw)[0]) for draw in draws[:: max(1, DRAWN // 20)]], axis=0)
    found, flat = variances(best)
    N = max(round(duration * rate), JUDGED) + 1
    q, v, a = series.motion(best, N)
    size = np.linalg.norm(flat, axis=0)
    scaled = flat[:, size > 0.0] / size[size > 0.0]
    return Excitation(
        model, np.linspace(0.0, duration, N), q, v, a, names, tuple(regressor.unit(name) for name in names),
        1.96 * np.sqrt(found), tuple(names[k] for k in asked), 1.96 * random, float(np.linalg.cond(scaled)),
    )  # fmt: skip


class _Series:
    """Fourier series of all joints, scaled to the limits: whatever the coefficients are, the motion is within them."""

    def __init__(
        self, robot: RobotModel, duration: float, harmonics: int, acceleration: ArrayLike | None, share: float
    ) -> None:
        n = robot.n
        bounded = np.isfinite(robot.position_lower) & np.isfinite(robot.position_upper)
        self.centre = np.where(bounded, 0.5 * (robot.position_lower + robot.position_upper), 0.0)
        ranges = np.where(bounded, 0.5 * (robot.position_upper - robot.position_lower), RANGE)
        speeds = np.asarray(robot.velocity_limit, dtype=np.float64)
        speeds = np.where(np.isfinite(speeds) & (speeds > 0.0), speeds, SPEED)
        given = speeds / RISE if acceleration is None else _positive("acceleration", acceleration, n)
        self.limits = share * ranges, share * speeds, given
        self.n, self.size = n, 2 * n * harmonics
        self.order = np.arange(1, harmonics + 1)
        self.w = 2.0 * np.pi / duration * self.order
        self.duration = duration
        self._bases: dict[int, tuple[Array, Array]] = {}

    def motion(self, coefficients: Array, count: int) -> tuple[Array, Array, Array]:
        """Return q, v, a (count, n)."""
        a, b = coefficients.reshape(2, self.n, len(self.w))
        a = a - a.mean(axis=1, keepdims=True)  # at rest at both ends,
        b = b - (b @ self.order)[:, None] * self.order / (self.order @ self.order)  # and not accelerated
        fine = self._of(a, b, FINE)
        scale = np.min(
            [limit / np.maximum(np.abs(x).max(axis=0), 1e-12) for x, limit in zip(fine, self.limits, strict=True)],
            axis=0,
        )
        q, v, acceleration = self._of(a, b, count)
        return self.centre + scale * q, scale * v, scale * acceleration

    def _of(self, a: Array, b: Array, count: int) -> tuple[Array, Array, Array]:
        if count not in self._bases:
            turn = np.outer(np.linspace(0.0, self.duration, count), self.w)
            self._bases[count] = np.sin(turn), np.cos(turn)
        sine, cosine = self._bases[count]
        q = sine @ (a / self.w).T - cosine @ (b / self.w).T
        return q, cosine @ a.T + sine @ b.T, cosine @ (b * self.w).T - sine @ (a * self.w).T


def _asked(target: Sequence[str], names: Sequence[str], base: BaseParameters, regressor: Regressor) -> list[int]:
    if not target:
        return list(range(len(names)))
    for name in target:
        if name in names:
            continue
        within = [text for text in base.names if name in text.split()]
        if within:
            raise ModelError(f"{name} acts only together with others, whatever the motion: ask for {within[0]!r}")
        if name in regressor.names:
            raise ModelError(f"{name}: no torque depends on it")
        raise ModelError(f"{name!r} is no parameter of {regressor.robot.name}: they are {', '.join(names)}")
    return [names.index(name) for name in target]


def _positive(name: str, value: ArrayLike, n: int) -> Array:
    """Return an argument for each joint, (n,)."""
    given = np.asarray(value, dtype=np.float64)
    if given.ndim > 1 or given.size not in (1, n) or not np.all(given > 0.0) or not np.isfinite(given).all():
        raise ModelError(f"{name} is {value!r}: must be positive, one number or {n}")
    return np.broadcast_to(given, n).astype(np.float64)
