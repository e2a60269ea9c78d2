"""`identify_contact`: a log of a tip on a plane in, the contact's parameters with intervals out.

Restitution is found from the heights of a tip that bounces: e = −(rate after)/(rate before) of each impact. An impact
is a kink of n·r. A cubic through the rows on either side gives both rates at the instant where they meet, with their
noise. The coefficient is that of all impacts by least squares, v⁺ = −e v⁻, less what the noise of v⁻ takes from it; its
interval comes from how much the impacts scatter, or from the noise if that is more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, plain
from closedloop.base.errors import ModelError
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.run import Run
from closedloop.studies.comparison.recording import Recording, checked, read_recording
from closedloop.studies.identify import motion
from closedloop.studies.identify.contact import found as fits
from closedloop.studies.identify.contact.found import Part, Touch
from closedloop.studies.identify.identify import Estimate, unknown
from closedloop.studies.identify.motion import LogError, check_positions, white_noise

if TYPE_CHECKING:
    from os import PathLike

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from robot_models import RobotModel


# Coefficients (4,) of cubics through more and more rows, the highest power first, with their covariances.
Cubics = list[tuple[Array, Array]]

# Rows of a cubic. More of them may change the rates by so many deviations: the median over the impacts, and one.
LENGTHS, AGREE, AT_MOST = (8, 11, 15, 20, 27, 36, 48, 64), 0.5, 3.0
# Rows beside the impact that belong to neither side.
FEWEST, GUARD = LENGTHS[0], 2
# A kink is a change of the rate of so many deviations; half the rows have to find this share of it.
SURE, SHARP = 12.0, 0.8
# From so many beginnings the counts of encoders are drawn: their mean square is known to a third.
BEGINNINGS = 5
# Impacts that a dependence on the speed needs, how sure it has to be, and how much of e at least.
IMPACTS, LIKELY, MATTERS = 5, 4.0, 0.02


@dataclass(frozen=True)
class Impact:
    """One impact."""

    time: float  # s
    # before, after: rate of n·r, m/s; negative before
    before: float
    after: float
    noise: float  # standard deviation of each, m/s


def impacts_of(time: Array, height: Array) -> list[Impact]:
    """Return the impacts of a tip whose heights, m, are known at evenly spaced times."""
    step = float((time[-1] - time[0]) / (len(time) - 1))
    sigma = max(float(white_noise(height[:, None])[0]), 1e-12 * max(1.0, float(np.abs(height).max())))
    m = FEWEST
    slopes, half = _kinks(height, m, step), _kinks(height, m // 2, step)
    rate_noise = sigma * np.sqrt(12.0 / m**3) / step
    found = []
    jump = slopes[1] - slopes[0]
    sharp = (half[1] - half[0]) > SHARP * jump
    candidates = np.flatnonzero((jump > SURE * rate_noise) & sharp & (slopes[0] < 0.0) & (slopes[1] > 0.0))
    places: list[int] = []
    for k in candidates[np.argsort(-jump[candidates])]:
        if all(abs(int(k) - other) > 2 * m for other in places):
            places.append(int(k))
    places.sort()
    ends = [-1, *places, len(height)]
    sides: tuple[list[Cubics], list[Cubics]] = ([], [])
    used = []
    for first, k, last in zip(ends, places, ends[2:], strict=False):
        left = np.arange(k - GUARD, max(first + GUARD, k - GUARD - LENGTHS[-1]), -1)
        right = np.arange(k + GUARD, min(last - GUARD, k + GUARD + LENGTHS[-1]))
        if min(len(left), len(right)) >= FEWEST:
            used.append(k)
            for side, rows in zip(sides, (left, right), strict=True):
                side.append(_cubics(time[rows] - time[k], height[rows], sigma))
    most = [_good(side, AGREE) for side in sides]
    for at, k in enumerate(used):  # a cubic ends before the next thing happens
        fits = [
            side[at][min(count, _good([side[at]], AT_MOST), len(side[at])) - 1]
            for side, count in zip(sides, most, strict=True)
        ]
        if (one := _impact(float(time[k]), step, fits)) is not None:
            found.append(one)
    return found


def _kinks(height: Array, m: int, step: float) -> Array:
    """Return slopes (2, N) of lines through the m rows up to, and from, each row."""
    weights = 12.0 * (np.arange(m) - 0.5 * (m - 1)) / (m * (m * m - 1.0) * step)
    slope = np.correlate(height, weights, mode="valid")  # of rows k ... k + m - 1
    before, after = np.zeros((2, len(height)))
    before[m - 1 :] = slope
    after[: len(slope)] = slope
    return np.stack([before, after])


def _cubics(t: Array, height: Array, sigma: float) -> Cubics:
    """Return the coefficients of cubics through the first 8, 11 ... rows, and their covariances."""
    fits = [np.polyfit(t[:m], height[:m], 3, cov="unscaled") for m in LENGTHS if m <= len(t)]
    return [(value, sigma**2 * covariance) for value, covariance in fits]


def _good(side: list[Cubics], bound: float) -> int:
    """Return how many of `LENGTHS` are good on one side of all these impacts.

    More rows are taken while the rates that they give are those of fewer, but for `bound` deviations of their noise in
    the median: what a cubic lacks must stay below noise (O. Lepski, Theory of Probability and its Applications 35
    (1990) 454-466).
    """
    for longer in range(1, len(LENGTHS)):
        there = [x for x in side if len(x) > longer]
        for shorter in range(longer if there else 0):
            pairs = ((x[shorter], x[longer]) for x in there)
            z = [(more[0][2] - fewer[0][2]) / np.sqrt(fewer[1][2, 2]) for fewer, more in pairs]
            if abs(np.median(z)) > bound:
                return longer
    return len(LENGTHS)


def _impact(time: float, step: float, fits: list[tuple[Array, Array]]) -> Impact | None:
    """Return the impact where both cubics, of time since a row at `time`, meet, next to the row."""
    roots = np.roots(fits[1][0] - fits[0][0])
    real = roots[np.abs(roots.imag) < 1e-9].real
    if not len(real):
        return None
    at = float(real[np.abs(real).argmin()])
    if abs(at) > 2.0 * step * (GUARD + 1):
        return None
    row = np.array([3.0 * at * at, 2.0 * at, 1.0, 0.0])
    before, after = (float(row @ value) for value, _ in fits)
    noise = float(np.sqrt(max(row @ covariance @ row for _, covariance in fits)))
    if before >= -SURE * noise:
        return None
    return Impact(time + at, before, after, noise)


def restitution_of(time: Array, height: Array, confidence: float) -> Part:
    """Return the coefficient of restitution of the impacts in a log."""
    part = Part("rate after an impact, m/s")
    impacts = impacts_of(time, height)
    if not impacts:
        why = "no impact is seen: let the tip fall on the surface, and bounce, several times"
        part.estimates = [unknown("restitution", "1", why)]
        return part
    v, w, noise = (np.array([getattr(x, name) for x in impacts]) for name in ("before", "after", "noise"))
    weight = 1.0 / noise**2 if noise.min() > 0.0 else np.ones(len(v))
    square = float((weight * v * v).sum())
    e = -float((weight * v * w).sum()) / (square - len(v))
    left = w + e * v
    by_noise = np.sqrt((1.0 + e * e) / square)
    scatter = np.sqrt(float((weight**2 * v**2 * left**2).sum()) * len(v) / max(len(v) - 1, 1)) / square
    half = float(stats.norm.ppf(0.5 + 0.5 * confidence)) * by_noise
    if len(v) > 1:
        half = max(half, float(stats.t.ppf(0.5 + 0.5 * confidence, len(v) - 1)) * scatter)
    part.estimates = [Estimate("restitution", e, e - half, e + half, "1", f"restitution, {len(v)} impacts", "")]
    part.time, part.measured, part.predicted = np.array([x.time for x in impacts]), w, -e * v
    if len(v) >= IMPACTS:
        A = np.column_stack([v, v * v]) / noise[:, None]
        value, *_ = np.linalg.lstsq(A, w / noise, rcond=None)
        rest = w / noise - A @ value
        variance = max(1.0, float(rest @ rest) / (len(v) - 2)) * np.linalg.inv(A.T @ A)[1, 1]
        if abs(value[1]) > LIKELY * np.sqrt(variance) and abs(value[1]) * np.ptp(v) > MATTERS * e:
            part.misses = ["restitution: it depends on the speed of the impact"]
    return part


@dataclass(frozen=True, eq=False)
class ContactIdentification:
    """Parameters of a contact that a log identifies.

    `parts`: of the sensor, friction, surface and restitution: estimates, what the law misses, measured and predicted.
    `closed`, `free`: shares of the rows in which the tip certainly touches, and certainly does not.
    `confidence`: of the intervals.
    """

    parts: tuple[Part, ...]
    source: str
    closed: float
    free: float
    confidence: float

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Every parameter, known or not."""
        return tuple(e for part in self.parts for e in part.estimates)

    @property
    def misses(self) -> tuple[str, ...]:
        """Effects that the laws of the contact do not have."""
        return tuple(text for part in self.parts for text in part.misses)

    def __getitem__(self, name: str) -> Estimate:
        found = next((e for e in self.estimates if e.name == name), None)
        if found is None:
            raise KeyError(f"{name!r}: the parameters are {', '.join(e.name for e in self.estimates)}")
        return found

    def lines(self) -> list[str]:
        """Return the findings in words."""
        told = [
            f"{self.source}: the tip touches in {100 * self.closed:.0f} % of the rows, and is free in "
            f"{100 * self.free:.0f} %",
            f"  {'parameter':20}{'value':>12}  {100 * self.confidence:.0f} % interval",
        ]
        told += [e.line(20) for e in self.estimates if not e.why]
        reasons: dict[str, list[str]] = {}
        for e in self.estimates:
            reasons.setdefault(e.why, []).append(e.name)
        told += [f"  not identifiable, {', '.join(names)}: {why}" for why, names in reasons.items() if why]
        return told + [f"  the model misses, in {text}" for text in self.misses]

    def summary(self) -> dict[str, Any]:
        """Return it as a dictionary; unknown values are None."""
        return plain({
            "closed": self.closed, "free": self.free, "confidence": self.confidence, "misses": self.misses,
            "parameters": {e.name: e.as_dict() for e in self.estimates},
        })  # fmt: skip

    def figure(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Return a figure of the measured and the predicted values of each part, and the residual.

        With `ax` it is drawn on axes of the caller's, see `closedloop.figures`.
        """
        from closedloop.figures.style import COLOURS, legend_beside_title, panels, styled

        drawn = [part for part in self.parts if len(part.time)]
        with styled():
            count = max(len(drawn), 1)
            figure, on = panels(count, 2.2 * count + 0.6, ax, share=False)
            for panel, part in zip(on, drawn, strict=False):
                panel.plot(part.time, part.measured, ".", ms=3, color="0.4", label="measured")
                panel.plot(part.time, part.predicted, ".", ms=2, color=COLOURS[1], label="predicted")
                panel.plot(part.time, part.measured - part.predicted, ".", ms=2, color=COLOURS[0], label="residual")
                panel.set_ylabel("\n".join(wrap(part.what, 24)), fontsize="small")
            if drawn:
                legend_beside_title(on[0])
            on[-1].set_xlabel("time, s")
        return figure


@arguments_checked()
def identify_contact(
    log: Recording | Run | str | Path, robot: RobotModel | str | PathLike[str] | None = None, *,
    normal: ArrayLike = (0.0, 0.0, 1.0), tip: str | None = None, delay: float | None = None,
    cutoff: float | None = None, confidence: float = 0.95,
) -> ContactIdentification:  # fmt: skip
    """Identify friction, stiffness, damping, restitution and the force sensor from a log of a tip on a plane.

    Parameters
    ----------
    log : Recording, Run or path
        Joint positions and, but for restitution, the contact force: along the normal, or three components in the base's
        axes, on the robot. With the torques of the drives, the sensor's gain and delay too. If it is a run, the run's
        own surface, sensor and encoders are used. A log without positions needs force and speed of a tip that moves
        along the normal: its height is the integral of its speed.
    robot : RobotModel, or what `robot_models.load` takes
        Its kinematics give the position of the tip. If the log is a run, the run's own robot is used.
    normal : (3,)
        Normal of the plane, pointing out of it, base axes.
    tip : str, optional
        The frame that touches; the robot's own tip if left out.
    delay : float, optional
        Delay of the recorded force, s; if left out, it is identified.
    cutoff : float, optional
        Of the zero-phase low-pass, Hz; ten times the bandwidth of the tip's motion if left out.
    confidence : float
        Of the intervals.

    Returns
    -------
    ContactIdentification
        With `friction` (μ), `viscous_friction`, `stiffness`, `damping`, `delay`, `surface_offset`, `restitution`,
        `bias`, `payload`, `gain`, `sensor_delay`, as far as the log tells them; the equations are in the modules of
        `closedloop.studies.identify.contact`.

    Raises
    ------
    LogError
        If the log is at fault, or the surface of a run is not a plane at rest.
    ModelError
        If an argument is, or the robot cannot be loaded.
    """
    import robot_models
    from robot_models import RobotModel

    if not 0.5 <= confidence < 1.0:
        raise ModelError(f"confidence is {confidence!r}: it must be from 0.5 to below 1")
    out = np.asarray(normal, dtype=np.float64)
    if out.shape != (3,) or not np.isfinite(out).all() or not np.linalg.norm(out) > 0.0:
        raise ModelError(f"normal is {normal!r}: it must be three numbers, not all 0")
    out = out / np.linalg.norm(out)
    if isinstance(log, Run):
        model, tip = log.model, tip or log.scenario.robot.tip
        recording, out = contact_recording(log)
    elif robot is None:
        raise ModelError("robot is missing: a log needs the robot whose tip touches")
    else:
        model = robot if isinstance(robot, RobotModel) else robot_models.load(robot)
        recording = log if isinstance(log, Recording) else read_recording(log, model)
    recording = checked(recording, model)
    mechanics = Robot(model, tip)
    z = float(stats.norm.ppf(0.5 + 0.5 * confidence))
    if recording.q is None:
        touch = fits.touch_of_speed(recording, out)
        moves = touch.position
    else:
        touch, moves = fits.touch_of(recording, mechanics, out), recording.q
        if not isinstance(log, Run):
            check_positions(moves, model, recording.source)
    if np.ptp(moves, axis=0).max() == 0.0:
        raise LogError(f"{recording.source}: the robot rests: no joint moves, nothing can be found")
    parts: list[Part] = []
    if touch.force is not None:
        parts, at = _beside_force(recording, mechanics, touch, cutoff, delay, z)
        if recording.q is not None:

            def again(other: Recording) -> list[Part]:
                return _beside_force(other, mechanics, fits.touch_of(other, mechanics, out), at, delay, z)[0]

            _allow_for_counts(recording, parts, at, z, again)
    else:
        why = "the log has no force: name its columns, as in force=fx,fy,fz"
        parts.append(Part("force, N").untold((*fits.SLIDING, *fits.NAMES), why))
    parts.append(restitution_of(touch.time, touch.height, confidence))
    closed, free = (float(np.mean(rows)) for rows in (touch.closed, touch.free))
    return ContactIdentification(tuple(parts), recording.source, closed, free, confidence)


def _beside_force(
    recording: Recording, mechanics: Robot, touch: Touch, cutoff: float | None, delay: float | None, z: float
) -> tuple[list[Part], float]:
    """Return what is found of the sensor, the surface and friction, and the cutoff, Hz."""
    windows = fits.Windows.of(touch, cutoff)
    sensor = fits.of_free_rows(windows, np.asarray(mechanics.model.pinocchio_model().gravity.linear), z)
    beside = fits.beside_torques(recording, mechanics, touch, cutoff, z)
    if delay is not None:
        sensor.read_late(delay, 0.0)
    surface = fits.compliance_of(windows, sensor, z)
    if delay is None:
        late = [e for e in (*beside.estimates, *surface.estimates) if "delay" in e.name and not e.why]
        if late:  # the sensor has their mean, each by its precision
            precision = np.array([(2.0 * z / (e.high - e.low)) ** 2 if e.high > e.low else 1e30 for e in late])
            mean = float(precision @ [e.value for e in late] / precision.sum())
            sensor.read_late(mean, float(1.0 / np.sqrt(precision.sum())))
        if any(e.name == "sensor_delay" for e in late):  # which tells damping and delay apart
            own = [e for e in surface.estimates if e.name == "delay" and not e.why]
            surface = fits.compliance_of(windows, sensor, z)
            surface.estimates += own
    if recording.q is None:
        why = "the log has no positions: its heights are those above the first row"
        surface.estimates = [
            unknown(e.name, e.unit, why) if e.name == "surface_offset" else e for e in surface.estimates
        ]
    return [sensor.part, beside, surface, fits.friction_of(windows, sensor, z)], windows.cutoff


def _allow_for_counts(
    recording: Recording, parts: list[Part], cutoff: float, z: float, fit: Callable[[Recording], list[Part]]
) -> None:
    """Let intervals contain what the counts of encoders do to the estimates, which `fit` finds in a recording.

    Errors of counts follow the motion for many rows: they are no noise, and bias what is fitted. The motion below the
    cutoff, Hz, is counted anew from other beginnings, beside the same forces. By how much its estimates then differ
    from those without counts is how much those of the log are off. Of so few beginnings the mean square is uncertain
    itself: Student's quantile with their number allows for it, where the normal one would cover 89 % for 95.
    """
    size = motion.count_of(recording.positions)
    if not size.any():
        return
    smooth = motion.low_passed(motion.between_counts(recording.positions), cutoff, recording.step)
    draw = np.random.default_rng(0)
    counted = [motion.counted_from_elsewhere(smooth, size, draw) for _ in range(BEGINNINGS)]
    true, *read = (
        {e.name: e.value for part in fit(replace(recording, q=q)) for e in part.estimates} for q in (smooth, *counted)
    )
    for part in parts:
        for at, e in enumerate(part.estimates):
            off = np.array([found.get(e.name, np.nan) - true.get(e.name, np.nan) for found in read])
            off = off[~np.isnan(off)]
            if not e.why and len(off):
                sure = stats.t.ppf(stats.norm.cdf(z), len(off))
                half = float(np.hypot(0.5 * (e.high - e.low), sure * np.sqrt(np.mean(off**2))))
                part.estimates[at] = e._replace(low=e.value - half, high=e.value + half)
            elif not e.why:
                why = "the counts of the encoders are too coarse for this motion: move farther, or faster"
                part.estimates[at] = unknown(e.name, e.unit, why)


def contact_recording(run: Run, source: str = "the run") -> tuple[Recording, Array]:
    """Return the log of a run as its encoders and its sensor have it, with a force of three components, and the normal.

    The normal force is the sensor's reading; friction is that of the row.
    """
    normals = run.surface_normal
    if not run.scenario.has_surface or run.scenario.surface.kind != "plane" or np.ptp(normals, axis=0).max() > 0.0:
        raise LogError(f"{source}: its surface is not a plane at rest: contacts are identified on planes")
    q = run.measured_position if "measured_position" in run.specs else run.q
    force = run.measured_force[:, None] * normals + run.friction_force
    torque = None if "motor_position" in run.specs else np.array(run.torque)
    return Recording(np.array(run.time), np.array(q), torque, force, source), np.array(normals[0])
