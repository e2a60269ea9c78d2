"""Where the tip is to the surface, and the round end of a tool.

The round end of a tool, `tool.radius`: the tip is the centre of a ball, and its contact where the ball touches.

The gap of the surface is that of the ball already (`closedloop.mechanics.surface.placed`). The material at the contact
moves with ṙ + ω × (−ρ n), so that friction has a lever about the centre: the rows t1 and t2 of Eq. 24 have it, and n is
the same. With the tip as a point nothing of this is called.

Where the tip is to the surface: contact frame, gap, and the tip's motion in that frame.

Of a plane at rest the frame is constant; any other surface is asked, by address
(`closedloop.mechanics.surface.contact`).
"""

from typing import Any

from closedloop.base.arrays import Array
from closedloop.control.reference.table import Reference
from closedloop.jit.blocks import Block
from closedloop.jit.calls import call_at, integers_at
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.user_code import RAISED
from closedloop.loop.step.memory import Constants, State, Work, loop_at
from closedloop.mechanics.closure.contact_force import FREE, into_contact_frame
from closedloop.mechanics.closure.solve import NO_NORMAL, OK
from closedloop.mechanics.contacts.rolling import RADIUS, move_to_ball, shapes_at, turn_against, turn_on_surface
from closedloop.mechanics.loops.memory import loops_at
from closedloop.mechanics.loops.rows import locate_rows
from closedloop.mechanics.surface.contact import CONTACT, FOUND, ask_at, edge_distance
from closedloop.mechanics.surface.geometry import Touch


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


@kernel_inlined
def locate_on_plane(w: Work, constants: Any) -> None:
    """Write the tip's motion in the contact frame of a plane at rest, and the gap and its rate."""
    into_contact_frame(w, w.tip)
    w.tip.gap, w.tip.rate = w.tip.p[0] - constants.offset, w.tip.u[0]


@kernel_inlined
def locate_tip(w: Work, constants: Constants, state: State) -> int:
    """Write the contact frame, the tip's motion in it, and the gap and its rate; return OK or NO_NORMAL."""
    if state.surface.entry == 0:
        locate_on_plane(w, constants)
        if state.ball.entry != 0:
            call_at(state.ball.entry, state.ball.at, 0)
        return OK
    if not ask_surface(w, constants.h, state):
        return NO_NORMAL
    locate_on_surface(w)
    if state.ball.entry != 0:
        call_at(state.ball.entry, state.ball.at, 0)
    return OK


@kernel_inlined
def locate_on_surface(w: Work) -> None:
    """Write the tip's motion in the contact frame that a surface has answered, and the rate of the gap."""
    into_contact_frame(w, w.tip)
    for i in range(3):
        w.tip.u[i] -= w.tip.carried[i]
        w.tip.drift_c[i] += w.tip.turning[i]
    w.tip.rate = w.tip.u[0]


@kernel
def ask_surface(w: Work, h: float, state: State) -> bool:
    """Write what the surface answers: contact frame, gap, carried and turning; False if it has no normal there.

    Or if a tip in contact is coming to where it has none: a step of `h`, s, leads over a point without showing it, so
    that the run stops where |∇φ|, as it falls along the motion, would vanish within the step.
    """
    return ask_about_tip(w, state.surface.entry, state.surface.at, state) and take_answer(w, h, state)


@kernel
def take_answer(w: Work, h: float, state: State) -> bool:
    """Do the rest of `ask_surface` with what the surface has answered."""
    _, ask = ask_at(state.surface.at)
    touch = Touch(ask.touch)
    if state.mode != FREE and touch.growth * h < -1.0:
        return False
    w.tip.gap, w.tip.inside = touch.level / touch.size, edge_distance(touch.at, ask.bounds, ask.solid)
    for i in range(3):
        w.tip.carried[i], w.tip.turning[i] = touch.carried[i], touch.turning[i]
        for k in range(3):
            w.tip.frame[i, k] = ask.frame[i, k]
    return True


@kernel
def ask_about_tip(w: Work, entry: int, at: int, state: State) -> bool:
    """Ask a surface, whose memory is at an address, how the tip is to it; False if it has no normal there."""
    links, ask = ask_at(at)
    ask.time = w.time
    for i in range(3):
        speed = 0.0
        for j in range(w.v.shape[0]):
            speed += w.J[i, j] * w.v[j]
        ask.velocity[i] = speed
        ask.r[i] = w.r[i]
    answer = call_at(entry, links.address, CONTACT)
    if answer != FOUND:
        state.raised = 1 if answer == RAISED else 0
    return answer == FOUND


@kernel
def set_anchor(w: Work, state: State) -> None:
    """Write where the tip is, as a place on the surface, which carries it along: it has stuck there."""
    for i in range(3):
        w.tip.anchor[i] = w.tip.p[i]
    if state.surface.entry != 0:
        _, ask = ask_at(state.surface.at)
        touch = Touch(ask.touch)
        for i in range(3):
            w.tip.anchor[i] = touch.at[i]


@kernel
def flows(touch: Touch) -> bool:
    """Whether the material of a surface flows along it where it has been asked."""
    return touch.flow[1] != 0.0 or touch.flow[2] != 0.0


@kernel
def off_anchor(w: Work, state: State, tangent: int) -> float:
    """Return how far the tip is from where it stuck, m, along tangent 1 or 2.

    It is 0 of a ball, which rolls on, and of what is stuck to material that flows: that moves on with it.
    """
    if state.ball.entry != 0:
        return 0.0
    if state.surface.entry == 0:
        return float(w.tip.p[tangent] - w.tip.anchor[tangent])
    _, ask = ask_at(state.surface.at)
    touch, off = Touch(ask.touch), 0.0
    if flows(touch):
        return off
    for k in range(3):
        off += touch.local[tangent, k] * (touch.at[k] - w.tip.anchor[k])
    return off


@kernel
def in_contact_frame(frame: Array, carried: Array, turning: Array, wanted: Reference) -> None:
    """Turn the desired motion of the tip into a contact frame N, where it is compared with p, u and u̇ of the tip.

    That is N r_des, N ṙ_des − carried and N r̈_des + turning.
    """
    for part in range(3):
        x = wanted.position if part == 0 else (wanted.velocity if part == 1 else wanted.acceleration)
        x0, x1, x2 = x[0], x[1], x[2]
        for i in range(3):
            x[i] = frame[i, 0] * x0 + frame[i, 1] * x1 + frame[i, 2] * x2
            if part == 1:
                x[i] -= carried[i]
            elif part == 2:
                x[i] += turning[i]
