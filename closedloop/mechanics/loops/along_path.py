"""The loops of a mechanism whose tip follows a path: postures that close them, and motions that keep them so."""

from __future__ import annotations

from closedloop.jit.kernel import entry_kernel
from closedloop.mechanics.loops.close import close_state, factor_rows
from closedloop.mechanics.loops.memory import loops_at
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.loops.solve import leave_free

# What is asked.
TANGENT, NEAREST = range(2)


@entry_kernel
def along_path(address: int, what: int) -> int:
    """Answer for the loops at `q` of their memory, by its address; joints count alike.

    TANGENT     replace `tip`, rows of joint velocities, by what the loops leave of them
    NEAREST     replace `q` by the nearest posture that closes the loops
    """
    links, rows = loops_at(address)
    if what == TANGENT:
        for j in range(links.n):
            rows.v[j] = 0.0
        locate_rows(links, rows)
        factor_rows(links, rows, rows.error, links.m)
        links.known = links.rank
        for k in range(6):
            leave_free(links, rows, rows.tip[k])
    else:
        for j in range(links.n):
            rows.column[j], rows.still[j] = rows.q[j], 0.0
        close_state(links, rows, rows.column, rows.still)
        for j in range(links.n):
            rows.q[j] = rows.column[j]
    return 0
