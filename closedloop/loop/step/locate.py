"""Where the tip is to the surface: contact frame, gap, and the tip's motion in that frame; and what the law sees of it.

Of a plane at rest the frame is constant; any other surface is asked, by address
(`closedloop.mechanics.surface.contact`).

Of a tool with a round end, `tool.radius`, the tip is the centre of a ball, and its contact where the ball touches. The
gap of the surface is that of the ball already (`closedloop.mechanics.surface.placed`). The material at the contact
moves with ṙ + ω × (−ρ n), so that friction has a lever about the centre: the rows t1 and t2 of Eq. 24 have it, and n is
the same. With the tip as a point nothing of this is called.

The law sees a state by its own model, and as the encoders read it. Where the controller's model of the arm is wrong,
its H and C follow from those of the arm:

    H' = κ (H − m JᵣᵀJᵣ − D) + D        C' = κ (C − m Jᵣᵀ(J̇ᵣq̇ − g))

with m a payload at the tip that it does not know of, κ the factor by which it is wrong about all masses, and D the
drives' inertia. Both are exact: C is linear in the masses, and m JᵣᵀJᵣ and m Jᵣᵀ(J̇ᵣq̇ − g) are what a point mass adds.

With encoders the terms are requested twice a row: at the state that they read, for the law, and at the true one, for
Eq. 24. See `closedloop.loop.events.proceed`, phase MEASURED. Of a mechanism with loops the controller knows that they
are closed: what it sees is the state nearest to the readings at which they are.
"""

import math
from typing import Any

from closedloop.base.arrays import Array
from closedloop.control.law import Perceived
from closedloop.control.reference.desired import DrawnRow, Reference
from closedloop.control.sensor import EncoderParameters, across, read_encoder
from closedloop.jit.blocks import Block
from closedloop.jit.calls import call_at, integers_at, matrix_at, row_of
from closedloop.jit.kernel import entry_kernel, kernel, kernel_inlined
from closedloop.jit.user_code import RAISED
from closedloop.loop.step.closed_loops import BIND_PERCEIVED, CLOSE
from closedloop.loop.step.memory import Constants, State, Work, loop_at
from closedloop.mechanics.closure.contact_force import FREE, factorise, into_contact_frame
from closedloop.mechanics.closure.solve import NO_NORMAL, NOT_POSITIVE_DEFINITE, OK
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


@kernel
def apply_model_error(w: Work, constants: Constants) -> None:
    """Overwrite H and C, which the control law reads, by those of the controller's model."""
    k, m = constants.mass_factor, constants.unknown_payload
    for i in range(w.q.shape[0]):
        carried = 0.0
        for a in range(3):
            carried += w.J[a, i] * (w.drift[a] - constants.gravity[a])
        w.C[i] = k * (w.C[i] - m * carried)
        for j in range(w.q.shape[0]):
            moved = 0.0
            for a in range(3):
                moved += w.J[a, i] * w.J[a, j]
            drive = constants.armature[i] if i == j else 0.0
            w.H[i, j] = k * (w.H[i, j] - m * moved - drive) + drive


# Of `Settings.elastic`: the encoders are on the motors.
MOTORS_MEASURED = 2


@kernel
def keep_terms(H: Array, C: Array, w: Work) -> None:
    """Keep H, whole, and C where a law reads them, which is called by address."""
    n = w.q.shape[0]
    for i in range(n):
        w.C[i] = C[i]
        for j in range(i, n):
            w.H[i, j] = H[i, j]
            w.H[j, i] = H[i, j]


@kernel
def perceive(H: Array, C: Array, w: Work, constants: Constants, state: State) -> int:
    """Write what the law sees of the state in `w`, whose terms are given.

    Its contact frame is that of the surface that it believes in, turned by `constants.tilt` and by noise. Returns
    OK, NO_NORMAL if that surface has none at the tip, or NOT_POSITIVE_DEFINITE if the H that it believes in is no
    inertia.
    """
    n, tilt = w.q.shape[0], constants.tilt
    perceived, wanted = Perceived(w.perceived, n), w.reference
    frame, carried, turning = w.tip.frame, w.tip.carried, w.tip.turning
    if state.surface.believed.entry != 0:
        if not ask_about_tip(w, state.surface.believed.entry, state.surface.believed.at, state):
            return int(NO_NORMAL)
        _, ask = ask_at(state.surface.believed.at)
        touch = Touch(ask.touch)
        frame, carried, turning = ask.frame, touch.carried, touch.turning
    for i in range(3):
        perceived.r[i], perceived.drift[i] = w.r[i], w.drift[i]
        perceived.carried[i], perceived.turning[i] = 0.0, 0.0
        for k in range(3):
            perceived.carried[i] += tilt[i, k] * carried[k]
            perceived.turning[i] += tilt[i, k] * turning[k]
            perceived.frame[i, k] = tilt[i, 0] * frame[0, k] + tilt[i, 1] * frame[1, k] + tilt[i, 2] * frame[2, k]
        for j in range(n):
            perceived.J[i, j] = w.J[i, j]
    for j in range(n):
        perceived.q[j], perceived.v[j] = w.q[j], w.v[j]
    if state.surface.noise != 0:
        row = min(int(w.time / constants.h + EARLY), state.settings.steps)
        shake(row_of(matrix_at(state.surface.noise, state.settings.steps + 1, 2), row), perceived)
    into_contact_frame(perceived, perceived)
    for i in range(3):
        perceived.u[i] -= perceived.carried[i]
        perceived.drift_c[i] += perceived.turning[i]
    in_contact_frame(perceived.frame, perceived.carried, perceived.turning, wanted)
    keep_terms(H, C, w)
    if state.settings.model_error != 0:
        apply_model_error(w, constants)
    if state.settings.elastic != 0:  # the controller takes the joints for rigid
        for j in range(n):
            w.H[j, j] += constants.gears.motor_inertia[j]
    ends = integers_at(state.addresses.group_ends, state.n)
    status = int(factorise(w.H, perceived.A, perceived.L, perceived.X, perceived.S, constants.reach, ends))
    if status != OK:
        return int(NOT_POSITIVE_DEFINITE)
    if state.loops.perceived_at != 0:
        call_at(state.loops.entry, state.loops.perceived_at, BIND_PERCEIVED)
    return int(OK)


Pair = tuple[float, float]
# A sample begins by this share of a step before its row: instants are rounded.
EARLY = 1e-6


@kernel
def shake(angles: Array, perceived: Perceived) -> None:
    """Turn the frame that the law sees, and what the surface carries in it, so that n tilts by angles (2,), rad."""
    a, b = angles[0], angles[1]
    size = math.sqrt(a * a + b * b)
    if not size > 0.0:
        return
    c, s, a, b = math.cos(size), math.sin(size), a / size, b / size
    for k in range(3):
        n, t, u = perceived.frame[0, k], perceived.frame[1, k], perceived.frame[2, k]
        perceived.frame[0, k], perceived.frame[1, k], perceived.frame[2, k] = shaken(n, t, u, (a, b), (c, s))
    for x in (perceived.carried, perceived.turning):
        x[0], x[1], x[2] = shaken(x[0], x[1], x[2], (a, b), (c, s))


@kernel
def shaken(n: float, t: float, u: float, way: Pair, turn: Pair) -> tuple[float, float, float]:
    """Return components along n, t1, t2 in a frame whose n has turned towards a t1 + b t2; c, s are of the angle."""
    (a, b), (c, s) = way, turn
    d, e = a * t + b * u, a * u - b * t
    n, d = c * n + s * d, c * d - s * n
    return n, a * d - b * e, b * d + a * e


@kernel
def sensor_feels(axis: int, w: Work, par: Any, state: State) -> float:
    """Return the force on the tip that an axis of the sensor feels, N, in the contact frame that the law sees.

    Forces from outside on the tip are part of it, and what moves the mass that the sensor carries.
    """
    F, felt, f = w.scratch.force, w.scratch.acceleration, w.tip.frame
    for i in range(3):
        F[i] = w.tip.F[i]
    if state.external.entry != 0 or par.mass > 0.0:
        for k in range(3):
            rate = w.drift[k]
            for j in range(w.q.shape[0]):
                rate += w.J[k, j] * w.qdd[j]
            for i in range(3):
                F[i] += f[i, k] * (w.sensing.outside[k] - par.mass * rate)
    if state.settings.misjudged != 0:
        frame = Perceived(w.perceived, w.q.shape[0]).frame
        for i in range(3):
            felt[i] = F[i]
        for i in range(3):
            F[i] = 0.0
            for k in range(3):
                F[i] += frame[i, k] * (f[0, k] * felt[0] + f[1, k] * felt[1] + f[2, k] * felt[2])
    return across(F, axis, par)


@kernel
def read_joints(w: Work, constants: Constants, state: State, table: Array) -> None:
    """Put what the encoders read in place of q and q̇, for the terms that the law sees; keep the true ones aside."""
    n, row = w.q.shape[0], state.row
    par = EncoderParameters(constants.encoder, n)
    normal = DrawnRow(row_of(table, row * state.settings.nodes_per_step), n).draws
    motors = w.z.shape[0] - 2 * n
    for j in range(n):
        w.encoders.true_q[j], w.encoders.true_v[j] = w.q[j], w.v[j]
        q, v = w.q[j], w.v[j]
        if state.settings.elastic == MOTORS_MEASURED and constants.gears.motor_inertia[j] > 0.0:
            q, v = w.z[motors + j], w.z[motors + n + j]
        position, velocity = read_encoder(
            state.settings.encoder,
            (q, v),
            j,
            par,
            normal,
            constants.h if row > 0 else 0.0,
            (w.encoders.last_q, w.encoders.last_v),
        )
        if constants.measured[j] == 0.0:
            position, velocity = q, v
        w.encoders.q[j], w.encoders.v[j] = position, velocity
        w.q[j], w.v[j] = position, velocity
    if state.loops.entry != 0 and state.loops.perceived_at != 0:
        call_at(state.loops.entry, state.loops.perceived_at, CLOSE)


@kernel
def back_to_true(w: Work) -> None:
    """Put the true q and q̇ back."""
    for j in range(w.q.shape[0]):
        w.q[j], w.v[j] = w.encoders.true_q[j], w.encoders.true_v[j]
