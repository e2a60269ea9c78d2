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
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.studies.identify.motion import Motion
from robot_models import RobotModel

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

        Near a change the joint may stick, and its filtered velocity has the wrong sign: both bias the friction.
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
    order = _preferred(regressor, np.flatnonzero(size > RANK))
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


def _preferred(regressor: Regressor, there: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the columns in the order to be kept: friction, links' moments, masses, drives, which act like moments."""
    inertial = 10 * regressor.n
    names = regressor.names

    def rank(k: int) -> tuple[int, int]:
        if k >= inertial:
            return (2, k) if names[k].startswith("drive_inertia_") else (0, k)
        return (1, k)

    return np.array(sorted(map(int, there), key=rank))
