"""poisson: P_n of decompression = ε P_n of compression

Kinetic: the energy never grows.
"""

from typing import ClassVar

from closedloop.mechanics.impact.single import Restitution


class Poisson(Restitution):
    """Poisson's: a ratio of impulses."""

    ratio_of: ClassVar = "impulses"
