"""The friction force of the surface beside its bound, and the slip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.closure.contact_force import FREE
from closedloop.figures.dress import dress, explain_contact, legend_beside_title
from closedloop.figures.style import COLOURS, new_figure
from closedloop.friction.contact import surface_contact
from closedloop.friction.law import FrictionLaw
from closedloop.record.run import Run
from closedloop.surface.plane import unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def has_friction(run: Run) -> bool:
    """Tell whether the surface ever resisted slip."""
    return bool(np.any(run.friction_force))


def friction_levels(law: Any) -> list[tuple[float, str, str]]:
    """Return the levels that a law has, static and kinetic, each with its name and stroke; none of one that is gone."""
    if not isinstance(law, FrictionLaw):
        return []
    contact = surface_contact(law)
    contact.rested()
    static, kinetic = contact.stick_limit, contact.kinetic_level
    levels = [(kinetic, "μ f", "-")] if static == kinetic else [(static, "μₛ f", "-"), (kinetic, "μₖ f", "--")]
    return [each for each in levels if each[0] > 0.0]


def friction_force(run: Run) -> Figure:
    """Draw the size of the friction force beside μf, and the speed of slip, against time."""
    normal = unit(run.scenario.surface.normal, "surface.normal")
    along = run.velocity - np.outer(run.velocity @ normal, normal)
    slip = np.where(run.mode != FREE, np.linalg.norm(along, axis=1), np.nan)
    figure = new_figure(height=4.8)
    above, below = figure.subplots(2, 1, sharex=True)
    for level, name, stroke in friction_levels(run.scenario.friction):
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
