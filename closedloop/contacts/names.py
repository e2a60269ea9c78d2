"""What the contacts of the links are called, in columns and messages."""

from __future__ import annotations

from closedloop.scenario.contact_sections import ContactSection
from closedloop.scenario.tables import names_in


def names_of(sections: tuple[ContactSection, ...]) -> tuple[str, ...]:
    """Return the names of the contacts, in the order of their sections."""
    return names_in("contact", sections)


def tangents_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the two tangents of each contact are called, as columns along them are ordered."""
    return tuple(f"{name} {tangent}" for name in names for tangent in ("t1", "t2"))
