"""How much later a log began than a run: the shift at which both differ least."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from closedloop.base.arrays import Array
from closedloop.record.run import Run
from closedloop.studies.comparison.recording import Recording

# Shifts that are tried, the rows that they are tried on, and the share of the shorter one that must overlap.
SHIFTS, TRIED_ROWS, OVERLAP = 800, 400, 0.5
# A signal whose spread is below this tells no shift.
STILL = 1e-4


def shift_of(clock: Array, recording: Recording, run: Run) -> tuple[float, str]:
    """Return the shift at which log and run differ least, and what told it."""
    pairs = [("q", recording.q, run.q)] if recording.q is not None else []
    if recording.force is not None and run.scenario.has_surface:
        size = recording.force if recording.force.ndim == 1 else np.linalg.norm(recording.force, axis=1)
        pairs.append(("force", np.abs(size)[:, None], np.abs(run.contact_force)[:, None]))
    if recording.speed is not None:
        pairs.append(("speed", recording.speed[:, None], np.linalg.norm(run.velocity, axis=1)[:, None]))
    for name, logged, simulated in pairs:
        spread = simulated.std(axis=0)
        moves = (spread > STILL) & (logged.std(axis=0) > STILL)
        if moves.any():
            return _best_shift(
                clock, logged[:, moves] / spread[moves], run.time, simulated[:, moves] / spread[moves]
            ), name
    return 0.0, ""


def _best_shift(clock: Array, logged: Array, time: Array, simulated: Array) -> float:
    """Return the shift of least mean square difference: of many, then between the best one's neighbours."""
    rows = np.unique(np.linspace(0, len(clock) - 1, TRIED_ROWS).astype(int))
    shorter = min(clock[-1], time[-1] - time[0])
    first, last = clock[0] - time[-1] + OVERLAP * shorter, clock[-1] - time[0] - OVERLAP * shorter

    def cost(shift: float, rows: NDArray[np.int64] = rows) -> float:
        at = clock[rows] - shift
        inside = (at >= time[0]) & (at <= time[-1])
        there = rows[inside]
        if len(there) < 10:
            return np.inf
        return sum(
            float(np.mean((logged[there, k] - np.interp(at[inside], time, simulated[:, k])) ** 2))
            for k in range(logged.shape[1])
        )

    shifts = np.union1d(np.linspace(first, last, SHIFTS), [0.0])
    best = int(np.argmin([cost(shift) for shift in shifts]))
    around = shifts[max(best - 1, 0)], shifts[min(best + 1, len(shifts) - 1)]
    every = np.arange(len(clock))
    found = minimize_scalar(lambda s: cost(s, every), bounds=around, method="bounded", options={"xatol": 1e-7})
    return float(found.x) if found.fun < cost(shifts[best], every) else float(shifts[best])
