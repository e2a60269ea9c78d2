"""The round end of a tool, `tool.radius`: the tip is the centre of a ball, and its contact where the ball touches.

The gap of the surface is that of the ball already (`closedloop.mechanics.surface.placed`). The material at the contact
moves with ṙ + ω × (−ρ n), so that friction has a lever about the centre: the rows t1 and t2 of Eq. 24 have it, and n is
the same. With the tip as a point nothing of this is called.
"""

from __future__ import annotations

from closedloop.jit.blocks import Block
from closedloop.jit.calls import integers_at
from closedloop.jit.kernel import entry_kernel
from closedloop.loop.step.memory import loop_at
from closedloop.mechanics.contacts.rolling import move_to_ball, turn_against, turn_on_surface
from closedloop.mechanics.contacts.shapes import RADIUS, shapes_at
from closedloop.mechanics.loops.memory import loops_at
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.surface.contact import ask_at


class BallTip(Block):
    """Whole numbers, int64: its own address, and those of the loop, of the rows of the tip and of its shape."""

    address: int
    loop: int
    rows: int  # n, t1, t2 of a plane at rest, or x, y, z of the base
    shapes: int  # of which the first is the ball


BALL_TIP = BallTip.count()


@entry_kernel
def ball_tip(address: int, what: int) -> int:
    """Move the rows of the tip, which has been located as a point, to where its ball touches."""
    ball = BallTip(integers_at(address, BALL_TIP))
    state, _, w = loop_at(ball.loop)
    joints, rows = loops_at(ball.rows)
    shapes = shapes_at(ball.shapes)
    for j in range(joints.n):
        rows.q[j], rows.v[j] = w.q[j], w.v[j]
    locate_rows(joints, rows)
    turn_against(joints, rows, 0, shapes)
    if state.surface.entry != 0:
        turn_on_surface(shapes, ask_at(state.surface.at)[1])
    else:
        for a in range(3):
            shapes.carried[a], shapes.turning[a] = 0.0, 0.0
    move_to_ball(shapes, shapes.shape[0, RADIUS], w.tip.A, w.tip.u, w.tip.carried, w.tip.turning, w.tip.drift_c)
    return 0
