"""Figures of a force loop: Bode and Nyquist of its transfer, its poles, its sensitivity, and where it is stable.

With `ax` each is drawn on axes of the user's own, see `closedloop.figures`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from closedloop.figures.files import IMAGES, write_figure
from closedloop.figures.style import COLOURS, MANY, legend_beside_title, new_figure, panels, styled
from closedloop.scenario.messages import key_unit, with_unit
from closedloop.scenario.scenario import Scenario
from closedloop.studies.analysis.page import Page
from closedloop.studies.analysis.stability import Limit, Range, Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from closedloop.studies.analysis.linear_loop import LinearLoop, Margins

# |L| beyond which Nyquist's curve is not drawn.
NYQUIST = 3.0
# Poles that are drawn in the plane of s.
SLOWEST = 10


def draw_page(page: Page, folder: Path, formats: Sequence[str] = IMAGES) -> list[Path]:
    """Draw Bode's and Nyquist's diagrams, the poles, and the sensitivity; return the paths of the first format."""
    drawn = {"bode": bode, "nyquist": nyquist, "poles": poles, "sensitivity": sensitivity}
    return [written(figure(page), folder / f"analysis_{name}", formats) for name, figure in drawn.items()]


@styled()
def written(figure: Figure, path: Path, formats: Sequence[str] = IMAGES) -> Path:
    """Write a figure, and return the path of its first format."""
    return write_figure(figure, path, formats)


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
    axes.set_xlim(-NYQUIST, NYQUIST)
    axes.set_ylim(-NYQUIST, NYQUIST)
    axes.set_aspect("equal")
    axes.set_xlabel("Re L")
    axes.set_ylabel("Im L")
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
        slow.plot(
            [s.real for s in near], [s.imag / (2.0 * math.pi) for s in near], "x", color=colour, markeredgewidth=1.6
        )
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
    axes.set_title(
        f"sensitivity at {margins.cut}: " + _unless_unstable(margins, f"at most {margins.peak_sensitivity:.2f}")
    )
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
    axes.set_xlim(along.low, along.high)
    axes.set_ylim(over.low, over.high)
    across, up = (with_unit(each.key, key_unit(each.key, scenario)) for each in (along, over))
    axes.set(xlabel=across, ylabel=up)
    axes.set_title("Where the force loop becomes unstable" if boundary else "The force loop has no limit in this map")
    legend_beside_title(axes)
    return figure
