"""The records of `closedloop.loop.step.memory.Work`, each with its owner: what a part of a step works on."""

from __future__ import annotations

from typing import Annotated

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count

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
    replaced: float  # the end that the latest trial has replaced, and the value there
    at_replaced: float
    value: float  # of the event function


class Supply(Block):
    """The energy supplied, see `closedloop.loop.step.energy_supplied`."""

    energy: float  # J
    work: float  # of the substep, J
    power: float  # at its beginning, W, and the rate
    power_rate: float


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
    ring: Annotated[Array, RING]  # latest samples


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
    depth: float  # least gap of the closed contacts of links, m
    force_over_load: float  # of the contacts of links, see `closedloop.loop.step.contacts.force_over_load`
    contact_margin: float  # see `LinkContacts.margin`
    slip: Annotated[Array, 2]  # velocity
    state: Annotated[Array, 2 * N + K]  # q, q̇ and z
    slope: Annotated[Array, N + K]  # q̈ and ż


class Decays(Block, sizes=("k", "stages")):
    """States that decay by themselves, ż = g − a z, see `closedloop.loop.step.decay`."""

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
