"""The columns of the links' contacts, a column for each contact, named by it: ``link_forces_floor_left``."""

from __future__ import annotations

from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.record.columns.recorded import CONTACT_COLUMNS, RESISTANCE_COLUMNS
from closedloop.scenario.contact_names import labels_of, tangents_of


def columns_by_contact(sections: tuple[ContactSection, ...]) -> dict[str, tuple[str, int]]:
    """Return name -> column of `CONTACT_COLUMNS`, and the place in it; one along a tangent ends in ``_t1``, ``_t2``."""
    labels = labels_of(sections)
    ways = {"contact": labels, "contact_tangent": tangents_of(labels)}
    return {
        f"{name}_{label}": (name, k)
        for name, spec in CONTACT_COLUMNS.items()
        if name not in RESISTANCE_COLUMNS or any(section.resists for section in sections)
        for k, label in enumerate(ways[spec.dims[1]])
    }
