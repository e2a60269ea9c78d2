"""The values of a run's summary from the columns of a `Run`, many rows at a time, with nothing to compile.

What a row has to say is `closedloop.record.report.row_sample`, interpreted on columns. The largest, the sum, the first
of it over the rows is numpy's here; `closedloop.record.report.measured` has it row by row.
`tests/closedloop/record/test_measured.py` holds the two equal. Interpreted, the latter would take 3 s for the 8000
rows of wam_slide, and compiling it 10 s.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.record_row import RECORDED
from closedloop.record.columns.record import Record
from closedloop.record.columns.recorded import POSITIONS
from closedloop.record.report.alternation import SPAN, alternation
from closedloop.record.report.limited import count_limited
from closedloop.record.report.link_contacts import lost_to_slips
from closedloop.record.report.measured import Tally, Values, begin_tally, share_inside, write_values
from closedloop.record.report.row_sample import JointLimits, Sample, Scale, joint_limits, sample_row
from robot_models.coordinates import with_rotation_vectors

# So many rows at a time: their samples stay in the processor's cache.
ROWS = 2048

_LAST = ("contact_force", "closure_error", "mode", "normal_mobility")
_COLUMNS = tuple(name for name in RECORDED if name not in ("acceleration", "measured_force"))


def columns_of(run: Record, rows: slice = slice(None)) -> Any:
    """Return these rows of a run as `sample_row` reads them: columns (N,) and (k, N) by their names."""
    found = {name: getattr(run, name)[rows].T for name in _COLUMNS}
    if run.model.balls:
        found |= {
            name: with_rotation_vectors(found[name].T, run.model.joint_types).T for name in POSITIONS if name in found
        }
    return SimpleNamespace(**found)


@np.errstate(all="ignore")  # what overflows is named in the summary
def run_values(run: Record) -> Any:
    """Return the values of a run of at least one row, see `closedloop.record.report.measured.Values`."""
    n, count, h = run.model.n, len(run), run.scenario.time.step
    tally, values = Tally(np.zeros(Tally.count(n)), n), Values(np.zeros(Values.count(n)), n)
    interpreted(begin_tally)(tally, h, float(np.max(np.abs(run.reference_force))))
    Scale(tally.scale).start_energy = run.kinetic_energy[0] + run.potential_energy[0]
    Scale(tally.scale).start_supplied = run.energy_supplied[0]
    memory, signals = np.empty((Sample.count(n), min(ROWS, count))), np.empty((1 + n, 0))
    for rows in (slice(begin, min(begin + ROWS, count)) for begin in range(0, count, ROWS)):
        sample = Sample(memory[:, : rows.stop - rows.start], n)
        _sample_rows(run, rows, Scale(tally.scale), sample)
        if rows.start == 0:
            tally.start_error = float(memory[Sample.place("contact_error", n), 0])
            tally.powers_before[:] = sample.powers[:, 0]
        _count_rows(run.time[max(rows.start - 1, 0) : rows.stop], rows.start, sample, tally)
        signals = np.hstack([signals[:, 1 - SPAN :], sample.signals])
        tally.signals[:, -1] += alternation(signals.T)
    tally.condition = np.max(run.kkt_condition)
    last = SimpleNamespace(**{name: getattr(run, name)[-1] for name in _LAST})
    interpreted(write_values)(last, n, count, tally, values)
    if "torque_limited" in run.columns:
        count_limited(run.torque_limited, h, values)
    values.energy_lost_in_impacts = np.sum(run.event_energy_lost)
    values.energy_taken_at_rest = np.nansum(run.event_energy_rested)  # NaN in files from before there was the column
    if run.scenario.contact:
        values.energy_lost_to_friction += lost_to_slips(run.time, run.link_frictions, run.link_slips)
    values.largest_rate_cut = np.max(run.event_rate_cut, initial=0.0)
    values.events[:] = np.bincount(run.event_kind, minlength=values.events.size + 1)[1:]
    return values


def _sample_rows(run: Record, rows: slice, scale: Scale, sample: Sample) -> None:
    n = run.model.n
    wanted = SimpleNamespace(position=run.reference_tip[rows].T, force=run.reference_force[rows])
    limits = JointLimits(joint_limits(run.model), n)
    interpreted(sample_row)(columns_of(run, rows), n, run.potential_energy[rows], wanted, limits, scale, sample)


def _count_rows(time: Array, begin: int, sample: Sample, tally: Tally) -> None:
    """Count in the rows from row `begin` on; `time` is theirs and, unless it is the first, the one's before."""
    np.maximum(tally.greatest, np.max(sample.greatest, axis=1), out=tally.greatest)
    lowest = np.minimum(np.minimum.accumulate(sample.energy), tally.lowest_energy)
    tally.energy_gained = max(tally.energy_gained, np.max(sample.energy - lowest))
    tally.lowest_energy = lowest[-1]
    tally.sums += np.sum(sample.sums, axis=1)
    powers = np.hstack([tally.powers_before[:, None], sample.powers]) if begin > 0 else sample.powers
    tally.work += np.sum(0.5 * (powers[:, 1:] + powers[:, :-1]) * np.diff(time), axis=1)
    tally.powers_before[:] = sample.powers[:, -1]
    flagged = sample.flags > 0.0
    when = np.where(np.any(flagged, axis=1), time[-flagged.shape[1] :][np.argmax(flagged, axis=1)], np.nan)
    tally.first[:] = np.where(np.isnan(tally.first), when, tally.first)
    excess = np.concatenate([[tally.excess_before], sample.unsettled])
    enters = np.flatnonzero((excess[1:] <= 0.0) & (excess[:-1] > 0.0))
    if enters.size:
        at = enters[-1]
        tally.settled = begin + at - 1.0 + interpreted(share_inside)(excess[at], excess[at + 1])
    unsettled = np.flatnonzero(excess[1:] > 0.0)
    if unsettled.size:
        tally.last_unsettled = begin + unsettled[-1]
    tally.excess_before = excess[-1]
