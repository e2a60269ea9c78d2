"""The loops of a mechanism in a step: what they leave free of the motion of the tree.

With H = L Lᵀ, y = L⁻¹(Q − C) and X = L⁻¹Aᵀ of the tip's rows A, the loops' rows Z = G L⁻ᵀ, and P the projection onto
what they leave free (`closedloop.mechanics.loops.solve`), the motion of the closed mechanism is

    q̈ = L⁻ᵀ(P y + y_b + (P Xᵀ) F),      Z P = 0,  Z y_b = −drift,  P y_b = 0

So with P X for X and P y + y_b for y, Eq. 24, friction, impact and the mobility S = X P Xᵀ of the tip are those of a
tree. The loops take what they bind, whatever acts.

A mechanism may pass a pose in which the rows of the loops lose rank, as where it lies flat. Where a row is outside the
span of the others by a share s only, what it requires of the acceleration is its drift divided by s. On the mechanism's
way both go to zero together, and the quotient has a limit; but an error e of the loops changes it by |q̇|² e/s³: with e
of rounding, 1e-15 m, by 1e-5 rad/s² at s = 1e-3 and by 1e4 rad/s² at s = 1e-6. So near such a pose the quotient is
interpolated between states on both sides of it, closed to rounding, along the velocity.
"""

import math

from closedloop.base.arrays import Array
from closedloop.control.law import Perceived
from closedloop.jit.calls import integers_at, row_of
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.loop.step.energy_supplied import applied_torque
from closedloop.loop.step.memory import Constants, State, Work, ask_loops, loop_at
from closedloop.mechanics.closure.contact_force import factorise
from closedloop.mechanics.closure.solve import LOOPS_OPEN, OK, SINGULAR_MOBILITY, forward_substitute
from closedloop.mechanics.loops.factor import factor, smallest_share
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, loops_at, tree_at
from closedloop.mechanics.loops.moved import place_frames
from closedloop.mechanics.loops.reactions import through_drives
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import (
    TOLERANCE,
    basis_in_metric,
    close_state,
    dot,
    leave_free,
    multiply_transposed,
    take_free,
)
from closedloop.mechanics.robot.tree.layout import move_posture

# A row is near to losing its direction below this share; the way to the next of the four states between which what it
# requires is interpolated, rad or m; by how much more it has to be outside the span there; and the way to the state
# whose direction stands for one that is lost, which must be far enough for it to be found there again (`DEPENDENT`).
NEAR, WAY, FARTHER, ASIDE = 1e-3, 1e-2, 3.0, 1e-4


@kernel
def find_basis(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Write the rows at a state, factored for their drift, and the basis of P (`closedloop.mechanics.loops.solve`)."""
    for j in range(links.n):
        rows.q[j], rows.v[j] = q[j], v[j]
    locate_rows(links, rows)
    factor(links, rows, rows.drift, links.m)
    links.known = links.rank
    basis_in_metric(links, rows, L)


@kernel
def find_required(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Do `find_basis`, and write the shortest part (n,) of which L⁻ᵀ part is an acceleration with G q̈ = −drift."""
    find_basis(links, rows, L, q, v)
    for j in range(links.n):
        rows.part[j] = -rows.met[j]
    multiply_transposed(L, rows.part, links.n)
    take_free(links, rows, rows.part)


@kernel
def find_required_on_the_way(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array) -> None:
    """Do `find_required`, also where the rows lose rank on the mechanism's way."""
    known = links.known
    find_required(links, rows, L, q, v)
    lost = links.rank < known
    share = 0.0 if lost else smallest_share(links, rows)
    if not share < NEAR:
        return
    found = interpolate_part(links, rows, L, q, v, known if lost else links.rank, share)
    if found and lost:  # the direction that is lost here is that of a state close by
        close_beside(links, rows, q, v, ASIDE)
        find_basis(links, rows, L, rows.near.q, rows.near.v)
    else:
        find_required(links, rows, L, q, v)
    if found:
        take_free(links, rows, rows.near.part)  # what the rows determine, so that reactions account for all of it
        for j in range(links.n):
            rows.part[j] = rows.near.part[j]


@kernel
def close_beside(links: LoopLinks, rows: LoopRows, q: Array, v: Array, way: float) -> float:
    """Write the state near_q, near_v at a way, rad or m, along the velocity, closed; return the error left."""
    n = links.n
    for j in range(n):
        rows.near.q[j], rows.near.v[j] = q[j], v[j]
    move_posture(tree_at(links), rows.near.q, v, way / math.sqrt(dot(v, v, n)))
    return close_state(links, rows, rows.near.q, rows.near.v)


@kernel
def interpolate_part(links: LoopLinks, rows: LoopRows, L: Array, q: Array, v: Array, rank: int, share: float) -> bool:
    """Write `near_part`, what the rows require at a state near a pose in which they lose rank, if that has a limit.

    Between its values f at −2, −1, 1 and 2 steps along the velocity, with the same L,

        f(0) = (4 f(1) + 4 f(−1) − f(2) − f(−2)) / 6 + O(step⁴).

    Returns false where that is not so: with frames that move, which are elsewhere then, at rest, where the rows do not
    get farther from losing rank on both sides, or where the mechanism cannot be closed there. The rows are those of
    another state afterwards.
    """
    if links.frames > 0 or not dot(v, v, links.n) > 0.0:
        return False
    for j in range(links.n):
        rows.near.part[j] = 0.0
    for steps in (-2, -1, 1, 2):
        links.known = rank
        left = close_beside(links, rows, q, v, steps * WAY)
        find_required(links, rows, L, rows.near.q, rows.near.v)
        if links.rank != rank or not left <= TOLERANCE or not smallest_share(links, rows) > FARTHER * share:
            return False
        weight = (4.0 if abs(steps) == 1 else -1.0) / 6.0
        for j in range(links.n):
            rows.near.part[j] += weight * rows.part[j]
    return True


# What the loops are asked for.
BIND_TIP, BIND_LOAD, BIND_ANSWER, DRIVE, CLOSE, REACTION, BIND_PERCEIVED = range(7)


@kernel_inlined
def factorise_tip(H: Array, w: Work, constants: Constants, state: State) -> int:
    """Do `factorise` for the tip of the closed mechanism, where it has just been located."""
    status = factorise(
        H, w.tip.A, w.L, w.tip.X, w.tip.S, constants.reach, integers_at(state.addresses.group_ends, state.n)
    )
    if status == OK:
        ask_loops(state, BIND_TIP)
    return status


@entry_kernel
def closed_loops(address: int, what: int) -> int:
    """Answer for the loops, by the address of their memory; return a status of `closedloop.mechanics.closure.solve`.

    BIND_TIP        project X, write S of it, and add to the tip's drift what the loops require of it BIND_LOAD
    replace y = L⁻¹(Q − C) by P y + y_b BIND_ANSWER     replace `column`, L⁻¹ of a torque, by P of it DRIVE
    replace the torque by one of the drives alone, see `closedloop.mechanics.loops.reactions` CLOSE           move q and
    q̇ to the nearest state that the loops allow; LOOPS_OPEN where a frame that moves has left none REACTION
    replace `column`, H q̈ + C − Q − AᵀF, by the part of it that the loops can give, and take from the tip's drift what
    BIND_TIP has added BIND_PERCEIVED       do BIND_TIP for the X, S and drift that the law sees, with the H that it
    believes in
    """
    links, rows = loops_at(address)
    _, _, w = loop_at(links.loop)
    if links.frames > 0 and what in (BIND_TIP, BIND_PERCEIVED, CLOSE):
        place_frames(links, w.time)
    if what == BIND_TIP:
        bind_tip(links, rows, w, w.L, w.tip.X, w.tip.S)
        for k in range(3):
            w.tip.drift_c[k] += rows.moved[k]
    elif what == BIND_PERCEIVED:
        perceived = Perceived(w.perceived, links.n)
        bind_tip(links, rows, w, perceived.L, perceived.X, perceived.S)
        for k in range(3):
            perceived.drift_c[k] += rows.moved[k]
    elif what == BIND_LOAD:
        leave_free(links, rows, w.y)
        for j in range(links.n):
            w.y[j] += rows.part[j]
    elif what == BIND_ANSWER:
        leave_free(links, rows, w.scratch.column)
    elif what == DRIVE:
        through_drives(links, rows, w.torque)
    elif what == CLOSE:
        if not close_state(links, rows, w.q, w.v) <= TOLERANCE and links.frames > 0:
            return LOOPS_OPEN
    else:
        reaction(links, rows, w)
        for k in range(3):
            w.tip.drift_c[k] -= rows.moved[k]
    return OK


@kernel
def bind_tip(links: LoopLinks, rows: LoopRows, w: Work, L: Array, X: Array, S: Array) -> None:
    """Project the tip's rows onto what the loops leave free, at the state in `w`, and write S of them."""
    n = links.n
    find_required_on_the_way(links, rows, L, w.q, w.v)
    for k in range(3):
        moved = 0.0
        for j in range(n):
            moved += X[k, j] * rows.part[j]
        rows.moved[k] = moved
        leave_free(links, rows, row_of(X, k))
    for k in range(3):
        for i in range(k + 1):
            s = 0.0
            for j in range(n):
                s += X[k, j] * X[i, j]
            if i == k and not s > SINGULAR_MOBILITY * S[k, k]:
                s = 0.0  # the loops hold the tip in this direction
            S[k, i] = s
            S[i, k] = s


@kernel
def reaction(links: LoopLinks, rows: LoopRows, w: Work) -> None:
    """Replace `column`, what is missing in the equation of motion, by the part of it that the loops can give."""
    forward_substitute(w.L, w.scratch.column, 0, links.n)
    take_free(links, rows, w.scratch.column)
    for i in range(links.n - 1, -1, -1):  # L x, with the reciprocals on L's diagonal
        s = w.scratch.column[i] / w.L[i, i]
        for j in range(i):
            s += w.L[i, j] * w.scratch.column[j]
        w.scratch.column[i] = s


@kernel
def missing_torque(H: Array, C: Array, w: Work, state: State) -> None:
    """Write into `column` what is missing in the equation of motion: H q̈ + C − Q − AᵀF, and of other contacts."""
    n = w.q.shape[0]
    for i in range(n):
        s = C[i] - applied_torque(w, state, i)
        for k in range(3):
            s -= w.tip.A[k, i] * w.tip.F[k]
        if state.coupled != 0:
            s -= w.contacts.torque[i]
        for j in range(n):
            s += (H[i, j] if i <= j else H[j, i]) * w.qdd[j]
        w.scratch.column[i] = s


@kernel
def power_of_frames(H: Array, C: Array, w: Work, state: State) -> None:
    """Write the power of frames that move the mechanism, W, and its rate with what the loops give held, W/s."""
    missing_torque(H, C, w, state)
    w.supply.moved_power = dot(w.scratch.column, w.v, state.n)
    w.supply.moved_rate = dot(w.scratch.column, w.qdd, state.n)


@kernel
def impulse_of_frames(w: Work, X: Array, F: Array, velocity: Array, carried: Array) -> float:
    """Return the work, J, of frames that move the mechanism in an impact with impulses F (m,), N s.

    The impulses find the free part of Lᵀq̇ alone. What a point has beside X Lᵀq̇, X = P X, of its velocity, `velocity`
    to its surface and `carried` of that, it has by the frames, and their loops take the impulse there.
    """
    n, work = w.v.shape[0], 0.0
    for j in range(n):
        w.scratch.column[j] = w.v[j]
    multiply_transposed(w.L, w.scratch.column, n)
    for i in range(F.shape[0]):
        work += F[i] * (dot(row_of(X, i), w.scratch.column, n) - velocity[i] - carried[i])
    return work
