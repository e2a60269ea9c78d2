"""The memory of the loop: one flat array of numbers, one of whole numbers, and the names of their parts.

Each array handed from Python to a compiled function costs about 60 ns, so everything that the loop keeps travels as
one block. Inside, `workspace` cuts it into named views.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.compiled import kernel

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# --- whole numbers, by place -----------------------------------------------------------------------------------------
# What was asked for.
(
    STAGES, STEPS, HOLD, LAW, LAW_STATES, PROJECT, UNILATERAL, IMPACT_LAW, SEMI_IMPLICIT, PER_STEP, FRICTION,
    FRICTION_STATES, STICKING, JOINT_FRICTION, JOINT_STATES, SENSOR_STATES, SENSOR_RING, SENSOR_SAMPLED,
) = range(18)  # fmt: skip
# Where the loop is.
(
    PHASE, ROW, STAGE, MODE, TRIAL, EVENTS, TRIES, NEXT, MOVES, STATUS, IN_STEP, RUSHED, SAMPLED, CERTAIN, PIECE, RISEN,
    KIND, STARTED,
) = range(18, 36)  # fmt: skip
WHOLES = 36

# How the surface's law of friction sticks, state[STICKING].
SMOOTH, RIGID_STICK, ELASTIC_STICK, SPRING_STICK = range(4)

# --- numbers that change, by place in `Work.now` ---------------------------------------------------------------------
# time: of the state that terms are asked for; begin, length: of the substep under way; tau: of a trial inside it;
# low, high: bracket of the event searched, with the gauge's value at either end.
(
    TIME, BEGIN, LENGTH, TAU, LOW, HIGH, AT_LOW, AT_HIGH, GAUGE, RATE, GAP, RIGID, START_GAUGE, START_RATE, START_GAP,
    START_SLIP, LAST_EVENT, MEASURED, DELAYED, CUT,
) = range(20)  # fmt: skip
NOW = 24

# --- constants, by place ---------------------------------------------------------------------------------------------
H_STEP, NODE, OFFSET_D, S_V, S_P = range(5)
FRAME = 5  # 9: rows n, t1, t2
TIP = 14  # 3: tip in the frame of the joint that carries it
GRAVITY = 17  # 3
RESTITUTION, REST_SPEED, IMPACT_FRICTION, STICK_SPEED, PD_AT = range(20, 25)
SENSOR_AT = 25  # 4
FRICTION_AT = 29  # 12
JOINTS = 41  # 3 n: support, K_p, K_d; then the law's parameters, 18 + 2 n; then those of joint friction, 12 n
LAW_WIDTH, FRICTION_WIDTH = 18, 12


@kernel
def law_at(n: int) -> int:
    """Return where the law's parameters (LAW_WIDTH + 2 n) begin."""
    return JOINTS + 3 * n


@kernel
def joint_friction_at(n: int) -> int:
    """Return where the joints' friction parameters (n · FRICTION_WIDTH) begin."""
    return JOINTS + 5 * n + LAW_WIDTH


class Work(NamedTuple):
    """Views into the loop's memory; n joints, k numbers of state beside q and q̇."""

    now: Array  # (NOW,) see the places above
    q: Array  # (n,) state
    v: Array  # (n,)
    z: Array  # (k,) states: of the law, the sensor, the surface's friction, the joints' friction
    torque: Array  # (n,) Q
    held: Array  # (n,) the Q that acted until the last sample
    begin: Array  # (2 n + k,) state at the beginning of the substep
    slope: Array  # (n + k,) q̈ and ż there
    stages: Array  # (S, 2 n + k) see `closedloop.integrate.advance`
    qdd: Array  # (n,)
    dz: Array  # (k,)
    y: Array  # (n,) L⁻¹(Q − C)
    column: Array  # (n,) scratch
    loss: Array  # (n,) torque of joint friction, on the joints
    L: Array  # (n, n)
    J: Array  # (3, n) base axes
    A: Array  # (3, n) contact frame
    X: Array  # (3, n) L⁻¹Aᵀ
    S: Array  # (3, 3)
    r: Array  # (3,) base axes
    drift: Array  # (3,) base axes
    p: Array  # (3,) contact frame, as all that follow
    u: Array  # (3,)
    drift_c: Array  # (3,)
    a: Array  # (3,) acceleration without contact
    F: Array  # (3,)
    b: Array  # (3,) right-hand sides of Eq. 24
    b_stabiliser: Array  # (3,)
    share: Array  # (3,) the stabiliser's part of F
    slip: Array  # (2,) velocity of slip at the beginning of the substep
    direction: Array  # (2,) and its direction
    anchor: Array  # (2,) where the tip stuck
    c: Array  # (2,) friction F_t = −c f − w
    w: Array  # (2,)
    before: Array  # (3,) tip velocity before an impact
    compression: Array  # (3,)
    decompression: Array  # (3,)
    after: Array  # (3,)
    reference: Array  # (2 n + 10,) row of the table at this instant
    stuck: Array  # (n,) 1 for a joint that sticks as a spring
    gain: Array  # (n, n) answer of q̈ to friction in each joint
    ring: Array  # (delay + 1,) latest samples of the force sensor
    scratch: Array  # (n n + 3 n + 224,)


def memory_size(n: int, k: int, stages: int, ring: int) -> int:
    """Return how many numbers `workspace` needs."""
    x = 2 * n + k
    return (
        NOW
        + 2 * x
        + n
        + 2 * x
        + stages * x
        + x
        + 3 * n
        + n * n
        + 9 * n
        + 9
        + 54
        + 2 * n
        + 10
        + n
        + n * n
        + ring
        + (n * n + 3 * n + 224)
    )


def views(memory: Array, n: int, k: int, stages: int, ring: int) -> Work:
    """Cut `memory` (memory_size(n, k, stages, ring),) into views."""
    x = 2 * n + k
    at = NOW
    now, q = memory[0:at], memory[at : at + n]
    at += n
    v, z = memory[at : at + n], memory[at + n : at + n + k]
    at += n + k
    torque, held = memory[at : at + n], memory[at + n : at + 2 * n]
    at += 2 * n
    begin, slope = memory[at : at + x], memory[at + x : at + x + n + k]
    at += 2 * x
    stage = memory[at : at + stages * x].reshape(stages, x)
    at += stages * x
    qdd, dz = memory[at : at + n], memory[at + n : at + n + k]
    at += x
    y, column, loss = memory[at : at + n], memory[at + n : at + 2 * n], memory[at + 2 * n : at + 3 * n]
    at += 3 * n
    L = memory[at : at + n * n].reshape(n, n)
    at += n * n
    J = memory[at : at + 3 * n].reshape(3, n)
    A = memory[at + 3 * n : at + 6 * n].reshape(3, n)
    X = memory[at + 6 * n : at + 9 * n].reshape(3, n)
    at += 9 * n
    S = memory[at : at + 9].reshape(3, 3)
    at += 9
    r, drift, p, u = memory[at : at + 3], memory[at + 3 : at + 6], memory[at + 6 : at + 9], memory[at + 9 : at + 12]
    at += 12
    drift_c, a, F, b = memory[at : at + 3], memory[at + 3 : at + 6], memory[at + 6 : at + 9], memory[at + 9 : at + 12]
    at += 12
    b_stabiliser, share = memory[at : at + 3], memory[at + 3 : at + 6]
    slip, direction, anchor = memory[at + 6 : at + 8], memory[at + 8 : at + 10], memory[at + 10 : at + 12]
    c, w = memory[at + 12 : at + 14], memory[at + 14 : at + 16]
    at += 16
    before, compression = memory[at : at + 3], memory[at + 3 : at + 6]
    decompression, after = memory[at + 6 : at + 9], memory[at + 9 : at + 12]
    at += 14
    reference = memory[at : at + 2 * n + 10]
    at += 2 * n + 10
    stuck, gain = memory[at : at + n], memory[at + n : at + n + n * n].reshape(n, n)
    at += n + n * n
    latest = memory[at : at + ring]
    at += ring
    scratch = memory[at : at + n * n + 3 * n + 224]
    return Work(
        now, q, v, z, torque, held, begin, slope, stage, qdd, dz, y, column, loss, L, J, A, X, S, r, drift, p, u,
        drift_c, a, F, b, b_stabiliser, share, slip, direction, anchor, c, w, before, compression, decompression, after,
        reference, stuck, gain, latest, scratch,
    )  # fmt: skip


# The same inside a step. (A compiled function may not hand arrays back to Python, see `closedloop.compiled.kernel`.)
workspace = kernel(views)
