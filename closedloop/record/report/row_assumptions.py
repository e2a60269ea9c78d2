"""Whether each of the paper's assumptions holds in a row of the record."""

from __future__ import annotations

from typing import Any

from closedloop.jit.kernel import kernel_inlined
from closedloop.mechanics.closure.contact_force import FREE, STUCK

# Eq. 24 is solved to rounding: n additions of rounding 1e-16 each, with room for the conditioning of H.
RESIDUAL_TOLERANCE = 1e-12
# Below this share of its mobility the tip is within 1e-3 rad of a singular pose, and f, q̈ and Q along the normal
# grow a thousandfold; the simulation itself stops only at `closedloop.mechanics.closure.solve.SINGULAR_MOBILITY`.
NEAR_SINGULAR = 1e-6
# On the way through such a pose, within 1e-2 rad of it. A force that has a limit in the pose is about as large from
# there on; one that has none is ten times as large 1e-3 rad from it, and grows as one over the distance.
ON_THE_WAY = 1e-4
MOST_GROWTH = 2.0
NAMES = ("one_loop", "single_point", "contact_kept", "frictionless", "nonsingular")


@kernel_inlined
def assumptions_met(row: Any, friction: float, in_joints: float) -> Any:
    """Return whether each of `NAMES` holds in a row (`closedloop.loop.step.record_row.Row`), or in columns of rows.

    `friction` and `in_joints` are zero where there is none at the tip and in the joints.
    """
    met = row.residual_motion <= RESIDUAL_TOLERANCE
    return (
        (row.residual_closure <= RESIDUAL_TOLERANCE) & (row.mode != STUCK),
        met,
        (row.contact_force > 0.0) & (row.mode != FREE),
        met & (friction == 0.0) & (in_joints == 0.0),
        (row.normal_mobility > NEAR_SINGULAR) | (row.mode == FREE),  # an open contact closes no loop
    )
