"""none: no friction.

    F_t = 0

No parameters, no states.
"""

from closedloop.mechanics.friction.law import JointFriction, SurfaceFriction


class NoFriction(SurfaceFriction, JointFriction):
    """[friction] or [joint_friction] kind = "none": no friction."""
