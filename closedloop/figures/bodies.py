"""The free bodies of a run: how high each is, how far it has gone, and how far it has turned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arrays import Array
from closedloop.figures.style import (
    MANY,
    MOST_CURVES,
    dress,
    explain_contact,
    legend_outside,
    length_unit,
    no_upper_labels,
    panels,
    widen,
)
from closedloop.record.run import Run
from robot_models.coordinates import PLACES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# What moves across, or turns, by no more than this, m or rad, does not: it has no panel.
AT_REST = 1e-9
HEIGHT = "z [mm]"
# Heights that change by less than this share of the way across are not drawn.
FLAT = 1e-3
# The axis of heights is at least so long, as a share of the longest way of a body.
LEAST = 0.01


def has_bodies(run: Run) -> bool:
    """Tell whether a body of the run is free."""
    return bool(run.model.bodies)


def rests(run: Run) -> bool:
    """Tell whether no free body of the run moves."""
    return all(
        np.max(np.abs(r - r[0]), initial=0.0) <= AT_REST and np.max(turned(turn), initial=0.0) <= AT_REST
        for r, turn in body_motions(run).values()
    )


def turned(quaternions: Array) -> Array:
    """Return the angle (N,), rad, from 0 to π, by which each of unit quaternions (N, 4) is turned from the first."""
    along = np.abs(quaternions @ quaternions[0])
    across = np.linalg.norm(quaternions - np.sign(quaternions @ quaternions[0])[:, None] * quaternions[0], axis=1)
    return 2.0 * np.arctan2(across * np.sqrt(np.maximum(1.0 - 0.25 * across**2, 0.0)), along)


def body_motions(run: Run) -> dict[str, tuple[Array, Array]]:
    """Return the positions (N, 3), m, and quaternions (N, 4) of each free body, by the name of its joint."""
    names, found = list(run.model.coordinate_names), {}
    for j in run.model.bodies:
        name = run.model.joint_names[j].removesuffix(PLACES[0])
        at = names.index(run.model.joint_names[j])
        found[name] = run.q[:, at : at + 3], run.q[:, at + 3 : at + 7]
    return found


def bodies(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the height of each free body, its distance from the start across, and the angle from its start.

    Of more bodies than can be told apart those that move most are drawn. What does not change has no panel, except the
    height where nothing moves. For `ax` see `closedloop.figures`.
    """
    motions = body_motions(run)
    if not motions:
        raise ValueError("the run has no free body")
    size = {name: float(np.max(np.abs(r - r[0]))) for name, (r, _) in motions.items()}
    shown = sorted(sorted(motions, key=lambda name: -size[name])[:MOST_CURVES], key=list(motions).index)
    across = {name: np.hypot(*(motions[name][0] - motions[name][0][0])[:, :2].T) for name in shown}
    angles = {name: turned(motions[name][1]) for name in shown}
    furthest, most = (max(float(np.max(each)) for each in values.values()) for values in (across, angles))
    factor, unit = length_unit(furthest)
    drawn = []
    rise = max(float(np.ptp(motions[name][0][:, 2])) for name in shown)
    if rise > max(AT_REST, FLAT * furthest) or max(furthest, most) <= AT_REST:
        drawn.append(({name: 1e3 * motions[name][0][:, 2] for name in shown}, "Height", HEIGHT))
    if furthest > AT_REST:
        label = f"√(Δx² + Δy²) [{unit}]"
        drawn.append(
            ({name: factor * each for name, each in across.items()}, "Horizontal distance from the start", label)
        )
    if most > AT_REST:
        drawn.append(
            ({name: np.degrees(each) for name, each in angles.items()}, "Rotation from the start", "angle [°]")
        )
    figure, on = panels(len(drawn), 1.6 + 1.6 * len(drawn), ax)
    those = f"the {len(shown)} of {len(motions)} bodies that move most" if len(shown) < len(motions) else ""
    for axes, (curves, title, label) in zip(on, drawn, strict=True):
        for k, name in enumerate(shown):
            axes.plot(run.time, curves[name], color=MANY[k % len(MANY)], label=name)
        axes.margins(y=0.12)
        if label == HEIGHT:
            widen(axes, LEAST * 1e3 * max(furthest, *size.values()))
        first, last = axes is on[0], axes is on[-1]
        dress(axes, run, f"{title}: {those}" if first and those else title, label, label_marks=first, show_events=last)
    no_upper_labels(figure, on)
    legend_outside(figure, "upper center", on[0].get_legend_handles_labels()[0], 4, axes=on[0])
    explain_contact(figure, run)
    return figure
