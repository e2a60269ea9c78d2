"""The pictures of a run in its own rooms: closure error, and the errors along and across the path.

The closure error, Figs. 6 and 7 of the paper, and the gap of a tip that is off the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.figures.style import (
    COLOURS,
    dress,
    explain_contact,
    length_unit,
    mark_rounding,
    no_upper_labels,
    panels,
    position_rounding,
)
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.surface.placed import contact_frame, unit
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_STABILISED = {
    "baumgarte": "with Baumgarte's stabiliser",
    "projection": "with projection",
    "both": "with Baumgarte's stabiliser and projection",
    "none": "without stabiliser",
}


def closure_error(run: Run, ax: Axes | Sequence[Axes] | None = None) -> Figure:
    """Draw the closure error e against time (Fig. 6 with the stabiliser, Fig. 7 without).

    Off the surface e is a gap and no error, a million times larger than the error in contact: a run that has both gets
    a panel for each. For `ax` see `closedloop.figures`.
    """
    touching = run.mode != FREE
    how = _STABILISED[run.scenario.stabiliser.kind]
    soft = run.scenario.compliance.kind != "none"
    what = "Position of the tip relative to the soft surface; e < 0: inside" if soft else f"Closure error, {how}"
    both = bool(np.any(touching) and not np.all(touching))
    figure, drawn = panels(2 if both else 1, 4.8 if both else 3.4, ax)
    if np.all(touching):
        unit = _draw(drawn[0], run, run.closure_error)
        dress(
            drawn[0],
            run,
            what if soft or run.scenario.surface.kind != "plane" else f"Closure error e = n·r − d, {how}",
            f"e [{unit}]",
        )
    else:
        unit = _draw(drawn[0], run, run.closure_error)
        dress(drawn[0], run, "Gap e", f"e [{unit}]", show_events=not both)
    if both:
        unit = _draw(drawn[1], run, np.where(touching, run.closure_error, np.nan))
        dress(drawn[1], run, f"In contact: {what[0].lower()}{what[1:]}", f"e [{unit}]", label_marks=False)
    no_upper_labels(figure, drawn)
    explain_contact(figure, run)
    return figure


def _draw(axes: Axes, run: Run, error: NDArray[np.float64]) -> str:
    """Draw an error, m, which is NaN where there is none, and return the unit in which it is drawn."""
    axes.margins(y=0.15)
    size = float(np.nanmax(np.abs(error), initial=0.0))
    factor, unit = length_unit(size) if size > 0.0 else (1.0, "m")
    axes.plot(run.time, factor * error, color=COLOURS[1])
    mark_rounding(axes, size, position_rounding(run), factor)
    return unit


# A desired motion slower than this share of its largest step has no direction of its own.
STILL = 1e-3


class TipErrors(NamedTuple):
    """Tip errors r − r_des (N,), m: along the path, across it in the surface, along the normal."""

    along: Array
    across: Array
    normal: Array


def frame_of(run: Run) -> Array:
    """Return the contact frame at the surface's origin (3, 3): rows n, t1, t2 in base axes."""
    return contact_frame(unit(run.scenario.surface.normal, "surface.normal"))


def directions(run: Run) -> Array:
    """Return unit vectors along the path in the surface (N, 3), base frame; at rest that of the motion before.

    Before the first motion it is that of the first; of a reference that never moves along the surface it is t1. On a
    surface that moves it is the motion along the surface, without that of the surface.
    """
    normals = run.surface_normal
    step = np.gradient(run.reference_tip, axis=0) if len(run) > 1 else np.zeros_like(run.reference_tip)
    if len(run) > 1 and run.scenario.surface_motion.kind != "none":
        carried = run.velocity - run.slip_velocity - run.closure_rate[:, None] * normals
        step -= carried * np.gradient(run.time)[:, None]
    step = _along(step, normals)
    size = np.sqrt(_dot(step, step))
    moves = size > max(STILL * float(np.max(size, initial=0.0)), 1e-12)
    if not np.any(moves):
        found = np.tile(frame_of(run)[1], (len(run), 1))
    else:
        found = step[np.maximum.accumulate(np.where(moves, np.arange(len(run)), np.argmax(moves)))]
    found = _along(found, normals)  # of a surface that curves away since
    return found / np.sqrt(_dot(found, found))[:, None]


def _along(x: Array, normals: Array) -> Array:
    """Return the parts of vectors (N, 3) along the surface."""
    return x - _dot(x, normals)[:, None] * normals


def _dot(x: Array, y: Array) -> Array:
    """Return the inner products (N,) of vectors (N, 3)."""
    return np.einsum("ij,ij->i", x, y)


def sideways(run: Run, along: Array) -> Array:
    """Return the direction across the path (N, 3) in the surface, on the left of `along` (N, 3) seen from outside."""
    return np.cross(run.surface_normal, along)


def tip_errors(run: Run) -> TipErrors:
    """Return the tip's errors against the desired tip position."""
    off, along = run.position - run.reference_tip, directions(run)
    return TipErrors(*(_dot(off, axis) for axis in (along, sideways(run, along), run.surface_normal)))


def force_error(run: Run, force: Array) -> Array:
    """Return f − f_des (N,), N, of a force (N,), N; NaN while the tip is free."""
    return np.where(run.mode != FREE, force - run.reference_force, np.nan)
