"""The tool of a run: what a sensor at the wrist reads, and how the tool is turned to the surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from closedloop.figures.style import MANY, dress, explain_contact, legend_beside_title, new_figure
from closedloop.record.columns.derived import WRENCH
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A moment that is less than this times the force, with an arm of a metre, is rounding.
ROUNDING = 1e-13


def has_tool(run: Run) -> bool:
    """Whether the arm carries something, or the orientation of the tool is held."""
    held = getattr(run.scenario.reference, "orientation", "free") != "free"
    return bool(held or run.scenario.tool.mass or run.scenario.model_error.payload)


def tool(run: Run) -> Figure:
    """Draw the force and the moment at the wrist, in the axes of the frame robot.tip, and the angle of the tool.

    A moment that is zero to rounding has no panel.
    """
    force, moment = (float(np.max(np.linalg.norm(part, axis=1))) for part in np.split(run.wrist_wrench, 2, axis=1))
    parts = [("Force at the wrist", "N", 0), ("Moment", "N m", 3)]
    if moment < ROUNDING * max(1.0, force):
        parts.pop()
    figure = new_figure(height=1.6 + 1.6 * (len(parts) + 1))
    panels = figure.subplots(len(parts) + 1, 1, sharex=True)
    for axes, (title, unit, first) in zip(panels, parts, strict=False):
        part = run.wrist_wrench[:, first : first + 3]
        for k in range(3):
            axes.plot(run.time, part[:, k], color=MANY[k], label=WRENCH[first + k])
        axes.margins(y=0.08)
        largest = float(np.max(np.linalg.norm(part, axis=1)))
        label = f"{title.split()[0].lower()} [{unit}]"
        dress(axes, run, f"{title}, up to {largest:.3g} {unit}", label, label_marks=first == 0, show_events=False)
        legend_beside_title(axes)
        axes.set_xlabel("")
    last = panels[-1]
    last.plot(run.time, run.tool_angle, color=MANY[0], label="from the normal")
    last.plot(run.time, run.orientation_error, "--", color=MANY[1], label="from its reference")
    last.margins(y=0.08)
    told = f"Angle of the tool, up to {float(np.max(run.tool_angle)):.3g} deg"
    dress(last, run, told, "angle [deg]", label_marks=False)
    legend_beside_title(last)
    explain_contact(figure, run)
    return figure
