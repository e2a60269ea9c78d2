"""The memory of the loop: what was asked for, where the loop stands, and the numbers of the state it works on.

Each is a `Block`, one array whose parts have names: handing an array from Python to compiled code costs about 60 ns,
so everything that the loop keeps travels as three.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from closedloop.closure.conditioning import LANES, pending_rows
from closedloop.jit.blocks import Block, Count

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# How the surface's law of friction sticks, `State.sticking`.
SMOOTH, RIGID_STICK, ELASTIC_STICK, SPRING_STICK = range(4)

# Parameters of a control law beside 2 for each joint, and of a law of friction.
LAW_WIDTH, FRICTION_WIDTH = 18, 12

# Sizes: joints, numbers of state beside q and q̇, stages of the integrator, samples that the sensor keeps.
N, K, STAGES, RING = (Count.of(size) for size in ("n", "k", "stages", "ring"))


class State(Block):
    """Whole numbers, int64: what was asked for, and where the loop stands."""

    # What was asked for.
    stages: int  # of the integrator
    steps: int
    hold: int  # steps for which a sampled torque is held; 0: the law is evaluated at every stage
    law: int  # see `closedloop.control.parameters.LAWS`, or LAW_GIVEN
    law_states: int
    project: int
    unilateral: int
    impact_law: int
    semi_implicit: int
    nodes_per_step: int  # rows of the reference's table to a step
    friction: int  # law of the surface's friction, and its states
    friction_states: int
    sticking: int
    joint_friction: int
    joint_states: int
    sensor_states: int
    sensor_ring: int
    sensor_sampled: int
    # Where the loop stands.
    phase: int
    row: int
    stage: int
    mode: int
    trial: int
    events: int
    tries: int
    next_phase: int
    moves: int
    status: int
    events_in_step: int
    rushed: int
    sampled: int
    certain: int
    after_event: int
    risen: int
    kind: int
    started: int
    pending: int


class Constants(Block, sizes=("n",)):
    """What does not change during a run of n joints."""

    h: float  # step, s
    node: float  # time between two rows of the reference's table, s
    offset: float  # d, m
    s_v: float
    s_p: float
    restitution: float
    rest_speed: float
    impact_friction: float
    stick_speed: float
    pd_start: float
    reach: float  # of the arm, squared
    frame: Annotated[Array, 3, 3]  # rows n, t1, t2, base axes
    tip: Annotated[Array, 3]  # in the frame of the joint that carries it
    gravity: Annotated[Array, 3]
    sensor: Annotated[Array, 4]
    friction: Annotated[Array, FRICTION_WIDTH]
    support: Annotated[Array, N]
    gains: Annotated[Array, 2, N]  # K_p, K_d
    law: Annotated[Array, LAW_WIDTH + 2 * N]
    joint_friction: Annotated[Array, N, FRICTION_WIDTH]


# Single numbers and parts of a fixed size come first, then those of the joints: what a step touches is then at short
# distances.
class Work(Block, sizes=("n", "k", "stages", "ring")):
    """The state that the loop works on; n joints, k numbers of state beside q and q̇."""

    time: float  # of the state that terms are asked for
    begin_time: float  # of the substep under way, and its length
    length: float
    tau: float  # length of a trial substep
    low: float  # bracket of the event searched for, with the event function at either end
    high: float
    at_low: float
    at_high: float
    event_value: float  # of the event function
    rate: float
    gap: float
    rigid_force: float  # of the closure without its stabiliser, by which contact is judged
    start_event_value: float  # at the beginning of the substep, as all that follow
    start_rate: float
    start_gap: float
    start_slip_speed: float
    last_event: float  # its instant
    measured: float  # reading of the force sensor
    delayed_slip: float  # speed of slip that friction with memory answers to
    discarded_rebound: float  # of a restitution too slow to leave the surface, m/s
    straight: float  # slip up to this speed, m/s, is resisted along `direction`, whichever way it points
    restitution_given: float
    supplied: float  # see `closedloop.step.energy_supplied`, as all that follow
    gained: float
    start_power: float
    start_power_rate: float
    r: Annotated[Array, 3]  # base axes
    drift: Annotated[Array, 3]  # base axes
    p: Annotated[Array, 3]  # contact frame, as all that follow
    u: Annotated[Array, 3]
    drift_c: Annotated[Array, 3]
    a: Annotated[Array, 3]  # acceleration without contact
    F: Annotated[Array, 3]
    b: Annotated[Array, 3]  # right-hand sides of Eq. 24
    b_stabiliser: Annotated[Array, 3]  # scratch: a right-hand side that is zero
    stabiliser_force: Annotated[Array, 3]  # the stabiliser's part of F
    S: Annotated[Array, 3, 3]
    before: Annotated[Array, 3]  # tip velocity before an impact
    compression: Annotated[Array, 3]
    decompression: Annotated[Array, 3]
    after: Annotated[Array, 3]
    start_slip: Annotated[Array, 2]  # velocity of slip at the beginning of the substep
    direction: Annotated[Array, 2]  # and its direction
    anchor: Annotated[Array, 2]  # where the tip stuck
    c: Annotated[Array, 2]  # friction F_t = −c f − w
    viscous: Annotated[Array, 2]  # w
    q: Annotated[Array, N]  # state
    v: Annotated[Array, N]
    torque: Annotated[Array, N]  # Q
    held: Annotated[Array, N]  # the Q that acted until the last sample
    qdd: Annotated[Array, N]
    y: Annotated[Array, N]  # L⁻¹(Q − C)
    column: Annotated[Array, N]  # scratch
    joint_friction: Annotated[Array, N]  # torque of friction on the joints
    stuck: Annotated[Array, N]  # 1 for a joint that sticks as a spring
    J: Annotated[Array, 3, N]  # base axes
    A: Annotated[Array, 3, N]  # contact frame
    X: Annotated[Array, 3, N]  # L⁻¹Aᵀ
    reference: Annotated[Array, 2 * N + 10]  # row of the table at this instant
    L: Annotated[Array, N, N]
    gain: Annotated[Array, N, N]  # answer of q̈ to friction in each joint
    pending: Annotated[Array, pending_rows(N), LANES]  # see `closedloop.closure.conditioning`
    scratch: Annotated[Array, N * N + 3 * N + 224]
    z: Annotated[Array, K]  # states: of the law, the sensor, the surface's friction, the joints' friction
    dz: Annotated[Array, K]
    begin: Annotated[Array, 2 * N + K]  # state at the beginning of the substep
    slope: Annotated[Array, N + K]  # q̈ and ż there
    stages: Annotated[Array, STAGES, 2 * N + K]  # see `closedloop.step.advance.advance`
    ring: Annotated[Array, RING]  # latest samples of the force sensor
