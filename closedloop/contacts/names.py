"""What the contacts of the links are called, in columns and messages."""

from __future__ import annotations

from closedloop.scenario.contact_sections import ContactSection


def names_of(sections: tuple[ContactSection, ...]) -> tuple[str, ...]:
    """Return the names of the contacts, in the order of their sections."""
    return tuple(section.name or f"contact {i}" for i, section in enumerate(sections, 1))


def tangents_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the two tangents of each contact are called, as columns along them are ordered."""
    return tuple(f"{name} {tangent}" for name in names for tangent in ("t1", "t2"))
