"""The memory of the loop: settings and whole-number state, constants, and the state it works on.

Each is a `Block`, one array whose parts have names: passing an array from Python to compiled code costs about 60 ns,
so all memory of the loop is passed as three.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from closedloop.control.encoder import EncoderParameters
from closedloop.control.seen import Seen
from closedloop.control.sensor import SensorParameters
from closedloop.jit.blocks import Block, Count
from closedloop.jit.kernel import kernel_inlined
from closedloop.jit.pointers import integers_at, vector_at
from closedloop.mechanics.closure.conditioning import BATCH, batch_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# How a law of friction sticks, `State.sticking`.
SMOOTH, RIGID_STICK, ELASTIC_STICK, SPRING_STICK = range(4)

# Sizes: joints, numbers of state beside q and q̇, stages of the integrator, samples that the sensor keeps.
N, K, STAGES, RING = (Count.of(size) for size in ("n", "k", "stages", "ring"))


class State(Block):
    """Whole numbers, int64: the settings of the run, and the state of the loop."""

    # Settings.
    stages: int  # of the integrator
    steps: int
    hold: int  # steps for which a sampled torque is held; 0: the law is evaluated at every stage
    # Address of the control law's entry, see `closedloop.loop.step.entries`; 0: the paper's, on a smooth surface
    law: int
    compensation: int  # and of its compensation's; 0: none
    own_law_states: int  # of the law alone
    law_states: int  # of the law and its compensation
    project: int
    unilateral: int
    impact_law: int
    semi_implicit: int
    nodes_per_step: int  # rows of the reference's table to a step
    friction: int  # address of the entry of the law of the surface's friction, 0: none; how many states it has
    friction_states: int
    sticking: int
    joint_friction: int  # and of the joints' friction; states of each joint
    joint_states: int
    joint_sticking: int
    sensor_states: int
    sensor_ring: int
    sensor_sampled: int
    # Where its memory is: addresses, its own first, and sizes.
    address: int
    n: int  # joints
    extra: int  # numbers of state beside q and q̇
    law_size: int  # of the parameters of each
    compensation_size: int
    friction_size: int
    joint_friction_size: int  # of one joint
    surface: int  # address of the entry of the surface, 0: a plane at rest; and of its memory
    surface_at: int
    model_error: int  # 1 if the controller is wrong about the arm
    encoder: int  # see `closedloop.control.encoder.encoder_kind`
    seen: int  # 1 if the law sees `Work.seen`, not the state itself
    elastic: int  # 1 if the joints are; 2 if the motors are measured
    drives: int  # 1 if the drives have limits
    arm_at: int  # where in a row there is a `closedloop.loop.step.record_row.ArmRow`; 0: nowhere
    states_at: int  # where in a row the states of law and compensation are; 0: nowhere
    compliance: int  # address of the entry of the surface's compliance, 0: it is rigid; and its parameters
    compliance_size: int
    surface_motion: int  # address of the entry of its motion, 0: it is at rest
    loops: int  # address of the entry of the mechanism's loops, 0: a tree; and of their memory
    loops_at: int
    seen_loops_at: int  # address of the memory of the loops as the law sees them, 0: it sees the state itself
    contacts: int  # address of the entry of the contacts of the links, 0: none but the tip's; and of their memory
    contacts_at: int
    together: int  # 1 while a contact of a link is closed, or strikes: all contacts are then solved together
    watched: int  # 1 if the event that is searched for may be that an open contact of a link closes
    striking: int  # which contact strikes alone, 0 the tip; see `closedloop.loop.events.impacts.collide`
    stops: int  # 1 if the joints have stops
    balls: int  # ball joints
    feed_forward: int  # whether the law is told of the joints' desired acceleration
    proceed: int  # address of the entry of `closedloop.loop.events.proceed`, for the compiled engine
    constants_at: int
    constants_size: int
    work_at: int
    work_size: int
    # State of the loop; constants in `closedloop.loop.events.phases`.
    phase: int  # what the terms requested last are for
    row: int  # the next to be recorded
    stage: int
    mode: int
    trial: int  # what the trial step is for
    events: int  # rows written of the table of events
    trials: int  # trial steps of this search
    next_phase: int  # after a projection
    projections: int  # Newton steps of this projection
    status: int
    events_in_step: int  # less what rows took off, see `closedloop.loop.events.phases.OUTPACED`
    rapid_events: int  # events in a row within `RAPID` of each other
    sampled: int  # 1 if the law is evaluated with these terms
    raised: int  # 1 once a user's member has raised something
    no_search: int  # 1 if an event at the end of this step happens there, not before
    divided: int  # 1 in a substep that ends before the step for joints that turn fast
    after_event: int  # 1 in the remainder of a step after an event
    beside: int  # 1 while the tip is not above the surface because it has gone beyond its edge
    risen: int  # 1 if the tip has been clear of the surface since it lifted off
    kind: int  # of the event
    started: int  # 1 once the law has been evaluated
    batched: int  # rows in `Work.batch`
    approached: int  # substeps in a row that began near a singular pose, see `closedloop.loop.step.singular`


class Constants(Block, sizes=("n", "law", "compensation", "friction", "joint_friction", "compliance")):
    """What does not change during a run of n joints."""

    h: float  # step, s
    node: float  # time between two rows of the reference's table, s
    offset: float  # d of a plane at rest, m
    s_v: float
    s_p: float
    restitution: float
    rest_speed: float
    stop_restitution: float  # of joints at their stops
    impact_friction: float
    stick_speed: float
    capture_speed: float  # up to which sticking is tried, m/s
    lag: float  # by which friction is behind the slip, s
    reach: float  # of the arm, squared
    believed_masses: float  # see `closedloop.loop.step.belief`, as the next
    unknown_payload: float  # kg
    tip: Annotated[Array, 3]  # in the frame of the joint that carries it
    gravity: Annotated[Array, 3]
    sensor: Annotated[Array, SensorParameters.count(0)]
    support: Annotated[Array, N]
    lower_stop: Annotated[Array, N]
    upper_stop: Annotated[Array, N]
    armature: Annotated[Array, N]
    turns: Annotated[Array, N]  # 1 for the first of a ball joint's three, see `closedloop.loop.step.turn`
    tilt: Annotated[Array, 3, 3]  # of the contact frame that the controller believes in, in the true one
    stiffness: Annotated[Array, N]  # see `closedloop.control.transmission`, as the next two
    shaft_damping: Annotated[Array, N]
    motor_inertia: Annotated[Array, N]
    driven: Annotated[Array, N]  # 0 for a joint without a drive
    torque_limit: Annotated[Array, N]  # see `closedloop.control.drives`, as the next; infinite: none
    torque_change: Annotated[Array, N]  # from sample to sample
    joint_capture_speed: Annotated[Array, N]
    joint_lag: Annotated[Array, N]
    encoder: Annotated[Array, EncoderParameters.count(N)]
    law: Annotated[Array, Count.of("law")]  # parameters, see `closedloop.jit.parameters`
    compensation: Annotated[Array, Count.of("compensation")]
    friction: Annotated[Array, Count.of("friction")]
    joint_friction: Annotated[Array, N, Count.of("joint_friction")]
    compliance: Annotated[Array, Count.of("compliance")]


class Reference(Block, sizes=("n",)):
    """What is desired of n joints at an instant: a row of `closedloop.control.reference.desired.Desired.table`."""

    q: Annotated[Array, N]  # rad (m)
    v: Annotated[Array, N]  # rad/s (m/s)
    position: Annotated[Array, 3]  # of the tip, m, base axes, as the next two; see `in_contact_frame`
    velocity: Annotated[Array, 3]  # m/s
    acceleration: Annotated[Array, 3]  # m/s²
    force: float  # N


# Single numbers and parts of a fixed size come first, then those of the joints: what a step touches is then at short
# distances.
class Work(Block, sizes=("n", "k", "stages", "ring")):
    """The state that the loop works on; n joints, k states beside q and q̇."""

    time: float  # of the state whose terms are requested
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
    inside: float  # distance of the tip from the edge of a surface that the loop asks, m, negative beyond it
    rigid_force: float  # of the closure without its stabiliser, by which contact is judged
    start_event_value: float  # at the beginning of the substep, as all that follow
    start_rate: float
    start_gap: float
    start_slip_speed: float
    stop_margin: float  # negative once a joint is beyond its stop, rad (m), or is pulled by it, N m (N)
    last_event: float  # its instant
    measured: float  # reading of the force sensor, of the latest row
    reading: float  # and at this instant
    delayed_slip: float  # speed of slip that friction with memory answers to
    stick_limit: float  # μ_s, beyond which sticking ends
    friction_span: float  # by which friction's states are to be advanced, s
    discarded_rebound: float  # of a restitution too slow to leave the surface, m/s
    straight_speed: float  # up to this speed of slip, m/s, friction acts against `direction`, not against the slip
    restitution_given: float
    energy_rested: float  # of an impact, what it took so that what parts too slowly rests, J
    supplied: float  # see `closedloop.loop.step.energy_supplied`, as all that follow
    substep_work: float
    start_power: float
    start_power_rate: float
    contact_margin: (
        float  # of the links' contacts in the event function, see `closedloop.loop.step.contacts`, as the next
    )
    start_contact_margin: float
    contact_power: float  # of their forces, the tip's apart, W, and its rate with these forces, W/s
    contact_power_rate: float
    r: Annotated[Array, 3]  # base axes
    drift: Annotated[Array, 3]  # base axes
    frame: Annotated[Array, 3, 3]  # contact frame: rows n, t1, t2, base axes
    p: Annotated[Array, 3]  # contact frame, as all that follow
    u: Annotated[Array, 3]
    drift_c: Annotated[Array, 3]  # u̇ = A q̈ + drift_c
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
    carried: Annotated[Array, 3]  # u = N ṙ − carried and u̇ = N r̈ + turning; zero on a plane at rest
    turning: Annotated[Array, 3]
    anchor: Annotated[Array, 3]  # where the tip stuck, see `closedloop.loop.step.locate`
    slip: Annotated[Array, 2]  # velocity of slip that friction is asked about
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
    contact_torque: Annotated[Array, N]  # of the forces of the links' contacts, the tip's apart
    stuck: Annotated[Array, N]  # 1 for a joint that sticks as a spring
    stopped: Annotated[Array, N]  # 1 for a joint at its upper stop, −1 at its lower, else 0
    stop_torque: Annotated[Array, N]  # what the stops give, N m (N)
    joint_slip: Annotated[Array, N]  # velocity, delayed speed and direction that a joint's friction is asked about
    joint_lagged: Annotated[Array, N]
    joint_direction: Annotated[Array, N]
    joint_dry: Annotated[Array, N]  # friction −c − w of each joint
    joint_viscous: Annotated[Array, N]
    joint_limit: Annotated[Array, N]  # torque beyond which sticking ends
    J: Annotated[Array, 3, N]  # base axes
    A: Annotated[Array, 3, N]  # contact frame
    X: Annotated[Array, 3, N]  # L⁻¹Aᵀ
    reference: Annotated[Array, 2 * N + 10]  # row of the table at this instant
    qdd_des: Annotated[Array, N]  # see `closedloop.loop.step.reference_row.desired_acceleration`
    H: Annotated[Array, N, N]  # for laws that are called by address, as C
    C: Annotated[Array, N]
    L: Annotated[Array, N, N]
    gain: Annotated[Array, N, N]  # answer of q̈ to friction in each joint
    batch: Annotated[Array, batch_rows(N), BATCH]  # see `closedloop.mechanics.closure.conditioning`
    scratch: Annotated[Array, N * N + 3 * N + 224]
    z: Annotated[Array, K]  # states: of the law, the sensor, the surface's friction, the joints', the motors
    dz: Annotated[Array, K]
    begin: Annotated[Array, 2 * N + K]  # state at the beginning of the substep
    slope: Annotated[Array, N + K]  # q̈ and ż there
    stages: Annotated[Array, STAGES, 2 * N + K]  # see `closedloop.loop.step.advance.advance`
    ring: Annotated[Array, RING]  # latest samples of the force sensor
    sampled_at: float  # instant of the latest sample of the law, s
    torque_before: Annotated[Array, N]  # Q of the sample before it
    seen: Annotated[Array, Seen.count(N)]
    true_q: Annotated[Array, N]  # while q and q̇ are what the encoders read
    true_v: Annotated[Array, N]
    read_q: Annotated[Array, N]  # latest readings, and those of the latest row
    read_v: Annotated[Array, N]
    last_read_q: Annotated[Array, N]
    last_read_v: Annotated[Array, N]
    transmitted: Annotated[Array, N]  # torque on the links of elastic joints
    torque_limited: Annotated[Array, N]  # see `closedloop.control.drives.AS_ASKED`
    approach: Annotated[Array, N + 6]  # see `closedloop.loop.step.singular.Approach`


STATE_COUNT = State.count()


@kernel_inlined
def loop_at(address: int) -> tuple[State, Constants, Work]:
    """Return the loop's memory, by the address of its `State`."""
    state = State(integers_at(address, STATE_COUNT))
    n = state.n
    constants = Constants(
        vector_at(state.constants_at, state.constants_size), n, state.law_size, state.compensation_size,
        state.friction_size, state.joint_friction_size, state.compliance_size,
    )  # fmt: skip
    w = Work(vector_at(state.work_at, state.work_size), n, state.extra, state.stages, state.sensor_ring)
    return state, constants, w
