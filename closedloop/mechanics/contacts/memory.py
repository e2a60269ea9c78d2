"""The memory of the contacts: what they are, and their rows, forces and modes at the state asked about last.

Contact 0 is the tip with the scenario's surface; then come those of the sections [[contact]], in their order; then, of
each joint with stops, the nearer of its two. Every contact has three rows, along its normal and two tangents, so k
contacts have 3 k; those of a stop are ± q̇ of its joint and two of zeros, in rad (m) and N m (N).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.jit.blocks import Block, Count
from closedloop.jit.kernel import kernel
from closedloop.jit.pointers import address_of, integers_at, vector_at
from closedloop.mechanics.loops.memory import LoopMemory

Array = NDArray[np.float64]

N, K = Count.of("n"), Count.of("k")

# Kinds of a contact in a problem: without force; that slides in a known direction, F = f (1, −μ d) with f >= 0; inside
# Coulomb's cone; and one that also pulls, F = f (1, −c).
OFF, RAY, CONE, LINE = range(4)


class ContactLinks(Block):
    """Whole numbers, int64: where the memory is, its own address first."""

    address: int
    numbers: int  # address of the `Contacts`
    total: int  # of its numbers
    n: int  # joints
    k: int  # contacts, the tip's and the stops of joints among them
    stops: int  # how many of them, the last, are stops
    surfaces: int  # address of the entry and the memory of the surface of each, 0 of a plane at rest; 0: all are such
    compliances: int  # address of the same of the compliance of each, 0 of a rigid one; 0: all are rigid
    rows: int  # address of the memory of their rows, see `closedloop.mechanics.loops.memory`
    loop: int  # and of the loop that they are for; 0: none
    undecided: int  # 1 until the modes after an event, or at the start, are found
    fresh: int  # 1 at the start
    tired: int  # 1 after many events in a row: there is no restitution, and no contact sticks at its limit; 2 after
    # too many: their modes are not sought
    stepped: int  # 1 while the forces are those of a time step, see `closedloop.mechanics.contacts.time_step`
    record_at: int  # where in a row of the record there is a `ContactRow`


class Contacts(Block, sizes=("n", "k")):
    """What k contacts are, and what they are at a state of n joints; rows n, t1, t2 of each contact."""

    mu: Annotated[Array, K]
    restitution: Annotated[Array, K]
    soft: Annotated[Array, K]  # 1 of a surface that gives way, see `closedloop.mechanics.contacts.soft`
    joint: Annotated[Array, K]  # of a stop, as the next
    side: Annotated[Array, K]  # 1 of a lower stop, −1 of an upper
    mode: Annotated[Array, K]  # see `closedloop.mechanics.closure.contact_force`
    kind: Annotated[Array, K]  # in the present problem
    near: Annotated[Array, K]  # 1 while its rows X and W are written: while it is closed, or about to be
    risen: Annotated[Array, K]  # 1 if it has been clear of the surface since it lifted off
    floor: Annotated[Array, K]  # the gap at which it parted, m, if that was negative
    direction: Annotated[Array, K, 2]  # of its slip at the beginning of the substep
    start_slip: Annotated[Array, K]  # and the speed there, m/s
    along: Annotated[Array, K, 2]  # F_t = −along f of a RAY or a LINE
    anchor: Annotated[Array, 3 * K]  # where it stuck
    located: Annotated[Array, 3 * K]  # gap and place along the surface, m
    u: Annotated[Array, 3 * K]  # velocity, m/s
    drift: Annotated[Array, 3 * K]  # u̇ = G q̈ + drift
    carried: Annotated[Array, 3 * K]  # u = G q̇ − carried, of a surface that moves by itself
    turning: Annotated[Array, 3 * K]  # and what its motion and its curvature add to the drift
    at: Annotated[Array, 3 * K]  # where the point is on its surface, m
    a: Annotated[Array, 3 * K]  # acceleration without contacts, m/s²
    b: Annotated[Array, 3 * K]  # what the stabiliser asks for, m/s²
    axes: Annotated[Array, 3 * K, 3]  # n, t1 and t2 in base axes, and where it is, m; in an event
    point: Annotated[Array, K, 3]
    G: Annotated[Array, 3 * K, N]
    X: Annotated[Array, 3 * K, N]  # L⁻¹ Gᵀ, less what loops bind
    W: Annotated[Array, 3 * K, 3 * K]  # X Xᵀ: the mobility, 1/kg
    F: Annotated[Array, 3 * K]  # force, N, or impulse, N s
    rigid: Annotated[Array, 3 * K]  # the force without the stabiliser's part, N
    load: Annotated[Array, N]  # L⁻¹(Q − C), of the tree
    viscous: Annotated[Array, 3 * K]  # the part of the friction that does not depend on f, N
    q: Annotated[Array, 3 * K]  # of a problem u⁺ = q + W F
    after: Annotated[Array, 3 * K]  # and its u⁺
    before: Annotated[Array, 3 * K]
    start: Annotated[Array, 3 * K]  # scratch
    torque: Annotated[Array, N]  # Gᵀ F without the tip's part, N m (N)
    happened: Annotated[Array, K]  # to each contact in an event, a kind of `closedloop.loop.events.table`; 0: nothing
    struck: Annotated[Array, K]  # 1 if it was an impact
    pulled: Annotated[Array, K]  # 1 if its mode would have had it pull
    outside: Annotated[Array, K]  # 1 if it would have had to hold with more than friction can
    turned: Annotated[Array, K]  # 1 if its slip has turned round
    energy_lost: float  # J, in an event
    energy_rested: float  # what of it was taken so that contacts that part slowly rest
    step_end: float  # of a time step, s
    step_force: Annotated[Array, 3 * K]  # and its force, N
    restitution_share: float  # by which the restitution of an impact was lessened, so that it creates no energy
    margin: float  # of the event function
    rounding: float  # force below which there is none, N
    penalty: float  # see `closedloop.mechanics.contacts.complementarity`
    residual: float  # of the last problem, N or N s
    system: Annotated[Array, 3 * K + N, 3 * K + N + 2]  # scratch, as all that follow
    column_order: Annotated[Array, 3 * K + N]
    solution: Annotated[Array, 2, 3 * K + N]
    unknown: Annotated[Array, 3 * K]
    unknowns: Annotated[Array, 3 * K, 3 * K]
    basis: Annotated[Array, 3 * K, N]
    Y: Annotated[Array, 3 * K, N]
    residuals: Annotated[Array, 3 * K]
    trial: Annotated[Array, 3 * K]
    best: Annotated[Array, 3 * K]
    multiplier: Annotated[Array, N]
    sum: Annotated[Array, N]
    sum_trial: Annotated[Array, N]
    sought: Annotated[Array, 3 * K]
    slope: Annotated[Array, 3, 3]
    vector: Annotated[Array, 3]
    path: Annotated[
        Array, 3 * K + 1
    ]  # of `closedloop.mechanics.contacts.continuation`: x, N, and log τ, as all that follow
    path_trial: Annotated[Array, 3 * K + 1]
    path_tangent: Annotated[Array, 3 * K + 1]
    path_start: Annotated[Array, 3 * K]
    path_scale: Annotated[Array, K]
    path_force: Annotated[Array, 3 * K, 3]  # ∂F/∂x and ∂F/∂τ of each contact, and −∂z/∂x and ∂z/∂τ
    path_force_rate: Annotated[Array, 3 * K]
    path_gap: Annotated[Array, 3 * K, 3]
    path_gap_rate: Annotated[Array, 3 * K]


CONTACT_LINKS = ContactLinks.count()


@kernel
def contacts_at(address: int) -> tuple[ContactLinks, Contacts]:
    """Return the memory of the contacts, by the address of its `ContactLinks`."""
    links = ContactLinks(integers_at(address, CONTACT_LINKS))
    return links, Contacts(vector_at(links.numbers, links.total), links.n, links.k)


class ContactMemory(NamedTuple):
    """The memory of the contacts, made in Python: kept as long as its address is used."""

    links: ContactLinks
    contacts: Contacts

    @property
    def address(self) -> int:
        """Return what `contacts_at` takes."""
        return int(self.links.address)


def make_contact_memory(n: int, k: int, rows: LoopMemory | None = None, stops: int = 0) -> ContactMemory:
    """Return the memory of k contacts of a tree of n joints, the last of them `stops`; `rows` of the others but 0."""
    links = ContactLinks(np.zeros(CONTACT_LINKS, dtype=np.int64))
    contacts = Contacts(np.zeros(Contacts.count(n, k)), n, k)
    links.address, links.numbers, links.total = (
        address_of(links.memory),
        address_of(contacts.memory),
        contacts.memory.size,
    )
    links.n, links.k, links.stops = n, k, stops
    links.rows = 0 if rows is None else rows.address
    contacts.direction[:, 0], contacts.near[:] = 1.0, 1.0
    links.keep_alive(rows=rows)
    return ContactMemory(links, contacts)
