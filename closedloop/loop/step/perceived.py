"""What the law sees of a state: by its own model, and as the encoders read it.

The controller's model of the arm, where it is wrong: its H and C, from those of the arm.

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
from closedloop.control.reference.table import DrawnRow
from closedloop.control.sensor import EncoderParameters, across, read_encoder
from closedloop.jit.calls import call_at, integers_at, matrix_at, row_of
from closedloop.jit.kernel import kernel
from closedloop.loop.step.closed_loops import BIND_PERCEIVED, CLOSE
from closedloop.loop.step.locate import ask_about_tip, in_contact_frame
from closedloop.loop.step.memory import Constants, State, Work
from closedloop.mechanics.closure.contact_force import factorise, into_contact_frame
from closedloop.mechanics.closure.solve import NO_NORMAL, NOT_POSITIVE_DEFINITE, OK
from closedloop.mechanics.surface.contact import ask_at
from closedloop.mechanics.surface.geometry import Touch


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
