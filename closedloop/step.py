"""One evaluation of the equation of motion: law, friction, contact and Eq. 24 at one state, and the row it leaves.

The caller provides H, C, Jᵣ, r and J̇ᵣq̇ of the state, from Pinocchio or from anything else; nothing here asks further.
`closedloop.machine` decides which states are evaluated, and when.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import kernel
from closedloop.contact import (
    FREE,
    PRESSED,
    accelerate,
    baumgarte_acceleration,
    factorise,
    into_contact_frame,
    pressed_force,
    residuals,
    stuck_force,
    unloaded,
)
from closedloop.control import paper_law
from closedloop.solve import DIVERGED, OK, SINGULAR, condition
from closedloop.workspace import (
    FRAME,
    GAP,
    JOINTS,
    LAW,
    LAW_PARAMETERS,
    MEASURED,
    MODE,
    NODE,
    OFFSET_D,
    RATE,
    RIGID,
    S_P,
    S_V,
    SAMPLED,
    TIME,
    UNILATERAL,
    Whole,
    Work,
)

Array = NDArray[np.float64]

# A joint at 10⁴ rad/s (m/s) is no robot any more; the run stops there, long before the numbers overflow.
SPEED_LIMIT = 1e4

# The law is evaluated outside (a user's Python function), or here.
LAW_GIVEN, LAW_PAPER = -1, 0


@kernel
def reference_row(t: float, spacing: float, table: Array, n: int, row: Array) -> None:
    """Write what is desired at time t: between the table's instants, a cubic in position and lines for the rest.

    Parameters
    ----------
    t, spacing : float
        Time, and time between two rows of the table, s.
    table : (P, 2 n + 10) array
        q_des, q̇_des, and in the contact frame p_des, u_des and u̇_des, then f_des.
    row : (2 n + 10,) array
        Written.
    """
    x = t / spacing
    at = round(x)
    width = row.shape[0]
    if abs(x - at) < 1e-6 or at >= table.shape[0]:
        at = min(at, table.shape[0] - 1)
        for j in range(width):
            row[j] = table[at, j]
        return
    at = min(int(x), table.shape[0] - 2)
    s = x - at
    for j in range(width):
        row[j] = (1.0 - s) * table[at, j] + s * table[at + 1, j]
    for block in range(2):
        begin = 0 if block == 0 else 2 * n
        size = n if block == 0 else 3
        for j in range(begin, begin + size):
            rise = table[at + 1, j] - table[at, j]
            v0, v1 = spacing * table[at, j + size], spacing * table[at + 1, j + size]
            row[j] = table[at, j] + s * (v0 + s * (3.0 * rise - 2.0 * v0 - v1 + s * (v0 + v1 - 2.0 * rise)))


@kernel
def locate_tip(w: Work, k: Array) -> None:
    """Write the tip's motion in the contact frame, and the gap and its rate."""
    into_contact_frame(k[FRAME : FRAME + 9], w.J, w.r, w.drift, w.v, w.A, w.p, w.u, w.drift_c)
    w.now[GAP] = w.p[0] - k[OFFSET_D]
    w.now[RATE] = w.u[0]


@kernel
def evaluate(H: Array, C: Array, w: Work, k: Array, state: Whole, table: Array) -> int:
    """Evaluate law, friction, contact and Eq. 24 at the state in `w`.

    Parameters
    ----------
    H, C : (n, n), (n,) arrays
        Terms of the state, H's upper triangle.
    w : Work
        In: now[TIME], q, q̇, z, Jᵣ, r, J̇ᵣq̇ (and the torque, if the law is given or held). Written: everything else.
    k : array
        Constants, see `closedloop.workspace`.
    state : array of int
        See `closedloop.workspace`; read.
    table : (P, 2 n + 10) array
        See `reference_row`.

    Returns
    -------
    int
        OK, SINGULAR, NOT_POSITIVE_DEFINITE, PAINLEVE or DIVERGED.
    """
    n = w.q.shape[0]
    locate_tip(w, k)
    status = factorise(H, w.A, w.L, w.X, w.S)
    if status != OK:
        return status
    if state[LAW] == LAW_PAPER and state[SAMPLED] != 0:
        reference_row(w.now[TIME], k[NODE], table, n, w.reference)
        gains = k[JOINTS + n : JOINTS + 3 * n].reshape(2, n)
        path = w.reference[: 2 * n].reshape(2, n)
        w.scratch[0], w.scratch[1] = w.reference[2 * n + 9], k[LAW_PARAMETERS]
        paper_law(w.now[TIME], w.scratch, gains, path, w.q, w.v, C, w.A, w.torque)
    unloaded(w.L, w.X, w.drift_c, w.torque, C, w.y, w.a)
    w.now[RIGID] = 0.0
    for i in range(3):
        w.F[i] = 0.0
        w.share[i] = 0.0
        w.b[i] = 0.0
    if state[MODE] == PRESSED:
        b = baumgarte_acceleration(k[S_V], k[S_P], w.now[RATE], w.now[GAP])
        status, share = pressed_force(w.S, w.a, b, w.c, w.w, w.F)
        if status != OK:
            return status
        rigid = w.F[0] - share
        if state[UNILATERAL] != 0 and w.F[0] < 0.0 <= rigid:
            # The stabiliser may push the tip off the surface but never pull it in: it is left out here.
            b, share = 0.0, 0.0
            w.F[0] = rigid
            w.F[1], w.F[2] = -w.c[0] * rigid - w.w[0], -w.c[1] * rigid - w.w[1]
        w.now[RIGID] = rigid
        w.b[0], w.share[0] = b, share
    elif state[MODE] != FREE:
        w.b[0] = baumgarte_acceleration(k[S_V], k[S_P], w.now[RATE], w.now[GAP])
        for i in range(1, 3):
            w.b[i] = baumgarte_acceleration(k[S_V], k[S_P], w.u[i], w.p[i] - w.anchor[i - 1])
        if stuck_force(w.S, w.a, w.b, w.F, w.share) != OK:
            return SINGULAR
        w.now[RIGID] = w.F[0] - w.share[0]
    accelerate(w.L, w.X, w.y, w.F, w.qdd)
    total = abs(w.F[0])
    for j in range(n):
        total += abs(w.qdd[j])
        if not abs(w.v[j]) <= SPEED_LIMIT:
            return DIVERGED
    return OK if math.isfinite(total) else DIVERGED


class Row(NamedTuple):
    """Where each column begins in a recorded row; `width` is the row's length."""

    q: int
    v: int
    acceleration: int
    torque: int
    position: int
    velocity: int
    friction_force: int
    scalars: int
    width: int

    @classmethod
    def of(cls, n: int) -> Row:
        """Lay out a row for n joints."""
        ends = np.cumsum((0, n, n, n, n, 3, 3, 3, len(SCALARS))).tolist()
        return cls(*ends)


SCALARS = (
    "contact_force", "stabiliser_force", "closure_error", "closure_rate", "mode", "residual_motion",
    "residual_closure", "kkt_condition", "normal_mobility", "kinetic_energy",
)  # fmt: skip


@kernel
def kinetic_energy(H: Array, v: Array) -> float:
    """Return ½ q̇ᵀH q̇, J, from H's upper triangle."""
    total = 0.0
    for i in range(v.shape[0]):
        total += 0.5 * H[i, i] * v[i] * v[i]
        for j in range(i + 1, v.shape[0]):
            total += H[i, j] * v[i] * v[j]
    return total


@kernel
def record(H: Array, C: Array, w: Work, k: Array, state: Whole, row: Array) -> None:
    """Write one row in the order of `Row`: the state, and what acted in it."""
    n = w.q.shape[0]
    for j in range(n):
        row[j] = w.q[j]
        row[n + j] = w.v[j]
        row[2 * n + j] = w.qdd[j]
        row[3 * n + j] = w.torque[j]
    at = 4 * n
    for i in range(3):
        row[at + i] = w.r[i]
        speed = 0.0
        for j in range(n):
            speed += w.J[i, j] * w.v[j]
        row[at + 3 + i] = speed
        row[at + 6 + i] = k[FRAME + 3 + i] * w.F[1] + k[FRAME + 6 + i] * w.F[2]
    at += 9
    mode = state[MODE]
    closures = 0 if mode == FREE else (1 if mode == PRESSED else 3)
    motion, closed = residuals(H, w.torque, C, w.A, w.S, w.drift_c, w.b, w.a, w.qdd, w.F, 0, closures)
    trace = w.S[0, 0] + w.S[1, 1] + w.S[2, 2]
    row[at] = w.F[0]
    row[at + 1] = w.share[0]
    row[at + 2] = w.now[GAP]
    row[at + 3] = w.now[RATE]
    row[at + 4] = mode
    row[at + 5] = motion
    row[at + 6] = closed
    # With the normal row of Eq. 24; of H alone while the tip is free.
    row[at + 7] = condition(H, w.A[0], w.L, w.X[0], w.S[0, 0], mode != FREE, w.scratch)
    row[at + 8] = w.S[0, 0] / trace if trace > 0.0 else 0.0
    row[at + 9] = kinetic_energy(H, w.v)
    w.now[MEASURED] = w.F[0]
