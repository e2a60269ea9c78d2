"""Whether the force of a recording is consistent with its motion and torques, and which force it is.

From the equation of motion H q̈ + C = Q + JᵀF the force on the tip follows by least squares, as a force observer
finds it (A. De Luca, R. Mattone, Sensorless robot collision detection and hybrid force/motion control, ICRA 2005), here
with accelerations from zero-phase filters. The recorded force is compared with what it may be: F along the normal, its
length, or along an axis, on the robot or on the environment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from closedloop.base.arrays import Array
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.report.control_verdict import rms
from closedloop.studies.comparison.explain import Hypothesis, Reason, explain
from closedloop.studies.comparison.recording import Recording
from closedloop.studies.identify.log import Log, LogError
from closedloop.studies.identify.motion import usual_cutoff

ROWS = 1500
# Rows at both ends that filters spoil, in periods of the cutoff.
EDGE = 2.0
# A recorded force is consistent if it differs by less than this share of its RMS, or by this, N.
CONSISTENT, SMALL = 0.1, 0.2


@dataclass(frozen=True)
class Audit:
    """The result of the audit of a recorded force.

    Attributes
    ----------
    what : str
        The reading that fits best, such as "along the normal, on the robot".
    rms : float
        RMS of recorded minus expected force in this reading, N.
    size : float
        RMS of the expected force, N.
    usual : float
        RMS of the difference if the force is read by this simulator's convention, along the normal and on the robot, N.
    explained : float
        Share of the joint torque, beyond that of motion and drives, that a force at the tip explains.
    reasons : list of Reason
        Explanations of the remaining difference: bias, gain, delay.
    rows : int
    cutoff : float
        Of the filters, Hz.
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


def audit(recording: Recording, robot: Robot, normal: Array, cutoff: float | None = None) -> Audit:
    """Compare the force of a recording with that of its motion and torques.

    Parameters
    ----------
    normal : (N, 3) array
        Of the surface at each row, base axes.
    cutoff : float, optional
        Of the low-pass, Hz; ten times that of the motion if left out.

    Raises
    ------
    LogError
        If there is no torque or no force, or too few rows are left.
    """
    at, expected, f, explained, cutoff = expected_force(recording, robot, cutoff)
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
    recording: Recording, robot: Robot, cutoff: float | None = None
) -> tuple[NDArray[np.int64], Array, Array, float, float]:
    """Return the force on the tip that follows from motion and torques, beside the recorded one.

    Parameters
    ----------
    cutoff : float, optional
        Of the low-pass, Hz; ten times that of the motion if left out.

    Returns
    -------
    rows (R,), expected (R, 3) N in base axes at them, recorded (N,) or (N, 3) N of all rows with the same filter, the
    share of the torque beyond that of motion and drives that a force at the tip explains, and the cutoff, Hz.
    """
    torque, force = recording.torque, recording.force
    if torque is None or force is None:
        missing = "torque" if torque is None else "force"
        raise LogError(f"{recording.source}: has no {missing}: the meaning of its force cannot be determined")
    step, N = recording.step, len(recording.time)
    cutoff = usual_cutoff(Log(recording.time, recording.positions, torque)) if cutoff is None else cutoff
    if not 0.0 < cutoff < 0.5 / step:
        raise LogError(f"cutoff is {cutoff:.6g} Hz: it must be above 0 and below half the rate, {0.5 / step:.6g} Hz")
    low_pass = signal.butter(4, 2.0 * cutoff * step, output="sos")
    edge = min(round(EDGE / (cutoff * step)), N // 4)
    q, Q, f = (signal.sosfiltfilt(low_pass, x, axis=0) for x in (recording.positions, torque, force))
    v = np.gradient(q, step, axis=0)
    a = np.zeros_like(q)  # differences of neighbours lose less of fast motions than those of differences
    a[1:-1] = np.diff(q, 2, axis=0) / step**2
    at = np.unique(np.linspace(edge, N - 1 - edge, min(ROWS, N - 2 * edge)).astype(int))
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
