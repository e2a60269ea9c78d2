"""The motors behind elastic joints: their angles and rates are the last of z, see `closedloop.control.transmission`."""

from __future__ import annotations

from closedloop.jit.kernel import kernel
from closedloop.loop.step.memory import Constants, Work


@kernel
def transmit(w: Work, constants: Constants) -> None:
    """Write the torque that the transmissions pass on to the links, `transmitted` (n,), N m."""
    n = w.q.shape[0]
    at = w.z.shape[0] - 2 * n
    for j in range(n):
        spring = constants.stiffness[j] * (w.z[at + j] - w.q[j])
        w.drives.transmitted[j] = spring + constants.shaft_damping[j] * (w.z[at + n + j] - w.v[j])


@kernel
def motor_rates(w: Work, constants: Constants) -> None:
    """Write the rates of the motors' states, from the torque and what the transmissions pass on."""
    n = w.q.shape[0]
    at = w.z.shape[0] - 2 * n
    for j in range(n):
        w.dz[at + j] = w.z[at + n + j]
        if constants.motor_inertia[j] > 0.0:
            w.dz[at + n + j] = (w.torque[j] - w.drives.transmitted[j]) / constants.motor_inertia[j]
        else:  # a joint without a drive
            w.dz[at + n + j] = 0.0


@kernel
def lead_motors(w: Work, tau: float, substep: bool) -> None:
    """For the semi-implicit scheme, let the motors' angles advance with their new rates, as the joints do.

    In a substep after an event it is the mean of the old and the new rate, see `closedloop.loop.step.advance.advance`.
    """
    n = w.q.shape[0]
    at = w.z.shape[0] - 2 * n
    for j in range(n):
        w.dz[at + j] = w.z[at + n + j] + (0.5 * tau if substep else tau) * w.dz[at + n + j]
