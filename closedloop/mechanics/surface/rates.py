"""Whether a motion of a surface of a user's own moves as it says."""

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import is_users
from closedloop.mechanics.surface.placed import PlacedSurface

# Shares of the run's duration at which it is looked at, and of it between two displacements.
INSTANTS, APART = (0.1234, 0.4321, 0.7531), 1e-6
# Share by which a velocity may differ from differences of what it is the velocity of; and m/s.
WRONG_RATE = 1e-2


def check_rates(surface: PlacedSurface, duration: float) -> None:
    """Refuse a motion of a user's own whose velocity is not the rate of its displacement, from 0 to `duration`, s.

    It is compared with differences, to a hundredth: a velocity that was forgotten is meant, not its last digits.
    """
    if not is_users(surface.motion):
        return
    h = APART * duration
    for share in INSTANTS:
        t = share * duration
        moved = (_ends_of_axes(surface, t + h) - _ends_of_axes(surface, t - h)) / (2.0 * h)
        now, pose = _ends_of_axes(surface, t), surface.pose(t)
        said = pose.velocity + np.cross(pose.spin, now - pose.origin)
        if np.max(np.abs(moved - said)) > WRONG_RATE * max(float(np.max(np.abs(moved))), WRONG_RATE):
            worst = int(np.argmax(np.max(np.abs(moved - said), axis=1)))
            raise ScenarioError(
                f"surface_motion.kind = {surface.motion.kind}: at t = {t:.4g} s the surface moves with "
                f"{np.round(moved[worst], 6).tolist()} m/s, but its rates give "
                f"{np.round(said[worst], 6).tolist()} m/s: `rate` and `shift_rate` must be the "
                "derivatives of `angle` and `shift`"
            )


def _ends_of_axes(surface: PlacedSurface, t: float) -> Array:
    """Return where the surface's origin and the ends of its axes are at t, s: (4, 3), m, base frame."""
    turn, shift = surface.displacement(t)
    return (surface.origin + np.vstack([np.zeros(3), surface.frame])) @ turn.T + shift
