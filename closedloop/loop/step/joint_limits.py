"""The largest torques of dry friction in the joints, and forces of that in tendons."""

from __future__ import annotations

from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.loop.step.entries import LIMIT
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.mechanics.friction.quantities import AT_REST
from robot_models.tendon import FRICTION


@kernel
def joint_limits(w: Work, constants: Constants, state: State) -> None:
    """Write the limits, N m (N): of a joint at rest what holds it at most, of another its dry friction; of tendons."""
    call_at(state.joint_friction.entry, state.address, LIMIT)
    for j in range(w.q.shape[0]):
        if not abs(w.v[j]) <= max(constants.joint_capture_speed[j], AT_REST):
            w.joint_friction.limit[j] = abs(w.joint_friction.dry[j])
    for t in range(state.tendons):
        w.joint_friction.limit[w.q.shape[0] + t] = constants.tendons[t, FRICTION]
