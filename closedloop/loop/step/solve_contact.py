"""Eq. 24 in the present contact mode, and contact with a soft surface.

Contact with a soft surface: f is a function of the depth, and Eq. 24 has no row along the normal.
"""

from functools import cache

from closedloop.base.arrays import Array
from closedloop.jit.calls import Entry, call_at, integers_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.parameters import parameter_block
from closedloop.jit.user_code import function_of, member_entry
from closedloop.loop.step.closed_loops import BIND_LOAD
from closedloop.loop.step.contacts import FORCE
from closedloop.loop.step.energy_supplied import applied_torque
from closedloop.loop.step.entries import mark_raised
from closedloop.loop.step.locate import off_anchor
from closedloop.loop.step.memory import (
    RIGID_STICK,
    SPRING_STICK,
    Constants,
    State,
    Work,
    ask_contacts,
    ask_loops,
    loop_at,
)
from closedloop.loop.step.singular import force_in_singular_pose, pushed_on_the_way, row_is_rounding
from closedloop.loop.step.tip_friction import rub_without_pressure, turn_with_slip
from closedloop.mechanics.closure.contact_force import (
    FREE,
    PRESSED,
    STUCK,
    accelerate,
    baumgarte_acceleration,
    free_acceleration,
    normal_rounding,
    pressed_force,
    stuck_force,
    stuck_tangentially,
)
from closedloop.mechanics.closure.solve import OK, PAINLEVE, PUSHED, SINGULAR
from closedloop.mechanics.contacts.soft import AS_FORCE
from closedloop.mechanics.limits import AT_EDGE, ITERATIONS
from closedloop.mechanics.surface.surface import POINTS, WEIGHTS, Compliance


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


@kernel_inlined
def contact_force(C: Array, w: Work, constants: Constants, state: State) -> int:
    """Solve Eq. 24 in the present mode for the contact force F and the acceleration q̈; return a status."""
    for j in range(w.q.shape[0]):
        w.scratch.column[j] = applied_torque(w, state, j)
    free_acceleration(
        w.L, w.tip.X, w.tip.drift_c, w.scratch.column, C, w.y, w.tip.a, integers_at(state.addresses.group_ends, state.n)
    )
    ask_loops(state, BIND_LOAD)
    if state.coupled != 0:
        return ask_contacts(state, FORCE)
    w.tip.rigid_force = 0.0
    for i in range(3):
        w.tip.F[i] = 0.0
        w.tip.stabiliser_force[i] = 0.0
        w.tip.b[i] = 0.0
    if state.compliance.entry != 0 and state.mode != FREE:
        soft_contact_force(w, constants, state)
        return OK
    if state.mode == PRESSED and state.approached > 1 and row_is_rounding(C, w, constants, state):
        return force_in_singular_pose(C, w, constants, state)
    if state.mode == PRESSED or (state.mode == STUCK and state.friction.sticking == SPRING_STICK):
        b = baumgarte_acceleration(constants.s_v, constants.s_p, w.tip.rate, w.tip.gap)
        status, share = rubbed_force(b, w, state)
        if status == SINGULAR and state.mode == PRESSED:
            return force_in_singular_pose(C, w, constants, state)
        if status != OK:
            return status
        sticking = state.friction.sticking
        if state.mode == PRESSED and state.settings.adaptive == 0 and sticking in (RIGID_STICK, SPRING_STICK):
            status, share = slide_slowly(b, share, w, constants.h)
            if status != OK:
                return status
        rigid = w.tip.F[0] - share
        if state.approached > 0 and pushed_on_the_way(C, w, constants, rigid):
            return PUSHED
        w.tip.rigid_force = kept_force(rigid, C, w, state)
        if state.settings.unilateral != 0 and w.tip.rigid_force < 0.0 and w.tip.a[0] < 0.0:
            w.tip.rigid_force = -w.tip.a[0] / w.tip.S[0, 0]  # it is friction alone that lifts the tip
            if w.tip.F[0] < 0.0:
                b, share = rub_without_pressure(w, b), 0.0
        elif state.settings.unilateral != 0 and w.tip.F[0] < 0.0 <= w.tip.rigid_force:
            # The stabiliser may reduce f of a unilateral contact to zero, but not below.
            share = -rigid
            b = share * (w.tip.S[0, 0] - w.tip.S[0, 1] * w.friction.c[0] - w.tip.S[0, 2] * w.friction.c[1])
            w.tip.F[0], w.tip.F[1], w.tip.F[2] = 0.0, -w.friction.viscous[0], -w.friction.viscous[1]
        w.tip.b[0], w.tip.stabiliser_force[0] = b, share
    elif state.mode == STUCK:
        w.tip.b[0] = baumgarte_acceleration(constants.s_v, constants.s_p, w.tip.rate, w.tip.gap)
        for i in range(1, 3):
            w.tip.b[i] = baumgarte_acceleration(constants.s_v, constants.s_p, w.tip.u[i], off_anchor(w, state, i))
        if stuck_force(w.tip.S, w.tip.a, w.tip.b, w.tip.F, w.tip.stabiliser_force) != OK:
            return SINGULAR
        w.tip.rigid_force = kept_force(w.tip.F[0] - w.tip.stabiliser_force[0], C, w, state)
    accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, integers_at(state.addresses.group_ends, state.n))
    return OK


@kernel
def slide_slowly(b: float, share: float, w: Work, h: float) -> tuple[int, float]:
    """Turn the friction of a slow tip to where it slips at the end of the step, with the f that goes with it.

    In: F of the friction as it is, and the stabiliser's share of it, N. Returns a status and the share.
    """
    status = OK
    for _ in range(ITERATIONS):
        before = w.tip.F[0]
        if not turn_with_slip(w, h):
            break
        status, share = pressed_force(w.tip.S, w.tip.a, b, w.friction.c, w.friction.viscous, w.tip.F)
        if status != OK or abs(w.tip.F[0] - before) <= AT_EDGE * abs(before):
            break
    return status, share


@kernel_inlined
def rubbed_force(b: float, w: Work, state: State) -> tuple[int, float]:
    """Do `pressed_force` for a tip that slips, on a closure that may pull if it is bilateral.

    Where it pulls, friction is that of |f| on the other side, and there is no paradox if that solution exists.
    """
    status, share = pressed_force(w.tip.S, w.tip.a, b, w.friction.c, w.friction.viscous, w.tip.F)
    has_friction = w.friction.c[0] != 0.0 or w.friction.c[1] != 0.0
    if state.settings.unilateral == 0 and has_friction and (status == PAINLEVE or (status == OK and w.tip.F[0] < 0.0)):
        w.friction.c[0], w.friction.c[1] = -w.friction.c[0], -w.friction.c[1]
        wedged = status == PAINLEVE
        status, share = pressed_force(w.tip.S, w.tip.a, b, w.friction.c, w.friction.viscous, w.tip.F)
        if status == OK and wedged and not w.tip.F[0] < 0.0:
            status = PAINLEVE
    return status, share


@kernel_inlined
def kept_force(rigid: float, C: Array, w: Work, state: State) -> float:
    """Return the force of the rigid closure, N, that decides liftoff: the tip lifts off where it is negative.

    For a unilateral contact it is corrected by its rounding: with f_des = 0 the computed force is rounding, of either
    sign, and the tip stays in contact.
    """
    kept = rigid
    if state.settings.unilateral != 0 and rigid < 0.0:
        kept += normal_rounding(C, w) / w.tip.S[0, 0]
    return kept
