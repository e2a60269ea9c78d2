"""The memory of the contacts: what they are, and their rows, forces and modes at the state asked about last.

Contact 0 is the tip with the scenario's surface; then come those of the sections [[contact]], in their order; then, of
each joint with stops, the nearer of its two, and of each such tendon; then each joint and each tendon, if dry friction
may hold them: a contact with its largest torque as normal force, there only while modes are sought. Before the joints
come the resistances to rolling and to pivoting (`closedloop.mechanics.contacts.resistance`), contacts with the normal
force of another. Every contact has three rows, along its normal and two tangents, so k contacts have 3 k; those of a
stop are ± q̇ of its joint, or ± L̇ of its tendon, and two of zeros, in rad (m) and N m (N).
"""

from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import address_of, integers_at, vector_at
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.mechanics.contacts.joint_space import JointSpace
from closedloop.mechanics.limits import HOVERING, SLIGHT
from closedloop.mechanics.loops.memory import LoopMemory

N, K, PAST = Count.of("n"), Count.of("k"), Count.of("past")

# Kinds of a contact in a problem: without force; that slides in a known direction, F = f (1, −μ d) with f >= 0; inside
# Coulomb's cone; and of those that also pull one with F = f (1, −c), and one with |F_t| <= μ|f|.
OFF, RAY, CONE, LINE, DOUBLE = range(5)
# Friction below this share of its limit is inside the cone.
INSIDE = 1.0 - SLIGHT
# How a law of friction sticks: not, there being none; with u = 0 as a constraint; and see `FrictionLaw.sticks`.
SMOOTH, RIGID_STICK, ELASTIC_STICK, SPRING_STICK = range(4)


class ContactLinks(Block):
    """Whole numbers, int64: where the memory is, its own address first."""

    address: int
    numbers: int  # address of the `Contacts`
    total: int  # of its numbers
    n: int  # joints
    k: int  # contacts, the tip's and the stops of joints among them
    points: int  # how many of them, the first, are points that touch surfaces
    stops: int  # how many, after these
    joints: int  # number of the first that stands for the friction of a joint, while modes are sought alone
    surfaces: int  # address of the entry and the memory of the surface of each, 0 of a plane at rest; 0: all are such
    compliances: int  # address of the same of the compliance of each, 0 of a rigid one; 0: all are rigid
    shapes: int  # address of the memory of their shapes, see `closedloop.mechanics.contacts.rolling`; 0: all are points
    frictions: int  # and of the law of friction of each, 0 of Coulomb's μ; 0: all have that
    past: int  # speeds of slip that are kept of each, see `closedloop.mechanics.contacts.friction.delayed_speed`
    moved: int  # 1 if a projection found something to move
    raised: int  # 1 once a user's member has raised something
    rows: int  # address of the memory of their rows, see `closedloop.mechanics.loops.memory`
    loop: int  # and of the loop that they are for; 0: none
    undecided: int  # 1 until the modes after an event, or at the start, are found
    fresh: int  # 1 at the start
    chattering: (
        int  # 1 after many events in a row: there is no restitution, and no contact sticks at its limit; 2 after
    )
    # too many: their modes are not sought
    stepped: int  # 1 while the forces are those of a time step, see `closedloop.mechanics.contacts.time_step`
    record_at: int  # where in a row of the record there is a `ContactRow`


class Problem(Block, sizes=("n", "k")):
    """The problem that is solved: u⁺ = q + W F with each contact's form."""

    form: Annotated[Array, K]  # OFF, RAY, CONE, LINE or DOUBLE
    along: Annotated[Array, K, 2]  # F_t = −along f − viscous of a RAY or a LINE
    known: Annotated[Array, K]  # normal force, N: of a soft surface, or the limit of what stands for dry friction
    pushed: Annotated[Array, N]  # L⁻¹(Q − C), and what soft contacts press with
    q: Annotated[Array, 3 * K]
    after: Annotated[Array, 3 * K]  # u⁺
    rounding: float  # force below which there is none, N
    beyond: float  # how far the nearest forces inside the cones are from those that the modes need, N
    borne: float  # as far as that goes before the modes are sought again, N: twice what it was when they were found
    sought: float  # 1 until forces are solved in the modes that were sought
    points: float  # 1 if only points touch
    ends: float  # 1 if a slow slip ends within the step, see `closedloop.mechanics.contacts.turning`
    # the largest share by which forces that an iteration ended with were off, since the row before
    off: float


class Moves(Block, sizes=("k",)):
    """The joints that each contact moves: elsewhere its rows G and X are zero."""

    first: Annotated[Array, K]  # of whole groups, see `closedloop.mechanics.robot.tree.group_ends`
    end: Annotated[Array, K]  # one more than the last
    upto: Annotated[Array, K]  # of two groups, where the first ends, and the second begins; of one its end, and first
    again: Annotated[Array, K]
    dry: Annotated[Array, K]  # 1 if one of its groups has joints with dry friction


class Gaps(Block, sizes=("k",)):
    """From which gap on contacts are open."""

    cleared: Annotated[Array, K]  # 1 if it has been clear of the surface since it lifted off
    floor: Annotated[Array, K]  # the gap at which it parted, m, if that was negative
    extent: Annotated[Array, K]  # of its surface, or its edges, from the origin of the frame that carries them, m
    unloaded: Annotated[Array, K]  # the gap at which a soft one has no force, m, negative where it began inside


class ContactEvent(Block, sizes=("k",)):
    """What happens to the contacts in an event."""

    axes: Annotated[Array, 3 * K, 3]  # n, t1 and t2 in base axes
    point: Annotated[Array, K, 3]  # and where it is, m
    happened: Annotated[Array, K]  # to each, a kind of `closedloop.loop.events.table`; 0: nothing
    struck: Annotated[Array, K]  # 1 if it was an impact
    pulled: Annotated[Array, K]  # 1 if its mode would have had it pull
    outside: Annotated[Array, K]  # 1 if it would have had to hold with more than friction can
    turned: Annotated[Array, K]  # 1 if its slip has turned round
    energy_lost: float  # J
    energy_rested: float  # what of it was taken so that contacts that part slowly rest
    restitution_share: float  # by which the restitution of an impact was lessened, so that it creates no energy


class TimeStep(Block, sizes=("n", "k")):
    """A time step of its own, see `closedloop.mechanics.contacts.time_step`, and what comes before one."""

    end: float  # s
    begun: float  # 1 if the substep began within it
    span: float  # the longest that the next substep may be, and after which friction points along slow slips, s
    within: float  # the same of the substep under way
    force: Annotated[Array, 3 * K]  # N
    reach: float  # m, within which contacts are near
    gained: float  # most that smooth forces add, in the last step in which a contact took part, m/s; inf at first
    struck: float  # when the last tangential impact was, s
    in_vain: float  # 1 if there were no modes after it; 0 again likewise
    at_once: float  # 1 while its impulses have just been written
    follows: float  # 1 if the last step was one of these: no modes are found; 2 if its contacts were compliant
    # of an integrator that steps in time: 1 if the step under way puts something back, and then by what it moves q
    shifts: float
    shift: Annotated[Array, N]  # rad (m), of ball joints in axes of their links


class GivenModes(Block, sizes=("n", "k")):
    """What `closedloop.mechanics.contacts.given_modes` uses. Of two rows the second is with the stabiliser's part."""

    row: Annotated[Array, 3 * K]  # of each unknown
    weight: Annotated[Array, 3 * K]  # D⁻¹
    plain: Annotated[Array, 3 * K]  # 1 if its column is its row
    first: Annotated[Array, 3 * K]  # of the columns of its R and C that are not zero
    end: Annotated[Array, 3 * K]
    R: Annotated[Array, 3 * K, N]
    C: Annotated[Array, 3 * K, N]
    basis: Annotated[Array, 3 * K, N]  # of the rows of R, where they are fewer than n
    rank: float  # how many that has, or n
    slides: float  # 1 if C is not R
    whole: float  # 1 if R is of full rank: there is no basis
    factor: Annotated[Array, N, N]  # L of RᵀR
    other: Annotated[Array, N, N]  # and of CᵀD⁻¹C
    begins: Annotated[Array, N]  # the first column of each row of L that is not zero
    until: Annotated[Array, N]  # the end of the rows of each column that are not
    left: Annotated[Array, 2, 3 * K]
    x: Annotated[Array, 2, 3 * K]
    moved: Annotated[Array, 2, N]  # y
    z: Annotated[Array, 2, N]
    change: Annotated[Array, 2, N]
    along: Annotated[Array, N]


class ContactScratch(Block, sizes=("n", "k")):
    """What one kernel uses, and nothing outlives."""

    start: Annotated[Array, 3 * K]
    system: Annotated[Array, N, N]
    columns: Annotated[Array, N, 3 * K]
    moved: Annotated[Array, N, 3 * K]
    solution: Annotated[Array, N]
    unknown: Annotated[Array, 3 * K]
    multiples: Annotated[Array, 3 * K]
    mu: Annotated[Array, K]
    turned: Annotated[Array, K]  # 1 of a contact whose friction is turned
    residuals: Annotated[Array, 3 * K]
    trial: Annotated[Array, 3 * K]
    best: Annotated[Array, 3 * K]
    motion: Annotated[Array, N]  # see `closedloop.mechanics.contacts.mobility`
    sum: Annotated[Array, N]
    sought: Annotated[Array, 3 * K]


class Resistance(Block, sizes=("k",)):
    """Resistance to rolling and to pivoting, contacts of their own; see `closedloop.mechanics.contacts.resistance`."""

    owner: Annotated[Array, K]  # the contact whose normal force such a contact has; −1 of every other contact
    arm: Annotated[Array, K]  # largest moment of one, divided by that force, m
    rolling: Annotated[Array, K]  # of each contact the one that is its resistance to rolling, or −1
    pivoting: Annotated[Array, K]  # and to pivoting


class ContactFriction(Block, sizes=("k", "past")):
    """What the law of friction of each contact is, and its state; of Coulomb's μ too."""

    limit: Annotated[Array, K]  # up to which it sticks: μ_s, zero of a law without a mode of sticking
    kinetic: Annotated[Array, K]  # μ of an impact
    sticks: Annotated[Array, K]  # how, see SMOOTH
    capture: Annotated[Array, K]  # speed of slip up to which sticking is tried, m/s
    lag: Annotated[Array, K]  # by which friction is behind the slip, s
    shared: Annotated[Array, K]  # largest |F_t|/f of a soft contact beside others, else 0; see `write_shared`
    rises: float  # 1 if friction that is shared rises with the slip, see `let_friction_rise`
    held: Annotated[Array, K]  # 1 if its spring holds it, in the present problem
    bound: Annotated[Array, K]  # 1 of a slip of none that what sticks leaves no motion: its friction is not turned
    states: Annotated[Array, K]  # how many its law of friction has
    states_at: Annotated[Array, K]  # and where in `Work.z` they are
    pulls: Annotated[Array, K]  # 1 of a contact that cannot part
    sense: Annotated[Array, K]  # sign of f that is tried of a DOUBLE whose force is not unique
    start_slip: Annotated[Array, K]  # speed of slip at the beginning of the substep, m/s
    against: Annotated[Array, K]  # 1 if friction is against the slip all the substep, not turned
    next_against: Annotated[Array, K]  # and in the next
    start_u: Annotated[Array, K, 2]  # and its velocity
    delayed: Annotated[Array, K]  # speed of slip that friction with memory answers to, m/s
    speeds: Annotated[Array, K, PAST]  # of slip at the latest rows, m/s
    resistance: Resistance


class Contacts(Block, sizes=("n", "k", "past")):
    """What k contacts are, and what they are at a state of n joints; rows n, t1, t2 of each contact."""

    mu: Annotated[Array, K]  # of the cone in the present problem: `friction.limit`, or in an impact `friction.kinetic`
    rest_speed: Annotated[Array, K]  # below which it does not rebound, m/s, or of a stop rad/s (m/s)
    inside: Annotated[Array, K]  # distance from the edge of its surface, m, negative beyond it
    past_edge: Annotated[Array, K]  # 1 while it is not above its surface because it has gone beyond the edge
    restitution: Annotated[Array, K]
    soft: Annotated[Array, K]  # 1 of a surface that gives way, see `closedloop.mechanics.contacts.soft`
    joint: Annotated[Array, K]  # of a stop, as the next; of a tendon see `closedloop.loop.step.tendons`
    side: Annotated[Array, K]  # 1 of a lower stop, −1 of an upper
    mode: Annotated[Array, K]  # see `closedloop.mechanics.closure.contact_force`
    near: Annotated[Array, K]  # 1 while its rows X and W are written: while it is closed, or about to be
    moves: Moves
    gaps: Gaps
    direction: Annotated[Array, K, 2]  # of its slip at the beginning of the substep
    anchor: Annotated[Array, 3 * K]  # where it stuck
    located: Annotated[Array, 3 * K]  # gap and place along the surface, m
    u: Annotated[Array, 3 * K]  # velocity, m/s
    drift: Annotated[Array, 3 * K]  # u̇ = G q̈ + drift
    carried: Annotated[Array, 3 * K]  # u = G q̇ − carried, of a surface that moves by itself
    turning: Annotated[Array, 3 * K]  # and what its motion and its curvature add to the drift
    at: Annotated[Array, 3 * K]  # where the point is on its surface, m
    a: Annotated[Array, 3 * K]  # acceleration without contacts, m/s²
    size: Annotated[Array, 3 * K]  # of the terms that it is made of, m/s²; zero of a contact that is not near
    b: Annotated[Array, 3 * K]  # what the stabiliser asks for, m/s²
    S: Annotated[Array, K, 3, 3]  # mobility of each by itself, 1/kg
    F: Annotated[Array, 3 * K]  # force, N, or impulse, N s
    rigid: Annotated[Array, 3 * K]  # the force without the stabiliser's part, N
    load: Annotated[Array, N]  # L⁻¹(Q − C), of the tree
    viscous: Annotated[Array, 3 * K]  # the part of the friction that does not depend on f, N
    before: Annotated[Array, 3 * K]
    torque: Annotated[Array, N]  # Gᵀ F without the tip's part, N m (N)
    margin: float  # of the event function
    friction: ContactFriction
    problem: Problem
    event: ContactEvent
    step: TimeStep
    # From here on all is written anew wherever it is read, see `ContactMemory.lasting`.
    G: Annotated[Array, 3 * K, N]
    X: Annotated[Array, 3 * K, N]  # L⁻¹ Gᵀ, less what loops bind
    stepping: JointSpace
    given: GivenModes
    scratch: ContactScratch


CONTACT_LINKS = ContactLinks.count()


@kernel
def contacts_at(address: int) -> tuple[ContactLinks, Contacts]:
    """Return the memory of the contacts, by the address of its `ContactLinks`."""
    links = ContactLinks(integers_at(address, CONTACT_LINKS))
    return links, Contacts(vector_at(links.numbers, links.total), links.n, links.k, links.past)


@kernel_inlined
def joints_of(c: Contacts, i: int) -> tuple[int, int]:
    """Return the first of the joints that contact i moves, and one more than the last; see `Moves`."""
    return int(c.moves.first[i]), int(c.moves.end[i])


@kernel
def joints_rub(links: ContactLinks) -> bool:
    """Whether joints have dry friction: what stands for it comes after the contacts."""
    return bool(links.joints < links.k)


class ContactMemory(NamedTuple):
    """The memory of the contacts, made in Python: kept as long as its address is used."""

    links: ContactLinks
    contacts: Contacts

    @property
    def address(self) -> int:
        """Return what `contacts_at` takes."""
        return int(self.links.address)

    @property
    def lasting(self) -> tuple[NDArray[Any], ...]:
        """Return the memory that outlives an evaluation: a fiftieth of all, of twenty boxes."""
        first = Contacts.place("G", *self.contacts.sizes)
        assert isinstance(first, slice)
        return self.links.memory, self.contacts.memory[: first.start]


def make_contact_memory(
    n: int,
    k: int,
    rows: LoopMemory | None = None,
    stops: int = 0,
    joints: int = 0,
    past: int = 0,
    resistances: tuple[tuple[int, float, bool], ...] = (),
) -> ContactMemory:
    """Return the memory of k contacts of a tree of n joints: points, `rows` of all but the first, stops, and joints.

    Of each the speeds of slip at `past` rows are kept. `resistances` has the contact, the arm, m, and whether it is to
    pivoting, of those that stand before the joints.
    """
    links = ContactLinks(np.zeros(CONTACT_LINKS, dtype=np.int64))
    contacts = Contacts(np.zeros(Contacts.count(n, k, past)), n, k, past)
    links.address, links.numbers, links.total = (
        address_of(links.memory),
        address_of(contacts.memory),
        contacts.memory.size,
    )
    links.n, links.k, links.stops, links.joints, links.past = n, k, stops, k - joints, past
    links.points = links.joints - stops - len(resistances)
    turns = contacts.friction.resistance
    turns.owner[:], turns.rolling[:], turns.pivoting[:] = -1.0, -1.0, -1.0
    for i, (owner, arm, pivots) in enumerate(resistances, links.points + stops):
        turns.owner[i], turns.arm[i], contacts.mu[i] = owner, arm, 1.0
        (turns.pivoting if pivots else turns.rolling)[owner] = i
    contacts.past_edge[k - joints :] = 1.0
    links.rows = 0 if rows is None else rows.address
    contacts.moves.end[:], contacts.moves.upto[:], contacts.moves.dry[:] = n, n, 1.0 if joints > 0 else 0.0
    contacts.direction[:, 0], contacts.near[:], contacts.inside[:] = 1.0, 1.0, np.inf
    contacts.step.reach, contacts.step.gained, contacts.gaps.extent[:] = HOVERING, np.inf, np.inf
    links.keep_alive(rows=rows)
    return ContactMemory(links, contacts)
