"""newton: u_n⁺ = −ε u_n⁻

Kinematic: it prescribes a velocity, and can create energy where slip reverses or sticks (Kane and Levinson 1985); the
impact is then cut off at the instant when the energy is back at its value before.
"""

from typing import ClassVar

from closedloop.mechanics.impact.single import Restitution


class Newton(Restitution):
    """Newton's: a ratio of velocities."""

    ratio_of: ClassVar = "velocities"
