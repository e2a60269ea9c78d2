"""The loops of a mechanism in a step: what they leave free of the motion of the tree.

With H = L Lᵀ, y = L⁻¹(Q − C) and X = L⁻¹Aᵀ of the tip's rows A, the loops' rows Z = G L⁻ᵀ, and P the projection onto
what they leave free (`closedloop.mechanics.loops.solve`), the motion of the closed mechanism is

    q̈ = L⁻ᵀ(P y + y_b + (P Xᵀ) F),      Z P = 0,  Z y_b = −drift,  P y_b = 0

So with P X for X and P y + y_b for y, Eq. 24, friction, impact and the mobility S = X P Xᵀ of the tip are those of a
tree. The loops take what they bind, whatever acts.
"""

from closedloop.base.arrays import Array
from closedloop.control.law import Perceived
from closedloop.jit.calls import integers_at, row_of
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.loop.step.energy_supplied import applied_torque
from closedloop.loop.step.memory import Constants, State, Work, ask_loops, loop_at
from closedloop.mechanics.closure.contact_force import factorise
from closedloop.mechanics.closure.solve import LOOPS_OPEN, OK, SINGULAR_MOBILITY, forward_substitute
from closedloop.mechanics.loops.close import TOLERANCE, close_state
from closedloop.mechanics.loops.drives import through_drives
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows, loops_at
from closedloop.mechanics.loops.moved import place_frames
from closedloop.mechanics.loops.passing import find_required_on_the_way
from closedloop.mechanics.loops.solve import dot, leave_free, multiply_transposed, take_free

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

    BIND_TIP        project X, write S of it, and add to the tip's drift what the loops require of it
    BIND_LOAD       replace y = L⁻¹(Q − C) by P y + y_b
    BIND_ANSWER     replace `column`, L⁻¹ of a torque, by P of it
    DRIVE           replace the torque by one of the drives alone, see `closedloop.mechanics.loops.drives`
    CLOSE           move q and q̇ to the nearest state that the loops allow; LOOPS_OPEN where a frame that moves has left
                    none
    REACTION        replace `column`, H q̈ + C − Q − AᵀF, by the part of it that the loops can give, and take from the
                    tip's drift what BIND_TIP has added
    BIND_PERCEIVED       do BIND_TIP for the X, S and drift that the law sees, with the H that it believes in
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

    The impulses find the free part of Lᵀq̇ alone. What a point has beside X Lᵀq̇, X = P X, of its velocity, `velocity` to
    its surface and `carried` of that, it has by the frames, and their loops take the impulse there.
    """
    n, work = w.v.shape[0], 0.0
    for j in range(n):
        w.scratch.column[j] = w.v[j]
    multiply_transposed(w.L, w.scratch.column, n)
    for i in range(F.shape[0]):
        work += F[i] * (dot(row_of(X, i), w.scratch.column, n) - velocity[i] - carried[i])
    return work
