"""A tip that passes through a pose in which it cannot move along the normal.

There A = nᵀJᵣ vanishes and Eq. 24 has no row: whatever f is, the arm does not feel it. On the way through, with
ℓ = √(A H⁻¹Aᵀ) for the distance from the pose, the contact changes q̈ by g = f ℓ in the norm of H. Two cases:

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
from closedloop.jit.calls import integers_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.jit.simd8 import every
from closedloop.loop.step.memory import Constants, N, State, Work
from closedloop.mechanics.closure.contact_force import accelerate
from closedloop.mechanics.closure.solve import OK, PUSHED, SINGULAR, SINGULAR_MOBILITY, forward_substitute
from closedloop.mechanics.limits import NEAR, SMALL

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

    Parameters
    ----------
    C : (n,) array
        Bias.
    w : Work
        With everything of Eq. 24, `column` being what drives the joints, N m.
    rigid : float
        f without the stabiliser's share, N.
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

    Parameters
    ----------
    C : (n,) array
        Bias.
    w : Work
        In: everything of Eq. 24, `column` being what drives the joints, N m. Written: F, q̈, `stabiliser_force`,
        `b`, `rigid_force`, and S_nn, which is zero.
    state : State
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
