"""The tool of a run: what a sensor at the wrist reads, and how the tool is turned to the surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from closedloop.figures.dress import dress, explain_contact, legend_beside_title
from closedloop.figures.style import MANY, new_figure
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
    """Draw the force and the moment at the wrist, in the axes of the frame robot.tip, and the angle of the tool."""
    figure = new_figure(height=6.4)
    panels = figure.subplots(3, 1, sharex=True)
    strongest = max(1.0, float(np.max(np.linalg.norm(run.wrist_wrench[:, :3], axis=1))))
    for axes, title, unit, first in ((panels[0], "Force at the wrist", "N", 0), (panels[1], "Moment", "N m", 3)):
        part = run.wrist_wrench[:, first : first + 3]
        for k in range(3):
            axes.plot(run.time, part[:, k], color=MANY[k], label=WRENCH[first + k])
        axes.margins(y=0.08)
        largest = float(np.max(np.linalg.norm(part, axis=1)))
        told = f"{title}, up to {largest:.3g} {unit}"
        if largest < ROUNDING * strongest:  # rounding is no picture
            axes.set_ylim(-1.0, 1.0)
            told = f"{title}: rounding"
        label = f"{title.split()[0].lower()} [{unit}]"
        dress(axes, run, told, label, label_marks=first == 0, show_events=False)
        legend_beside_title(axes)
        axes.set_xlabel("")
    panels[2].plot(run.time, run.tool_angle, color=MANY[0], label="from the normal")
    panels[2].plot(run.time, run.orientation_error, "--", color=MANY[1], label="from its reference")
    panels[2].margins(y=0.08)
    told = f"Turn of the tool, up to {float(np.max(run.tool_angle)):.3g} deg"
    dress(panels[2], run, told, "angle [deg]", label_marks=False)
    legend_beside_title(panels[2])
    explain_contact(figure, run)
    return figure
