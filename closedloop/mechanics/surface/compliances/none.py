"""[compliance] kind = "none": the surface is rigid, as in the paper."""

from closedloop.mechanics.surface.surface import Compliance


class Rigid(Compliance):
    """The surface is rigid; the contact force is the multiplier of Eq. 24."""
