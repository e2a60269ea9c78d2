"""Dry friction of joints and tendons, and the rows of both: joint r for r < n, then tendon r − n."""

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import kernel
from closedloop.loop.step.energy_supplied import driving_torque
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.mechanics.friction.answers import LIMIT
from closedloop.mechanics.friction.law import AT_REST
from robot_models.tendon import FRICTION, ROUGH, STOPS


@kernel
def part_of(constants: Constants, r: int, j: int) -> float:
    """Return what joint j does to r, per unit of its position."""
    n = constants.armature.shape[0]
    if r < n:
        return 1.0 if r == j else 0.0
    return float(constants.tendons[r - n, ROUGH + j])


@kernel
def rate_along(constants: Constants, r: int, x: Array) -> float:
    """Return the position of r, or its rate, at positions or rates x (n,) of the joints."""
    n = constants.armature.shape[0]
    if r < n:
        return float(x[r])
    s = 0.0
    for j in range(n):
        s += constants.tendons[r - n, ROUGH + j] * x[j]
    return s


@kernel
def add_along(constants: Constants, r: int, force: float, torque: Array) -> None:
    """Add what a torque, or a force, in r does to the torques (n,) of the joints."""
    n = constants.armature.shape[0]
    if r < n:
        torque[r] += force
        return
    for j in range(n):
        torque[j] += constants.tendons[r - n, ROUGH + j] * force


@kernel
def stops_of(constants: Constants, r: int) -> tuple[float, float]:
    """Return the lower and the upper stop of r, infinite where there is none."""
    n = constants.armature.shape[0]
    if r < n:
        return float(constants.lower_stop[r]), float(constants.upper_stop[r])
    return float(constants.tendons[r - n, STOPS]), float(constants.tendons[r - n, STOPS + 1])


@kernel
def joint_limits(w: Work, constants: Constants, state: State) -> None:
    """Write the limits, N m (N): of a joint at rest what holds it at most, of another its dry friction; of tendons."""
    call_at(state.joint_friction.entry, state.address, LIMIT)
    for j in range(w.q.shape[0]):
        if not abs(w.v[j]) <= max(constants.joint_capture_speed[j], AT_REST):
            w.joint_friction.limit[j] = abs(w.joint_friction.dry[j])
        if constants.gears.load_friction[j] > 0.0:
            w.joint_friction.limit[j] += constants.gears.load_friction[j] * abs(driving_torque(w, state, j))
    for t in range(state.tendons):
        w.joint_friction.limit[w.q.shape[0] + t] = constants.tendons[t, FRICTION]
