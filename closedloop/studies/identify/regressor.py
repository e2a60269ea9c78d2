"""The inverse dynamics as a matrix times its parameters, τ = W(q, q̇, q̈) χ, and the base parameters among them.

Ten inertial parameters of each link (Pinocchio's `computeJointTorqueRegressor`): m, m c, and I about the origin of the
joint's frame, the links fixed to it included. Then by joint

    drive inertia      I_a q̈
    dry friction       F_c sign(q̇)
    viscous friction   F_v q̇
    offset             a constant, of the drive's current or of friction that is not the same both ways
    load friction      μ |τ| sign(q̇), of a gear that rubs in proportion to what it passes on; τ is the torque measured
    Stribeck           F_s sign(q̇) exp(−(q̇/v_s)²), the excess of static friction, at a given v_s

and of a pair of joints whose second motor turns with both of them (the wrist of a Stäubli TX: motor 6 turns by
N₆(q₅ + q₆)), in the rows of both,

    I_am q̈ of the other joint,   F_vm q̇ of the other,   F_cm sign(q̇₅ + q̇₆)

W has columns that are combinations of others whatever the motion is. A QR factorisation with pivoting of W at
random states tells how many are not; without pivoting, in the order of preference, it tells which ones: a column whose
diagonal entry of R vanishes is a combination of those before it, W₂ = W₁ β, and W χ = W₁ (χ₁ + β χ₂).

Sources: W. Khalil, E. Dombre, Modeling, identification and control of robots (2002) ch. 12; M. Gautier, A. Janot,
P.-O. Vandanjon, A new closed-loop output error method for parameter identification of robot dynamics, IEEE Trans.
Control Systems Technology 21 (2013) 428-444, which has the TX40 and its wrist; P. Hamon, M. Gautier, P. Garrec, Dynamic
identification of robots with a dry friction model depending on load and velocity, IROS 2010; M. Gautier, Numerical
calculation of the base inertial parameters of robots, J. Robotic Systems 8 (1991) 485-506.

Parameters are fitted by weighted least squares and instrumental variables, with intervals that allow for correlation.

    χ = (Zᵀ Ω W)⁻¹ Zᵀ Ω τ,   Ω = 1/σ_j² of each joint, Z = W for least squares

Instruments Z are the regressor of a motion whose noise is independent of that of W, so that noise of the positions does
not bias χ. The residuals of a real robot are no white noise: those of each joint are taken for an autoregression,

    u_t = φ_j u_{t−1} + e_t,   var e = s_j²,   cov χ = A⁻¹ Zᵀ Ω Γ Ω Z A⁻ᵀ,   A = Zᵀ Ω W,   Γ = cov u

where φ_j and s_j maximise the restricted likelihood, that of the part of τ that no χ explains: the residuals themselves
are less correlated than the noise, as χ follows whatever in it is slow. The e of the joints at one instant may be
correlated. As φ and s are known only so well, intervals are those of Student's t, with the degrees of freedom that the
variance of a variance has (Satterthwaite): `deviation` is made so wide that 1.96 of it are 95 %. σ_j² is the sum of
squares over the windows less the parameters that they tell (Horn), and not below the noise of the torque itself.
Sources: D. Harville, J. American Statistical Association 72 (1977) 320-338; D. Andrews, J. Monahan, Econometrica 60
(1992) 953-966, who whiten by autoregressions; F. Satterthwaite, Biometrics Bulletin 2 (1946) 110-114; S. Horn, R. Horn,
D. Duncan, J. American Statistical Association 70 (1975) 380-385; A. Janot, P.-O. Vandanjon, M. Gautier, A generic
instrumental variable approach for industrial robot identification, IEEE Trans. Control Systems Technology 22 (2014)
132-145.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, signal, stats

from closedloop.base.arrays import Array, Mask
from closedloop.base.errors import ModelError
from closedloop.studies.identify.motion import Motion
from robot_models import RobotModel
from robot_models.cached import cached_property

Columns = Callable[[Array, Array, Array], Array]

INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
FRICTION = ("viscous", "dry", "offset")
LOAD = "load"  # what else may be asked for
# Units of what a joint has, one that turns and one that slides.
UNITS = {
    "m": ("kg", "kg"), "mx": ("kg m", "kg m"), "my": ("kg m", "kg m"), "mz": ("kg m", "kg m"),
    **dict.fromkeys(INERTIAL[4:], ("kg m²", "kg m²")),
    "drive_inertia": ("kg m²", "kg"), "dry": ("N m", "N"), "viscous": ("N m s/rad", "N s/m"), "offset": ("N m", "N"),
    "stribeck": ("N m", "N"), LOAD: ("", ""),
    "coupled_inertia": ("kg m²", "kg"), "coupled_viscous": ("N m s/rad", "N s/m"), "coupled_dry": ("N m", "N"),
}  # fmt: skip
# What begins so dissipates or stores energy, and is not below zero.
BOUNDED = ("viscous_", "dry_", "load_", "drive_inertia_", "coupled_inertia_", "coupled_viscous_", "coupled_dry_")
# Below so many standard deviations of its noise the sign of a velocity is not relied on.
NOISY = 5.0
# A joint that moves by less than this, rad (m), before it turns round, does not slide: its parts give, as bristles do.
REST = 1e-3
# Windows that are put together at a time: what is not yet averaged stays small.
BLOCK = 2000


@dataclass(frozen=True)
class Terms:
    """What the torque of a joint is made of, beside the links' inertia."""

    friction: Sequence[str] = FRICTION
    drive_inertia: bool = True
    coupled: Sequence[tuple[str, str]] = ()  # the second motor of each pair turns with both joints
    stribeck_speed: float | Array | None = None  # v_s of the Stribeck term of each joint, rad/s; none if left out
    slow: float = 0.01  # below this share of a joint's largest speed the sign of its velocity is not relied on
    # columns of one's own: q, v, a (N, n) to the torque per unit of the parameter, (N, n)
    extra: Mapping[str, Columns] = field(default_factory=dict)


class Regressor:
    """W of a robot with given terms.

    `names`, tuple of str: of the parameters χ: KIND_JOINT, such as "Izz_J2" or "dry_J1", and those of `Terms.extra`.
    `kinds`, tuple of str: of those that each joint has.
    """

    def __init__(self, robot: RobotModel, terms: Terms) -> None:
        for name in terms.friction:
            if name not in (*FRICTION, LOAD):
                raise ModelError(f"friction is {name!r}: it must be of {', '.join((*FRICTION, LOAD))}")
        for name in {name for pair in terms.coupled for name in pair} - set(robot.joint_names):
            raise ModelError(f"coupled: {robot.name} has no joint {name!r}: it has {', '.join(robot.joint_names)}")
        for k, pair in enumerate(terms.coupled):
            if pair[0] == pair[1]:
                raise ModelError(f"coupled {', '.join(pair)}: must be two different joints")
            if set(pair) in map(set, terms.coupled[:k]):
                raise ModelError(f"coupled {', '.join(pair)}: the pair is there twice")
        if robot.springs.size:
            raise ModelError(f"{robot.name} has springs in its file, which are not identified: leave them out of it")
        self.robot, self.terms, self.n = robot, terms, robot.n
        self._model: Any = robot.pinocchio_model()
        self._model.armature = np.zeros(self.n)  # the drives have columns of their own
        self._data: Any = self._model.createData()
        self._pairs = [tuple(robot.joint_names.index(name) for name in pair) for pair in terms.coupled]
        by_joint = [*terms.friction, *(["stribeck"] if terms.stribeck_speed is not None else [])]
        self._kinds = [*by_joint, *(["drive_inertia"] if terms.drive_inertia else [])]
        self.kinds: tuple[str, ...] = (*self._kinds, *INERTIAL)
        joints = robot.joint_names
        self.names: tuple[str, ...] = (
            *(f"{kind}_{joint}" for joint in joints for kind in INERTIAL),
            *(f"{kind}_{joint}" for kind in self._kinds for joint in joints),
            *(f"coupled_{kind}_{a}_{b}" for a, b in terms.coupled for kind in ("inertia", "viscous", "dry")),
            *terms.extra,
        )

    def unit(self, name: str) -> str:
        """Return the unit of a parameter, "" of one of one's own."""
        kind = next((k for k in sorted(UNITS, key=len, reverse=True) if name.startswith(k + "_")), None)
        if kind is None or name in self.terms.extra:
            return ""
        slides = any(
            name == f"{kind}_{joint}" and kind_of == "prismatic"
            for joint, kind_of in zip(self.robot.joint_names, self.robot.joint_types, strict=True)
        )
        return UNITS[kind][slides]

    def rows(self, q: Array, v: Array, a: Array, torque: Array | None = None) -> Array:
        """Return W (N, n, p) at each row of q, v, a, and of the torque that friction may grow with, (N, n)."""
        import pinocchio as pin

        n, model, data = self.n, self._model, self._data
        W = np.zeros((len(q), n, len(self.names)))
        links = 10 * n
        call = pin.computeJointTorqueRegressor
        for k in range(len(q)):
            W[k, :, :links] = call(model, data, q[k], v[k], a[k])
        at, joints = links, np.arange(n)
        sign = np.sign(v)
        for kind in self._kinds:
            if kind == "stribeck" and self.terms.stribeck_speed is not None:
                column = sign * np.exp(-((v / self.terms.stribeck_speed) ** 2))
            else:
                load = np.zeros_like(v) if torque is None else sign * np.abs(torque)
                column = {"drive_inertia": a, "viscous": v, "dry": sign, "offset": np.ones_like(v), LOAD: load}[kind]
            W[:, joints, at + joints] = column
            at += n
        for i, j in self._pairs:
            W[:, i, at], W[:, j, at] = a[:, j], a[:, i]
            W[:, i, at + 1], W[:, j, at + 1] = v[:, j], v[:, i]
            W[:, i, at + 2] = W[:, j, at + 2] = np.sign(v[:, i] + v[:, j])
            at += 3
        for columns in self.terms.extra.values():
            W[:, :, at] = columns(q, v, a)
            at += 1
        return W

    def averaged(self, x: Motion) -> Array:
        """Return the mean of W over each window, (R, n, p)."""
        R, D = len(x.time), x.size
        W = np.empty((R, self.n, len(self.names)))
        block = max(1, BLOCK // D)
        for first in range(0, R, block):
            count = min(block, R - first)
            rows = slice(first * D, (first + count) * D)
            torque = np.repeat(x.torque[first : first + count], D, axis=0)
            each = self.rows(x.q[rows], x.v[rows], x.a[rows], torque)
            W[first : first + count] = each.reshape(count, D, self.n, -1).mean(1)
        return W

    def certain(self, x: Motion) -> NDArray[np.bool_]:
        """Return (R, n) whether the friction of a joint has one sign, that is sure, throughout a window.

        Near a change of sign the joint may stick, and the filtered velocity has the wrong sign for a moment. Both
        reduce the estimate of the dry friction and raise that of the viscous friction.
        """
        R, D = len(x.time), x.size
        good = np.ones((R, self.n), dtype=bool)
        if not {"dry", LOAD} & set(self.terms.friction):
            return good
        channels: list[tuple[Array, Array, float, tuple[int, ...]]]
        channels = [(x.q[:, j], x.v[:, j], x.noise[j], (j,)) for j in range(self.n)]
        for i, j in self._pairs:
            channels.append(
                (x.q[:, i] + x.q[:, j], x.v[:, i] + x.v[:, j], float(np.hypot(x.noise[i], x.noise[j])), (i, j))
            )
        for place, speed, noise, joints in channels:
            least = max(self.terms.slow * np.abs(speed).max(), NOISY * noise)
            windows = speed.reshape(R, D)
            one_way = (windows.min(axis=1) > least) | (windows.max(axis=1) < -least)
            # how far a joint moves between the two changes of its direction about each row
            stroke = np.concatenate([[0], np.cumsum(np.diff(np.sign(speed)) != 0.0)])
            ends = np.flatnonzero(np.diff(stroke, append=stroke[-1] + 1))
            starts = np.concatenate([[0], ends[:-1] + 1])
            one_way &= (np.abs(place[ends] - place[starts])[stroke] > REST).reshape(R, D).all(axis=1)
            near = one_way.copy()  # the filter smears what happens in a window into those beside it
            near[1:] &= one_way[:-1]
            near[:-1] &= one_way[1:]
            for joint in joints:
                good[:, joint] &= near
        return good


# Of columns of length one at random states, a diagonal entry of R: rounding gives 1e-14, true ones exceed 1e-5.
RANK = 1e-9
# A coefficient of a grouping below this is rounding.
ROUNDING = 1e-8


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The columns of W that are independent, and the contributions of the others to them."""

    kept: NDArray[np.int64]  # (b,): numbers of the columns that are independent
    grouping: Array  # (b, p): χ_base = grouping @ χ
    names: tuple[str, ...]  # "Izz_J2 + drive_inertia_J2 + 0.0506 m_J3", the parameters in each


def base_parameters(regressor: Regressor, seed: int = 0) -> BaseParameters:
    """Return the base parameters of a robot with given terms, whatever the log."""
    rng = np.random.default_rng(seed)
    n, p = regressor.n, len(regressor.names)
    count = max(60, 4 * p // n)
    q, v, a = rng.uniform(-np.pi, np.pi, (count, n)), rng.uniform(-2, 2, (count, n)), rng.uniform(-5, 5, (count, n))
    if regressor.terms.stribeck_speed is not None:  # whatever v_s is, its column is one of its own
        regressor = Regressor(regressor.robot, replace(regressor.terms, stribeck_speed=1.0))
    W = regressor.rows(q, v, a, rng.normal(size=(count, n))).reshape(-1, p)
    size = np.linalg.norm(W, axis=0)
    # The order in which columns are kept: friction, moments of links, then masses and drives. The inertia of a drive
    # comes last: where it acts as a link's moment of inertia does, it is part of that.
    drives = np.array([name.startswith("drive_inertia_") for name in regressor.names])
    rank_of = np.where(np.arange(p) < 10 * n, 1, np.where(drives, 2, 0))
    order = np.flatnonzero(size > RANK)
    order = order[np.argsort(rank_of[order], kind="stable")]
    R = linalg.qr(W[:, order] / size[order], mode="r")[0][: len(order)]
    rank = int((np.abs(np.diag(linalg.qr(R, mode="r", pivoting=True)[0])) > RANK).sum())
    diagonal = np.abs(np.diag(R))
    # The diagonal of R without pivoting can stay away from zero where a column nearly depends: the rank decides.
    first = np.sort(np.argsort(-diagonal, kind="stable")[:rank])
    kept = order[first]
    second = np.setdiff1d(np.arange(len(order)), first)
    grouping = np.zeros((len(kept), p))
    grouping[np.arange(len(kept)), kept] = 1.0
    if len(second):
        beta = linalg.lstsq(R[:, first], R[:, second])[0]
        grouping[:, order[second]] = beta * size[order[second]] / size[kept][:, None]
    grouping[np.abs(grouping) < ROUNDING] = 0.0
    by_number = np.argsort(kept)
    kept, grouping = kept[by_number], grouping[by_number]
    said = []
    for row, own in zip(grouping, kept, strict=True):
        terms = [regressor.names[own]]
        for k in np.flatnonzero(row):
            if k != own:
                factor = "" if abs(abs(row[k]) - 1.0) < ROUNDING else f"{abs(row[k]):.4g} "
                terms.append(f"{'-' if row[k] < 0 else '+'} {factor}{regressor.names[k]}")
        said.append(" ".join(terms))
    return BaseParameters(kept, grouping, tuple(said))


# Rounds of weighting: the weights follow from the residuals, and the residuals from the weights.
ROUNDS = 20
# A column whose part that no other column explains is below this share of it is not told from the others.
UNIQUE = 2e-3
# So many products, and the threads of the linear algebra library are worth their start.
LARGE = 100_000_000
# A correlation of neighbouring residuals outside these is not looked for: the log is too short to tell it.
CORRELATED = -0.9, 0.995
# Of log (s/σ)², either way.
SPREAD = 20.0
# Steps of differences of φ and log s², and the least information on them that is believed.
STEP, LEAST_TOLD = 1e-4, 0.1
# Degrees of freedom of an interval, at least.
FEWEST = 3.0
# Lags of the portmanteau test of whiteness.
WHITENESS_LAGS = 10
# No division by zero, nor by its square.
TINY = 1e-100


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters, and the residual of the torques."""

    value: Array  # (b,): the parameters; 0 for those that cannot be distinguished from others
    told: Mask  # (b,) bool: which parameters the rows distinguish
    # for each parameter that cannot be distinguished, the others with which it is confused; empty where its column is
    # zero
    alike: tuple[tuple[int, ...], ...]
    residual: Array  # (R, n): torque less W χ, N m, in all windows, used or not
    sigma: Array  # (n,): standard deviation of the noise in the windows used
    condition: float  # of the weighted W, columns of length one
    # (b,): what a torque that the model lacks, and that is as large as the residual, adds to a parameter at most
    lacking: Array
    noise: Callable[[], tuple[Array, Array]]  # what `covariance` and `correlation` are computed by when they are asked

    @cached_property
    def _noise(self) -> tuple[Array, Array]:
        return self.noise()

    @property
    def covariance(self) -> Array:
        """Covariance (b, b) of the parameters that are distinguished; the rows and columns of others are 0."""
        return self._noise[0]

    @property
    def correlation(self) -> Array:
        """Correlation φ (n,) of the noise of each joint from one window to the next."""
        return self._noise[1]

    @property
    def deviation(self) -> Array:
        """Standard deviation (b,) of the parameters; ∞ for those that are not distinguished."""
        return np.where(self.told, np.sqrt(np.maximum(np.diag(self.covariance), 0.0)), np.inf)


def fit(
    W: Array, torque: Array, used: Mask, Z: Array | None = None, told: Mask | None = None, least: Array | float = 0.0,
    seen: Array | None = None,
) -> Fit:  # fmt: skip
    """Fit the parameters of W (R, n, b) to torques (R, n), by least squares or with instruments Z (R, n, b).

    `used` (R, n): which torques count.
    `told` (b,): parameters to be found; the others are 0. What the rows tell apart, if not given.
    `least` (n,): standard deviation that the noise of the torques has at least, N m.
    `seen` (R, n, b): in place of W, what tells parameters apart.
    """
    n, b = W.shape[1:]
    Z = W if Z is None else Z
    count = used.sum(axis=0)
    size = np.where(count > 0, np.sqrt((torque**2 * used).sum(axis=0) / np.maximum(count, 1)), 1.0)
    products = [_product(Z[used[:, j], j], W[used[:, j], j]) for j in range(n)]  # Zᵀ W of each joint, (b, b)
    sides = [_product(Z[used[:, j], j], torque[used[:, j], j, None])[:, 0] for j in range(n)]
    alike: list[tuple[int, ...]] = [()] * b
    if told is None:
        seen = W if seen is None else seen
        weighted = [seen[:, j] * (used[:, j] / np.maximum(size[j], TINY))[:, None] for j in range(n)]
        told, alike = told_apart(np.sum([_product(x, x) for x in weighted], axis=0))
    X, S, at, value = W[:, :, told], Z[:, :, told], np.ix_(told, told), np.zeros(b)
    floor = np.maximum(least, 1e-12 * np.abs(torque).max()) + TINY
    sigma, residual = np.maximum(size, floor), torque
    scale = np.sqrt(np.einsum("tji,tj->i", X**2, used / sigma**2))  # columns of about one length
    for _ in range(ROUNDS):
        parts = np.array([x[at] / s**2 for x, s in zip(products, sigma, strict=True)]) / scale / scale[:, None]
        inverse = linalg.inv(parts.sum(axis=0))
        side = np.sum([x[told] / s**2 for x, s in zip(sides, sigma, strict=True)], axis=0) / scale
        value[told] = inverse @ side / scale
        residual = torque - X @ value[told]
        squares, free = (residual**2 * used).sum(axis=0), count - np.einsum("ab,jba->j", inverse, parts)
        last, sigma = sigma, np.maximum(np.sqrt(squares / np.maximum(free, 1.0)), floor)
        if np.all(np.abs(sigma - last) < 1e-6 * sigma):
            break
    # χ̂ − χ = Σ_t rows_tᵀ u_t, at most Σ_j |rows_j| |u_j| whatever u is (Cauchy and Schwarz)
    back = inverse / scale[:, None] / scale
    rows = np.einsum("kl,tjl->tjk", back, S * (used / last**2)[:, :, None], optimize=True)
    lacking = np.zeros(b)
    lacking[told] = np.sqrt(squares) @ np.sqrt(np.einsum("tjk,tjk->jk", rows, rows))

    def noise() -> tuple[Array, Array]:
        found, phi = _covariance(rows, X / scale, torque, residual, used, sigma)
        covariance = np.zeros((b, b))
        covariance[at] = found
        return covariance, phi

    square = np.sum([_product(x, x) for x in (X[used[:, j], j] / sigma[j] for j in range(n))], axis=0)
    size = np.sqrt(np.diag(square))
    condition = float(np.sqrt(np.linalg.cond(square / size / size[:, None]))) if told.any() else 1.0
    return Fit(value, told, tuple(alike), residual, sigma, condition, lacking, noise)


def _covariance(rows: Array, X: Array, torque: Array, residual: Array, used: Mask, sigma: Array) -> tuple[Array, Array]:
    """Return the covariance (b, b) of Σ_t rows_tᵀ u_t, as wide as Student's intervals are, and φ (n,) of the noise u.

    `rows` are (R, n, b); of the others see `_autoregression`.
    """
    n = len(sigma)
    phi, step, unsure = _autoregression(X, torque, used, sigma)
    innovation = np.where(used[1:] & used[:-1], residual[1:] - phi * residual[:-1], 0.0)
    gram = innovation.T @ innovation
    length = np.maximum(np.sqrt(np.diag(gram)), TINY)
    together = np.where(np.eye(n) > 0.0, 1.0, gram / length / length[:, None]) * step * step[:, None]  # cov e

    def reach(phi: Array) -> list[Array]:
        """Return what an innovation adds, by all windows after it."""
        return [np.asarray(signal.lfilter([1.0], [1.0, -phi[j]], rows[:, j][::-1], axis=0)[::-1]) for j in range(n)]

    def variances(phi: Array) -> Array:
        """Return the parts (n, n, b) of the variances, by pairs of joints."""
        g = np.stack(reach(phi), axis=1)
        before = phi * phi[:, None] / (1.0 - phi * phi[:, None])  # the noise was there before the log
        inside = np.einsum("tia,tja->ija", g, g) + before[:, :, None] * g[0][:, None] * g[0]
        return np.asarray(together[:, :, None] * inside)

    parts = variances(phi)
    known = parts.sum(axis=(0, 1))
    slopes = []  # of the variances by φ and by log s² of each joint
    for j in range(n):
        moved = phi + STEP * (np.arange(n) == j) * np.where(phi > 0.0, -1.0, 1.0)
        slopes.append((variances(moved).sum(axis=(0, 1)) - known) / (moved[j] - phi[j]))
    slopes += list(parts.sum(axis=0))
    spread = np.einsum("ia,ij,ja->a", slopes, unsure, slopes)
    freedom = np.maximum(2.0 * known**2 / np.maximum(spread, TINY), FEWEST)
    wider = stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975)
    found = np.zeros((rows.shape[2],) * 2)
    g = reach(phi)
    for i in range(n):
        for j in range(n):
            before = phi[i] * phi[j] / (1.0 - phi[i] * phi[j])
            found += together[i, j] * (_product(g[i], g[j]) + before * np.outer(g[i][0], g[j][0]))
    return found * wider * wider[:, None], phi


def _autoregression(X: Array, torque: Array, used: Mask, sigma: Array) -> tuple[Array, Array, Array]:
    """Return φ and s (n,) of the noise of each joint, which maximise the restricted likelihood of torques (R, n), and
    the covariance (2n, 2n) of φ and log s².

    `X` (R, n, b): columns that are told apart; of about one length, each row over `sigma`.
    `sigma` (n,): standard deviation of the noise, where the search begins.
    """
    n, b = X.shape[1:]
    both = used[1:] & used[:-1]
    first = used.copy()  # windows without a used one before: of them the noise has the variance s²/(1 − φ²)
    first[1:] &= ~both
    count, firsts = used.sum(axis=0), first.sum(axis=0)
    if count.sum() <= b:
        return np.zeros(n), sigma, np.eye(2 * n) / LEAST_TOLD
    # of [X τ]/σ: of windows with themselves, those before, of those, of firsts
    moments = np.zeros((n, 4, b + 1, b + 1))
    for j in range(n):
        rows = np.column_stack([X[:, j], torque[:, j]]) / sigma[j]
        now, before, alone = rows[1:][both[:, j]], rows[:-1][both[:, j]], rows[first[:, j]]
        cross, of_first = _product(now, before), _product(alone, alone)
        moments[j] = _product(now, now) + of_first, cross + cross.T, _product(before, before), of_first

    def unlikely(z: Array) -> tuple[float, Array]:
        """Return −2 log of the likelihood of φ and log (s/σ)², and its derivative."""
        phi, log = z[:n], z[n:]
        weights, square = np.exp(-log), phi * phi
        powers = np.stack([np.ones(n), -phi, square, -square], axis=1)
        A = np.einsum("j,jk,jkab->ab", weights, powers, moments)
        C = linalg.inv(A[:b, :b])
        left = np.append(-C @ A[:b, b], 1.0)
        squares = np.einsum("a,jkab,b->jk", left, moments, left) + np.einsum("ab,jkab->jk", C, moments[:, :, :b, :b])
        slope = 2.0 * phi * (squares[:, 2] - squares[:, 3]) - squares[:, 1]
        rise = np.concatenate([
            weights * slope + 2.0 * firsts * phi / (1.0 - square), count - weights * (powers * squares).sum(axis=1)
        ])  # fmt: skip
        value = count @ log - firsts @ np.log(1.0 - square) + np.linalg.slogdet(A[:b, :b])[1] + left @ A @ left
        return float(value), rise

    bounds = [CORRELATED] * n + [(-SPREAD, SPREAD)] * n
    best = optimize.minimize(unlikely, np.zeros(2 * n), jac=True, method="L-BFGS-B", bounds=bounds).x
    bend = np.array([(unlikely(best + e)[1] - unlikely(best - e)[1]) / (2.0 * STEP) for e in STEP * np.eye(2 * n)])
    values, vectors = linalg.eigh(0.25 * (bend + bend.T))  # of the information
    return best[:n], sigma * np.exp(0.5 * best[n:]), (vectors / np.maximum(values, LEAST_TOLD)) @ vectors.T


def told_apart(square: Array) -> tuple[Mask, list[tuple[int, ...]]]:
    """Return which columns of X are told from all others, and for each that is not, which it looks like.

    A column is not told if it is zero, or if the part of it that the others do not explain is below `UNIQUE` of it. Of
    columns that look alike one is taken out after the other, the least told first, and the rest is asked again.

    `square` (b, b): XᵀX.
    """
    b = len(square)
    size = np.sqrt(np.maximum(np.diag(square), 0.0))
    told = size > 1e-9 * max(float(size.max()), TINY)
    alike: list[tuple[int, ...]] = [()] * b
    length = np.where(told, size, 1.0)
    gram = square / length / length[:, None]
    while told.any():
        at = np.flatnonzero(told)
        # One over the diagonal of the inverse is the squared part of a column that the others do not explain.
        values, vectors = linalg.eigh(gram[np.ix_(at, at)])
        part = 1.0 / ((vectors**2) / np.maximum(values, 1e-18)).sum(axis=1)
        least = int(part.argmin())
        if part[least] > UNIQUE**2:
            break
        mix = vectors[:, 0] / (np.abs(vectors[:, 0]).max() or 1.0)
        alike[at[least]] = tuple(int(k) for k in at[np.abs(mix) > 0.1] if k != at[least])
        told[at[least]] = False
    return told, alike


def _product(x: Array, y: Array) -> Array:
    """Return xᵀy of x (R, b) and y (R, c), (b, c); a small one without the threads of the linear algebra library."""
    if x.size * y.shape[1] > LARGE:
        return np.asarray(x.T @ y)
    return np.einsum("ti,tk->ik", x, y)


def whiteness(residual: Array, used: Mask) -> Array:
    """Return the probability that white residuals (R, n) are as correlated as these, (n,) (Ljung and Box)."""
    statistic = np.zeros(residual.shape[1])
    for lag in range(1, WHITENESS_LAGS + 1):
        both = used[lag:] & used[:-lag]
        x, y = residual[lag:] * both, residual[:-lag] * both
        scale = (x**2).sum(axis=0) * (y**2).sum(axis=0)
        statistic += both.sum(axis=0) * (x * y).sum(axis=0) ** 2 / np.where(scale > 0.0, scale, 1.0)
    return np.asarray(stats.chi2.sf(statistic, WHITENESS_LAGS))
