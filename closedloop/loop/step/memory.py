"""The memory of the loop: settings, state, and the records that a part of a step works on.

Each is a `Block`, one array whose parts have names: passing an array from Python to compiled code costs about 60 ns,
so all memory of the loop is passed as three.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.control.law import Perceived
from closedloop.control.reference.desired import Reference
from closedloop.control.sensor import EncoderParameters, SensorParameters
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import address_of, call_at, integers_at, vector_at
from closedloop.jit.kernel import kernel_inlined
from closedloop.mechanics.closure.conditioning import BATCH, batch_rows
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.memory import ELASTIC_STICK as ELASTIC_STICK
from closedloop.mechanics.contacts.memory import RIGID_STICK as RIGID_STICK
from closedloop.mechanics.contacts.memory import SMOOTH as SMOOTH
from closedloop.mechanics.contacts.memory import SPRING_STICK as SPRING_STICK
from robot_models.tendon import ROUGH

# Sizes: joints, numbers of state beside q and q̇, stages of the integrator, samples that the sensor keeps, tendons.
N, K, STAGES, RING, TENDONS = (Count.of(size) for size in ("n", "k", "stages", "ring", "tendons"))


class Search(Block):
    """The search for an event within a substep."""

    tau: float  # length of a trial substep, s
    low: float  # bracket of the event searched for, s, with the event function at either end
    high: float
    at_low: float
    at_stage: float  # of dual numbers: the least event function at the stages of a step to the instant found
    at_high: float
    least: float  # margin of the contacts at the stages of the trial substep, and of that to the high end
    least_to_high: float
    replaced: float  # the end that the latest trial has replaced, and the value there
    at_replaced: float
    value: float  # of the event function


class Supply(Block):
    """The energy supplied, see `closedloop.loop.step.energy_supplied`."""

    energy: float  # J
    work: float  # of the substep, J
    power: float  # at its beginning, W, and the rate
    power_rate: float
    moved_power: float  # of frames that move the mechanism, and their rate, see `closedloop.mechanics.loops.moved`
    moved_rate: float


class Impact(Block):
    """The impact of the tip, contact frame."""

    before: Annotated[Array, 3]  # velocity of the tip, m/s
    compression: Annotated[Array, 3]  # impulse, N s
    decompression: Annotated[Array, 3]
    after: Annotated[Array, 3]
    discarded_rebound: float  # of a restitution too slow to leave the surface, m/s
    restitution_given: float
    energy_rested: float  # what it took so that what parts too slowly rests, J


class TipFriction(Block):
    """Friction at the tip: what it is asked, and its answer F_t = −c f − viscous."""

    c: Annotated[Array, 2]
    viscous: Annotated[Array, 2]
    slip: Annotated[Array, 2]  # velocity of slip that friction is asked about
    direction: Annotated[Array, 2]  # of slip at the beginning of the substep
    delayed_slip: float  # speed of slip that friction with memory answers to
    stick_limit: float  # μ_s, beyond which sticking ends
    straight_speed: float  # up to this speed of slip, m/s, friction acts against `direction`, not against the slip
    span: float  # by which friction's states are to be advanced, s; the joints' too


class TipContact(Block, sizes=("n",)):
    """The contact of the tip with the surface, and Eq. 24's numbers; contact frame but for the first."""

    frame: Annotated[Array, 3, 3]  # contact frame: rows n, t1, t2, base axes
    gap: float  # m
    rate: float  # of the gap, m/s
    inside: float  # distance of the tip from the edge of a surface that the loop asks, m, negative beyond it
    rigid_force: float  # of the closure without its stabiliser, by which contact is judged, N
    p: Annotated[Array, 3]
    u: Annotated[Array, 3]
    drift_c: Annotated[Array, 3]  # u̇ = A q̈ + drift_c
    a: Annotated[Array, 3]  # acceleration without contact
    F: Annotated[Array, 3]
    b: Annotated[Array, 3]  # right-hand sides of Eq. 24
    stabiliser_force: Annotated[Array, 3]  # the stabiliser's part of F
    S: Annotated[Array, 3, 3]
    carried: Annotated[Array, 3]  # u = N ṙ − carried and u̇ = N r̈ + turning; zero on a plane at rest
    turning: Annotated[Array, 3]
    anchor: Annotated[Array, 3]  # where the tip stuck, see `closedloop.loop.step.locate`
    A: Annotated[Array, 3, N]
    X: Annotated[Array, 3, N]  # L⁻¹Aᵀ


class LinkContacts(Block, sizes=("n",)):
    """What the contacts of the links do together, see `closedloop.loop.step.contacts`."""

    margin: float  # in the event function
    power: float  # of their forces, the tip's apart, W, and its rate with these forces, W/s
    power_rate: float
    torque: Annotated[Array, N]  # of the same forces, N m (N)


class JointFriction(Block, sizes=("n", "tendons")):
    """Friction in the joints: what it is asked of each, and its answer −dry − viscous, N m (N).

    What dry friction holds are the joints, then the tendons that rub.
    """

    torque: Annotated[Array, N]  # on the joints
    stuck: Annotated[Array, N]  # 1 for a joint that sticks as a spring
    slip: Annotated[Array, N]  # velocity, delayed speed and direction that friction is asked about
    lagged: Annotated[Array, N]
    direction: Annotated[Array, N]
    dry: Annotated[Array, N]
    viscous: Annotated[Array, N]
    limit: Annotated[Array, N + TENDONS]  # torque beyond which sticking ends
    gain: Annotated[Array, N + TENDONS, N]  # answer of q̈ to friction in each
    mobility: Annotated[Array, N + TENDONS]  # and of its own acceleration; 0 of what does not move
    held: Annotated[Array, N + TENDONS]  # dry friction that is being sought


class Sensing(Block, sizes=("ring",)):
    """The force sensor."""

    measured: float  # its reading of the latest row, N
    reading: float  # and at this instant
    tangential: Annotated[Array, 2]  # readings of the latest row along the tangents, N
    signal: Annotated[Array, 3]  # what was sampled at the latest row, see `closedloop.control.sensor.signal_of`
    outside: Annotated[Array, 3]  # forces from outside on the tip, N, base axes
    ring: Annotated[Array, 3, RING]  # latest samples along n, t1, t2


class Encoders(Block, sizes=("n",)):
    """What the encoders read, rad (m) and rad/s (m/s)."""

    true_q: Annotated[Array, N]  # while q and q̇ are what the encoders read
    true_v: Annotated[Array, N]
    q: Annotated[Array, N]  # latest readings, and those of the latest row
    v: Annotated[Array, N]
    last_q: Annotated[Array, N]
    last_v: Annotated[Array, N]


class Drives(Block, sizes=("n",)):
    """The drives, and the shafts between them and the links."""

    sampled_at: float  # instant of the latest sample of the law, s
    held: Annotated[Array, N]  # the Q that acted until the last sample
    before: Annotated[Array, N]  # Q of the sample before it
    transmitted: Annotated[Array, N]  # torque on the links of elastic joints
    limited: Annotated[Array, N]  # see `closedloop.control.drives.AS_ASKED`


class Start(Block, sizes=("n", "k")):
    """The beginning of the substep under way."""

    time: float  # s
    value: float  # of the event function
    rate: float  # of the gap, m/s
    gap: float
    slip_speed: float
    force_over_load: float  # of the contacts of links, see `closedloop.loop.step.contacts.force_over_load`
    contact_margin: float  # see `LinkContacts.margin`
    slip: Annotated[Array, 2]  # velocity
    state: Annotated[Array, 2 * N + K]  # q, q̇ and z
    slope: Annotated[Array, N + K]  # q̈ and ż


class Decays(Block, sizes=("k", "stages")):
    """States that decay by themselves, ż = g − a z, see `closedloop.loop.step.advance`."""

    rate: Annotated[Array, K]  # a, 1/s
    begin: Annotated[Array, K]  # and at the beginning of the substep
    rates: Annotated[Array, STAGES, K]  # a and g at each stage so far
    driven: Annotated[Array, STAGES, K]
    first: Annotated[Array, STAGES + 1, STAGES]  # see `closedloop.mechanics.integrators.Scheme.first`


class Scratch(Block, sizes=("n",)):
    """What one kernel uses, and nothing outlives."""

    column: Annotated[Array, N]
    acceleration: Annotated[Array, 3]  # of the tip without contact, and the force, of one answer of many
    force: Annotated[Array, 3]
    target: Annotated[Array, 3]  # a right-hand side of Eq. 24, and a force that is of no use
    unused: Annotated[Array, 3]
    none: Annotated[Array, 2]  # friction −c f of a contact without
    numbers: Annotated[Array, N * N + 3 * N + 224]


class Member(Block):
    """A member of a family that the loop calls."""

    entry: int  # its address, see `closedloop.loop.step.entries`; 0: there is none
    size: int  # of its parameters; of friction in joints, those of one
    states: int  # how many it has; of friction in joints, each
    sticking: int  # of a law of friction: how it sticks


class Called(Block):
    """What the loop calls with a memory of its own."""

    entry: int  # its address; 0: there is none
    at: int  # address of its memory


class TouchedSurface(Called):
    """The surface, and the one that the controller believes in; without an entry of that it is the same."""

    believed: Called
    noise: int  # address of the noise of the normal that the controller believes in, (rows, 2), rad; 0: none


class Loops(Called):
    """The loops of a mechanism."""

    perceived_at: int  # address of the memory of the loops as the law sees them, 0: it sees the state itself
    frames: int  # that move the mechanism as they are told


class Sensor(Block):
    """The force sensor."""

    axes: int
    states: int
    ring: int  # samples kept
    sampled: int


class Addresses(Block):
    """Where the rest of the memory is, and its sizes."""

    constants: int
    constants_size: int
    work: int
    work_size: int
    extra: int  # numbers of state beside q and q̇
    group_ends: int  # of where the blocks of H end, see `closedloop.mechanics.robot.tree.group_ends`


class Settings(Block):
    """Settings of the run."""

    stages: int  # of the integrator
    steps: int
    adaptive: int  # 1 for an integrator that chooses its steps: friction need not be corrected for slip turning in one
    general: int  # 0 if the law is the paper's on a smooth surface, which is part of the loop; 1: `State.law` is called
    hold: int  # steps for which a sampled torque is held; 0: the law is evaluated at every stage
    project: int
    unilateral: int
    impact_law: int
    semi_implicit: int
    time_stepping: int  # 1 if each step is one problem of impulses, see `closedloop.mechanics.contacts.stepping`
    nodes_per_step: int  # rows of the reference's table to a step
    model_error: int  # 1 if the controller is wrong about the arm
    encoder: int  # see `closedloop.control.sensor.encoder_kind`
    perceived: int  # 1 if the law sees `Work.perceived`, not the state itself
    misjudged: int  # 1 if the contact frame that it sees is not the true one
    elastic: int  # 1 if the joints are; 2 if the motors are measured
    drives: int  # 1 if the drives have limits
    arm_at: int  # where in a row there is a `closedloop.loop.step.record_row.ArmRow`; 0: nowhere
    states_at: int  # where in a row the states of law and compensation are; 0: nowhere
    balls: int  # ball joints
    undriven: int  # directions of torque that no drive gives, see `robot_models.model.RobotModel.undriven`
    feed_forward: int  # whether the law is told of the joints' desired acceleration


class Trial(Block):
    """The search for an event within a substep; constants in `closedloop.loop.events.locate`."""

    purpose: int  # what the trial step is for
    steps: int  # of this search
    off: int  # 1 if an event at the end of this step happens there, not before
    watched: int  # 1 if the event that is searched for may be that an open contact of a link closes
    settling: int  # of dual numbers (`closedloop.jit.dual8`): 1 while the slope at the instant found is sought, then 2


class Projecting(Block):
    """The projection of a state onto the closure."""

    next_phase: int  # after it
    moves: int  # Newton steps so far


class EventCount(Block):
    """The events."""

    rows: int  # written of the table of events
    in_step: int  # less what rows took off, see `closedloop.loop.events.locate.OUTPACED`
    rapid: int  # events in a row within `INSTANT` of each other
    instants: int  # of events in the step, but for those at which a step of impulses ends
    kind: int  # of the event
    stepping: int  # 1 while there are none, and each step is one problem of impulses, see `Settings.time_stepping`
    steady: int  # such steps in a row in which no contact's mode has changed
    modes: int  # of all contacts, as one number, as they were found last; 0 after an impact
    modes_before: int  # and before that


class State(Block):
    """Whole numbers, int64: the settings of the run, and the state of the loop."""

    address: int  # of this memory
    n: int  # joints
    tendons: int  # that rub or have stops
    law_states: int  # of the law and its compensation
    law: Member
    compensation: Member
    friction: Member  # the tip's
    joint_friction: Member
    compliance: Member  # of the surface; without an entry it is rigid
    surface: TouchedSurface  # without an entry it is a plane at rest
    surface_motion: Called
    loops: Loops  # of the mechanism
    contacts: Called  # of the links; without an entry there is none but the tip's
    ball: Called  # the round end of the tool, see `closedloop.loop.step.locate`; without an entry it is a point
    external: Called  # forces from outside, see `closedloop.loop.step.external`; without an entry there is none
    sensor: Sensor
    settings: Settings
    addresses: Addresses
    proceed: int  # address of the entry of `closedloop.loop.events.proceed`, for the compiled engine
    # State of the loop; constants in `closedloop.loop.events.locate`.
    phase: int  # what the terms requested last are for
    begins: int  # 1 if a substep may begin at the state that is evaluated
    query: int  # what for, in the phase QUERY, see `closedloop.loop.events.proceed`
    row: int  # the next to be recorded
    stage: int
    mode: int
    trial: Trial
    event: EventCount
    projection: Projecting
    status: int
    sampled: int  # 1 if the law is evaluated with these terms
    raised: int  # 1 once a user's member has raised something
    divided: int  # 1 in a substep that ends before the step
    after_event: int  # 1 in the remainder of a step after an event
    past_edge: int  # 1 while the tip is not above the surface because it has gone beyond its edge
    cleared: int  # 1 if the tip has been clear of the surface since it lifted off
    coupled: int  # 1 while a contact of a link is closed, or strikes: all contacts are then one problem
    striking: int  # which contact strikes alone, 0 the tip; see `closedloop.loop.events.transitions.collide`
    started: int  # 1 once the law has been evaluated
    batched: int  # rows in `Work.batch`
    approached: int  # substeps in a row that began near a singular pose, see `closedloop.loop.step.solve_contact`


class Gears(Block, sizes=("n",)):
    """What is between motors and links, see `closedloop.control.drives`."""

    stiffness: Annotated[Array, N]
    damping: Annotated[Array, N]
    motor_inertia: Annotated[Array, N]
    play: Annotated[Array, N]  # half the backlash, rad (m)
    load_friction: Annotated[Array, N]  # share of the torque passed on


class Constants(Block, sizes=("n", "law", "compensation", "friction", "joint_friction", "compliance", "tendons")):
    """What does not change during a run of n joints."""

    h: float  # step, s
    node: float  # time between two rows of the reference's table, s
    offset: float  # d of a plane at rest, m
    s_v: float
    s_p: float
    restitution: float
    rest_speed: float
    impact_friction: float
    stick_speed: float
    capture_speed: float  # up to which sticking is tried, m/s
    lag: float  # by which friction is behind the slip, s
    reach: float  # of the arm, squared
    mass_factor: float  # see `closedloop.loop.step.locate`, as the next
    unknown_payload: float  # kg
    tip: Annotated[Array, 3]  # in the frame of the joint that carries it
    gravity: Annotated[Array, 3]
    sensor: Annotated[Array, SensorParameters.count(0)]
    support: Annotated[Array, N]
    lower_stop: Annotated[Array, N]
    upper_stop: Annotated[Array, N]
    armature: Annotated[Array, N]
    turns: Annotated[Array, N]  # 1 for the first of a ball joint's three, see `closedloop.loop.step.advance`
    tilt: Annotated[Array, 3, 3]  # of the contact frame that the controller believes in, in the true one
    gears: Gears
    undriven: Annotated[Array, N, N]  # first rows: see `Settings.undriven`
    torque_limit: Annotated[Array, N]  # see `closedloop.control.drives`, as the next; infinite: none
    torque_change: Annotated[Array, N]  # from sample to sample
    joint_capture_speed: Annotated[Array, N]
    joint_lag: Annotated[Array, N]
    bearings: Annotated[Array, N]  # 0 for a coordinate of a free body: it has no bearing, so no friction of a joint
    encoder: Annotated[Array, EncoderParameters.count(N)]
    measured: Annotated[Array, N]  # 0 of what turns freely, which no encoder reads: the controller knows it as it is
    law: Annotated[Array, Count.of("law")]  # parameters, see `closedloop.jit.parameters`
    compensation: Annotated[Array, Count.of("compensation")]
    friction: Annotated[Array, Count.of("friction")]
    joint_friction: Annotated[Array, N, Count.of("joint_friction")]
    compliance: Annotated[Array, Count.of("compliance")]
    tendons: Annotated[Array, TENDONS, N + ROUGH]  # rows of `robot_models.tendon.rough_tendons`


# Records of a fixed size come first, then those with a part for each joint: what a step touches is then at short
# distances.
class Work(Block, sizes=("n", "k", "stages", "ring", "tendons")):
    """The state that the loop works on; n joints, k states beside q and q̇."""

    time: float  # of the state whose terms are requested, s
    length: float  # of the substep under way, s
    last_event: float  # its instant, s
    search: Search
    supply: Supply
    impact: Impact
    friction: TipFriction
    r: Annotated[Array, 3]  # base axes
    drift: Annotated[Array, 3]  # base axes
    tip: TipContact
    q: Annotated[Array, N]  # state
    v: Annotated[Array, N]
    torque: Annotated[Array, N]  # Q
    external: Annotated[Array, N]  # torque of forces from outside, N m (N)
    qdd: Annotated[Array, N]
    y: Annotated[Array, N]  # L⁻¹(Q − C)
    contacts: LinkContacts
    J: Annotated[Array, 3, N]  # base axes
    reference: Reference  # at this instant
    qdd_des: Annotated[Array, N]  # see `closedloop.loop.step.entries.desired_acceleration`
    H: Annotated[Array, N, N]  # for laws that are called by address, as C
    C: Annotated[Array, N]
    L: Annotated[Array, N, N]
    joint_friction: JointFriction
    batch: Annotated[Array, batch_rows(N), BATCH]  # see `closedloop.mechanics.closure.conditioning`
    scratch: Scratch
    z: Annotated[Array, K]  # states: of the law, the sensor, the surface's friction, the joints', the motors
    dz: Annotated[Array, K]
    start: Start
    stages: Annotated[Array, STAGES, 2 * N + K]  # see `closedloop.loop.step.advance.advance`
    decays: Decays
    sensing: Sensing
    drives: Drives
    encoders: Encoders
    perceived: Annotated[Array, Perceived.count(N)]
    approach: Annotated[Array, N + 6]  # see `closedloop.loop.step.solve_contact.Approach`


STATE_COUNT = State.count()


@kernel_inlined
def ask_loops(state: State, what: int) -> int:
    """Ask the loops for one of what `closedloop.loop.step.closed_loops` names; return a status, OK without any."""
    if state.loops.entry == 0:
        return OK
    return call_at(state.loops.entry, state.loops.at, what)


@kernel_inlined
def ask_contacts(state: State, what: int) -> int:
    """Ask the contacts of the links for one of what `closedloop.loop.step.contacts` names; return a status.

    Without any it is OK.
    """
    if state.contacts.entry == 0:
        return OK
    return call_at(state.contacts.entry, state.contacts.at, what)


@kernel_inlined
def takes_one_stage(state: State) -> bool:
    """Whether a step has one stage: of the scheme, or because it is one of impulses."""
    return bool(state.settings.stages == 1 or state.event.stepping != 0)


@kernel_inlined
def is_semi_implicit(state: State) -> bool:
    """Whether the position advances with the new velocity: by the scheme, or in a step of impulses."""
    return bool(state.settings.semi_implicit != 0 or state.event.stepping != 0)


@kernel_inlined
def loop_at(address: int) -> tuple[State, Constants, Work]:
    """Return the loop's memory, by the address of its `State`."""
    state = State(integers_at(address, STATE_COUNT))
    n, at = state.n, state.addresses
    constants = Constants(
        vector_at(at.constants, at.constants_size), n, state.law.size, state.compensation.size, state.friction.size,
        state.joint_friction.size, state.compliance.size, state.tendons,
    )  # fmt: skip
    w = Work(vector_at(at.work, at.work_size), n, at.extra, state.settings.stages, state.sensor.ring, state.tendons)
    return state, constants, w


class Loop(NamedTuple):
    """The loop's memory, made in Python: kept as long as its address is used."""

    state: State
    constants: Constants
    w: Work

    @property
    def address(self) -> int:
        """Return what `loop_at` takes."""
        return int(self.state.address)

    @property
    def written(self) -> list[NDArray[Any]]:
        """Return the memory that a call of the loop changes, that of loops and of contacts of links included."""
        kept = self.w.kept
        others = (block for name in ("loops", "perceived_loops", "contacts") for block in kept.get(name, ()))
        return [block.memory for block in (self.state, self.w, *others)]

    @property
    def lasting_contacts(self) -> tuple[NDArray[Any], ...]:
        """Return what of the memory of the contacts of links outlives an evaluation; none without them."""
        return self.w.kept["contacts"].lasting if "contacts" in self.w.kept else ()


def make_loop(
    n: int, *, law: int = 0, compensation: int = 0, friction: int = 0, joint_friction: int = 0, compliance: int = 0,
    tendons: int = 0, extra: int = 0, stages: int = 1, ring: int = 1, ends: NDArray[np.int64] | None = None,
    into: Loop | None = None,
) -> Loop:  # fmt: skip
    """Return a loop's memory, zero everywhere.

    `n`: joints.
    `law`, `compensation`, `friction`, `joint_friction`, `compliance`: how many numbers their parameters are; of the
        joints' friction, those of one joint.
    `tendons`: that rub or have stops.
    `extra`: numbers of state beside q and q̇.
    `stages`: of the integrator.
    `ring`: samples that the force sensor keeps.
    `ends` (n,): see `closedloop.mechanics.robot.tree.group_ends`; all joints are one group without it.
    `into`: memory that nothing uses any more: if it has these sizes, it is what is returned.
    """
    sizes, of_work = (
        (n, law, compensation, friction, joint_friction, compliance, tendons),
        (n, extra, stages, ring, tendons),
    )
    if into is not None and (into.constants.sizes, into.w.sizes) == (sizes, of_work):
        state, constants, w = into
        for block in into:
            block.memory[:] = 0
            block.kept.clear()
    else:
        state = State(np.zeros(STATE_COUNT, dtype=np.int64))
        constants = Constants(np.zeros(Constants.count(*sizes)), *sizes)
        w = Work(np.zeros(Work.count(*of_work)), *of_work)
    state.address = address_of(state.memory)
    ends = np.full(n, n, dtype=np.int64) if ends is None else ends
    state.addresses.group_ends = address_of(ends)
    state.keep_alive(ends=ends)
    state.n, state.addresses.extra, state.settings.stages, state.sensor.ring = n, extra, stages, ring
    state.law.size, state.compensation.size, state.tendons = law, compensation, tendons
    state.friction.size, state.joint_friction.size, state.compliance.size = friction, joint_friction, compliance
    state.addresses.constants, state.addresses.constants_size = address_of(constants.memory), constants.memory.size
    state.addresses.work, state.addresses.work_size = address_of(w.memory), w.memory.size
    w.contacts.margin = w.tip.inside = np.inf  # of what there may not be: it is nowhere near
    return Loop(state, constants, w)
