"""The surfaces of contacts that are no planes at rest: where each is, and the memory by which the loop asks it.

They are those of the tip (`closedloop.mechanics.surface`), in the axes of the frame that carries them: `through` is the
surface's origin and `normal` its normal there, and what moves moves relative to that frame.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Member
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.surface.contact import SurfaceMemory
from closedloop.mechanics.surface.motion import MOTIONS
from closedloop.mechanics.surface.placed import PlacedSurface, Touching, contact_frame, unit
from closedloop.mechanics.surface.surface import SURFACES, Surface


class Called(NamedTuple):
    """A member of contact `contact`, by its key in [[contact]], its entry kernel, and the address that it takes."""

    contact: int
    key: str
    member: Member
    entry: Any
    address: int


class ContactSurfaces(NamedTuple):
    """The surfaces of k contacts as the loop reads them: addresses of entry and memory, and what they are of."""

    addresses: IntArray  # (2 k,), zero of a plane at rest
    placed: dict[int, tuple[PlacedSurface, SurfaceMemory]]  # by the number of the contact

    def entries(self) -> list[Called]:
        """Return the entry kernels of the surfaces and of their motions, and what they are of."""
        found = []
        for i, (surface, memory) in self.placed.items():
            for what, entry in surface.entries().items():
                key, member = ("motion", surface.motion) if what == "surface_motion" else ("surface", surface.section)
                found.append(Called(i, key, member, entry, memory.address))
        return found

    def connect(self, address: Callable[[Any], int]) -> None:
        """Write where the entries are, by what gives the address of one."""
        for i, (surface, memory) in self.placed.items():
            entries = surface.entries()
            self.addresses[2 * i : 2 * i + 2] = address(entries["surface"]), memory.address
            if surface.moves:
                memory.links.motion = address(entries["surface_motion"])


def surface_of(section: ContactSection, name: str = "") -> PlacedSurface | None:
    """Return the surface of a contact in the axes of the frame that carries it, None of a plane at rest.

    Raises ScenarioError if it says what the contact says, or is neither flat nor at rest where the shape that touches
        it is no ball; `name` is the contact's in the message.
    """
    surface, motion = section.surface, section.motion
    if surface is None and motion is None:
        return None
    where = f"contact {name!r}"
    surface = SURFACES["plane"]() if surface is None else surface
    motion = MOTIONS["none"]() if motion is None else motion
    if surface.kind == "none":
        raise ScenarioError(f"{where}: surface.kind = 'none': must be a surface: leave the contact out")
    said = {*Surface.model_fields, "point", "offset"} - {"kind", "extent", "edge_radius"}
    for key in said & surface.model_fields_set:
        if getattr(surface, key) != type(surface).model_fields[key].default:
            raise ScenarioError(f"{where}: surface.{key}: must be left out: normal and through say where it is")
    frame = contact_frame(unit(section.normal, f"{where}: normal"))
    surface = surface.model_copy(update={"normal": section.normal})  # its axis is at right angles to it
    placed = PlacedSurface(surface, motion, frame, np.array(section.through), False, section.radius)
    if placed.fixed_plane:
        return None
    if section.half_axes is not None:
        raise ScenarioError(
            f"{where}: half_axes: must be left out with a surface that is curved or moves: give a ball's radius"
        )
    return placed


def surfaces_of(sections: tuple[ContactSection, ...], names: tuple[str, ...]) -> dict[int, PlacedSurface]:
    """Return the surfaces that are no planes at rest, by the number of their contact, the tip's being 0."""
    found = {i: surface_of(section, name) for i, (section, name) in enumerate(zip(sections, names, strict=True), 1)}
    return {i: surface for i, surface in found.items() if surface is not None}


def contact_surfaces(surfaces: dict[int, PlacedSurface], k: int) -> ContactSurfaces:
    """Return the surfaces of k contacts, with a new memory of each."""
    return ContactSurfaces(
        np.zeros(2 * k, dtype=np.int64), {i: (surface, surface.memory()) for i, surface in surfaces.items()}
    )


def check_surface(surface: PlacedSurface, place: Array, name: str) -> Touching:
    """Return how a point at `place` (3,), m, axes of the frame that carries a surface, is to it at the start.

    Raises ScenarioError if the surface's parameters do not go together, or it has no normal there; `name` is the
        contact's.
    """
    try:
        return surface.touching(place)
    except ScenarioError as error:
        raise ScenarioError(*(f"contact {name!r}: {line}" for line in str(error).splitlines())) from None
