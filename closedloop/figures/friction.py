"""The friction force of the surface beside its bound, and the slip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from closedloop.closure.contact_force import FREE
from closedloop.figures.dress import dress, explain_contact, legend_beside_title
from closedloop.figures.style import COLOURS, new_figure
from closedloop.friction.layout import KINETIC, STATIC
from closedloop.friction.packing import pack
from closedloop.record.run import Run
from closedloop.surface.plane import unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def has_friction(run: Run) -> bool:
    """Tell whether the surface ever resisted slip."""
    return bool(np.any(run.friction_force))


def friction_force(run: Run) -> Figure:
    """Draw the size of the friction force beside μf, and the speed of slip, against time."""
    _, par = pack(run.scenario.friction)
    normal = unit(run.scenario.surface.normal, "surface.normal")
    along = run.velocity - np.outer(run.velocity @ normal, normal)
    slip = np.where(run.mode != FREE, np.linalg.norm(along, axis=1), np.nan)
    figure = new_figure(height=4.8)
    above, below = figure.subplots(2, 1, sharex=True)
    levels = [(par[STATIC], "μₛ f", "-"), (par[KINETIC], "μₖ f", "--")]
    if par[STATIC] == par[KINETIC]:
        levels = [(par[KINETIC], "μ f", "-")]
    for level, name, stroke in levels:
        above.plot(
            run.time, level * run.contact_force, stroke, color="0.6", linewidth=2.4, label=f"{name}, μ = {level:g}"
        )
    above.plot(run.time, np.linalg.norm(run.friction_force, axis=1), color=COLOURS[0], label="friction |Fₜ|")
    dress(above, run, "Friction on the tip", "force [N]", show_events=False)
    above.set_xlabel("")
    legend_beside_title(above)
    below.plot(run.time, 1e3 * slip, color=COLOURS[1])
    dress(below, run, "Speed of slip", "speed [mm/s]", label_marks=False)
    explain_contact(figure, run)
    return figure
