"""A page about a force loop: what a display shows at once, and figures of its transfer, poles and stability.

Bode and Nyquist of the transfer, the sensitivity, the locus of the poles and a map are drawn on axes of the user's own
with `ax`, see `closedloop.figures`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array, ComplexArray, plain
from closedloop.base.errors import ClosedLoopError
from closedloop.figures.files import IMAGES, write_figure
from closedloop.figures.style import COLOURS, MANY, legend_beside_title, new_figure, panels, styled
from closedloop.scenario.messages import key_unit, with_unit
from closedloop.scenario.scenario import Scenario
from closedloop.studies.analysis.linear_loop import LinearLoop, Margins, Pole
from closedloop.studies.analysis.stability import Limit, Range, Stability, Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Up to how many times their value gains and stiffnesses are looked for limits, and at how many values.
MOST_GAIN, MOST_STIFFNESS, LOOKS = 1e3, 1e4, 13
# The longest delay that is tried, in samples.
MOST_DELAY = 512
# Gains of the force loop, and what their limits are called.
GAINS = {"law.force_integral": "1/s", "law.force_feedback": "", "compensation.rate": "1/s"}
# The poles that a table shows.
SHOWN_POLES = 6


@dataclass
class Page:
    """What is known of a force loop."""

    loop: LinearLoop
    margins: dict[str, Margins]  # by where the loop is cut
    limits: dict[str, Limit | str] = field(default_factory=dict)  # largest stable values by key, or why none was found
    # the longest stable `sensor.delay` of those tried, s; infinite if all are; None if the law reads no force
    delay: float | None = None
    tried: float = math.inf  # the longest that was tried, s

    @property
    def weakest(self) -> Margins:
        """The margins at the sensor, if the law reads it, else those at the torque whose modulus margin is least."""
        sensor = self.margins["sensor"]
        return sensor if sensor.closed else min(self.margins.values(), key=lambda one: one.modulus)

    def sentence(self) -> str:
        """Return the verdict in one sentence."""
        loop = self.loop
        if not loop.stable:
            pole = next(pole for pole in loop.poles() if pole.grows)
            how = f"oscillates at {pole.frequency:.3g} Hz and " if abs(pole.s.imag) > 1e-9 * abs(pole.s) else ""
            fed_back = any(one.closed for one in self.margins.values())
            what = f"a mode, mostly of the {pole.part}," if fed_back else "a motion that nothing controls"
            grows = f"unstable: {what} {how}grows with exp({pole.s.real:.3g} t)"
            ways = [
                f"{name} {'below' if limit.upwards else 'above'} {limit.value:.3g} makes it stable"
                for name, limit in self._limits()
            ]
            return "; ".join([grows, *ways])
        margins = self.weakest
        if not margins.closed:
            return "stable; nothing is fed back"
        decibels = "no gain" if math.isinf(margins.decibels) else f"{margins.decibels:.1f} dB"
        degrees = "no phase lag" if math.isinf(margins.phase) else f"{margins.phase:.0f}°"
        far = f"{decibels} and {degrees} from instability"
        if margins.decibels == math.inf and margins.phase == math.inf:
            far = "no gain and no phase lag makes it unstable"
        where = "" if margins.cut == "sensor" else f"the law reads no force; at {margins.cut} "
        said = [f"stable; {where}{far}"]
        for name, limit in self._limits():
            if limit.upwards and name == "compliance.stiffness":
                said.append(f"a surface stiffer than {limit.value:.3g} N/m makes it unstable")
            elif limit.upwards:
                least = f"{limit.value:.3g} {GAINS.get(name, '')}".rstrip()
                said.append(f"{name} above {least} makes it unstable")
        return "; ".join(said)

    def _limits(self) -> list[tuple[str, Limit]]:
        return [(name, limit) for name, limit in self.limits.items() if isinstance(limit, Limit)]

    def lines(self) -> list[str]:
        """Return the page as lines of text."""
        loop = self.loop
        found = [self.sentence(), ""]
        kind = "soft" if loop.soft else "rigid"
        mode = {0: "free", 1: "pressed", 2: "stuck"}[loop.mode]
        at = f"{kind} surface, tip {mode}" if loop.mode else f"tip {mode}"
        found.append(f"t = {loop.time:g} s, {at}; {len(loop.states)} states, every {loop.dt:g} s")
        wide = max(22, *map(len, self.margins))
        found += ["", f"{'cut at':{wide}}{'gain':>10}{'phase':>10}{'delay':>12}{'modulus':>10}{'max |S|':>10}"]
        for name, one in self.margins.items():
            if not one.closed:
                found.append(f"{name:{wide}}{'nothing is fed back':>20}")
                continue
            gain = "any" if math.isinf(one.decibels) else f"{one.decibels:.1f} dB"
            phase = "any" if math.isinf(one.phase) else f"{one.phase:.0f}°"
            delay = "any" if math.isinf(one.delay) else f"{1e3 * one.delay:.3g} ms"
            size = f"{one.modulus:>10.3f}{one.peak_sensitivity:>10.2f}"
            found.append(f"{name:{wide}}{gain:>10}{phase:>10}{delay:>12}{size}")
        shown = [pole for pole in loop.poles() if pole.s.imag >= 0.0 and not pole.at_rest][:SHOWN_POLES]
        if shown:
            found += ["", f"{'pole, 1/s':28}{'Hz':>9}{'damping':>9}  belongs to"]
        for pole in shown:
            parts = sorted(pole.participation.items(), key=lambda item: -item[1])
            belongs = ", ".join(f"{name} {100 * share:.0f} %" for name, share in parts if share >= 0.05)
            if math.isinf(pole.s.real):
                text = "over at once"
                found.append(f"{text:28}{'':>9}{'':>9}  {belongs}")
                continue
            text = f"{pole.s.real:.4g}" + (f" ± {pole.s.imag:.4g}i" if pole.s.imag > 0.0 else "")
            found.append(f"{text:28}{pole.frequency:>9.3g}{pole.damping:>9.3f}  {belongs}")
        rest = sum(pole.at_rest for pole in loop.poles())
        if rest:
            found.append(f"{rest} more neither grow nor decay: friction blocks these motions, or no gain acts on them")
        if loop.mode == 0:
            found += ["", "the tip touches nothing: f has no bandwidth, and there is no port"]
        else:
            band, port = loop.bandwidth(), loop.port()
            beyond = f"beyond {0.5 / loop.dt:.3g} Hz, half of the sampling rate"
            found += ["", f"bandwidth of the command: {f'{band:.3g} Hz' if math.isfinite(band) else beyond}"]
            active = f"not passive, most active at {port.active_at:.3g} Hz" if not port.passive else ""
            found.append(f"port: {active or 'passive, so stable on every passive surface'}")
        for name, limit in self.limits.items():
            if isinstance(limit, str):
                found.append(f"{name}: {limit}")
            else:
                side = "largest" if limit.upwards else "smallest"
                found.append(f"{name}: {side} stable value {limit.value:.6g}, then {limit.pole.frequency:.3g} Hz")
        if self.delay is not None:
            longest = f"longest stable value {self.delay:.4g} s"
            found.append(f"sensor.delay: {f'no limit up to {self.tried:.3g} s' if math.isinf(self.delay) else longest}")
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the page as plain values, for JSON: what is infinite, or not known, is None."""
        loop, port = self.loop, self.loop.port()
        band = loop.bandwidth() if loop.mode else math.inf
        return plain({
            "sentence": self.sentence(), "time": loop.time, "dt": loop.dt, "stable": loop.stable,
            "states": loop.states,
            "poles": [pole.as_dict() for pole in loop.poles()],
            "margins": {name: one.as_dict() for name, one in self.margins.items()},
            "bandwidth": band,
            "passive": port.passive if loop.mode else None, "active_at": port.active_at if loop.mode else None,
            "limits": {k: v if isinstance(v, str) else v.as_dict() for k, v in self.limits.items()},
            "longest_delay": self.delay,
        })  # fmt: skip


def trial_line(trial: Trial) -> str:
    """Return one line about whole runs beside the boundary."""
    values = ", ".join(f"{key} = {value:.4g}" for key, value in trial.values.items())
    if math.isinf(trial.seen) and trial.seen > 0.0:
        seen = "a whole run from there on stops"
    else:
        seen = f"two neighbouring runs diverge with exp({trial.seen:+.3g} t)"
    verdict = "" if trial.agrees else ": the two DISAGREE"
    return f"  {values}: linear exp({trial.expected:+.3g} t), {seen}{verdict}"


def page_of(study: Stability, limits: bool = True) -> Page:
    """Return the page of a loop; `limits`: whether the largest stable gains, stiffness and delay are solved for."""
    loop = study.base
    cuts = ["sensor", *(each.name for each in loop.inputs if each.name.startswith("torque["))]
    margins = {cut: loop.margins(cut) for cut in cuts}  # of joints without a drive nothing is fed back
    page = Page(loop, {cut: each for cut, each in margins.items() if each.closed or cut == "sensor"})
    if limits:
        page.limits = _limits_of(study)
        if page.margins["sensor"].closed and loop.stable:
            page.delay, page.tried = _longest_delay(study)
    return page


def _limits_of(study: Stability) -> dict[str, Limit | str]:
    scenario, stable = study.scenario, study.base.stable
    found: dict[str, Limit | str] = {}
    for key in (*GAINS, *(("compliance.stiffness",) if study.base.soft else ())):
        section, _, name = key.partition(".")
        value = getattr(getattr(scenario, section), name, 0.0)
        if not isinstance(value, float | int) or value <= 0.0:
            continue
        most = MOST_GAIN if key in GAINS else MOST_STIFFNESS
        end = value * most if stable else value / most
        over = Range(key, value, end, log=True)
        try:
            limits, refused = study.limits(over, looks=LOOKS)
        except ClosedLoopError as error:
            found[key] = str(error)
            continue
        if limits:
            found[key] = limits[0]
        elif refused:
            found[key] = (
                f"{'stable' if stable else 'unstable'} at all values that can be run; others are refused: {refused}"
            )
        else:
            found[key] = f"no limit {'up' if stable else 'down'} to {end:.3g} {key_unit(key)}".rstrip()
    return found


def _longest_delay(study: Stability) -> tuple[float, float]:
    """Return the longest stable delay in whole samples, s, infinite if all are, and the longest that was tried."""
    period = study.scenario.law.sample_period or study.scenario.time.step
    h = study.scenario.time.step
    start = round(study.scenario.sensor.delay / h)

    def stable(samples: int) -> bool:
        try:
            return study.growth({"sensor.delay": samples * h}) < 0.0
        except ClosedLoopError:
            return False

    step = max(1, round(period / h))
    low, high = start, start + step
    while stable(high):
        low, high = high, start + 2 * (high - start)
        if high > start + MOST_DELAY * step:
            return math.inf, low * h
    while high - low > step:
        middle = low + (high - low) // (2 * step) * step
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low * h, high * h


@dataclass(frozen=True, eq=False)
class Overview:
    """A force loop at an instant, as a sentence and as arrays to draw.

    `sentence`: whether it is stable, and how far from instability, or what grows and how fast.
    `time`: the instant, s: the sample of the law nearest to the one asked for.
    `poles`, (k,) tuple of Pole: the slowest to decay first. Of each `z`, `s`, `frequency`, `damping`, `part` and
        `participation`.
    `margins`: where the loop is cut, `margins.cut`: at the sensor, or of a law that reads no force at the torque where
        the modulus margin is least.
    `frequency` (m,): of the curves, Hz, rising, up to half of the sampling rate.
    `transfer`, (m,) array of complex: L where the loop is cut: real and imaginary part are Nyquist's diagram.
    `gain`, `phase`, (m,) arrays: |L|, dB, at least −240, and the angle of L without jumps, degrees: Bode's diagram.
    `sensitivity` (m,): |1/(1 + L)|.
    `loop`: all else of it: `loop.response(...)`, `loop.port()`.
    """

    sentence: str
    stable: bool
    time: float
    poles: tuple[Pole, ...]
    margins: Margins
    frequency: Array
    transfer: ComplexArray
    gain: Array
    phase: Array
    sensitivity: Array
    loop: LinearLoop


def overview(loop: LinearLoop) -> Overview:
    """Return the sentence, margins, poles and Bode's curves of a loop, from `linearise`.

    With compiled kernels both take 5 µs for each step of the run up to the instant, and some 25 ms for the loop and its
    margins, 40 ms for one that is cut at its torques. Interpreted, as before the kernels are compiled, it is 0.3 ms a
    step.
    """
    margins = {"sensor": loop.margins("sensor")}
    if not margins["sensor"].closed:
        torques = [each.name for each in loop.inputs if each.name.startswith("torque[")]
        margins |= {cut: loop.margins(cut) for cut in torques}
    page = Page(loop, margins)
    weakest = page.weakest
    f = loop.grid
    L = loop.loop_transfer(f, weakest.cut)
    size = 20.0 * np.log10(np.maximum(np.abs(L), 1e-12))
    with np.errstate(divide="ignore"):
        S = 1.0 / np.abs(1.0 + L)
    return Overview(
        page.sentence(), loop.stable, loop.time, loop.poles(), weakest, f, L, size,
        np.degrees(np.unwrap(np.angle(L))), S, loop,
    )  # fmt: skip


# |L| beyond which Nyquist's curve is not drawn.
NYQUIST = 3.0
# Poles that are drawn in the plane of s.
SLOWEST = 10


def draw_page(page: Page, folder: Path, formats: Sequence[str] = IMAGES) -> list[Path]:
    """Draw Bode's and Nyquist's diagrams, the poles, and the sensitivity; return the paths of the first format."""
    drawn = {"bode": bode, "nyquist": nyquist, "poles": poles, "sensitivity": sensitivity}
    return [write_figure(figure(page), folder / f"analysis_{name}", formats) for name, figure in drawn.items()]


def _unless_unstable(margins: Margins, said: str, otherwise: str = "the loop is unstable") -> str:
    """Return what is said of the margins; those of an unstable loop are no distance from instability."""
    return said if margins.stable else otherwise


@styled()
def bode(page: Page, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Return Bode's diagram of the loop transfer, at the sensor if the law reads it, with its margins."""
    loop, margins = page.loop, page.weakest
    f = loop.grid
    L = loop.loop_transfer(f, margins.cut)
    from matplotlib.ticker import MultipleLocator

    figure, (upper, lower) = panels(2, 4.6, ax)
    upper.semilogx(f, 20.0 * np.log10(np.maximum(np.abs(L), 1e-12)), color=COLOURS[0])
    upper.axhline(0.0, color="0.5", linewidth=0.8, label="|L| = 1")
    upper.set_ylabel("|L| [dB]")
    upper.set_ylim(bottom=max(-120.0, upper.get_ylim()[0]))
    phase = np.degrees(np.unwrap(np.angle(L)))
    # It is known up to whole turns: it is drawn in the turn in which it comes nearest to −180°.
    turns = np.round((phase + 180.0) / 360.0)
    phase -= 360.0 * turns[np.argmin(np.abs(phase + 180.0 - 360.0 * turns))]
    lower.semilogx(f, phase, color=COLOURS[0])
    lower.axhline(-180.0, color="0.5", linewidth=0.8, label="−180°")
    low, high = lower.get_ylim()
    lower.set_ylim(min(low, -190.0), max(high, -170.0))
    lower.yaxis.set_major_locator(MultipleLocator(90.0 * math.ceil(np.ptp(lower.get_ylim()) / 540.0)))
    lower.set(ylabel="phase [°]", xlabel="frequency [Hz]")
    where = (
        (margins.gain_at, "gain margin", COLOURS[1], "--", f"{margins.decibels:.3g} dB"),
        (margins.phase_at, "phase margin", COLOURS[2], "-.", f"{margins.phase:.3g}°"),
    )
    for at, name, colour, stroke, size in where:
        if math.isfinite(at):
            told = _unless_unstable(margins, f"{name} {size} at {at:.3g} Hz", f"where the {name} would be, {at:.3g} Hz")
            upper.axvline(at, color=colour, linestyle=stroke, linewidth=0.9, label=told)
            lower.axvline(at, color=colour, linestyle=stroke, linewidth=0.9)
    upper.set_title(f"Loop cut at {margins.cut}" + _unless_unstable(margins, "", "; the loop is unstable"))
    for axes in (upper, lower):
        legend_beside_title(axes)
    return figure


@styled()
def nyquist(page: Page, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Return Nyquist's diagram, with the circle about −1 that the loop keeps clear of."""
    loop, margins = page.loop, page.weakest
    L = loop.loop_transfer(loop.grid, margins.cut)
    figure, (axes,) = panels(1, 4.6, ax)
    shown = np.where(np.abs(L) < 4.0 * NYQUIST, L, np.nan)
    axes.plot(shown.real, shown.imag, color=COLOURS[0])
    axes.plot(shown.real, -shown.imag, color=COLOURS[0], linestyle=":", linewidth=0.8)
    turn = np.linspace(0.0, 2.0 * math.pi, 200)
    axes.plot(-1.0 + margins.modulus * np.cos(turn), margins.modulus * np.sin(turn), color=COLOURS[2])
    axes.plot(np.cos(turn), np.sin(turn), color="0.6", linewidth=0.8, linestyle="--")
    axes.plot([-1.0], [0.0], "+", color=COLOURS[1], markersize=12, markeredgewidth=2)
    axes.set(xlim=(-NYQUIST, NYQUIST), ylim=(-NYQUIST, NYQUIST), aspect="equal", xlabel="Re L", ylabel="Im L")
    axes.set_title(f"loop cut at {margins.cut}; " + _unless_unstable(margins, f"modulus margin {margins.modulus:.2f}"))
    return figure


@styled()
def poles(page: Page, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Return the poles in the planes of z and, the slowest, of s, each in the colour of the part it belongs to."""
    if ax is None:
        figure = new_figure(3.4)
        axes, slow = figure.subplots(1, 2)
    else:
        figure, (axes, slow) = panels(2, 3.4, ax)
    _unit_circle(axes)
    slow.axvline(0.0, color="0.6", linewidth=0.8)
    shown = [pole for pole in page.loop.poles() if math.isfinite(pole.s.real)][:SLOWEST]  # what grows comes first
    parts = sorted({pole.part for pole in page.loop.poles()})
    for part, colour in zip(parts, MANY * 2, strict=False):
        mine = [pole.z for pole in page.loop.poles() if pole.part == part]
        axes.plot([z.real for z in mine], [z.imag for z in mine], "x", color=colour, label=part, markeredgewidth=1.6)
        near = [pole.s for pole in shown if pole.part == part]
        hertz = [s.imag / (2.0 * math.pi) for s in near]
        slow.plot([s.real for s in near], hertz, "x", color=colour, markeredgewidth=1.6)
    if page.loop.closure.size:
        z = page.loop.closure
        axes.plot(z.real, z.imag, "+", color="0.5", label="stabiliser")
    axes.legend(loc="lower left", fontsize="small")
    axes.set_title(f"poles, from sample to sample ({page.loop.dt:g} s)")
    slow.set(xlabel="Re s [1/s]", ylabel="Im s [Hz]", title=f"the {len(shown)} slowest to decay")
    return figure


def _unit_circle(axes: Axes) -> None:
    turn = np.linspace(0.0, 2.0 * math.pi, 300)
    axes.plot(np.cos(turn), np.sin(turn), color="0.6", linewidth=0.8)
    axes.set_aspect("equal")
    axes.locator_params(axis="x", nbins=5)  # else the numbers of a narrow panel touch
    axes.set(xlabel="Re z", ylabel="Im z")


@styled()
def sensitivity(page: Page, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Return |S| and |T| where the loop is cut, and the command's and the disturbance's way to f."""
    loop, margins = page.loop, page.weakest
    f = loop.grid
    S = 1.0 / (1.0 + loop.loop_transfer(f, margins.cut))
    figure, (axes,) = panels(1, 3.4, ax)
    curves = [("S", S), ("T = 1 − S", 1.0 - S),
              ("f/f_des", loop.frequency_response("force command", "contact force", f))]  # fmt: skip
    for (name, y), colour in zip(curves, COLOURS, strict=True):
        axes.loglog(f, np.maximum(np.abs(y), 1e-6), color=colour, label=name)
    axes.axhline(1.0, color="0.5", linewidth=0.8)
    axes.set(xlabel="frequency [Hz]", ylabel="size")
    axes.legend(fontsize="small")
    said = _unless_unstable(margins, f"at most {margins.peak_sensitivity:.2f}")
    axes.set_title(f"sensitivity at {margins.cut}: {said}")
    return figure


@styled()
def locus(
    loops: Sequence[tuple[float, LinearLoop]], over: Range, limits: Sequence[Limit], scenario: Scenario | None = None,
    ax: Axes | None = None,
) -> Figure:  # fmt: skip
    """Return the poles as a key goes through its range, from light to dark, and where they leave the unit circle."""
    import matplotlib as mpl

    figure, (axes,) = panels(1, 4.6, ax)
    _unit_circle(axes)
    colours = mpl.colormaps["viridis_r"]
    for value, loop in loops:
        z = np.array([pole.z for pole in loop.poles()])
        axes.plot(z.real, z.imag, ".", color=colours(0.1 + 0.9 * over.share(value)), markersize=3)
    for limit in limits:
        x, y = limit.pole.z.real, limit.pole.z.imag
        axes.plot([x, x], [y, -y], "o", color=COLOURS[1], fillstyle="none")
        axes.annotate(f" {limit.value:.4g}", (x, y), fontsize="small")
    unit = key_unit(over.key, scenario)
    ends = f"{over.low:g} (light) to {over.high:g} (dark)"
    axes.set_title(f"Poles for {over.key} = {ends} {unit if unit != '1' else ''}".rstrip())
    return figure


@styled()
def stability_map(
    boundary: Sequence[tuple[float, Limit]], over: Range, along: Range, here: tuple[float, float] | None,
    trials: Sequence[Trial], scenario: Scenario | None = None, ax: Axes | None = None,
) -> Figure:  # fmt: skip
    """Return the boundary over two keys, with the scenario's own place and the whole runs beside it."""
    figure, (axes,) = panels(1, 4.0, ax)
    x, y = np.array([value for value, _ in boundary]), np.array([limit.value for _, limit in boundary])
    if boundary:
        axes.plot(x, y, ".-" if len(x) < 100 else "-", color=COLOURS[0], label="boundary", markersize=4)
    for grows, marker, colour, name in ((False, "o", COLOURS[2], "stable"), (True, "x", COLOURS[1], "unstable")):
        mine = [trial.values for trial in trials if (trial.seen > 0.0) is grows and along.key in trial.values]
        if mine:
            axes.plot([v[along.key] for v in mine], [v[over.key] for v in mine], marker, color=colour, linestyle="none",
                      label=f"whole run: {name}")  # fmt: skip
    if here is not None:
        axes.plot(*here, "*", color="k", markersize=10, label="the scenario")
    for key, scale in ((along, axes.set_xscale), (over, axes.set_yscale)):
        scale("log" if key.log else "linear")
    across, up = (with_unit(each.key, key_unit(each.key, scenario)) for each in (along, over))
    axes.set(xlim=(along.low, along.high), ylim=(over.low, over.high), xlabel=across, ylabel=up)
    axes.set_title("Where the force loop becomes unstable" if boundary else "The force loop has no limit in this map")
    legend_beside_title(axes)
    return figure
