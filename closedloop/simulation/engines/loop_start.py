"""The first reading of encoders, before a run begins or where it goes on."""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.loop.events.phases import MEASURED
from closedloop.loop.step.make_loop import Loop
from closedloop.loop.step.memory import Work
from closedloop.loop.step.seen import read_joints
from closedloop.mechanics.loops.close import close_state, factor_rows
from closedloop.mechanics.loops.memory import LoopMemory
from closedloop.mechanics.loops.rows import locate_rows


def read_encoders(loop: Loop, table: Array) -> None:
    """Read the joints in the state of a loop, as the law sees them: the loops of the mechanism are closed there too."""
    state, entry = loop.state, loop.state.loops.entry
    state.loops.entry = 0  # compiled code, which interpreted code cannot call
    interpreted(read_joints)(loop.w, loop.constants, state, table)
    state.loops.entry, state.phase = entry, MEASURED
    if state.loops.seen_at != 0:
        _close_reading(loop.w, loop.w.kept["seen_loops"])


def _close_reading(w: Work, memory: LoopMemory) -> None:
    """Move the first reading of encoders, in place of q and q̇, to the nearest state that the loops allow.

    Their rank is that at the true state, before it is found in the course of a run.
    """
    links, rows = memory
    rows.q[:], rows.v[:] = w.encoders.true_q, w.encoders.true_v
    interpreted(locate_rows)(links, rows)
    interpreted(factor_rows)(links, rows, rows.error, links.m)
    links.known = links.rank
    interpreted(close_state)(links, rows, w.q, w.v)
