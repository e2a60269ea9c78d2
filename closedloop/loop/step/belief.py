"""The controller's model of the arm, where it is wrong: its H and C, from those of the arm.

    H' = κ (H − m JᵣᵀJᵣ − D) + D        C' = κ (C − m Jᵣᵀ(J̇ᵣq̇ − g))

with m a payload at the tip that it does not know of, κ the factor by which it is wrong about all masses, and D the
drives' inertia. Both are exact: C is linear in the masses, and m JᵣᵀJᵣ and m Jᵣᵀ(J̇ᵣq̇ − g) are what a point mass adds.
"""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.loop.step.memory import Constants, Work


@kernel
def believe(w: Work, constants: Constants) -> None:
    """Overwrite H and C, which the control law reads, by those of the controller's model."""
    k, m = constants.believed_masses, constants.unknown_payload
    for i in range(w.q.shape[0]):
        carried = 0.0
        for a in range(3):
            carried += w.J[a, i] * (w.drift[a] - constants.gravity[a])
        w.C[i] = k * (w.C[i] - m * carried)
        for j in range(w.q.shape[0]):
            moved = 0.0
            for a in range(3):
                moved += w.J[a, i] * w.J[a, j]
            drive = constants.armature[i] if i == j else 0.0
            w.H[i, j] = k * (w.H[i, j] - m * moved - drive) + drive
