"""The loops of a mechanism in a step: what they leave free of the motion of the tree.

With H = L Lᵀ, y = L⁻¹(Q − C) and X = L⁻¹Aᵀ of the tip's rows A, and the basis of the loops' rows Z = G L⁻ᵀ
(`closedloop.loops.solve`), the motion of the closed mechanism is

    q̈ = L⁻ᵀ(P y + y_b + (P Xᵀ) F),      P = 1 − ZᵀZ,  Z y_b = −drift

So with P X for X and P y + y_b for y, Eq. 24, friction, impact and the mobility S = X P Xᵀ of the tip are those of a
tree. The loops take what they bind, whatever acts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.contact_force import factorise
from closedloop.closure.solve import OK, SINGULAR_MOBILITY, back_substitute, forward_substitute
from closedloop.control.seen import Seen
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.pointers import integers_at
from closedloop.loops.close import close_state
from closedloop.loops.memory import STOP, LoopLinks, LoopRows, loops_at
from closedloop.loops.passing import find_required, find_required_on_the_way
from closedloop.loops.solve import dot, meet_rows, orthonormal_rows, remove_basis, spanned_force
from closedloop.step.energy_supplied import driving_torque
from closedloop.step.memory import Constants, State, Work, loop_at

Array = NDArray[np.float64]

# What the loops are asked for.
BIND_TIP, BIND_LOAD, BIND_ANSWER, DRIVE, CLOSE, REACTION, STOP_TORQUE, STRIKE, BIND_SEEN = range(9)


@kernel_inlined
def factorise_tip(H: Array, w: Work, constants: Constants, state: State) -> int:
    """Do `factorise` for the tip of the closed mechanism, where it has just been located."""
    status = factorise(H, w.A, w.L, w.X, w.S, constants.reach)
    if status == OK and state.loops != 0:
        call_at(state.loops, state.loops_at, BIND_TIP)
    return status


@entry_kernel
def closed_loops(address: int, what: int) -> int:
    """Answer for the loops, by the address of their memory.

    BIND_TIP        project X, write S of it, and add to the tip's drift what the loops require of it
    BIND_LOAD       replace y = L⁻¹(Q − C) by P y + y_b
    BIND_ANSWER     replace `column`, L⁻¹ of a torque, by P of it
    DRIVE           replace the torque by one of the drives alone that has the same effect
    CLOSE           move q and q̇ to the nearest state that the loops allow
    REACTION        replace `column`, H q̈ + C − Q − AᵀF, by the part of it that the loops can give, and take from the
                    tip's drift what BIND_TIP has added
    STOP_TORQUE     write the torque of the stops, of `column` as for REACTION
    STRIKE          change q̇ by the impulses of loops and stops that it does not obey
    BIND_SEEN       do BIND_TIP for the X, S and drift that the law sees, with the H that it believes in
    """
    links, rows = loops_at(address)
    _, _, w = loop_at(links.loop)
    for j in range(links.n if links.stops > 0 else 0):
        rows.held[j] = w.stopped[j]
    if what == BIND_TIP:
        bind_tip(links, rows, w, w.L, w.X, w.S)
        for k in range(3):
            w.drift_c[k] += rows.moved[k]
    elif what == BIND_SEEN:
        seen = Seen(w.seen, links.n)
        bind_tip(links, rows, w, seen.L, seen.X, seen.S)
        for k in range(3):
            seen.drift_c[k] += rows.moved[k]
    elif what == BIND_LOAD:
        remove_basis(w.y, rows.basis, links.rank)
        for j in range(links.n):
            w.y[j] += rows.part[j]
    elif what == BIND_ANSWER:
        remove_basis(w.column, rows.basis, links.rank)
    elif what == DRIVE:
        through_drives(links, rows, w.torque)
    elif what == CLOSE:
        close_state(links, rows, w.q, w.v)
    elif what == STOP_TORQUE:
        stop_torque(links, rows, w)
    elif what == STRIKE:
        strike(links, rows, w)
    else:
        reaction(links, rows, w)
        for k in range(3):
            w.drift_c[k] -= rows.moved[k]
    return 0


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
        remove_basis(X[k], rows.basis, links.rank)
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
def through_drives(links: LoopLinks, rows: LoopRows, torque: Array) -> None:
    """Replace a torque by one of the drives alone: what the joints without one would give goes through the loops.

    Of Q' + Gᵀλ = Q the parts of the joints without a drive are solved for λ; as Gᵀλ is a force of the loops, Q' moves
    the mechanism as Q would. If the drives cannot give that, it is as near as they come.
    """
    if links.undriven == 0:
        return
    m, n, wanted = links.m - links.stops, links.n, rows.column  # the rows of stops are the last
    Z = rows.drive_basis
    for j in range(n):
        driven = rows.undriven[j] == 0.0
        wanted[j] = 0.0 if driven else torque[j]
        for k in range(m):
            Z[k, j] = 0.0 if driven else rows.G[k, j]
    rank = orthonormal_rows(Z, m, m, rows.drive_order, rows.drive_coefficients, rows.along)
    spanned_force(wanted, rows.drive_order, rows.drive_coefficients, Z, rank, rows.along)
    for j in range(n):
        through = 0.0
        for k in range(m):
            through += rows.G[k, j] * rows.along[k]
        torque[j] = torque[j] - through if rows.undriven[j] == 0.0 else 0.0


@kernel
def reaction(links: LoopLinks, rows: LoopRows, w: Work) -> None:
    """Replace `column`, what is missing in the equation of motion, by the part of it that the loops can give."""
    forward_substitute(w.L, w.column)
    x = rows.column
    for j in range(links.n):
        x[j] = w.column[j]
    remove_basis(w.column, rows.basis, links.rank)
    for j in range(links.n):
        x[j] -= w.column[j]
    for i in range(links.n):  # L x, with the reciprocals on L's diagonal
        s = x[i] / w.L[i, i]
        for j in range(i):
            s += w.L[i, j] * x[j]
        w.column[i] = s


@kernel
def stop_torque(links: LoopLinks, rows: LoopRows, w: Work) -> None:
    """Write the torque of each stop that holds a joint, of what is missing in the equation of motion, `column`."""
    sides = integers_at(links.bound, 3 * links.m)
    forward_substitute(w.L, w.column)
    spanned_force(w.column, rows.order, rows.coefficients, rows.basis, links.rank, rows.along)
    for k in range(links.m):
        if sides[k] == STOP:
            w.stop_torque[sides[links.m + k]] = rows.along[k]


@kernel
def strike(links: LoopLinks, rows: LoopRows, w: Work) -> None:
    """Change q̇ by the smallest impulse, in the measure of H, after which all rows are obeyed: no rebound."""
    find_required(links, rows, w.L, w.q, w.v)
    for k in range(links.m):
        rows.rate[k] = -dot(rows.G[k], w.v, links.n)
    meet_rows(rows.rate, rows.order, rows.coefficients, rows.basis, links.rank, rows.along, rows.part)
    back_substitute(w.L, rows.part)
    for j in range(links.n):
        w.v[j] += rows.part[j]


@kernel
def missing_torque(H: Array, C: Array, w: Work, state: State) -> None:
    """Write into `column` what is missing in the equation of motion: H q̈ + C − Q − AᵀF, and of other contacts."""
    n = w.q.shape[0]
    for i in range(n):
        s = C[i] - driving_torque(w, state, i) - w.joint_friction[i]
        for k in range(3):
            s -= w.A[k, i] * w.F[k]
        if state.contacts != 0:
            s -= w.contact_torque[i]
        for j in range(n):
            s += (H[i, j] if i <= j else H[j, i]) * w.qdd[j]
        w.column[i] = s
