"""The tool of a run: what a sensor at the wrist reads, and how the tool is turned to the surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from closedloop.columns.derived import WRENCH
from closedloop.figures.dress import dress, explain_contact
from closedloop.figures.style import MANY, new_figure
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def has_tool(run: Run) -> bool:
    """Whether the arm carries something, or the orientation of the tool is held."""
    held = getattr(run.scenario.reference, "orientation", "free") != "free"
    return bool(held or run.scenario.tool.mass or run.scenario.model_error.payload)


def tool(run: Run) -> Figure:
    """Draw the force and the moment at the wrist, in the axes of the frame robot.tip, and the angle of the tool."""
    figure = new_figure(height=6.4)
    panels = figure.subplots(3, 1, sharex=True)
    for axes, title, unit, first in ((panels[0], "Force at the wrist", "N", 0), (panels[1], "Moment", "N m", 3)):
        part = run.wrist_wrench[:, first : first + 3]
        for k in range(3):
            axes.plot(run.time, part[:, k], color=MANY[k], label=WRENCH[first + k])
        axes.margins(y=0.08)
        largest = float(np.max(np.linalg.norm(part, axis=1)))
        dress(
            axes, run, f"{title}, up to {largest:.3g} {unit}", f"{title.split()[0].lower()} [{unit}]", show_events=False
        )
        axes.legend(loc="best", fontsize=8, ncols=3)
        axes.set_xlabel("")
    panels[2].plot(run.time, run.tool_angle, color=MANY[0], label="from the normal")
    panels[2].plot(run.time, run.orientation_error, "--", color=MANY[1], label="from its reference")
    panels[2].margins(y=0.08)
    told = f"Turn of the tool, up to {float(np.max(run.tool_angle)):.3g} degrees from the normal"
    dress(panels[2], run, told, "angle [deg]")
    panels[2].legend(loc="best", fontsize=8)
    explain_contact(figure, run)
    return figure
