"""What the contacts of the links are called, in messages and in columns."""

from __future__ import annotations

import re

from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.scenario.tables import names_in


def names_of(sections: tuple[ContactSection, ...]) -> tuple[str, ...]:
    """Return the names of the contacts, in the order of their sections."""
    return names_in("contact", sections)


def patches_of(sections: tuple[ContactSection, ...]) -> dict[str, list[int]]:
    """Return the numbers of contacts, from 0, by the name that points share: "foot 1" and "foot 2" are of "foot"."""
    found: dict[str, list[int]] = {}
    for k, name in enumerate(names_of(sections)):
        found.setdefault(re.sub(r" \d+$", "", name), []).append(k)
    return found


def labels_of(sections: tuple[ContactSection, ...]) -> tuple[str, ...]:
    """Return what columns call the contacts: each its own, of letters of ASCII, digits and underscores.

    "floor left" is floor_left. Where several would have one label, its number stands behind each, the first section 1:
    of two called "foot" and one called "toe", foot_1, foot_2 and toe.
    """
    plain = [re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_")[:30] for name in names_of(sections)]
    labels = [name if plain.count(name) == 1 and name else f"{name}_{i}".lstrip("_") for i, name in enumerate(plain, 1)]
    while len(set(labels)) < len(labels):  # foot, foot and foot_2
        labels = [f"{name}_{i}" if labels.count(name) > 1 else name for i, name in enumerate(labels, 1)]
    return tuple(labels)


def tangents_of(labels: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the two tangents of each contact are called, as columns along them are ordered."""
    return tuple(f"{label}_{tangent}" for label in labels for tangent in ("t1", "t2"))
