"""Eq. 24 in the present contact mode; on a soft surface; and where a tip passes through a singular pose.

On a soft surface f is a function of the depth, and Eq. 24 has no row along the normal.

In a pose in which the tip cannot move along the normal A = nᵀJᵣ vanishes and Eq. 24 has no row: whatever f is, the arm
does not feel it. On the way through, with ℓ = √(A H⁻¹Aᵀ) for the distance from the pose, the contact changes q̈ by g =
f ℓ in the norm of H. Two cases:

- g vanishes with ℓ: the motion goes on as it would without contact, and f has a finite limit, which is f in the pose.
- g has another limit: the torque pushes the tip along the normal, and f grows as 1/ℓ, beyond all bounds: PUSHED.

Between two states on either side of the pose (A has turned round), or before it, g is linear in ℓ up to the square of
the step. A start in such a pose has no way along which a limit could be taken, and a tip that stays there has no force:
SINGULAR.

Before the pose is reached the row says nothing more. A tip that is ε off the surface, and ε is at least rounding, is on
a way that turns as ε/ℓ: its acceleration along n is 2 ε (ℓ̇/ℓ)² off, and f by 2 ε ℓ̇²/ℓ⁴. Where that is more than f can
be told on the way (ROUNDING), f is its limit, as in the pose itself.
"""

import math
from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block
from closedloop.jit.calls import Entry, call_at, integers_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.parameters import parameter_block
from closedloop.jit.simd8 import every
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
    N,
    State,
    Work,
    ask_contacts,
    ask_loops,
    loop_at,
)
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
from closedloop.mechanics.closure.solve import OK, PAINLEVE, PUSHED, SINGULAR, SINGULAR_MOBILITY, forward_substitute
from closedloop.mechanics.contacts.soft import AS_FORCE
from closedloop.mechanics.limits import EXACT, ITERATIONS, NEAR, SMALL
from closedloop.mechanics.surface.surface import POINTS, WEIGHTS, Compliance
from robot_models.cached import cached

# Of the tip's position, as a share of the arm's reach.
ROUNDING = 2.0**-52
# A tip that has not left the pose after so many times the time which the way to it foretells stays there.
PATIENCE = 4.0


class Approach(Block, sizes=("n",)):
    """The last two substeps that began near a singular pose, the later one first."""

    time: Annotated[Array, 2]  # s
    lever: Annotated[Array, 2]  # ℓ, 1/√kg
    push: Annotated[Array, 2]  # g, N/√kg
    row: Annotated[Array, N]  # L⁻¹Aᵀ of the later one


@kernel_inlined
def near_singular(S: Array) -> bool:
    """Whether the tip with mobility S (3, 3) is near a singular pose."""
    return not every(S[0, 0] > NEAR * (S[0, 0] + S[1, 1] + S[2, 2]))


@kernel
def remember_approach(w: Work, state: State) -> None:
    """Remember ℓ and g at the beginning of a substep, of a tip on the surface near a singular pose."""
    if not w.tip.S[0, 0] > 0.0:
        return
    n, lever = w.q.shape[0], math.sqrt(w.tip.S[0, 0])
    way = Approach(w.approach, n)
    way.time[1], way.lever[1], way.push[1] = way.time[0], way.lever[0], way.push[0]
    way.time[0], way.lever[0] = w.start.time, lever
    way.push[0] = (w.tip.F[0] - w.tip.stabiliser_force[0]) * lever
    for j in range(n):
        way.row[j] = w.tip.X[0, j]
    state.approached += 1


@kernel
def pushed_on_the_way(C: Array, w: Work, constants: Constants, rigid: float) -> bool:
    """Whether the tip has passed a singular pose since the substep began, and the torque pushed it along n there.

    `C` (n,): bias.
    `w`: with everything of Eq. 24, `column` being what drives the joints, N m.
    `rigid`: f without the stabiliser's share, N.
    """
    n, turned = C.shape[0], 0.0
    way = Approach(w.approach, n)
    for j in range(n):
        turned += way.row[j] * w.tip.X[0, j]
    if turned >= 0.0:
        return False
    lever = math.sqrt(w.tip.S[0, 0])
    # A has turned round: the same push has the other sign
    pushed = (way.push[0] * lever - rigid * lever * way.lever[0]) / (way.lever[0] + lever)
    elapsed = w.time - way.time[0]
    rate = (way.lever[0] + lever) / elapsed if elapsed > 0.0 else 0.0
    off = rounding_of_push(constants, rate, min(lever, way.lever[0]))
    return not abs(pushed) <= no_push(C, w, constants, rate) + off


@kernel
def rounding_of_push(constants: Constants, rate: float, lever: float) -> float:
    """Return by how much g is off at a distance ℓ from the pose, N/√kg, where ℓ changes at a rate, 1/(s √kg)."""
    return float(2.0 * ROUNDING * math.sqrt(constants.reach) * rate * rate / (lever * lever * lever))


@kernel
def rate_of_way(w: Work, state: State, way: Approach, left: float) -> float:
    """Return how fast ℓ became less on the way to the pose, 1/(s √kg), where at most `left` was left; zero without one.

    There is none either of a tip that stays: see PATIENCE.
    """
    if state.approached < 2 or not way.lever[1] > way.lever[0]:
        return float(0.0 * way.lever[0])
    rate = (way.lever[1] - way.lever[0]) / (way.time[0] - way.time[1])
    return float(rate if (w.time - way.time[0]) * rate <= PATIENCE * left else 0.0 * rate)


@kernel
def row_is_rounding(C: Array, w: Work, constants: Constants, state: State) -> bool:
    """Whether the tip is so near the pose that rounding decides over f by Eq. 24, and it came from where it does not.

    There g counts as none that gives f an error of what the loads need at the tip, see `no_push`.
    """
    way, trace = Approach(w.approach, C.shape[0]), w.tip.S[0, 0] + w.tip.S[1, 1] + w.tip.S[2, 2]
    rate = rate_of_way(w, state, way, way.lever[0])
    if not (rate > 0.0 and w.tip.S[0, 0] > 0.0):
        return False
    most, lever = no_push(C, w, constants, rate) / math.sqrt(trace), math.sqrt(w.tip.S[0, 0])
    if not rounding_of_push(constants, rate, lever) > most * lever:
        return False
    return bool(rounding_of_push(constants, rate, way.lever[0]) <= most * way.lever[0])


@kernel
def force_in_singular_pose(C: Array, w: Work, constants: Constants, state: State) -> int:
    """Write F and q̈ of a tip in a singular pose, where f has a limit on the way; return OK, PUSHED or SINGULAR.

    `C` (n,): bias.
    `w`: in: everything of Eq. 24, `column` being what drives the joints, N m. Written: F, q̈, `stabiliser_force`, `b`,
        `rigid_force`, and S_nn, which is zero.
    """
    way, trace = Approach(w.approach, C.shape[0]), w.tip.S[0, 0] + w.tip.S[1, 1] + w.tip.S[2, 2]
    rate = rate_of_way(w, state, way, max(way.lever[0], math.sqrt(SINGULAR_MOBILITY * trace)))
    if not rate > 0.0:
        return SINGULAR
    nearer = way.lever[1] - way.lever[0]
    pushed = (way.push[0] * way.lever[1] - way.push[1] * way.lever[0]) / nearer
    along = w.tip.a[0] - w.tip.S[0, 1] * w.friction.viscous[0] - w.tip.S[0, 2] * w.friction.viscous[1]
    most = no_push(C, w, constants, rate)
    off = rounding_of_push(constants, rate, way.lever[0]) * (way.lever[0] + way.lever[1]) / nearer
    if not (abs(pushed) <= most + off and abs(along) <= most * math.sqrt(trace)):
        return PUSHED
    f = (way.push[1] - way.push[0]) / nearer
    if state.settings.unilateral != 0:
        f = max(f, 0.0)  # it would have lifted off before
    w.tip.F[0], w.tip.F[1], w.tip.F[2] = (
        f,
        -w.friction.c[0] * f - w.friction.viscous[0],
        -w.friction.c[1] * f - w.friction.viscous[1],
    )
    w.tip.rigid_force, w.tip.stabiliser_force[0], w.tip.b[0], w.tip.S[0, 0] = f, 0.0, 0.0, 0.0
    accelerate(w.L, w.tip.X, w.y, w.tip.F, w.qdd, integers_at(state.addresses.group_ends, state.n))
    return OK


@kernel
def no_push(C: Array, w: Work, constants: Constants, rate: float) -> float:
    """Return the largest g that counts as none, N/√kg, where ℓ changes at a rate, 1/(s √kg).

    A share of what Q (in `column`) and C would do one by one, |L⁻¹Q| + |L⁻¹C|, of what it takes to accelerate the tip
    by gravity, and of the velocity, |Lᵀq̇|, as A turns.
    """
    n, trace = C.shape[0], w.tip.S[0, 0] + w.tip.S[1, 1] + w.tip.S[2, 2]
    total = length(constants.gravity) / math.sqrt(trace)
    x = w.scratch.numbers[0:n]
    for side in range(2):
        for j in range(n):
            x[j] = w.scratch.column[j] if side == 0 else C[j]
        forward_substitute(w.L, x, 0, n)
        total += length(x)
    for j in range(n):
        x[j] = w.v[j] / w.L[j, j]  # the diagonal holds reciprocals
        for i in range(j + 1, n):
            x[j] += w.L[i, j] * w.v[i]
    return SMALL * (total + length(x) * rate / math.sqrt(trace))


@kernel
def length(x: Array) -> float:
    """Return |x|."""
    total = 0.0
    for j in range(x.shape[0]):
        total += x[j] * x[j]
    return math.sqrt(total)


@cached
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
        if status != OK or abs(w.tip.F[0] - before) <= EXACT * abs(before):
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
