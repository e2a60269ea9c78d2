"""What is reported of the contacts of the links: their forces, and how well complementarity and cone are kept."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.mechanics.contacts.soft import is_soft
from closedloop.record.columns.record import Record
from closedloop.record.columns.touching import contact_torques
from closedloop.scenario.contact_names import names_of
from robot_models.coordinates import in_pinocchios_order

# Sets of modes that are looked at; and what is left of a row, of the largest, that depends on others.
MOST_SETS, SAME_ROW = 20, 1e-9


class ContactFaults(NamedTuple):
    """By how much the k contacts of links miss their conditions, over all rows of a run."""

    names: tuple[str, ...]  # what they are called
    cone: Array  # (k,): the largest |F_t| − μ f, and −f, N; not below zero
    complementarity: Array  # (k,): the largest |f| times the gap, N m; zero of a soft one


def lost_to_slips(time: Array, frictions: Array, slips: Array) -> float:
    """Return the energy that sliding friction took at contacts of links, J, from (N,) instants and (N, 2 k) columns.

    It counts with the slip, as `closedloop.record.report.row_sample.friction_power` does at the tip.
    """
    power = np.sum(frictions * slips, axis=1)
    return -float(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(time)))


def contact_faults(run: Record) -> ContactFaults | None:
    """Return by how much the contacts of links miss their conditions; None if there are none."""
    sections = run.scenario.contact
    if not sections or not len(run):
        return None
    f, rub = run.link_forces, run.link_frictions.reshape(len(run), len(sections), 2)
    mu = np.array([coulomb_of(section) for section in sections])
    others = np.array([has_other_law(section) for section in sections])  # which have bounds of their own
    soft = np.array([is_soft(section) for section in sections])
    outside = np.maximum(np.where(others, 0.0, np.hypot(rub[..., 0], rub[..., 1]) - mu * f), -f)
    return ContactFaults(
        names_of(sections), np.max(np.maximum(outside, 0.0), axis=0), np.max(np.abs(f * run.link_gaps * ~soft), axis=0)
    )


def share_not_determined(run: Record) -> tuple[float, int, int] | None:
    """Return from when on rigid bodies do not determine the share of each contact; None if they do, or there are loops.

    See `shares_at`. Looked at is the first row of each set of modes, of at most `MOST_SETS` of them.

    Returns
    -------
    tuple of float, int, int
        The instant, s, how many rows there are then, and how many of them depend on no others.
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
    most, cone, product = (int(np.argmax(part)) for part in (largest, found.cone, found.complementarity))
    shares = share_not_determined(run)
    said = []
    if shares is not None:
        at, count, rank = shares
        what = f"{rank} of {count} rows are independent; that of least norm is given"
        said = [("share of each contact not determined", f"from {at:.4g}", "s", what)]
    return [
        *said,
        ("contacts: largest force", f"{largest[most]:.4g}", "N", found.names[most]),
        ("contacts: outside the cone", f"{found.cone[cone]:.1g}", "N", found.names[cone]),
        ("contacts: force times gap", f"{found.complementarity[product]:.1g}", "N m", found.names[product]),
    ]
