"""Errors of a run along the path, across it, and along the surface's normal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import FREE
from closedloop.record.run import Run
from closedloop.surface.plane import contact_frame, unit

Array = NDArray[np.float64]

# A desired motion slower than this share of its largest step has no direction of its own.
STILL = 1e-3


class TipErrors(NamedTuple):
    """Tip errors r − r_des (N,), m: along the path, across it in the surface, along the normal."""

    along: Array
    across: Array
    normal: Array


def frame_of(run: Run) -> Array:
    """Return the contact frame (3, 3): rows n, t1, t2 in base axes."""
    return contact_frame(unit(run.scenario.surface.normal, "surface.normal"))


def directions(run: Run) -> Array:
    """Return the direction of the path in the surface (N, 2), along t1 and t2; at rest that of the motion before.

    Before the first motion it is that of the first; of a reference that never moves along the surface it is t1.
    """
    wanted = run.reference_tip @ frame_of(run)[1:].T
    step = np.gradient(wanted, axis=0) if len(run) > 1 else np.zeros_like(wanted)
    size = np.linalg.norm(step, axis=1)
    moves = size > max(STILL * float(np.max(size, initial=0.0)), 1e-12)
    if not np.any(moves):
        return np.tile([1.0, 0.0], (len(run), 1))
    rows = np.flatnonzero(moves)
    at = rows[np.clip(np.searchsorted(rows, np.arange(len(run)), side="right") - 1, 0, None)]
    found: Array = step[at] / size[at][:, None]
    return found


def tip_errors(run: Run) -> TipErrors:
    """Return the tip's errors against the desired tip position."""
    frame, along = frame_of(run), directions(run)
    off = (run.position - run.reference_tip) @ frame.T
    across = np.column_stack((-along[:, 1], along[:, 0]))
    return TipErrors(np.sum(off[:, 1:] * along, axis=1), np.sum(off[:, 1:] * across, axis=1), off[:, 0])


def force_error(run: Run, force: Array) -> Array:
    """Return f − f_des (N,), N, of a force (N,), N; NaN while the tip is free."""
    error: Array = np.where(run.mode != FREE, force - run.reference_force, np.nan)
    return error
