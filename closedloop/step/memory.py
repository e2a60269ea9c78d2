"""The memory of the loop: one flat array of numbers, one of whole numbers, and the names of their parts.

Each array handed from Python to a compiled function costs about 60 ns, so everything that the loop keeps travels as
one block, which `workspace` cuts into named views.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.conditioning import LANES, pending_rows
from closedloop.jit.kernel import kernel
from closedloop.jit.memory_views import Count, Layout, compiled_views

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
    KIND, STARTED, PENDING,
) = range(18, 37)  # fmt: skip
WHOLES = 37

# How the surface's law of friction sticks, state[STICKING].
SMOOTH, RIGID_STICK, ELASTIC_STICK, SPRING_STICK = range(4)

# --- numbers that change, by place in `Work.now` ---------------------------------------------------------------------
# time: of the state that terms are asked for; begin, length: of the substep under way; tau: of a trial inside it;
# low, high: bracket of the event searched, with the gauge's value at either end. straight: slip up to this speed, m/s,
# is resisted along `Work.direction`, whichever way it points. cut, given: of a restitution.
# supplied, gained: see `closedloop.step.energy_supplied`.
(
    TIME, BEGIN, LENGTH, TAU, LOW, HIGH, AT_LOW, AT_HIGH, GAUGE, RATE, GAP, RIGID, START_GAUGE, START_RATE, START_GAP,
    START_SLIP, LAST_EVENT, MEASURED, DELAYED, CUT, STRAIGHT, GIVEN, SUPPLIED, GAINED, START_POWER, START_GROWTH,
) = range(26)  # fmt: skip
NOW = 32

# --- constants, by place ---------------------------------------------------------------------------------------------
H_STEP, NODE, OFFSET_D, S_V, S_P = range(5)
FRAME = 5  # 9: rows n, t1, t2
TIP = 14  # 3: tip in the frame of the joint that carries it
GRAVITY = 17  # 3
RESTITUTION, REST_SPEED, IMPACT_FRICTION, STICK_SPEED, PD_AT = range(20, 25)
SENSOR_AT = 25  # 4
FRICTION_AT = 29  # 12
REACH = 41  # of the arm, squared
JOINTS = 42  # 3 n: support, K_p, K_d; then the law's parameters, 18 + 2 n; then those of joint friction, 12 n
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
    stages: Array  # (S, 2 n + k) see `closedloop.step.advance`
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
    b_stabiliser: Array  # (3,) scratch: a right-hand side that is zero
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
    pending: Array  # (2 n² + 6 n + 5, 32) see `closedloop.closure.conditioning`
    scratch: Array  # (n n + 3 n + 224,)


# Those of a fixed size come first, then those of the joints: what a step touches is then at short distances.
_n, _k, _stages, _ring = (Count.of(size) for size in ("n", "k", "stages", "ring"))
LAYOUT = Layout(
    ("n", "k", "stages", "ring"),
    [
        ("now", (NOW,)),
        *((name, (3,)) for name in ("r", "drift", "p", "u", "drift_c", "a", "F", "b", "b_stabiliser", "share")),
        ("S", (3, 3)),
        *((name, (3,)) for name in ("before", "compression", "decompression", "after")),
        *((name, (2,)) for name in ("slip", "direction", "anchor", "c", "w")),
        *((name, (_n,)) for name in ("q", "v", "torque", "held", "qdd", "y", "column", "loss", "stuck")),
        ("J", (3, _n)),
        ("A", (3, _n)),
        ("X", (3, _n)),
        ("reference", (2 * _n + 10,)),
        ("L", (_n, _n)),
        ("gain", (_n, _n)),
        ("pending", (pending_rows(_n), LANES)),
        ("scratch", (_n * _n + 3 * _n + 224,)),
        ("z", (_k,)),
        ("dz", (_k,)),
        ("begin", (2 * _n + _k,)),
        ("slope", (_n + _k,)),
        ("stages", (_stages, 2 * _n + _k)),
        ("ring", (_ring,)),
    ],
)


def memory_size(n: int, k: int, stages: int, ring: int) -> int:
    """Return how many numbers `workspace` needs."""
    return LAYOUT.size(n, k, stages, ring)


def workspace(memory: Array, n: int, k: int, stages: int, ring: int) -> Work:
    """Cut `memory` (memory_size(n, k, stages, ring),) into views; in compiled code these are made where they are used.

    See `closedloop.jit.memory_views`.
    """
    return Work(**LAYOUT.views(memory, n, k, stages, ring))


compiled_views(LAYOUT, workspace)
