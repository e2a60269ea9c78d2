"""The base class of compliances: a section of the scenario, and the force of a soft surface as a function of depth.

A soft surface pushes with f(δ, δ̇), δ the depth of the tip in it, in place of the multiplier of Eq. 24: there is no
constraint along the normal, and nothing for a stabiliser to do there. As the stiffness grows, f approaches that
multiplier. A surface that the tip may leave (unilateral) does not pull: where f(δ, δ̇) is negative, f is zero; contact
begins and ends at δ = 0, without an impulse.

A compliance of one's own is a class derived from `Compliance`, with its parameters as typed fields and two functions.
Those that ship are in `closedloop.mechanics.surface.compliances`, one file each, written the same way.
"""

from __future__ import annotations

from typing import Any, ClassVar

from closedloop.base.families import Family, Parameters

# Gauss and Legendre's rule with eight points, on −1 to 1: half of the points, and their weights.
POINTS = (0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363)
WEIGHTS = (0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763)


class Compliance(Parameters):
    """[compliance]: stiffness and damping of the surface."""

    folder: ClassVar[str] = "closedloop.mechanics.surface.compliances"

    def static_depth(self, force: float) -> float:
        """Return the depth, m, at which the surface pushes a tip at rest with a force >= 0, N."""
        return 0.0

    def tangent(self, depth: float) -> tuple[float, float]:
        """Return stiffness, N/m, and damping, N s/m, of small motions about a depth, m: what a step must resolve."""
        return 0.0, 0.0

    @staticmethod
    def force(depth: float, speed: float, par: Any) -> float:
        """Return the force f along the normal, N, at a depth, m, that grows at `speed`, m/s."""
        return 0.0


COMPLIANCES = Family(Compliance, usual="none")
