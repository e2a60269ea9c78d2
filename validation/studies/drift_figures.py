"""Figures of the study of drift."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.figures.files import write_figure
from closedloop.figures.style import COLOURS, styled
from closedloop.mechanics.closure.baumgarte import spectral_radii

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {"semi_implicit_euler": "semi-implicit Euler", "explicit_euler": "explicit Euler", "rk4": "RK4"}
MARKERS = ("o", "s", "^")


def draw_drift(results: dict[str, Any], folder: Path) -> list[Path]:
    """Draw drift against step and speed, and the map of Baumgarte's stability; return the paths of the PNGs."""
    from matplotlib.figure import Figure

    with styled():
        slopes = Figure(figsize=(7.2, 5.4), layout="constrained")
        left, right = slopes.subplots(1, 2, sharey=True)
        power_laws(left, results["against_step"], 1e3, "step h [ms]", "h")
        power_laws(right, results["against_speed"], 1e3, "tip speed v [mm/s]", "v")
        left.set_ylabel("largest |e| [m]")
        stability = Figure(figsize=(7.2, 3.8), layout="constrained")
        stability_map(stability.add_subplot(), results["limits"])
        written = []
        for name, figure in (("drift_slopes", slopes), ("baumgarte_stability", stability)):
            written.append(write_figure(figure, folder / name))
    return written


def power_laws(axes: Axes, rows: list[dict[str, Any]], factor: float, label: str, symbol: str) -> None:
    """Draw |e| against the setting varied, with the fitted exponent: full lines without stabiliser, broken with it."""
    look = dict(zip(NAMES, zip(COLOURS, MARKERS, strict=True), strict=True))
    for row in rows:
        (colour, marker), free = look[row["integrator"]], row["stabiliser"] == "none"
        axes.loglog(
            factor * np.array(row["values"]), row["errors"], marker, color=colour, linestyle="-" if free else "--",
            fillstyle="full" if free else "none",
            label=f"{NAMES[row['integrator']]}{'' if free else ', Baumgarte'}: {symbol}$^{{{row['slope']:.2f}}}$",
        )  # fmt: skip
    axes.set_xlabel(label)
    ticks = [f"{factor * x:g}" for x in rows[0]["values"]]
    axes.set_xticks([factor * x for x in rows[0]["values"]], ticks)
    axes.minorticks_off()
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    axes.set_title("worse with a longer step" if symbol == "h" else "worse at a higher speed")


def stability_map(axes: Axes, limits: list[dict[str, Any]]) -> None:
    """Draw where Baumgarte is stable in the plane of (s_v h, s_p h²), and the limits that were measured."""
    x, y = np.meshgrid(np.linspace(0.02, 6.5, 220), np.linspace(0.02, 9.5, 220))  # s_v h, s_p h²
    for scheme, colour, marker in zip(NAMES, COLOURS, MARKERS, strict=True):
        radii = spectral_radii(scheme, x / (2.0 * np.sqrt(y)), np.sqrt(y))
        axes.contour(x, y, radii, levels=[1.0], colors=[colour], linewidths=1.4)
        mine = [row for row in limits if row["integrator"] == scheme]
        measured = np.array([row["measured"] for row in mine])
        damping = np.array([row["damping_ratio"] for row in mine])
        axes.plot(
            2.0 * damping * measured, measured**2, marker, color=colour, linestyle="none", label=f"{NAMES[scheme]}"
        )
    axes.plot([1.414], [1.0], "k*", markersize=10, label="the paper, at 1 kHz")
    axes.set_xlabel("s_v h = 2 ζ h/T")
    axes.set(ylabel="s_p h² = (h/T)²", title="Baumgarte is stable inside the line; marks: the limit measured on an arm")
    axes.legend(fontsize=8, loc="center right")
