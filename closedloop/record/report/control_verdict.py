"""The second verdict of a run: whether the controlled arm did what was commanded, and by which signals.

`closedloop.record.report.verdict` says whether the numbers can be trusted; this says whether the control is good. Force
counts while contact is commanded; with F, the root of the mean square of f_des there:

==================  ===========================================================================================
``stopped``         the simulation could not go on, so what was commanded was not done
``no_contact``      contact was commanded and never came
``lost_contact``    contact was commanded and given up: free over the last `LOST_SHARE` of that time, or at any time
                    for `FREE_SHARE` of it at a stretch
``bouncing``        `BOUNCES` touchdowns and more in the later half of that time; or free for so long after an impact
``force_error``     f is far from f_des: RMS over the later half, or the mean of the last tenth
``not_settled``     the mean error of the last tenth is too large and still changes
``oscillation``     force or path swings regularly: growing over all of that time, or a limit cycle in its later half;
                    noise, drifts and decaying oscillations are no regular swings
``path_error``      the tip is off its path along the surface
``unstable``        a gain of the law is negative: it drives the arm away from where it should be
``saturated``       a limit of `[drives]` cuts a joint's torque in a tenth of the rows and more
==================  ===========================================================================================

The later half leaves a run the first for its transients: an approach, the bounces of a touchdown, a break-away.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array, Mask
from closedloop.base.families import is_users
from closedloop.loop.events.table import IMPACT, TOUCHDOWN
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.columns.record import Record
from closedloop.record.report.verdict import names_of, problem_of
from closedloop.scenario.scenario import Scenario

# A regular swing has so many periods, each so many rows long, and periods that vary by this share of their mean at
# most. The times between crossings of noise vary by as much as their mean.
PERIODS, ROWS_IN_PERIOD, IRREGULAR = 4, 4, 0.4
# A swing that grows is no transient, wherever it began: in a slow one three periods over all the time tell. Two show
# that there may be one.
GROWING_PERIODS, LEAST_PERIODS = 3, 2
# So many means of neighbouring rows show a swing that is too slow for the later half alone: of eight periods at most.
SLOW_ROWS = 512
# Swings of the last third over those of the first: beyond this they grow, below its inverse they die away.
GROWTH = 1.5


class Swing(NamedTuple):
    """A regular swing: median amplitude of its last third, period, s, first instant, s, growth, number of periods."""

    amplitude: float
    period: float
    at: float
    growth: float
    periods: int

    @property
    def known(self) -> bool:
        """Whether there are enough periods to tell it from a transient."""
        return self.periods >= (GROWING_PERIODS if self.growth > GROWTH else PERIODS)


def lasting_swing(x: Array, bound: float, h: float, begin: float) -> Swing | None:
    """Return the regular swing in the later half of a signal (N,), or one over all of it, which may be too short."""
    half = len(x) // 2
    found = regular_swing(x[half:], bound, h, begin + half * h)
    if found is None:
        k = max(1, len(x) // SLOW_ROWS)
        slow = x[: len(x) // k * k].reshape(-1, k) @ np.full(k, 1.0 / k) if k > 1 else x
        found = regular_swing(slow, bound, k * h, begin, LEAST_PERIODS)
    return found


def regular_swing(x: Array, bound: float, h: float, begin: float, periods: int = PERIODS) -> Swing | None:
    """Return the swing of a signal (N,), `h` s apart, of `periods` and more beyond ±`bound`; None without one.

    What counts is a period from one rise through the middle to the next, each with an excursion to both sides between
    of more than half the bound and half the RMS; the last third of them must reach the bound, and all must last
    about equally long.
    """
    if len(x) < periods * ROWS_IN_PERIOD:
        return None
    k, middle = np.arange(len(x)) - 0.5 * (len(x) - 1), float(np.add.reduce(x)) / len(x)
    slope = float(np.dot(k, x)) / (len(x) * (len(x) ** 2 - 1.0) / 12.0)  # a drift is no swing
    # Without the work below: in each period the signal less its drift is beyond half the bound on both sides.
    level = 0.5 * bound - abs(middle) - 0.5 * len(x) * abs(slope)
    if level > 0.0 and min(np.count_nonzero(x > level), np.count_nonzero(x < -level)) < periods:
        return None
    y = x - middle - k * slope
    level = 0.5 * max(bound, rms(y))  # noise on a large swing does not pass the middle twice
    if not np.max(y) - np.min(y) > 2.0 * bound:
        return None  # nor where it is not finite
    there = np.flatnonzero(np.abs(y) > level)
    above = y[there] > 0.0
    rises = there[1:][above[1:] & ~above[:-1]]
    if rises.size < periods + 1:
        return None
    lengths = np.diff(rises)
    period = float(np.mean(lengths))
    if period < ROWS_IN_PERIOD or np.std(lengths) > IRREGULAR * period:
        return None
    swings = 0.5 * (np.maximum.reduceat(y[: rises[-1]], rises[:-1]) - np.minimum.reduceat(y[: rises[-1]], rises[:-1]))
    third = max(1, swings.size // 3)
    first, last = float(np.median(swings[:third])), float(np.median(swings[-third:]))
    ended = (len(x) - rises[-1]) > max(2.0 * period, 0.25 * len(x))
    growth = last / first
    if last <= bound or growth < 1.0 / GROWTH or ended:
        return None
    return Swing(last, period * h, begin + rises[0] * h, growth, lengths.size)


def rms(x: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(x * x)))


Problem = dict[str, Any]

# A tenth of the force, RMS: tools that polish and grind are sold with ±1 N of 10 N. Shipped scenarios whose control is
# good have 0.03 at most in the later half, those whose subject is bad control 0.13 and more.
RMS_SHARE = 0.1
# The mean of the last tenth: 5 %, the wider of the two usual settling bands. A mean, so that noise does not count.
MEAN_SHARE = 0.05
# An error that shrinks or grows by more than this share from one tenth of the time to the next has not settled.
STILL_CHANGING = 0.2
# Swings count beyond the settling band; of the path, beyond half of what its error may be.
SWING_SHARE = 0.05
# Force loops of arms swing with 1 to 30 Hz. Rows that a scheme of steps of its own leaves farther apart than this, s,
# show no swing of 25 Hz and more, or show it as a slow one; then nothing is said.
SPARSE = 0.01
# Three returns in the later half do not belong to a touchdown, which bounces at its start.
BOUNCES = 3
# With fewer rows a path has no direction in which it varies most.
LEAST_ROWS = 8
# The tip is off for good where it is off at the end; a flight of a fifth of the time is more than the bounce of a
# touchdown: those of wam_bounce, from 50 mm with a restitution of 0.7, take 0.07 each.
LOST_SHARE, FREE_SHARE = 0.05, 0.2
# RMS off the path, m or share of the path's extent: tools in contact are led to a millimetre.
PATH_FLOOR, PATH_SHARE = 1e-3, 0.02
SATURATED_SHARE = 0.1


class Signals(NamedTuple):
    """What the control of a run of N rows is judged by."""

    h: float  # time between two rows, s
    # force, wanted (N,): f and f_des, N
    force: Array
    wanted: Array
    touching: Mask  # (N,): whether the tip was in contact
    commanded: Mask  # (N,): whether it was to be
    approaching: bool  # whether the path was still on its way to the surface at the end
    off: Array | None  # (N, 3): the tip less its path, along the surface, m; None where nothing leads the tip along it
    tip: Array  # (N, 3): the path, m
    # (N,): where the path counts: not off the surface under a force that is to press, which moves the tip from its path
    led: Mask
    touchdowns: Array  # (E,): when contact began, or the tip bounced, s
    sparse: bool  # whether there may be more between two rows than the rows show, see `SPARSE`
    negative_gain: str = ""  # a gain of the law that is negative, "" where none is


def judge_control(
    signals: Signals | None, limited: Mapping[str, tuple[float, float]], stopped: str | None = None
) -> tuple[list[Problem], list[str]]:
    """Return what is wrong with the control, as `closedloop.record.report.verdict.judge` does, and what is not known.

    `limited`: by joint the share of the rows in which a limit of the drives cut its torque, and when first, s.
    """
    problems = [problem_of("stopped", f"what was commanded was not done: {stopped}")] if stopped else []
    unknown: list[str] = []
    if signals is not None:
        with np.errstate(all="ignore"):
            problems += _contact(signals, unknown) + _path(signals, unknown)
            if signals.negative_gain:
                text = f"{signals.negative_gain} is below 0: the feedback has the wrong sign"
                problems.append(problem_of("unstable", text))
            if signals.sparse:
                unknown.append(f"oscillation: rows are {signals.h:g} s apart, steps are shorter")
    problems += [
        problem_of(
            "saturated", f"a limit of [drives] cuts the torque of joint {name} in {100 * share:.3g} % of the rows, "
            f"more than {100 * SATURATED_SHARE:g} %", at,
        )
        for name, (share, at) in limited.items()
        if share > SATURATED_SHARE
    ]  # fmt: skip
    return problems, unknown


def _contact(s: Signals, unknown: list[str]) -> list[Problem]:
    """Return what is wrong with the contact and its force."""
    rows = np.flatnonzero(s.commanded)
    if not rows.size:
        return []
    met = rows if np.all(s.touching) else np.flatnonzero(s.touching & s.commanded)
    struck = s.touchdowns[s.commanded[np.minimum((s.touchdowns / s.h).astype(int), len(s.commanded) - 1)]]
    if not met.size and not struck.size:
        if s.approaching:
            unknown.append("contact: the path had not reached the surface at the end")
            return []
        at = rows[0] * s.h
        return [problem_of("no_contact", f"contact was commanded from {at:.4g} s on and did not occur", at)]
    first = min([*met[:1], *np.ceil(struck[:1] / s.h).astype(int)])  # an impact leaves no row in contact
    rows = rows[min(int(np.searchsorted(rows, first)), rows.size - 1) :]
    free, lost = _longest_free(s, rows)
    problems = [free] if free else []
    later = rows[rows.size // 2 :]
    begin, end = later[0] * s.h, later[-1] * s.h
    count = np.count_nonzero((s.touchdowns > begin) & (s.touchdowns <= end))
    if count >= BOUNCES:
        at = float(s.touchdowns[s.touchdowns > begin][0])
        said = f"{count} touchdowns between {begin:.4g} and {end:.4g} s, at most {BOUNCES - 1} belong to a touchdown"
        problems = [each for each in problems if each["name"] != "bouncing"] + [problem_of("bouncing", said, at)]
    if lost:
        return problems
    # Of rows without a gap a view, as it is in most runs.
    part = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] + 1 == rows.size else rows
    miss = s.force[part] - s.wanted[part]
    return problems + judge_force(miss, rms(s.wanted[part]), s.h, rows, unknown, s.sparse)


def _longest_free(s: Signals, rows: NDArray[np.int64]) -> tuple[Problem | None, bool]:
    """Return what is wrong where the tip is off the surface for long, and whether it is off at the end."""
    free = ~s.touching[rows]
    if not np.any(free) or rows.size < 2:
        return None, False
    # A touchdown between two rows ends a flight, though no row is in contact.
    bounds = np.union1d(np.flatnonzero(~free), np.searchsorted(rows, s.touchdowns / s.h))
    bounds = np.concatenate([[-1], bounds[bounds < rows.size], [rows.size]])
    flights = np.diff(bounds)
    k, share = int(np.argmax(flights)), float(np.max(flights) - 1) / rows.size
    last = LOST_SHARE * rows.size
    lost = flights[-1] - 1 >= last and not np.any(s.touching[rows[-max(1, int(np.ceil(last))) :]])
    if lost:
        k, share = len(flights) - 1, float(flights[-1] - 1) / rows.size
    bound = LOST_SHARE if lost else FREE_SHARE
    if not lost and share <= bound:
        return None, False
    begin, end = rows[max(bounds[k], 0)] * s.h, rows[min(bounds[k + 1], rows.size - 1)] * s.h
    text = f"off the surface from {begin:.4g} to {end:.4g} s, {100 * share:.3g} % of the time commanded, more than "
    text += f"{100 * bound:g} %" + (" at the end" if lost else "")
    if bounds[k] >= 0 and free[bounds[k]]:  # it left in an impact, not in a liftoff
        return problem_of("bouncing", f"after an impact {text}", begin), lost
    return problem_of("lost_contact", text, begin), lost


def judge_force(
    miss: Array, scale: float, h: float, rows: NDArray[np.int64], unknown: list[str], sparse: bool = False
) -> list[Problem]:
    """Return what is wrong with the force while contact is commanded, above all in the later half of that time.

    `miss` (R,): f − f_des, N, while contact is commanded.
    `scale`: F, N.
    `h`: time between two rows, s.
    `rows` (R,): which rows of the run these are.
    `unknown`: what is not known is added.
    `sparse`: see `Signals`.
    """
    late = miss[rows.size // 2 :]
    off = max(float(late.max()), -float(late.min()))
    if off <= MEAN_SHARE * scale:
        return []
    problems = []
    tenth = max(1, rows.size // 10)
    mean = float(np.mean(miss[-tenth:]))
    if not abs(mean) <= MEAN_SHARE * scale:
        before = float(np.mean(miss[-2 * tenth : -tenth])) if rows.size >= 2 * tenth else mean
        changes = abs(mean - before) > STILL_CHANGING * abs(mean)
        text = f"f is {mean:+.3g} N off on average at the end, more than {MEAN_SHARE * scale:.3g} N"
        text, name = (f"{text}, and still changes", "not_settled") if changes else (text, "force_error")
        problems.append(problem_of(name, text, rows[-tenth] * h))
    error = math.sqrt(np.dot(late, late) / late.size)
    if not error <= RMS_SHARE * scale:
        at = rows[rows.size // 2 + int(np.argmax(np.abs(late)))] * h
        text = f"{error:.3g} N RMS, more than {RMS_SHARE * scale:.3g} N; most, {off:.3g} N, at {at:.4g} s"
        problems.append(problem_of("force_error", text, at))
    if not sparse:
        problems += _swinging(lasting_swing(miss, SWING_SHARE * scale, h, rows[0] * h), "force", "N", unknown)
    return problems


def _path(s: Signals, unknown: list[str]) -> list[Problem]:
    """Return what is wrong with the motion along the surface."""
    if s.off is None:
        return []
    square = np.einsum("ij,ij->i", s.off, s.off) * s.led
    if np.max(square) <= (0.5 * PATH_FLOOR) ** 2 or not np.any(s.led):
        return []  # neither RMS nor a swing can reach its bound
    bound = max(PATH_FLOOR, PATH_SHARE * float(np.max(np.linalg.norm(s.tip - s.tip[0], axis=1))))
    problems, error = [], float(np.sqrt(np.sum(square) / np.count_nonzero(s.led)))
    if not error <= bound:
        worst = int(np.argmax(square))
        text = f"{error:.3g} m RMS along the surface, more than {bound:.2g} m; most, {np.sqrt(square[worst]):.3g} m"
        problems.append(problem_of("path_error", text, worst * s.h))
    if not s.sparse and len(square) >= LEAST_ROWS:
        part = s.off * s.led[:, None]
        along = np.linalg.eigh(np.cov(part[len(part) // 2 :], rowvar=False))[1][:, -1]  # where it varies most
        problems += _swinging(lasting_swing(part @ along, 0.5 * bound, s.h, 0.0), "path", "m", unknown)
    return problems


def _swinging(swing: Swing | None, what: str, unit: str, unknown: list[str]) -> list[Problem]:
    if swing is None:
        return []
    text = f"the {what} swings by ±{swing.amplitude:.3g} {unit} with {1.0 / swing.period:.3g} Hz"
    if not swing.known:
        unknown.append(f"oscillation: {text}, and {swing.periods} periods are too few: take a longer run")
        return []
    kind = "grows" if swing.growth > GROWTH else "is a limit cycle"
    text += f", which {kind}: {swing.growth:.3g} times as much in the last third as in the first"
    return [problem_of("oscillation", text, swing.at)]


def told(facts: Mapping[str, Any]) -> str:
    """Return the verdict of the control of a summary as a cell of a table: names of problems, and what is not known."""
    control = facts["control_verdict"]
    return names_of(control["problems"]) + unknown_text(control["not_known"])


def unknown_text(unknown: Sequence[str]) -> str:
    """Return what is not known as an addition to the line of the verdict, or an empty string."""
    return f"; not known: {', '.join(unknown)}" if unknown else ""


# A path leads off the surface where it lies so much farther from it than it did, m: what the stiffness of an arm's law,
# some 1e4 N/m, turns into a tenth of a newton.
RELEASE = 1e-5
# Gains of the laws that ship with which they lead the tip along its path.
_LEADS = ("kp", "motion_stiffness", "stiffness")
_FEEDBACK = (*_LEADS, "kd", "motion_damping", "damping", "force_feedback", "force_integral")


def follows_path(scenario: Scenario, own_law: bool = False) -> bool:
    """Whether something leads the tip along the path: a gain of the law; of a law of one's own, a path that moves."""
    if own_law or is_users(scenario.law):
        return scenario.reference.kind != "hold"
    return any(np.any(np.asarray(getattr(scenario.law, name, 0.0)) != 0.0) for name in _LEADS)


def negative_gain(scenario: Scenario) -> str:
    """Return the key of a gain of a law that ships which is below zero, "" if none is."""
    if is_users(scenario.law):
        return ""
    said = vars(scenario.law)
    return next((f"law.{name}" for name in _FEEDBACK if _below(said.get(name))), "")


def _below(gain: Any) -> bool:
    """Whether a gain, or one of several, is below zero; without numpy, for batches ask it of every run."""
    if isinstance(gain, tuple):
        return len(gain) > 0 and min(gain) < 0.0
    return gain is not None and gain < 0.0


def run_signals(run: Record) -> Signals | None:
    """Return the signals of a run; None if it has no rows."""
    if not len(run):
        return None
    off = run.position - run.reference_tip
    out = np.einsum("ij,ij->i", off, run.surface_normal)
    off = off - out[:, None] * run.surface_normal
    began = run.event_time[np.isin(run.event_kind, (IMPACT, TOUCHDOWN))]
    return signals_of(
        run.scenario, run.scenario.time.step, run.contact_force, run.reference_force, run.mode != FREE,
        (off, run.closure_error - out, run.reference_tip), began, run.law != "scenario",
    )  # fmt: skip


def signals_of(
    scenario: Scenario, h: float, force: Array, wanted: Array, touching: Mask, path: tuple[Array, Array, Array],
    touchdowns: Array, own_law: bool = False,
) -> Signals:  # fmt: skip
    """Return the signals of N rows.

    Contact is commanded where f_des > 0 (on a surface that can pull, where f_des is not zero), but for where the
    paper's law is led off the surface again by its path: by more than `RELEASE` from where it was nearest until
    then. Without a surface, and where links have contacts and the tip never had one, nothing is commanded of the tip:
    its force moves the arm.

    `h`: time between two rows, s.
    `force`, `wanted`, `touching`, (N,) arrays: f, f_des, N, and whether in contact.
    `path`, (N, 3), (N,) and (N, 3) arrays: the tip less its path, along the surface; how far off the surface the path
        is; the path; m.
    `touchdowns` (E,): when contact began or the tip bounced, s.
    `own_law`: whether the law is a function, and not the scenario's.
    """
    off, gap, tip = path
    led = follows_path(scenario, own_law)
    one_sided = scenario.surface.contact == "unilateral"
    commanded = wanted > 0.0 if one_sided else wanted != 0.0
    approaching = False
    if one_sided and led and (own_law or is_users(scenario.law) or scenario.law.kind == "paper"):
        nearest = np.minimum.accumulate(gap)
        commanded = commanded & (gap <= nearest + RELEASE)
        tenth = min(max(1, len(gap) // 10), len(gap) - 1)
        approaching = bool(gap[-1] > RELEASE and nearest[-1] < nearest[-1 - tenth])
    if scenario.contact and not np.any(touching):
        commanded, led = np.zeros(len(force), dtype=bool), led and not scenario.contact
    sparse = scenario.time.integrator in ADAPTIVE and h > SPARSE
    return Signals(
        h, force, wanted, touching, commanded, approaching, off if led else None, tip, touching | (wanted == 0.0),
        touchdowns, sparse, "" if own_law else negative_gain(scenario),
    )  # fmt: skip


def limited_joints(names: Any, share: Any, at: Any) -> dict[str, tuple[float, float]]:
    """Return by joint how often a limit of the drives cut its torque, and when first, s."""
    return {name: (float(s), float(t)) for name, s, t in zip(names, share, at, strict=True)}
