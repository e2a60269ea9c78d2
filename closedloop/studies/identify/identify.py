"""`identify`: a log in, parameters with intervals and a judgement of the model out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, plain
from closedloop.base.errors import ModelError
from closedloop.record.run import Run
from closedloop.studies.identify import regressor as equations
from closedloop.studies.identify.motion import Log, Motion, checked, joined, motion, usual_cutoff
from closedloop.studies.identify.read import log_of_run

if TYPE_CHECKING:
    from os import PathLike

    from robot_models import RobotModel

# The probability below which the residual is not white.
WHITENESS_LEVEL = 1e-3
# Of a Stribeck term that is to be fitted, rad/s (m/s).
STRIBECK_SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
# Windows in which a joint has to move for its torques to count at all: fewer tell its noise no more than its friction.
FEWEST = 20
# Parameters of a joint that act on its own torque alone.
OWN = (*equations.FRICTION, equations.LOAD, "stribeck", "drive_inertia")
# The Stribeck term of a log, per unit of its coefficient, is below this at most: it was not excited.
LEAST_STRIBECK = 0.1
# Pieces of a log, a share of each of which is held out.
PIECES = 10


class Estimate(NamedTuple):
    """One base parameter.

    `name`: its first parameter; `grouping` has all parameters that it combines.
    `value`, `low`, `high`: the value and its interval; NaN, −∞ and ∞ if it is not identifiable from the log.
    `why`: why it is not identifiable from this log, and which motion would identify it; "" if it is identifiable.
    """

    name: str
    value: float
    low: float
    high: float
    unit: str
    grouping: str
    why: str

    def as_dict(self) -> dict[str, Any]:
        """Return it without its name."""
        found = {"value": self.value, "interval": [self.low, self.high], "unit": self.unit, "grouping": self.grouping}
        return found | ({"not_identifiable": self.why} if self.why else {})

    def line(self, width: int) -> str:
        """Return name, value and interval in words, the name in so many letters."""
        made = f"   = {self.grouping}" if self.grouping != self.name else ""
        return f"  {self.name:{width}}{self.value:12.5g}  {self.low:.5g} to {self.high:.5g} {self.unit}{made}"


def unknown(name: str, unit: str, why: str, low: float = -np.inf, grouping: str = "") -> Estimate:
    """Return a parameter that the log does not tell."""
    return Estimate(name, np.nan, low, np.inf, unit, grouping or name, why)


def known(name: str, value: float, deviation: float, unit: str, z: float, grouping: str = "") -> Estimate:
    """Return a parameter with its interval."""
    return Estimate(name, value, value - z * deviation, value + z * deviation, unit, grouping or name, "")


@dataclass(frozen=True, eq=False)
class Identification:
    """Parameters of a robot that a log identifies.

    `regressor`, `base`, `solution`, `motion`: the parts of the computation.
    `measured`, `predicted` (R, n): torques of all windows, N m, at `time` (R,), s; prediction by the parameters of the
        whole log.
    `used` (R, n): torques that count: where friction has one sure sign.
    `tested` (R,): windows that were held out when `held_out` was computed; none if another log was used.
    `held_out` (n,): RMS of the error over RMS of the torque in the windows that were held out, where torques count. NaN
        without such windows.
    `noise_bias` (b,): least squares minus instrumental variables; NaN with "ls".
    `confidence`: of the intervals, 0.95.
    """

    robot: RobotModel
    regressor: equations.Regressor
    base: equations.BaseParameters
    solution: equations.Fit
    motion: Motion
    used: NDArray[np.bool_]
    tested: NDArray[np.bool_]
    estimates: tuple[Estimate, ...]
    held_out: Array
    noise_bias: Array
    method: str
    confidence: float

    @property
    def time(self) -> Array:
        """Middle of each window, s, (R,)."""
        return self.motion.time

    @property
    def measured(self) -> Array:
        """Torque of each window, N m, (R, n)."""
        return self.motion.torque

    @property
    def predicted(self) -> Array:
        """Torque of each window as the identified parameters give it, N m, (R, n)."""
        return self.motion.torque - self.solution.residual

    def __getitem__(self, name: str) -> Estimate:
        found = next((entry for entry in self.estimates if entry.name == name), None)
        if found is not None:
            return found
        if name in self.regressor.names:
            within = next((e for e in self.estimates if name in e.grouping.split()), None)
            why = f"it acts only together with others: {within.grouping}" if within else "no torque depends on it"
            return unknown(name, self.regressor.unit(name), why)
        raise KeyError(f"{name!r}: the parameters are {', '.join(self.regressor.names)}")

    def joints(self, kind: str) -> tuple[Estimate, ...]:
        """Return the estimates of a kind, "viscous", "dry", "offset", "drive_inertia" or "Izz", joint by joint.

        Raises ModelError if the joints have no such parameters.
        """
        if kind not in self.regressor.kinds:
            raise ModelError(f"joints({kind!r}): a kind of parameter must be one of {', '.join(self.regressor.kinds)}")
        return tuple(self[f"{kind}_{joint}"] for joint in self.robot.joint_names)

    @property
    def not_identifiable(self) -> tuple[Estimate, ...]:
        """The base parameters that are not identifiable from this log, each with the reason."""
        return tuple(entry for entry in self.estimates if entry.why)

    @property
    def not_physical(self) -> tuple[Estimate, ...]:
        """What dissipates or stores energy, and is surely below zero.

        Its whole interval is, and a torque that the model lacks, if it is as large as the residual, does not make it
        so. Filters leave such a torque, too, where there is no noise.
        """
        told = zip(self.estimates, self.solution.lacking, strict=True)
        bounded = ((e, lacking) for e, lacking in told if e.name.startswith(equations.BOUNDED) and e.name == e.grouping)
        return tuple(e for e, lacking in bounded if max(e.high, e.value + lacking) < 0.0)

    @property
    def relative_error(self) -> Array:
        """RMS of the residual over RMS of the torque, (n,), where torques count."""
        return _relative(self.solution.residual, self.measured, self.used)

    @property
    def whiteness(self) -> Array:
        """Probability, (n,), that a white residual is as correlated as this one (Ljung and Box)."""
        return equations.whiteness(self.solution.residual, self.used)

    @property
    def above_noise(self) -> Array:
        """Standard deviation of the residual over that of the torque's own white noise, (n,)."""
        return self.solution.sigma / np.maximum(self.motion.torque_noise, 1e-300)

    @property
    def misses(self) -> tuple[str, ...]:
        """The joints that the model does not explain fully: their residual is not white noise."""
        bad = self.whiteness < WHITENESS_LEVEL
        return tuple(name for name, wrong in zip(self.robot.joint_names, bad, strict=True) if wrong)

    def summary(self) -> dict[str, Any]:
        """Return the result as a dictionary of numbers, lists and texts; unknown values are None."""
        joints = {
            name: {
                "relative_error": self.relative_error[j],
                "held_out_error": self.held_out[j],
                "residual": self.solution.sigma[j],
                "residual_over_noise": self.above_noise[j],
                "whiteness": self.whiteness[j],
                "used_share": self.used[:, j].mean(),
            }
            for j, name in enumerate(self.robot.joint_names)
        }
        return plain({
            "robot": self.robot.name, "method": self.method, "confidence": self.confidence,
            "cutoff_hz": self.motion.cutoff, "windows": len(self.time), "condition": self.solution.condition,
            "correlation": self.solution.correlation, "joints": joints,
            "parameters": {e.name: e.as_dict() for e in self.estimates}, "model_misses_something": self.misses,
            "not_physical": [e.name for e in self.not_physical],
        })  # fmt: skip


@arguments_checked()
def identify(
    log: Log | Run | Sequence[Log | Run], robot: RobotModel | str | PathLike[str], *,
    friction: Sequence[str] = equations.FRICTION, drive_inertia: bool = True, coupled: Sequence[tuple[str, str]] = (),
    stribeck_speed: float | Sequence[float] | str | None = None, extra: Mapping[str, equations.Columns] | None = None,
    slow: float = 0.01, cutoff: float | None = None, held_out: float = 0.25, test: Log | None = None,
    method: str = "ls", confidence: float = 0.95,
) -> Identification:  # fmt: skip
    """Identify the base inertial parameters, friction and drive inertia of a robot from a log.

    Parameters
    ----------
    log : Log or Run, or several
        Time, positions and torques, see `closedloop.studies.identify.motion.Log` and `read_log`. The force on the tip
        of a run is added to its torques.
    robot : RobotModel, or what `robot_models.load` takes
        Its kinematics are used; the inertias in its file are not.
    friction : of "viscous", "dry", "offset", "load"
        What each joint has, see `closedloop.studies.identify.regressor`; "load" is `transmission.load_friction`, from a
        log in which the robot touches nothing.
    drive_inertia : bool
        Whether each joint has an inertia of its drive.
    coupled : pairs of joint names
        Two joints each: the motor of the second turns with both.
    stribeck_speed : float, (n,) or "fit", optional
        v_s, rad/s, of a Stribeck term in each joint; "fit" takes the one of `STRIBECK_SPEEDS` with the smallest
        residual.
    extra : mapping of names to functions, optional
        Columns of your own. Each function takes q, v, a (N, n) and returns the torque per unit of the parameter (N, n).
    slow : float
        Rows in which a joint is slower than this share of its largest speed are left out for that joint: the sign of
        its dry friction is not certain there.
    cutoff : float, optional
        Of the zero-phase low-pass, Hz; ten times the bandwidth of the motion if left out.
    held_out : float
        Share of the log on which parameters identified from the rest are tested: the end of each of ten equal pieces.
        The parameters returned are identified from the whole log.
    test : Log, optional
        Another log, used for this test instead.
    method : "ls" or "iv"
        Least squares, or instrumental variables: the regressor of every other row of the positions, with that of the
        rows between them as instruments.
    confidence : float
        Of the intervals.

    Raises
    ------
    LogError
        If the log is at fault, see `closedloop.studies.identify.motion.checked`.
    ModelError
        If an argument is, or the robot cannot be loaded.
    """
    import robot_models
    from robot_models import RobotModel

    model = robot if isinstance(robot, RobotModel) else robot_models.load(robot)
    _check(model, method, held_out, confidence, slow)
    several = [log] if isinstance(log, Log | Run) else log
    logs = [checked(log_of_run(one) if isinstance(one, Run) else one, model) for one in several]
    if not logs:
        raise ModelError("log = []: there is no log, give one or more")
    cutoff = max(usual_cutoff(one) for one in logs) if cutoff is None else cutoff
    x = joined([motion(one, cutoff) for one in logs])
    speeds = (
        None if stribeck_speed is None or isinstance(stribeck_speed, str) else np.asarray(stribeck_speed, dtype=float)
    )
    terms = equations.Terms(tuple(friction), drive_inertia, tuple(coupled), speeds, slow, dict(extra or {}))
    if isinstance(stribeck_speed, str):
        terms = replace(terms, stribeck_speed=_fitted_speeds(model, terms, x))
    regressor = equations.Regressor(model, terms)
    base = equations.base_parameters(regressor)
    used = _counted(regressor, x)
    W, seen = _columns(regressor, base, x, used)
    found = equations.fit(W, x.torque, used, least=x.torque_noise, seen=seen)
    bias = np.full(len(base.kept), np.nan)
    if method == "iv":
        halves = [joined([motion(one, cutoff, k) for one in logs]) for k in (0, 1)]
        even, odd = (regressor.averaged(half)[:, :, base.kept] for half in halves)
        better = equations.fit(even, x.torque, used, odd, found.told, x.torque_noise)
        bias = found.value - better.value
        found = replace(better, alike=found.alike)
    z = float(stats.norm.ppf(0.5 + 0.5 * confidence))
    if test is None:
        tested = _pieces(len(x.time), held_out)
        kept = ~tested
        fitted = (W[kept], x.torque[kept], used[kept])
        part = equations.fit(*fitted, least=x.torque_noise, seen=seen[kept]) if tested.any() else found
        judged, V, sure = x.torque[tested], W[tested], used[tested]
    else:
        y = motion(checked(test, model), cutoff)
        tested, part = np.zeros(len(x.time), dtype=bool), found
        judged, V, sure = y.torque, regressor.averaged(y)[:, :, base.kept], _counted(regressor, y)
    estimates = []
    for k, (value, deviation) in enumerate(zip(found.value.tolist(), found.deviation.tolist(), strict=True)):
        name, grouping = regressor.names[base.kept[k]], base.names[k]
        if found.told[k]:
            estimates.append(known(name, value, deviation, regressor.unit(name), z, grouping))
        else:
            why = _reason(k, found, base, regressor, used)
            estimates.append(unknown(name, regressor.unit(name), why, grouping=grouping))
    return Identification(
        model, regressor, base, found, x, used, tested,
        tuple(estimates),
        _relative(judged - V @ part.value, judged, sure), bias, method, confidence,
    )  # fmt: skip


def _fitted_speeds(robot: RobotModel, terms: equations.Terms, x: Motion) -> Array:
    """Return v_s of each joint, (n,): that of `STRIBECK_SPEEDS` that leaves least of its torque, all joints alike."""
    left = []
    highest = np.abs(x.v).max(axis=0)
    for speed in STRIBECK_SPEEDS:
        regressor = equations.Regressor(robot, replace(terms, stribeck_speed=np.full(robot.n, speed)))
        base = equations.base_parameters(regressor)
        used = _counted(regressor, x)
        W, seen = _columns(regressor, base, x, used)
        sigma = equations.fit(W, x.torque, used, least=x.torque_noise, seen=seen).sigma
        left.append(np.where(speed < 0.25 * highest, sigma, np.inf))  # more of the curve is the viscous term's
    return np.asarray(np.array(STRIBECK_SPEEDS)[np.argmin(left, axis=0)])


def _check(robot: RobotModel, method: str, held_out: float, confidence: float, slow: float) -> None:
    if robot.loops:
        raise ModelError(f"{robot.name} has closed loops: only a tree can be identified")
    if method not in ("ls", "iv"):
        raise ModelError(f"method is {method!r}: it must be 'ls' or 'iv'")
    if not 0.0 <= held_out <= 0.5:
        raise ModelError(f"held_out is {held_out!r}: it must be a share of the log from 0 to 0.5")
    if not 0.5 <= confidence < 1.0:
        raise ModelError(f"confidence is {confidence!r}: it must be from 0.5 to below 1")
    if not 0.0 <= slow < 1.0:
        raise ModelError(f"slow is {slow!r}: it must be from 0 to below 1")


def _counted(regressor: equations.Regressor, x: Motion) -> NDArray[np.bool_]:
    """Return (R, n) which torques count: those of a joint that moves for long, where its friction has one sure sign."""
    used = regressor.certain(x)
    return np.asarray(used & (used.sum(axis=0) >= FEWEST))


def _columns(
    regressor: equations.Regressor, base: equations.BaseParameters, x: Motion, used: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return W (R, n, b), and what of it was excited: where joints rest, noise moves them.

    The second is without columns, and small Stribeck terms, that the least stroke of such a joint makes as large.
    """
    W = regressor.averaged(x)[:, :, base.kept]
    rests, seen = np.asarray(~used.any(axis=0)), W.copy()
    if rests.any():
        still = replace(x, v=np.where(rests, 0.0, x.v), a=np.where(rests, 0.0, x.a))
        places = (np.where(rests, x.q.mean(axis=0) + side, x.q) for side in (0.0, equations.REST))
        seen, beside = (regressor.averaged(replace(still, q=q))[:, :, base.kept] for q in places)
        size, change = (np.einsum("tjk,tjk,tj->k", y, y, used) for y in (seen, seen - beside))
        seen[:, :, change > size] = 0.0
    for kind in OWN:
        for j, joint in enumerate(regressor.robot.joint_names):
            at = np.flatnonzero([regressor.names[k] == f"{kind}_{joint}" for k in base.kept])
            small = kind == "stribeck" and np.abs(seen[:, j, at]).max(initial=0.0) < LEAST_STRIBECK
            if small or rests[j]:
                seen[:, :, at] = 0.0
    return W, seen


def _pieces(R: int, share: float) -> NDArray[np.bool_]:
    """Return which of R windows are held out: the ends of `PIECES` pieces, since a log often moves joint by joint."""
    place = (np.arange(R) * PIECES / R) % 1.0
    return np.asarray(place >= 1.0 - share)


def _relative(error: Array, torque: Array, used: NDArray[np.bool_]) -> Array:
    size = (torque**2 * used).sum(axis=0)
    return np.asarray(np.sqrt((error**2 * used).sum(axis=0) / np.where(size > 0.0, size, np.nan)))


def _reason(
    k: int,
    found: equations.Fit,
    base: equations.BaseParameters,
    regressor: equations.Regressor,
    used: NDArray[np.bool_],
) -> str:
    name = regressor.names[base.kept[k]]
    joints = regressor.robot.joint_names
    joint = max((each for each in joints if name.endswith(f"_{each}")), key=len, default="")
    kind = name.removesuffix(f"_{joint}")
    others = [regressor.names[base.kept[other]] for other in found.alike[k]]
    if joint and not used[:, joints.index(joint)].any():
        return f"{joint} rests in this log, or moves too little or too slowly: move it, both ways and at several speeds"
    if kind == "stribeck" and not others:
        return f"{joint} never moves as slowly as the Stribeck speed in this log: move it slowly as well as fast"
    if not others:
        return f"no torque of this log depends on it: move {joint} and the joints before it"
    like = ", ".join(others[:3]) + (" ..." if len(others) > 3 else "")
    cure = {
        "viscous": f"move {joint} at several speeds",
        "dry": f"move {joint} both ways at several speeds",
        "offset": f"move {joint} both ways",
        equations.LOAD: f"move {joint} under loads that differ, as with a payload and without",
        "drive_inertia": f"accelerate {joint} more, in several postures",
        "stribeck": f"move {joint} slowly, below the Stribeck speed, as well as fast",
    }.get(kind, "more postures, and joints that accelerate together")
    return f"in this log it looks like {like}: {cure}"
