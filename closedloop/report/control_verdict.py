"""Whether the controlled arm did what was commanded: the second verdict of a run, beside that of its numbers.

`closedloop.report.verdict` says whether the numbers can be trusted; this says whether the control is good. Force counts
while contact is commanded (`closedloop.report.control_signals`); with F, the root of the mean square of f_des there:

==================  ===========================================================================================
``stopped``         the simulation could not go on, so what was commanded was not done
``no_contact``      contact was commanded and never came
``lost_contact``    contact was commanded and had ended for good: free over the last `LOST_SHARE` of that time
``bouncing``        `BOUNCES` touchdowns and more in the later half of that time
``force_error``     f is far from f_des: RMS over the later half, or the mean of the last tenth
``not_settled``     the mean error of the last tenth is too large and still changes
``oscillation``     force or path swings regularly: growing, or a limit cycle
``path_error``      the tip is off its path along the surface
``unstable``        a gain of the law is negative: it drives the arm away from where it should be
``saturated``       a limit of `[drives]` cuts a joint's torque in a tenth of the rows and more
==================  ===========================================================================================

The later half leaves a run the first for its transients: an approach, the bounces of a touchdown, a break-away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
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
# A regular swing has so many periods, each so many rows long, and periods that vary by this share of their mean at
# most. The times between crossings of noise vary by as much as their mean.
PERIODS, ROWS_IN_PERIOD, IRREGULAR = 4, 4, 0.4
# Swings of the last third over those of the first: beyond this they grow, below its inverse they die away.
GROWTH = 1.5
# Force loops of arms swing with 1 to 30 Hz. Rows that a scheme of steps of its own leaves farther apart than this, s,
# show no swing of 25 Hz and more, or show it as a slow one; then nothing is said.
SPARSE = 0.01
# Three returns in the later half are no touchdown any more, which has its bounces at its start.
BOUNCES = 3
LOST_SHARE = 0.05
# RMS off the path, m or share of the path's extent: tools in contact are led to a millimetre.
PATH_FLOOR, PATH_SHARE = 1e-3, 0.02
SATURATED_SHARE = 0.1


class Signals(NamedTuple):
    """What the control of a run of N rows is judged by.

    Attributes
    ----------
    h : float
        Time between two rows, s.
    force, wanted : (N,) arrays
        f and f_des, N.
    touching : (N,) array of bool
        Whether the tip was in contact.
    commanded : (N,) array of bool
        Whether it was to be.
    approaching : bool
        Whether the path was still on its way to the surface at the end.
    off : (N, 3) array or None
        The tip less its path, along the surface, m; None where nothing leads the tip along it.
    tip : (N, 3) array
        The path, m.
    led : (N,) array of bool
        Where the path counts: not off the surface under a force that is to press, which moves the tip from its path.
    touchdowns : (E,) array
        When contact began, or the tip bounced, s.
    sparse : bool
        Whether there may be more between two rows than the rows show, see `SPARSE`.
    negative_gain : str
        A gain of the law that is negative, "" where none is.
    """

    h: float
    force: Array
    wanted: Array
    touching: Bools
    commanded: Bools
    approaching: bool
    off: Array | None
    tip: Array
    led: Bools
    touchdowns: Array
    sparse: bool
    negative_gain: str = ""


class Swing(NamedTuple):
    """A regular swing: median amplitude of its last third, period, s, first instant, s, and growth over the run."""

    amplitude: float
    period: float
    at: float
    growth: float


def judge_control(
    signals: Signals | None,
    limited: Mapping[str, tuple[float, float]],
    stopped: str | None = None,
) -> tuple[list[Problem], list[str]]:
    """Return what is wrong with the control, as `closedloop.report.verdict.judge` does, and what is not known.

    Parameters
    ----------
    signals : Signals or None
        None of a run without rows.
    limited : mapping of str to (float, float)
        By joint the share of the rows in which a limit of the drives cut its torque, and when first, s.
    stopped : str, optional
        Why the simulation could not go on.
    """
    problems = [_problem("stopped", f"what was commanded was not done: {stopped}")] if stopped else []
    unknown: list[str] = []
    if signals is not None:
        with np.errstate(all="ignore"):
            problems += _contact(signals, unknown) + _path(signals)
            if signals.negative_gain:
                text = f"{signals.negative_gain} is below 0: the feedback drives the arm away, however slowly"
                problems.append(_problem("unstable", text))
            if signals.sparse:
                unknown.append(f"oscillation: rows are {signals.h:g} s apart, steps are shorter")
    problems += [
        _problem(
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
    met = np.flatnonzero(s.touching & s.commanded)
    if not met.size:
        if s.approaching:
            unknown.append("contact: the path had not come to the surface at the end")
            return []
        return [_problem("no_contact", f"contact was commanded from {rows[0] * s.h:.4g} s on and never came",
                         rows[0] * s.h)]  # fmt: skip
    rows = rows[rows >= met[0]]
    problems = []
    last = rows[-max(1, int(np.ceil(LOST_SHARE * rows.size))) :]
    lost = not np.any(s.touching[last]) and rows.size > 1
    if lost:
        at = met[-1] * s.h
        share = 100 * LOST_SHARE
        problems.append(
            _problem("lost_contact", f"contact ended at {at:.4g} s though it was commanded until {rows[-1] * s.h:.4g} "
                     f"s: free over more than {share:g} % of that time", at)
        )  # fmt: skip
    later = rows[rows.size // 2 :]
    begin, end = later[0] * s.h, later[-1] * s.h
    count = np.count_nonzero((s.touchdowns > begin) & (s.touchdowns <= end))
    if count >= BOUNCES:
        at = float(s.touchdowns[s.touchdowns > begin][0])
        said = f"{count} touchdowns between {begin:.4g} and {end:.4g} s, {BOUNCES} and more are no touchdown any more"
        problems.append(_problem("bouncing", said, at))
    return problems if lost else problems + _force(s, rows, later)


def _force(s: Signals, rows: NDArray[np.int64], later: NDArray[np.int64]) -> list[Problem]:
    """Return what is wrong with the force in the rows in which contact is commanded, and in the later half of them."""
    miss = s.force - s.wanted
    scale = _rms(s.wanted[rows])
    off = np.abs(miss[later])
    if np.max(off) <= MEAN_SHARE * scale:
        return []
    problems = []
    tenth = max(1, rows.size // 10)
    mean = float(np.mean(miss[rows[-tenth:]]))
    before = float(np.mean(miss[rows[-2 * tenth : -tenth]])) if rows.size >= 2 * tenth else mean
    rms, worst = _rms(miss[later]), int(later[np.argmax(off)])
    if not abs(mean) <= MEAN_SHARE * scale and abs(mean - before) > STILL_CHANGING * abs(mean):
        text = f"f is {mean:+.3g} N off on average at the end, more than {MEAN_SHARE * scale:.3g} N, and still changes"
        problems.append(_problem("not_settled", text, rows[-tenth] * s.h))
    elif not abs(mean) <= MEAN_SHARE * scale:
        text = f"f is {mean:+.3g} N off on average at the end, more than {MEAN_SHARE * scale:.3g} N"
        problems.append(_problem("force_error", text, rows[-tenth] * s.h))
    if not rms <= RMS_SHARE * scale:
        text = f"{rms:.3g} N RMS, more than {RMS_SHARE * scale:.3g} N; most, {off.max():.3g} N, at {worst * s.h:.4g} s"
        problems.append(_problem("force_error", text, worst * s.h))
    if not s.sparse:
        problems += _swinging(regular_swing(miss[later], SWING_SHARE * scale, s.h, later[0] * s.h), "force", "N")
    return problems


def _path(s: Signals) -> list[Problem]:
    """Return what is wrong with the motion along the surface."""
    if s.off is None:
        return []
    square = np.einsum("ij,ij->i", s.off, s.off) * s.led
    if np.max(square) <= (0.5 * PATH_FLOOR) ** 2 or not np.any(s.led):
        return []  # neither RMS nor a swing can reach its bound
    extent = float(np.max(np.linalg.norm(s.tip - s.tip[0], axis=1)))
    bound = max(PATH_FLOOR, PATH_SHARE * extent)
    problems, rms = [], float(np.sqrt(np.sum(square) / np.count_nonzero(s.led)))
    if not rms <= bound:
        worst = int(np.argmax(square))
        text = f"{rms:.3g} m RMS along the surface, more than {bound:.2g} m; most, {np.sqrt(square[worst]):.3g} m"
        problems.append(_problem("path_error", text, worst * s.h))
    if not s.sparse:
        half = len(s.off) // 2
        part = s.off[half:] * s.led[half:, None]
        most = int(np.argmax(np.var(part, axis=0)))
        problems += _swinging(regular_swing(part[:, most], 0.5 * bound, s.h, half * s.h), "path", "m")
    return problems


def _swinging(swing: Swing | None, what: str, unit: str) -> list[Problem]:
    if swing is None:
        return []
    kind = "grows" if swing.growth > GROWTH else "is a limit cycle"
    text = (
        f"the {what} swings by ±{swing.amplitude:.3g} {unit} with {1.0 / swing.period:.3g} Hz, which {kind}: "
        f"{swing.growth:.3g} times as much in the last third as in the first"
    )
    return [_problem("oscillation", text, swing.at)]


def regular_swing(x: Array, bound: float, h: float, begin: float) -> Swing | None:
    """Return the swing of a signal (N,), `h` s apart from `begin` on, that lasts beyond ±`bound`; None without one.

    What counts is a period from one rise through the middle to the next, each with an excursion to both sides between
    of more than half the bound and half the RMS; the last third of them must reach the bound, and all must last
    about equally long.
    """
    if len(x) < PERIODS * ROWS_IN_PERIOD or not np.all(np.isfinite(x)):
        return None
    k = np.arange(len(x), dtype=float) - 0.5 * (len(x) - 1)
    y = x - np.mean(x) - k * (np.dot(k, x) / np.dot(k, k))  # a drift is no swing
    level = 0.5 * max(bound, _rms(y))  # noise on a large swing does not pass the middle twice
    side = np.where(y > level, 1, np.where(y < -level, -1, 0))
    there = np.flatnonzero(side)
    if there.size < 2 * PERIODS:
        return None
    rises = there[1:][(side[there][1:] > 0) & (side[there][:-1] < 0)]
    if rises.size < PERIODS + 1:
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
    return Swing(last, period * h, begin + rises[0] * h, growth)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x * x)))


def _problem(name: str, text: str, at: float | None = None) -> Problem:
    return {"name": name, "at": None if at is None else float(at), "text": text}


def unknown_text(unknown: Sequence[str]) -> str:
    """Return what is not known as an addition to the line of the verdict, or an empty string."""
    return f"; not known: {', '.join(unknown)}" if unknown else ""
