"""The tip of a run, Fig. 4 of the paper, and the tool on it.

The tool of a run: what a sensor at the wrist reads, and how the tool is turned to the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from closedloop.figures.style import (
    COLOURS,
    MANY,
    STROKES,
    contact_changes,
    dress,
    explain_contact,
    legend_beside_title,
    length_unit,
    no_upper_labels,
    panels,
)
from closedloop.record.columns.derived import WRENCH
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Displacements below this share of the largest are not seen beside it, and get a panel of their own; what is below
# ROUNDING, m, is what many steps have rounded off.
SMALL, ROUNDING = 0.01, 1e-12


def tip_position(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the tip's position against time (Fig. 4), its displacement from the start, and small components of that.

    For `ax` see `closedloop.figures`.
    """
    moved = run.position - run.position[0]
    sizes = np.max(np.abs(moved), axis=0)
    if length_unit(float(sizes.max()))[1] == "mm":
        small = [k for k in range(3) if ROUNDING < sizes[k] < SMALL * sizes.max()]
    else:
        small = [0, 1, 2]
    slide = run.scenario.reference.kind == "line" and not contact_changes(run)
    ratios = [2, 2, 1] if small else [1, 1]
    figure, drawn = panels(len(ratios), 6.2 if small else 4.8, ax, ratios)
    where, above = drawn[:2]
    for k, axis in enumerate("xyz"):
        name = f"{axis} from {round(run.position[0, k], 4) + 0.0:.4f} m"
        where.plot(run.time, run.position[:, k], STROKES[k], color=COLOURS[k], label=axis)
        above.plot(run.time, 1e3 * moved[:, k], STROKES[k], color=COLOURS[k], label=name)
    for axes in (where, above):
        axes.margins(y=0.15)
    dress(where, run, "Tip, base frame", "position [m]", show_events=False)
    legend_beside_title(where)
    dress(above, run, "Displacement", "displacement [mm]", label_marks=False, show_events=not small)
    legend_beside_title(above)
    if small:
        below = drawn[2]
        factor, unit = length_unit(float(sizes[small].max()))
        for k in small:
            below.plot(run.time, factor * moved[:, k], STROKES[k], color=COLOURS[k], label="xyz"[k])
        dress(
            below,
            run,
            "Displacement off the path" if slide else "Small components of the displacement",
            f"[{unit}]",
            label_marks=False,
        )
        legend_beside_title(below)
    no_upper_labels(figure, drawn)
    explain_contact(figure, run)
    return figure


# A moment that is less than this times the force, with an arm of a metre, is rounding.
TURN_ROUNDING = 1e-13


def has_tool(run: Run) -> bool:
    """Whether the arm carries something, or the orientation of the tool is held."""
    held = getattr(run.scenario.reference, "orientation", "free") != "free"
    return bool(held or run.scenario.tool.mass or run.scenario.model_error.payload)


def tool(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the force and the moment at the wrist, in the axes of the frame robot.tip, and the angle of the tool.

    A moment that is zero to rounding has no panel. For `ax` see `closedloop.figures`.
    """
    force, moment = (float(np.max(np.linalg.norm(part, axis=1))) for part in np.split(run.wrist_wrench, 2, axis=1))
    parts = [("Force at the wrist", "N", 0), ("Moment", "N m", 3)]
    if moment < TURN_ROUNDING * max(1.0, force):
        parts.pop()
    figure, drawn = panels(len(parts) + 1, 1.6 + 1.6 * (len(parts) + 1), ax)
    for axes, (title, unit, first) in zip(drawn, parts, strict=False):
        part = run.wrist_wrench[:, first : first + 3]
        for k in range(3):
            axes.plot(run.time, part[:, k], color=MANY[k], label=WRENCH[first + k])
        axes.margins(y=0.08)
        largest = float(np.max(np.linalg.norm(part, axis=1)))
        label = f"{title.split()[0].lower()} [{unit}]"
        dress(axes, run, f"{title}, up to {largest:.3g} {unit}", label, label_marks=first == 0, show_events=False)
        legend_beside_title(axes)
    last = drawn[-1]
    last.plot(run.time, run.tool_angle, color=MANY[0], label="from the normal")
    last.plot(run.time, run.orientation_error, "--", color=MANY[1], label="from its reference")
    last.margins(y=0.08)
    told = f"Angle of the tool, up to {float(np.max(run.tool_angle)):.3g} deg"
    dress(last, run, told, "angle [deg]", label_marks=False)
    legend_beside_title(last)
    no_upper_labels(figure, drawn)
    explain_contact(figure, run)
    return figure
