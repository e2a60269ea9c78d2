"""The energy supplied to the arm: the work of torque, contact force and friction, less the losses in events.

It is integrated with the motion, by the same scheme, over every substep: a step divided by an event is the sum of its
substeps, each with the power on its own side of the event. The difference between the arm's energy and this integral
is then the error of the run, of the integrator's order, without the error of a quadrature over rows. In a scheme of one
stage, which holds the torque over the step, the work is that torque times the mean of the velocities before and after.

    P = (Q + τ)ᵀq̇ + F·N ṙ        F = (f, F_t) at the tip, N ṙ = u on a surface at rest

with τ the friction of the joints and what forces from outside do (`closedloop.loop.step.external`).

Loops do no work, but for those of a frame that moves as it is told: the power of all is Pₗ = (Gᵀλ)ᵀq̇, with Gᵀλ what is
missing in the equation of motion.

It counts from row 0, which holds the state after the events of t = 0: what these took is in the table of events alone.

With elastic joints the arm ends at the links: Q is then what they pass on to these.
"""

from closedloop.jit.kernel import kernel_inlined
from closedloop.loop.step.memory import State, Work, takes_one_stage


@kernel_inlined
def driving_torque(w: Work, state: State, j: int) -> float:
    """Return the torque that drives the link of joint j, N m: Q, or what an elastic joint passes on."""
    torque: float = w.torque[j]
    if state.settings.elastic != 0:
        torque = w.drives.transmitted[j]
    return torque


@kernel_inlined
def applied_torque(w: Work, state: State, j: int) -> float:
    """Return the torque of all forces but gravity and those of closures on the link of joint j, N m."""
    torque: float = driving_torque(w, state, j) + w.joint_friction.torque[j] + w.external[j]
    return torque


@kernel_inlined
def power(w: Work, state: State) -> float:
    """Return the power P of all forces but gravity at the state evaluated last, W."""
    total: float = (
        w.tip.F[0] * (w.tip.u[0] + w.tip.carried[0])
        + w.tip.F[1] * (w.tip.u[1] + w.tip.carried[1])
        + w.tip.F[2] * (w.tip.u[2] + w.tip.carried[2])
    )
    for j in range(w.v.shape[0]):
        total += applied_torque(w, state, j) * w.v[j]
    if state.coupled != 0:
        total += w.contacts.power
    return total + w.supply.moved_power


@kernel_inlined
def save_power(w: Work, state: State) -> None:
    """Save the power at the beginning of a substep, W, and its rate with the forces held constant, W/s."""
    w.supply.power = power(w, state)
    w.supply.power_rate = 0.0
    if takes_one_stage(state):
        growth = 0.0
        for i in range(3):
            growth += w.tip.F[i] * (w.tip.a[i] - w.tip.turning[i])  # N r̈ = u̇ − turning, u̇ = a + S F
            growth += w.tip.F[i] * (
                w.tip.S[i, 0] * w.tip.F[0] + w.tip.S[i, 1] * w.tip.F[1] + w.tip.S[i, 2] * w.tip.F[2]
            )
        for j in range(w.v.shape[0]):
            growth += applied_torque(w, state, j) * w.qdd[j]
        if state.coupled != 0:
            growth += w.contacts.power_rate
        w.supply.power_rate = growth + w.supply.moved_rate


@kernel_inlined
def add_stage_work(w: Work, state: State, stage: int, tau: float, weight: float) -> None:
    """Add a stage, of the given weight in the scheme, to the work of the substep of length tau, s."""
    if stage == 0:  # a substep may be repeated with another length from the same beginning
        w.supply.work = tau * weight * (w.supply.power + 0.5 * tau * w.supply.power_rate)
    else:
        w.supply.work += tau * weight * power(w, state)


@kernel_inlined
def commit_work(w: Work) -> None:
    """Add the work of a substep that is complete to the energy supplied."""
    w.supply.energy += w.supply.work
    w.supply.work = 0.0
