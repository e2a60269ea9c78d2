"""The joints of a run: torques, velocities and positions, against the limits of the robot's file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arrays import Array
from closedloop.figures.style import (
    MANY,
    MOST_CURVES,
    OTHERS,
    dress,
    explain_contact,
    legend_outside,
    no_upper_labels,
    panels,
)
from closedloop.record.run import Run, units_by_kind
from closedloop.scenario.messages import typeset
from robot_models import RobotModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A limit is drawn if the axis need not be longer than this times the range of the data for it; it is named in any case.
ROOM = 2.0


def has_joints(run: Run) -> bool:
    """Tell whether the run has a joint that is not that of a free body."""
    return not all(in_bodies(run.model, positions=False))


def in_bodies(model: RobotModel, positions: bool) -> list[bool]:
    """Return whether each position, or each velocity, is that of a free body."""
    names = model.coordinate_names if positions else model.joint_names
    found = [False] * len(names)
    for j in model.bodies:
        at = names.index(model.joint_names[j])
        found[at : at + (7 if positions else 6)] = [True] * (7 if positions else 6)
    return found


def joints(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the torque, velocity and position of every joint, with the limits of the robot's file as dashed lines.

    The coordinates of free bodies are left out: they have a figure of their own, `closedloop.figures.bodies`.

    A limit far from all that the joint does is not drawn; the titles say how near the joints come to one. For `ax` see
    `closedloop.figures`.
    """
    model = run.model
    figure, on = panels(3, 6.4, ax)
    drawn = (
        ("Torque Q", "torque", -model.effort_limit, model.effort_limit, "torque"),
        ("Velocity", "velocity", -model.velocity_limit, model.velocity_limit, "v"),
        ("Position", "position", *_position_limits(model), "q"),
    )
    for axes, (title, label, low, high, name) in zip(on, drawn, strict=True):
        values = run.columns[name]
        held = [j for j, free in enumerate(in_bodies(model, positions=name == "q")) if not free]
        all_names = model.coordinate_names if name == "q" else model.joint_names
        names, values = tuple(all_names[j] for j in held), values[:, held]
        if len(low) != len(held):
            low, high = low[held], high[held]
        colours = _colours(run, names)
        for j, joint in enumerate(names):
            named = joint in colours
            axes.plot(
                run.time, values[:, j], color=colours.get(joint, OTHERS), label=joint if named else None,
                zorder=2.0 if named else 1.5,
            )  # fmt: skip
        axes.margins(y=0.08)
        of_named = [j for j, joint in enumerate(names) if joint in colours]
        _draw_limits(axes, values[:, of_named], low[of_named], high[of_named], [colours[names[j]] for j in of_named])
        kinds = model.coordinate_types if name == "q" else model.joint_types
        each = [typeset(units_by_kind(run.specs[name].units, kinds[j])) for j in held]
        units = " | ".join(dict.fromkeys(each))
        told = f"{title}, {_told(values, low, high, names, each, positions=name == 'q')}"
        dress(axes, run, told, f"{label} [{units}]", label_marks=axes is on[0], show_events=axes is on[-1])
    no_upper_labels(figure, on)
    _name_joints(figure, on[0], int(sum(not free for free in in_bodies(model, positions=False))))
    explain_contact(figure, run)
    return figure


def _position_limits(model: RobotModel) -> tuple[Array, Array]:
    """Return the limits of all positions, (nq,), rad (m); a quaternion has none."""
    if not model.balls:
        return model.position_lower, model.position_upper
    known = {name: j for j, name in enumerate(model.joint_names)}
    lower, upper = (
        np.array([limits[known[name]] if name in known else far for name in model.coordinate_names])
        for limits, far in ((model.position_lower, -np.inf), (model.position_upper, np.inf))
    )
    return lower, upper


def _colours(run: Run, names: tuple[str, ...]) -> dict[str, str]:
    """Return the colour of each joint that is named: all of them, or those with a drive if they are too many."""
    model = run.model
    driven = [name for name, drive in zip(model.joint_names, model.driven, strict=True) if drive and name in names]
    chosen = names if len(names) <= MOST_CURVES else (driven or list(names))[:MOST_CURVES]
    return dict(zip(chosen, MANY, strict=False))


def _draw_limits(axes: Axes, values: Array, low: Array, high: Array, colours: Sequence[str]) -> None:
    """Draw the limits, each in its joint's colour, that are near what the joints do."""
    span = float(np.ptp(values))
    bottom, top = float(np.min(values)) - 0.5 * (ROOM - 1.0) * span, float(np.max(values)) + 0.5 * (ROOM - 1.0) * span
    reach = list(axes.get_ylim())
    for j in range(values.shape[1]):
        for limit in (float(low[j]), float(high[j])):
            if bottom <= limit <= top:
                axes.axhline(limit, color=colours[j], linestyle=(0, (6, 3)), linewidth=0.9)
                reach = [min(reach[0], limit - 0.05 * span), max(reach[1], limit + 0.05 * span)]
    axes.set_ylim(*reach)


def _told(values: Array, low: Array, high: Array, names: tuple[str, ...], units: Sequence[str], positions: bool) -> str:
    """Return how near the joints come to their limits, in words; `units` has that of each."""
    known = np.isfinite(low) & np.isfinite(high) & (high > low)
    if not np.any(known):
        return "no limits in the robot's file"
    if positions:
        room = np.minimum(np.min(values, axis=0) - low, high - np.max(values, axis=0))[known]
        j = int(np.argmin(room))
        which = np.flatnonzero(known)[j]
        distance = f"{abs(room[j]):.2g} {units[which]}"
        told = f"at least {distance} from every limit" if room[j] >= 0.0 else f"{distance} past a limit"
        return f"{told}: {names[which]}"
    share = np.max(np.abs(values), axis=0)[known] / high[known]
    j = int(np.argmax(share))
    which = np.flatnonzero(known)[j]
    return f"up to {float(f'{100.0 * share[j]:.2g}'):g} % of a limit: {names[which]}, ±{high[which]:g} {units[which]}"


def _name_joints(figure: Figure, axes: Axes, count: int) -> None:
    handles, names = axes.get_legend_handles_labels()
    others = "" if count == len(names) else f"; grey: {count - len(names)} others"
    legend_outside(figure, "upper center", handles, 4, f"joints; limits dashed{others}", axes)
