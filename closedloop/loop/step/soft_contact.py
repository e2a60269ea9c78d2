"""Contact with a soft surface: f is a function of the depth, and Eq. 24 has no row along the normal."""

from __future__ import annotations

from functools import cache

from closedloop.jit.calls import Entry, call_at, integers_at
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import parameter_block
from closedloop.jit.user_code import function_of, member_entry
from closedloop.loop.step.entries import mark_raised
from closedloop.loop.step.locate import off_anchor
from closedloop.loop.step.memory import RIGID_STICK, SPRING_STICK, Constants, State, Work, loop_at
from closedloop.loop.step.tip_friction import turn_with_slip
from closedloop.mechanics.closure.contact_force import STUCK, accelerate, baumgarte_acceleration, stuck_tangentially
from closedloop.mechanics.contacts.soft import AS_FORCE
from closedloop.mechanics.surface.compliance import POINTS, WEIGHTS, Compliance


@cache
def compliance_entry(member: type[Compliance]) -> Entry:
    """Return the entry of a compliance, compiled when it is first needed: it writes f into F[0]."""
    Parameters, force = parameter_block(member), function_of(member, "force")

    def entry(address: int, what: int) -> int:
        state, constants, w = loop_at(address)
        f = force(-w.tip.gap, -w.tip.rate, Parameters(constants.compliance, state.n))
        w.tip.F[0] = max(f, 0.0) if state.settings.unilateral != 0 else f
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_compliance_{member.__name__}"
    return member_entry(entry, member, mark_raised)


@kernel
def soft_contact_force(w: Work, constants: Constants, state: State) -> None:
    """Write the contact force F of a soft surface and q̈; the free acceleration has been computed.

    `rigid_force`, which decides liftoff where it is negative, has the sign of the depth. Just after touchdown the gap
    may be a rounding above zero: a tip that moves into the surface is in contact.
    """
    call_at(state.compliance.entry, state.address, 0)
    f = w.tip.F[0]
    if state.settings.unilateral != 0:
        w.tip.rigid_force = -AS_FORCE * w.tip.gap if w.tip.rate > 0.0 else max(-AS_FORCE * w.tip.gap, 0.0)
    if state.mode == STUCK and state.friction.sticking != SPRING_STICK:
        for i in range(1, 3):
            w.tip.b[i] = baumgarte_acceleration(constants.s_v, constants.s_p, w.tip.u[i], off_anchor(w, state, i))
        stuck_tangentially(w.tip.S, w.tip.a, w.tip.b, w.tip.F)
    else:
        rub_softly(w)
        slips = (
            state.mode != STUCK
            and state.settings.adaptive == 0
            and state.friction.sticking in (RIGID_STICK, SPRING_STICK)
        )
        if slips and turn_with_slip(w, constants.h):
            w.tip.F[1], w.tip.F[2] = (
                -w.friction.c[0] * f - w.friction.viscous[0],
                -w.friction.c[1] * f - w.friction.viscous[1],
            )
    accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, integers_at(state.addresses.group_ends, state.n))


@kernel
def rub_softly(w: Work) -> None:
    """Write the friction of a tip that slips, for the f of a soft surface: of |f| where a bilateral one pulls."""
    f = w.tip.F[0]
    if f < 0.0:
        w.friction.c[0], w.friction.c[1] = -w.friction.c[0], -w.friction.c[1]
    w.tip.F[1], w.tip.F[2] = -w.friction.c[0] * f - w.friction.viscous[0], -w.friction.c[1] * f - w.friction.viscous[1]


@kernel
def spring_energy(w: Work, constants: Constants, state: State) -> float:
    """Return what the spring of a soft surface has stored, J: f at rest over the depth, from none to the present.

    With the depth x = δ s² the integrand is a polynomial of low degree in s for a spring k x, and for Hertz's k x^1.5.
    """
    gap, rate, f, stored = w.tip.gap, w.tip.rate, w.tip.F[0], 0.0
    w.tip.rate = 0.0
    for k in range(4):
        for side in range(2):
            s = 0.5 * (1.0 + (POINTS[k] if side == 0 else -POINTS[k]))
            w.tip.gap = gap * s * s
            call_at(state.compliance.entry, state.address, 0)
            stored -= WEIGHTS[k] * w.tip.F[0] * gap * s
    w.tip.gap, w.tip.rate, w.tip.F[0] = gap, rate, f
    return float(stored)
