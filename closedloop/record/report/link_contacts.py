"""What is reported of the contacts of the links: their forces, and how well complementarity and cone are kept."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.mechanics.contacts.soft import is_soft
from closedloop.record.columns.record import Record
from closedloop.scenario.contact_names import names_of

Array = NDArray[np.float64]


class ContactFaults(NamedTuple):
    """By how much the k contacts of links miss their conditions, over all rows of a run.

    Attributes
    ----------
    names : tuple of str
        What they are called.
    cone : (k,) array
        The largest |F_t| − μ f, and −f, N; not below zero.
    complementarity : (k,) array
        The largest |f| times the gap, N m; zero of a soft one.
    """

    names: tuple[str, ...]
    cone: Array
    complementarity: Array


def contact_faults(run: Record) -> ContactFaults | None:
    """Return by how much the contacts of links miss their conditions; None if there are none."""
    sections = run.scenario.contact
    if not sections or not len(run):
        return None
    f, rub = run.link_forces, run.link_frictions.reshape(len(run), len(sections), 2)
    mu = np.array([section.friction for section in sections])
    soft = np.array([is_soft(section) for section in sections])
    outside = np.maximum(np.hypot(rub[..., 0], rub[..., 1]) - mu * f, -f)
    return ContactFaults(
        names_of(sections), np.max(np.maximum(outside, 0.0), axis=0), np.max(np.abs(f * run.link_gaps * ~soft), axis=0)
    )


def contact_rows(run: Record) -> list[tuple[str, str, str, str]]:
    """Return the rows of the table of errors: quantity, value, unit, and what stands beside it."""
    found = contact_faults(run)
    if found is None:
        return []
    largest = np.max(run.link_forces, axis=0)
    most, cone, product = (int(np.argmax(part)) for part in (largest, found.cone, found.complementarity))
    return [
        ("contacts: largest force", f"{largest[most]:.4g}", "N", found.names[most]),
        ("contacts: outside the cone", f"{found.cone[cone]:.1g}", "N", found.names[cone]),
        ("contacts: force times gap", f"{found.complementarity[product]:.1g}", "N m", found.names[product]),
    ]
