"""stronge: work of P_n in decompression = −ε² its work in compression

Energetic: the normal impulse and friction each take energy, by themselves. Source: W. J. Stronge, Rigid body
collisions with friction, Proc. R. Soc. A 431, 1990.
"""

from typing import ClassVar

from closedloop.mechanics.impact.single import Restitution


class Stronge(Restitution):
    """Stronge's: a ratio of energies."""

    ratio_of: ClassVar = "energies"
