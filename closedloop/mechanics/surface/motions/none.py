"""[surface_motion] kind = "none": the surface is at rest, as in the paper."""

from closedloop.mechanics.surface.motion import SurfaceMotion


class NoMotion(SurfaceMotion):
    """The surface is at rest."""
