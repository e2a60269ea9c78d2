"""The values of a run's summary from its columns, those of the contacts of links among them.

What a row has to say is `closedloop.record.report.measures`, interpreted on columns. The largest, the sum, the first
of it over the rows is numpy's here; `closedloop.record.report.measured` has it row by row.
`tests/closedloop/record/test_measured.py` holds the two equal. Interpreted, the latter would take 3 s for the 8000
rows of wam_slide, and compiling it 10 s.
"""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.record_row import RECORDED
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.mechanics.contacts.soft import is_soft
from closedloop.mechanics.integrators import steps_impulses
from closedloop.record.columns.record import POSITIONS, Record
from closedloop.record.columns.touching import contact_torques
from closedloop.record.report.measured import Tally, Values, begin_tally, share_inside, write_values
from closedloop.record.report.measures import SPAN, JointLimits, Sample, Scale, alternation, joint_limits, sample_row
from closedloop.record.report.verdict import count_limited
from closedloop.scenario.tables import names_of
from robot_models.coordinates import in_pinocchios_order, with_rotation_vectors

# Sets of modes that are looked at; and what is left of a row, of the largest, that depends on others.
MOST_SETS, SAME_ROW = 20, 1e-9


class ContactFaults(NamedTuple):
    """By how much the k contacts of links miss their conditions, over all rows of a run."""

    names: tuple[str, ...]  # what they are called
    cone: Array  # (k,): the largest |F_t| − μ f, and −f, N; not below zero
    complementarity: Array  # (k,): the largest |f| times the gap, N m; zero of a soft one
    depth: Array  # (k,): how deep one that presses is in its surface at most, m; zero of a soft one


def lost_to_slips(time: Array, frictions: Array, slips: Array) -> float:
    """Return the energy that sliding friction took at contacts of links, J, from (N,) instants and (N, 2 k) columns.

    It counts with the slip, as `closedloop.record.report.measures.friction_power` does at the tip.
    """
    power = np.sum(frictions * slips, axis=1)
    return -float(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(time)))


def contact_faults(run: Record) -> ContactFaults | None:
    """Return by how much the contacts of links miss their conditions; None if there are none."""
    sections = run.scenario.contact
    if not sections or not len(run):
        return None
    f, friction = run.link_forces, run.link_frictions.reshape(len(run), len(sections), 2)
    mu = np.array([coulomb_of(section) for section in sections])
    others = np.array([has_other_law(section) for section in sections])  # which have bounds of their own
    soft = np.array([is_soft(section) for section in sections])
    outside = np.maximum(np.where(others, 0.0, np.hypot(friction[..., 0], friction[..., 1]) - mu * f), -f)
    gaps = run.link_gaps
    if steps_impulses(run.scenario.time.integrator):  # whose forces go with the gaps at the step's end
        f, gaps = f[:-1], gaps[1:]
    missed = np.max(np.abs(f * gaps * ~soft), axis=0, initial=0.0)
    depth = np.max(np.where((f > 0.0) & ~soft, -gaps, 0.0), axis=0, initial=0.0)
    return ContactFaults(names_of(sections), np.max(np.maximum(outside, 0.0), axis=0), missed, depth)


def share_not_determined(run: Record) -> tuple[float, int, int] | None:
    """Return from when on rigid bodies do not determine the share of each contact; None if they do, or there are loops.

    That is the instant, s, how many rows there are then, and how many of them depend on no others, see `shares_at`.
    Looked at is the first row of each set of modes, of at most `MOST_SETS` of them.
    """
    if not run.scenario.contact or not len(run) or run.loops is not None:
        return None
    firsts = np.sort(np.unique(run.link_modes, axis=0, return_index=True)[1])
    for row in firsts[:MOST_SETS]:
        _, count, rank = shares_at(run, int(row))
        if rank < count:
            return float(run.time[row]), count, rank
    return None


def shares_at(run: Record, row: int) -> tuple[NDArray[np.bool_], int, int]:
    """Return of which contacts rigid bodies do not determine the share at a row, the number of rows, and their rank.

    The rows are those of the contacts that are closed, along their normals and, where they stick, along the surface:
    those that depend on each other have no unique forces. What soft contacts bear follows from how deep they are.
    """
    sections = run.scenario.contact or ()
    k, modes = len(sections), run.link_modes[row]
    held = [coulomb_of(each) > 0.0 or getattr(each.friction_law, "sticks", "") == "rigid" for each in sections]
    rigid = np.array([not is_soft(each) for each in sections])
    units = [(i, 0) for i in np.flatnonzero(rigid & (modes != FREE))]
    units += [(i, j) for i in np.flatnonzero(rigid & (modes == STUCK)) if held[i] for j in (1, 2)]
    undetermined = np.zeros(k, dtype=bool)
    if not units:
        return undetermined, 0, 0
    forces, frictions = np.zeros((len(units), k)), np.zeros((len(units), 2 * k))
    for at, (i, j) in enumerate(units):
        if j == 0:
            forces[at, i] = 1.0
        else:
            frictions[at, 2 * i + j - 1] = 1.0
    times, q = (
        np.full(len(units), run.time[row]),
        np.tile(in_pinocchios_order(run.q[row], run.model.joint_types), (len(units), 1)),
    )
    rows = contact_torques(run.scenario, run.model.pinocchio_model(), times, q, forces, frictions)
    ways, sizes, _ = np.linalg.svd(rows)
    rank = int(np.count_nonzero(sizes > SAME_ROW * float(np.max(np.abs(rows), initial=0.0))))
    for at, (i, _) in enumerate(units):
        undetermined[i] |= bool(np.max(np.abs(ways[at, rank:]), initial=0.0) > SAME_ROW)
    return undetermined, len(units), rank


def contact_rows(run: Record) -> list[tuple[str, str, str, str]]:
    """Return the rows of the table of errors: quantity, value, unit, and what stands beside it."""
    found = contact_faults(run)
    if found is None:
        return []
    largest = np.max(run.link_forces, axis=0)
    most, cone, product, deep = (int(np.argmax(part)) for part in (largest, *found[1:]))
    shares = share_not_determined(run)
    said = []
    if shares is not None:
        at, count, rank = shares
        what = f"{rank} of {count} rows are independent; the forces of least norm are recorded"
        said = [("share of each contact not determined", f"from {at:.4g}", "s", what)]
    return [
        *said,
        ("contacts: largest force", f"{largest[most]:.4g}", "N", found.names[most]),
        ("contacts: outside the cone", f"{found.cone[cone]:.1g}", "N", found.names[cone]),
        ("contacts: force times gap", f"{found.complementarity[product]:.1g}", "N m", found.names[product]),
        ("contacts: depth in a rigid surface", f"{found.depth[deep]:.1g}", "m", found.names[deep]),
    ]


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
    values.energy_taken_at_rest = np.sum(run.event_energy_rested)
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
