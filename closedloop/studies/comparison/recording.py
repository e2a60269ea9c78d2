"""What was recorded of a robot in contact, whether its force fits its motion, and what explains a difference.

From the equation of motion H q̈ + C = Q + JᵀF the force on the tip follows by least squares, as a force observer
finds it (A. De Luca, R. Mattone, Sensorless robot collision detection and hybrid force/motion control, ICRA 2005), here
with accelerations from zero-phase filters. The recorded force is compared with what it may be: F along the normal, its
length, or along an axis, on the robot or on the environment.

What explains a residual are hypotheses, each a column or several, fitted by least squares, alone and one by one. The
share that one explains is that of the residual's sum of squares. The interval of its coefficient takes into account
that neighbouring rows are alike: N is divided by how many are, from the sum of the autocorrelations (Bartlett).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.report.control_verdict import rms
from closedloop.record.run import Run
from closedloop.studies.identify import motion as logs
from closedloop.studies.identify.read import columns_named, factors_of, listed, read_joints, run_of
from robot_models import RobotModel

# A hypothesis is added while it explains this share of what is left, and so much of the whole.
ENOUGH, OF_ALL = 0.2, 0.02
MOST = 4
# A residual below this share of its signal is rounding, and of the integrator.
NOTHING = 1e-7
# A hypothesis that explains all but this share of what the best one does is as good.
AS_WELL = 0.01
# A hypothesis that says the same as those before it, up to this share of its size, adds nothing.
DEPENDENT = 1e-6
# Lags of the autocorrelation that are summed, over the number of rows.
LAGS = 0.1


@dataclass(frozen=True)
class Hypothesis:
    """A reason why two signals might differ."""

    # name, unit: of its coefficients
    name: str
    unit: str
    columns: Array  # (N, k): what the residual would be for coefficients of 1
    labels: Sequence[str] = ()  # of its columns, such as joints; empty for one


@dataclass(frozen=True)
class Reason:
    """A hypothesis that explains a residual."""

    name: str
    unit: str
    labels: tuple[str, ...]
    # value, half (k,): coefficients, fitted with those of all reasons, and half of their 95 % intervals
    value: Array
    half: Array
    alone: float  # share of the residual that it explains alone
    left: float  # share that is left with it and the reasons before it
    as_well: tuple[str, ...] = ()  # hypotheses that explain it equally well: the log does not distinguish them


def explain(residual: Array, hypotheses: Sequence[Hypothesis], size: float = 0.0) -> list[Reason]:
    """Return the hypotheses that explain a residual (N,), the one that explains most of what is left first.

    `size` is the RMS of the signal: a residual that is rounding beside it needs no reason.
    """
    whole = float(residual @ residual)
    if whole <= len(residual) * (NOTHING * size) ** 2:
        return []
    alone = {h.name: 1.0 - _left(residual, [h]) / whole for h in hypotheses}
    steps: list[tuple[Hypothesis, float, tuple[str, ...]]] = []  # what explains, what it leaves, what does so as well
    left = whole
    while len(steps) < MOST:
        chosen = [h for h, *_ in steps]
        rest = {h.name: _left(residual, [*chosen, h]) for h in hypotheses if h not in chosen}
        if not rest:
            break
        best = min(rest, key=rest.__getitem__)
        if left - rest[best] < max(ENOUGH * left, OF_ALL * whole):
            break
        gained, left = left - rest[best], rest[best]
        equal = tuple(name for name in rest if name != best and rest[name] - left < AS_WELL * gained)
        steps.append((next(h for h in hypotheses if h.name == best), left / whole, equal))
    if not steps:
        return []
    ends = np.cumsum([h.columns.shape[1] for h, *_ in steps])[:-1]
    value, half = (np.split(each, ends) for each in _fitted(residual, [h for h, *_ in steps]))
    return [
        Reason(h.name, h.unit, tuple(h.labels), its_value, its_half, alone[h.name], still, equal)
        for (h, still, equal), its_value, its_half in zip(steps, value, half, strict=True)
    ]


def _fitted(residual: Array, hypotheses: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """Return all coefficients, and half of their 95 % intervals."""
    A, sizes, value, left = _solved(residual, hypotheses)
    variance = float(left @ left) / max(len(left) - A.shape[1], 1) * alike_rows(left)
    covariance = np.linalg.pinv(A.T @ A, rcond=DEPENDENT)
    return value / sizes, 1.96 * np.sqrt(variance * np.diag(covariance)) / sizes


def _solved(residual: Array, hypotheses: Sequence[Hypothesis]) -> tuple[Array, Array, Array, Array]:
    """Return columns of length one (N, k), their lengths, their coefficients (k,), and what they leave (N,)."""
    A = np.concatenate([h.columns for h in hypotheses], axis=1)
    sizes = np.linalg.norm(A, axis=0)
    sizes[sizes == 0.0] = 1.0
    value = np.linalg.lstsq(A / sizes, residual, rcond=DEPENDENT)[0]
    return A / sizes, sizes, value, residual - (A / sizes) @ value


def _left(residual: Array, hypotheses: Sequence[Hypothesis]) -> float:
    """Return the sum of squares that hypotheses leave."""
    left = _solved(residual, hypotheses)[3]
    return float(left @ left)


def alike_rows(x: Array) -> float:
    """Return how many neighbouring rows of a signal count as one: 1 if it is white."""
    centred = x - x.mean()
    power = float(centred @ centred)
    if power == 0.0:
        return 1.0
    lags = max(1, min(int(LAGS * len(x)), len(x) - 1))
    correlation = signal.correlate(centred, centred, method="fft")[len(x) - 1 :][: lags + 1] / power
    ends = np.flatnonzero(correlation <= 0.0)
    upto = int(ends[0]) if len(ends) else lags + 1
    return float(max(1.0, 1.0 + 2.0 * correlation[1:upto].sum()))


# Rows at which torques are explained.
EXPLAINED = 3000


def of_joints(residual: Array, names: Sequence[str], v: Array, torque: Array) -> tuple[Array, list[Hypothesis]]:
    """Return the residual of positions as one column, and why it might not be zero."""
    N, n = residual.shape
    hypotheses = [
        Hypothesis("delay", "s", -v.reshape(-1, 1)),
        Hypothesis("offset", "rad (m)", _blocks(np.ones((N, n))), names),
        Hypothesis("give under the drives' torque", "rad/(N m)", _blocks(torque), names),
    ]
    return residual.reshape(-1), hypotheses


def of_torques(
    residual: Array, time: Array, names: Sequence[str], motion: tuple[Array, Array, Array], torque: Array,
    robot: Robot | None, normal: Array | None,
) -> tuple[Array, list[Hypothesis]]:  # fmt: skip
    """Return the residual of torques, at some rows, as one column, and why it might not be zero."""
    q, v, a = motion
    rows = np.unique(np.linspace(0, len(time) - 1, EXPLAINED).astype(int))
    rate = np.gradient(torque, time, axis=0)
    slow = 1e-3 * np.abs(v).max(axis=0) + 1e-9
    hypotheses = [
        Hypothesis("offset", "N m (N)", _blocks(np.ones((len(rows), v.shape[1]))), names),
        Hypothesis("dry friction", "N m (N)", _blocks(np.tanh(v[rows] / slow)), names),
        Hypothesis("viscous friction", "N m s/rad", _blocks(v[rows]), names),
        Hypothesis("delay", "s", -rate[rows].reshape(-1, 1)),
        Hypothesis("gain beyond 1", "1", _blocks(torque[rows]), names),
    ]
    if robot is not None:
        gravity = np.asarray(robot.model.pinocchio_model().gravity.linear)
        payload, pressing = np.empty((2, len(rows), v.shape[1]))
        for k, row in enumerate(rows):
            terms = robot.terms(q[row], v[row])
            payload[k] = terms.jacobian.T @ (terms.jacobian @ a[row] + terms.drift - gravity)
            if normal is not None:
                pressing[k] = -terms.jacobian.T @ normal[row]
        hypotheses.append(Hypothesis("payload at the tip", "kg", payload.reshape(-1, 1)))
        if normal is not None:
            hypotheses.append(Hypothesis("force along the normal at the tip", "N", pressing.reshape(-1, 1)))
    return residual[rows].reshape(-1), hypotheses


def _blocks(columns: Array) -> Array:
    """Return (N n, n): for each joint a column that is zero in the rows of the others."""
    N, n = columns.shape
    spread = np.zeros((N, n, n))
    spread[:, np.arange(n), np.arange(n)] = columns
    return spread.reshape(N * n, n)


# What the column of the tip's speed is called.
SPEED = ("speed", "tip_speed", "tcp_speed")
# What the columns of a force are called: three along the base's axes, the first two of them in files of
# `closedloop export`, or one along the surface's normal.
FORCES = (
    ("tip_force {}", "xyz"), ("tip_wrench.force.{}", "xyz"), ("force_{}", "xyz"), ("f{}", "xyz"), ("f_{}", "xyz"),
    ("force.{}", "xyz"), ("wrench.force.{}", "xyz"),
)  # fmt: skip
FORCE = ("contact_force", "normal_force", "force", "f", "fn", "f_n")
FEWEST = 50


@dataclass(frozen=True, eq=False)
@fields_checked
class Recording:
    """A recording of N rows, to compare with a scenario.

    Attributes
    ----------
    time : (N,)
        s, increasing.
    q : (N, n), optional
        Joint positions, rad (m); None where only the force, or the tip's speed, was recorded.
    torque : (N, n), optional
        Torques of the drives at the joints, N m (N).
    force : (N,) or (N, 3), optional
        Contact force, N: along the surface's normal, or along the axes of the base.
    source : str
        Named in messages.
    v : (N, n), optional
        Joint velocities, rad/s (m/s): only compared with the rates of the positions, to find wrong units and orders.
    speed : (N,), optional
        Size of the tip's velocity, m/s; where a contact is identified from it, it may have the sign of the direction.
    is_run : bool
        Whether it is a run: then its clock is that of the scenario, and no shift is looked for.
    """

    time: Array
    q: Array | None = None
    torque: Array | None = None
    force: Array | None = None
    source: str = "the log"
    v: Array | None = None
    speed: Array | None = None
    is_run: bool = False

    @property
    def positions(self) -> Array:
        """Joint positions q (N, n); LogError if the recording has none."""
        if self.q is None:
            raise logs.LogError(f"{self.source}: has no joint positions q: the force of the torques is not known")
        return self.q

    @property
    def step(self) -> float:
        """Median time between two rows, s."""
        return float(np.median(np.diff(self.time)))


def of_run(run: Run, source: str = "the run") -> Recording:
    """Return what a run recorded, with the force along the normal of its surface."""
    force = np.array(run.contact_force) if run.scenario.has_surface else None
    return Recording(np.array(run.time), np.array(run.q), np.array(run.torque), force, source, is_run=True)


def read_recording(
    path: str | Path, robot: RobotModel, *, columns: Mapping[str, str] | None = None, degrees: bool = False,
    gain: float | Sequence[float] | None = None,
) -> Recording:  # fmt: skip
    """Read a log or a run file.

    `path`: .csv, .parquet, .nc, .mcap, .db3 or a folder of rosbag2.
    `robot`: whose joints the columns are of.
    `columns`: of "time", "q", "torque", "force", "speed" to names, as `closedloop.studies.identify.read.read_log` takes
        them; of "force" one name, or three with commas between.
    `degrees`: whether angles are in degrees.
    `gain`, float or (n,), optional: what torques are multiplied by: N m/A of currents, which need one.
    Raises LogError if the file cannot be read, a column is missing, a value is not finite, or time jumps.
    """
    path, given = Path(path), dict(columns or {})
    factors_of(gain)  # whatever the file is
    if unknown := set(given) - {"time", "q", "torque", "force", "speed"}:
        raise logs.LogError(f"--columns {sorted(unknown)[0]}: is none of time, q, torque, force, speed")
    if path.suffix.lower() == ".nc" and not given:
        run = run_of(path)
        if run is not None:
            if run.model.joint_names != robot.joint_names:
                raise logs.LogError(
                    f"{path}: its joints are {', '.join(run.model.joint_names)}: those of the scenario's robot are "
                    f"{', '.join(robot.joint_names)}"
                )
            return checked(of_run(run, str(path)), robot)
    table, time, q, v, torque = read_joints(path, robot, given, degrees, gain)
    if q is not None:
        logs.check_positions(q, robot, str(path))
    forces = [[form.format(axis) for axis in axes] for form, axes in FORCES] + [[name] for name in FORCE]
    force = _found(table, "force", forces, given.pop("force", None), path)
    speed = _found(table, "speed", [[name] for name in SPEED], given.pop("speed", None), path)
    if q is None and force is None and speed is None:
        raise logs.LogError(
            f"{path}: no columns for q of the joints {', '.join(robot.joint_names)}, for force or for speed: name "
            f"them, as in --columns q='q_{{}}'; it has {listed(table)}"
        )
    return checked(Recording(time, q, torque, force, str(path), v, speed), robot)


def _found(table: dict[str, Array], what: str, usual: list[list[str]], asked: str | None, path: Path) -> Array | None:
    """Return the columns of a quantity, SI units, (N,) or (N, 3), or None if there are none of its usual names."""
    named = [name.strip() for name in asked.split(",")] if asked and what == "force" else [asked or ""]
    for names in [named] if asked else usual:
        found = columns_named(table, names, what, path) if len(names) in (1, 3) else None
        if found is not None:
            return found[0] if len(found) == 1 else np.stack(found, axis=1)
    if asked:
        missing = next((name for name in named if columns_named(table, [name], what, path) is None), None)
        reason = f"no column {missing!r}" if missing else f"{len(named)} names: one, or three"
        raise logs.LogError(f"{path}: --columns {what}={asked}: {reason}; it has {listed(table)}")
    return None


def checked(recording: Recording, robot: RobotModel) -> Recording:
    """Return the recording, of this robot, with every value finite and rows evenly spaced.

    Raises LogError if it has another number of rows or joints, a value that is not finite, or time that jumps.
    """
    where, time = recording.source, np.asarray(recording.time, dtype=np.float64)
    N = len(time)
    if N < FEWEST:
        raise logs.LogError(f"{where}: {N} rows: a comparison needs at least {FEWEST}")
    for name, x, shapes in (
        ("time", time, [(N,)]),
        ("q", recording.q, [(N, robot.n)]),
        ("torque", recording.torque, [(N, robot.n)]),
        ("force", recording.force, [(N,), (N, 3)]),
        ("v", recording.v, [(N, robot.n)]),
        ("speed", recording.speed, [(N,)]),
    ):
        if x is None:
            continue
        if np.shape(x) not in shapes:
            raise logs.LogError(f"{where}: {name} has shape {np.shape(x)}: must be {' or '.join(map(str, shapes))}")
        if not np.isfinite(x).all():
            raise logs.LogError(f"{where}: {name} in row {int(np.argwhere(~np.isfinite(x))[0][0])} is not finite")
    step = logs.check_time(time, where)
    if recording.q is None:
        if recording.force is None and recording.speed is None:
            raise logs.LogError(f"{where}: has neither q nor force nor speed: there is nothing to compare")
        return recording
    logs.check_motion(recording.q, recording.v, step, robot, where)
    if recording.torque is not None:
        logs.check_torques(recording.q, recording.torque, robot, where)
    return recording


ROWS = 1500
# Rows at both ends that filters spoil, in periods of the cutoff.
EDGE = 2.0
# A recorded force is consistent if it differs by less than this share of its RMS, or by this, N.
CONSISTENT, SMALL = 0.1, 0.2


@dataclass(frozen=True)
class Audit:
    """The result of the audit of a recorded force.

    `what`: the reading that fits best, such as "along the normal, on the robot".
    `rms`: RMS of recorded minus expected force in this reading, N.
    `size`: RMS of the expected force, N.
    `usual`: RMS of the difference if the force is read by this simulator's convention, along the normal and on the
        robot, N.
    `explained`: share of the joint torque, beyond that of motion and drives, that a force at the tip explains.
    `reasons`: explanations of the remaining difference: bias, gain, delay.
    `cutoff`: of the filters, Hz.
    """

    what: str
    rms: float
    size: float
    usual: float
    explained: float
    reasons: list[Reason]
    rows: int
    cutoff: float

    @property
    def consistent(self) -> bool:
        """Whether the force, read by this simulator's convention, agrees with motion and torques."""
        return self.usual <= max(CONSISTENT * self.size, SMALL)

    def lines(self) -> list[str]:
        """Return the audit in words."""
        told = [
            f"force expected from q, v and torque (cutoff {self.cutoff:.3g} Hz, {self.rows} rows): {self.size:.4g} N "
            f"RMS; a force at the tip explains {100 * self.explained:.0f} % of the torque that is left",
            f"the recorded force fits best as the force {self.what}: it differs by {self.rms:.4g} N RMS",
        ]
        if self.what != READINGS[0]:
            told.append(f"read as the force {READINGS[0]} it differs by {self.usual:.4g} N RMS")
        told.append("it is consistent" if self.consistent else "it is NOT consistent with the motion and the torques")
        return told


READINGS = (
    "along the normal, on the robot",
    "along the normal, on the environment",
    "as a length, whatever its direction",
)
AXES = ("along x of the base", "along y of the base", "along z of the base")


class NothingLeftError(logs.LogError):
    """Every row of a recording is near an impact, or near its ends."""


def audit(
    recording: Recording, robot: Robot, normal: Array, cutoff: float | None = None, struck: Array | None = None
) -> Audit:
    """Compare the force of a recording with that of its motion and torques.

    `normal` (N, 3): of the surface at each row, base axes.
    `cutoff`: of the low-pass, Hz; ten times that of the motion if left out.
    `struck` (m,): instants of impacts, s: an impulse is in the motion and in no force, and rows that the filter reaches
        from there are left out.
    Raises LogError if there is no torque or no force, or no rows are left.
    """
    at, expected, f, explained, cutoff = expected_force(recording, robot, cutoff, struck)
    n = normal[at]
    scalar = np.einsum("ij,ij->i", f[at], n) if f.ndim == 2 else f[at]
    along = np.einsum("ij,ij->i", expected, n)
    readings = dict(zip(READINGS, (along, -along, np.linalg.norm(expected, axis=1)), strict=True))
    if f.ndim == 1:
        readings |= {f"{name}, on the robot": expected[:, k] for k, name in enumerate(AXES)}
    differs = {name: rms(scalar - each) for name, each in readings.items()}
    usual = differs[READINGS[0]]
    best = min(differs, key=differs.__getitem__)
    if differs[best] > 0.8 * usual:  # no other reading is clearly better
        best = READINGS[0]
    rate = np.gradient(readings[best], recording.time[at])
    reasons = explain(scalar - readings[best], force_hypotheses(readings[best], rate), rms(scalar))
    return Audit(best, differs[best], rms(along), usual, explained, reasons, len(at), cutoff)


def expected_force(
    recording: Recording, robot: Robot, cutoff: float | None = None, struck: Array | None = None
) -> tuple[NDArray[np.int64], Array, Array, float, float]:
    """Return the force on the tip that follows from motion and torques, beside the recorded one; see `audit`.

    These are rows (R,), the force expected there (R, 3), N, base axes, the recorded one of all rows with the same
    filter, (N,) or (N, 3), N, the share of the torque beyond that of motion and drives that a force at the tip
    explains, and the cutoff, Hz.
    """
    torque, force = recording.torque, recording.force
    if torque is None or force is None:
        missing = "torque" if torque is None else "force"
        raise logs.LogError(f"{recording.source}: has no {missing}: the meaning of its force cannot be determined")
    step, N = recording.step, len(recording.time)
    cutoff = logs.usual_cutoff(logs.Log(recording.time, recording.positions, torque)) if cutoff is None else cutoff
    if not 0.0 < cutoff < 0.5 / step:
        raise logs.LogError(
            f"cutoff is {cutoff:.6g} Hz: it must be above 0 and below half the rate, {0.5 / step:.6g} Hz"
        )
    low_pass = signal.butter(4, 2.0 * cutoff * step, output="sos")
    edge = min(round(EDGE / (cutoff * step)), N // 4)
    q, Q, f = (signal.sosfiltfilt(low_pass, x, axis=0) for x in (recording.positions, torque, force))
    v = np.gradient(q, step, axis=0)
    a = np.zeros_like(q)  # differences of neighbours lose less of fast motions than those of differences
    a[1:-1] = np.diff(q, 2, axis=0) / step**2
    rows = np.arange(edge, N - edge)
    for instant in struck if struck is not None else ():
        rows = rows[np.abs(recording.time[rows] - instant) > EDGE / cutoff]
    if not rows.size:
        raise NothingLeftError(f"all of its rows are within {EDGE / cutoff:.3g} s of an impact: give a higher cutoff")
    at = rows[np.unique(np.linspace(0, rows.size - 1, min(ROWS, rows.size)).astype(int))]
    expected = np.empty((len(at), 3))
    left = whole = 0.0
    for k, row in enumerate(at):
        terms = robot.terms(q[row], v[row])
        beyond = terms.mass_matrix @ a[row] + terms.bias - Q[row]
        expected[k] = np.linalg.lstsq(terms.jacobian.T, beyond, rcond=1e-6)[0]
        left += float(np.sum((beyond - terms.jacobian.T @ expected[k]) ** 2))
        whole += float(beyond @ beyond)
    return at, expected, f, 1.0 - left / whole if whole > 0.0 else 0.0, cutoff


def force_hypotheses(force: Array, rate: Array) -> list[Hypothesis]:
    """Return why a recorded force (N,) might differ from another, whose rate (N,) is in N/s."""
    return [
        Hypothesis("bias", "N", np.ones((len(force), 1))),
        Hypothesis("gain beyond 1", "1", force[:, None]),
        Hypothesis("delay", "s", -rate[:, None]),
    ]
