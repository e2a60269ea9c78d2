"""The friction force of the surface in its cone, and the slip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.figures.closure import directions, sideways
from closedloop.figures.style import COLOURS, dress, explain_contact, legend_beside_title, no_upper_labels, panels
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.friction.contact import surface_contact
from closedloop.mechanics.friction.law import FrictionLaw
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A part of friction below this share of all of it is not drawn.
ASIDE = 0.01


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


def friction_bounds(run: Run) -> list[tuple[Array, str, str]]:
    """Return the cone of a run's friction: each level times f, and the viscous part b |u|, which f does not bound.

    Each is an array (N,), N, with its name and stroke.
    """
    law = run.scenario.friction
    b = float(getattr(law, "viscous", 0.0))
    touching = run.mode != FREE
    viscous = b * np.linalg.norm(run.slip_velocity, axis=1) if b > 0.0 else np.zeros(len(run))
    more = " + b |u|" if b > 0.0 else ""
    return [
        (np.where(touching, level * run.contact_force + viscous, 0.0), f"{name}{more}", stroke)
        for level, name, stroke in friction_levels(law)
    ]


def friction_force(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw friction along the path inside the friction cone, ±(μf + b|u|), and the velocity of slip along the path.

    Both are signed along the direction of the path, see `closedloop.figures.closure.directions`: friction that resists
    slip along the path is negative. Its part across the path is drawn beside it, where there is any.
    For `ax` see `closedloop.figures`.
    """
    along, force = directions(run), run.friction_force
    across = sideways(run, along)
    slip = np.where(run.mode != FREE, np.sum(run.slip_velocity * along, axis=1), np.nan)
    figure, (above, below) = panels(2, 4.8, ax)
    for (bound, name, stroke), (level, *_) in zip(
        friction_bounds(run), friction_levels(run.scenario.friction), strict=True
    ):
        for sign in (1.0, -1.0):
            label = f"±({name}), μ = {level:g}" if "+" in name else f"±{name}, μ = {level:g}"
            above.plot(
                run.time, sign * bound, stroke, color="0.6", linewidth=1.8, label=label if sign > 0 else None
            )  # fmt: skip
    above.plot(run.time, np.sum(force * along, axis=1), color=COLOURS[0], label="along the path")
    beside = np.sum(force * across, axis=1)
    if np.max(np.abs(beside)) > ASIDE * np.max(np.abs(force)):
        above.plot(run.time, beside, color=COLOURS[2], linewidth=0.9, label="across")
    above.axhline(0.0, color="0.3", linestyle=":", linewidth=1)
    dress(above, run, "Friction", "Fₜ [N]", show_events=False)
    legend_beside_title(above)
    below.plot(run.time, 1e3 * slip, color=COLOURS[1])
    below.axhline(0.0, color="0.3", linestyle=":", linewidth=1)
    dress(below, run, "Slip along the path", "velocity [mm/s]", label_marks=False)
    no_upper_labels(figure, (above, below))
    explain_contact(figure, run)
    return figure
