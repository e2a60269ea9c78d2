"""The laws of friction of several contacts: each contact's own, with its states, where it is not Coulomb's μ alone.

They are those of `closedloop.mechanics.friction`, called by address, each with a `FrictionQuery`. A law that sticks
"rigid" has the cone of its `stick_limit` while a contact is at rest; one that sticks as a "spring", and an "elastic"
one, give F_t = −c f − w in every state, so that their contacts slide for the problem of the forces. An impact takes no
time: it has the cone of `kinetic_level`, as the tip's has.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array, IntArray
from closedloop.jit.blocks import Block, Count
from closedloop.jit.calls import Entry, address_of, call_at, integers_at, vector_at
from closedloop.jit.kernel import kernel
from closedloop.jit.parameters import pack, parameter_block, state_block
from closedloop.jit.user_code import RAISED, member_entry, of_users
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.memory import (
    ELASTIC_STICK,
    RIGID_STICK,
    SMOOTH,
    SPRING_STICK,
    ContactLinks,
    Contacts,
)
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.contacts.surfaces import Called
from closedloop.mechanics.friction.answers import ADVANCE_STATES, HOLD, LIMIT, RATES, SLIDE, STICK, answers
from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.law import Slip, SurfaceFriction, length_of
from closedloop.mechanics.friction.laws.coulomb import SurfaceCoulomb
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.limits import EXACT, STILL
from robot_models.cached import cached

STICKING = {"rigid": RIGID_STICK, "elastic": ELASTIC_STICK, "spring": SPRING_STICK}


class FrictionQuery(Block, sizes=("states", "par")):
    """Arguments and results of the law of a contact."""

    delayed: float  # speed of slip of `lag` ago, m/s
    stuck: float  # 1 while it sticks
    span: float  # by which the states are to be advanced, s
    limit: float  # out: μ_s
    slip: Annotated[Array, 2]  # m/s
    direction: Annotated[Array, 2]
    c: Annotated[Array, 2]  # out: F_t = −c f − w
    w: Annotated[Array, 2]
    z: Annotated[Array, Count.of("states")]
    dz: Annotated[Array, Count.of("states")]
    decay: Annotated[Array, Count.of("states")]  # out: a of ż = g − a z, 1/s
    par: Annotated[Array, Count.of("par")]


# Numbers of a `FrictionQuery` before its states.
HEAD = FrictionQuery.count(0, 0)


@cached
def contact_friction_entry(member: type[SurfaceFriction]) -> Entry:
    """Return the entry of a law of friction at the address of a `FrictionQuery`, compiled when it is first needed."""
    Parameters, States, answer = parameter_block(member), state_block(member), answers(member)
    states, count = States.count(2), Parameters.count(2)
    size = HEAD + 3 * states + count

    def entry(address: int, what: int) -> int:
        query = FrictionQuery(vector_at(address, size), states, count)
        x = Slip(query.slip, length_of(query.slip), query.delayed, query.direction)
        for k in range(states):
            query.dz[k] = query.decay[k] = 0.0
        limit = answer(
            what, x, Parameters(query.par, 2), States(query.z, 2), query.stuck != 0.0, query.c, query.w,
            States(query.dz, 2), States(query.decay, 2), query.span,
        )  # fmt: skip
        if what == LIMIT:
            query.limit = limit
        return 0

    entry.__name__ = entry.__qualname__ = f"entry_of_friction_{member.__name__}"
    return member_entry(entry, member)


def plain_friction(section: SurfaceFriction | None, usual: float) -> float:
    """Return Coulomb's μ that a law of friction is, 0 of another one, and `usual` where there is no section."""
    if section is None:
        return usual
    return section.coefficient if isinstance(section, SurfaceCoulomb) else 0.0


def coulomb_of(section: ContactSection) -> float:
    """Return Coulomb's μ of a contact of a link, 0 of one with another law."""
    return plain_friction(section.friction_law, section.friction)


def has_other_law(section: ContactSection) -> bool:
    """Whether the friction of a contact of a link is not Coulomb's μ."""
    return section.friction_law is not None and not isinstance(section.friction_law, SurfaceCoulomb | NoFriction)


class ContactFrictions(NamedTuple):
    """The laws of friction of k contacts as the loop reads them: addresses of entry and memory, and what they are."""

    addresses: IntArray  # (2 k,), zero of Coulomb's μ alone
    members: dict[int, tuple[SurfaceFriction, Array]]  # by the number of the contact

    def entries(self) -> list[Called]:
        """Return the entry kernels of the laws, and what they are of."""
        return [
            Called(i, "friction_law", section, contact_friction_entry(type(section)), address_of(memory))
            for i, (section, memory) in self.members.items()
        ]

    def connect(self, address: Callable[[Any], int]) -> None:
        """Write where the entries are, by what gives the address of one."""
        for i, (section, memory) in self.members.items():
            self.addresses[2 * i : 2 * i + 2] = address(contact_friction_entry(type(section))), address_of(memory)


def contact_frictions(laws: dict[int, tuple[SurfaceFriction, str]], k: int) -> ContactFrictions:
    """Return the laws of friction of k contacts, with a new memory of each, by the numbers of their contacts.

    `laws`: the section of each, and what it is called in messages.
    """
    members: dict[int, tuple[SurfaceFriction, Array]] = {}
    for i, (section, where) in laws.items():
        type(section).check_functions(f"{where}.kind")
        with of_users(section, f"{where}.kind"):
            par = pack(section, 2, where)
        states = state_block(type(section)).count(2)
        query = FrictionQuery(np.zeros(FrictionQuery.count(states, par.size)), states, par.size)
        query.par[:] = par
        members[i] = section, query.memory
    return ContactFrictions(np.zeros(2 * k, dtype=np.int64), members)


def law_at(section: SurfaceFriction, where: str) -> Contact:
    """Return a contact with a law of friction, for what is asked of it once; `where` is what it is called."""
    par = pack(section, 2, where)
    return Contact(type(section), parameter_block(type(section))(par, 2), 2)


@kernel
def has_law(links: ContactLinks, i: int) -> bool:
    """Whether contact i has a law of friction of its own, not Coulomb's μ alone."""
    return bool(links.frictions != 0 and integers_at(links.frictions, 2 * links.k)[2 * i] != 0)


@kernel
def query_at(links: ContactLinks, c: Contacts, i: int) -> FrictionQuery:
    """Return the memory of the law of contact i."""
    states, where = int(c.friction.states[i]), integers_at(links.frictions, 2 * links.k)
    return FrictionQuery(vector_at(where[2 * i + 1], HEAD + 3 * states), states, 0)


@kernel
def ask_law_of(links: ContactLinks, i: int, what: int) -> None:
    """Ask the law of contact i, and note if a user's has raised something."""
    where = integers_at(links.frictions, 2 * links.k)
    if call_at(where[2 * i], where[2 * i + 1], what) == RAISED:
        links.raised = 1


@kernel
def stops_slipping(c: Contacts, i: int) -> bool:
    """Whether the friction of contact i has a mode of sticking, which begins where slip ends."""
    return bool(c.mu[i] > 0.0 or c.friction.sticks[i] == RIGID_STICK or c.friction.sticks[i] == SPRING_STICK)


@kernel
def cone_limit(c: Contacts, i: int) -> float:
    """Return the largest |F_t|/f that contact i holds while it sticks."""
    return float(c.friction.limit[i] * (1.0 + EXACT) if c.friction.sticks[i] == SPRING_STICK else c.mu[i])


@kernel
def write_limits(links: ContactLinks, c: Contacts) -> None:
    """Write μ of the cones of contacts at rest, and what their laws hold at most."""
    for i in range(links.k if links.frictions != 0 else 0):
        if has_law(links, i):
            if c.friction.sticks[i] == RIGID_STICK or c.friction.sticks[i] == SPRING_STICK:
                ask_law_of(links, i, LIMIT)
                c.friction.limit[i] = query_at(links, c, i).limit
            c.mu[i] = c.friction.limit[i] if c.friction.sticks[i] == RIGID_STICK else 0.0


@kernel
def take_kinetic(links: ContactLinks, c: Contacts) -> None:
    """Write μ of the cones of an impact."""
    for i in range(links.k if links.frictions != 0 else 0):
        if has_law(links, i):
            c.mu[i] = c.friction.kinetic[i]


@kernel
def friction_of_impact(links: ContactLinks, c: Contacts, i: int) -> float:
    """Return μ of contact i in an impact."""
    return float(c.friction.kinetic[i] if has_law(links, i) else c.mu[i])


@kernel
def slide(links: ContactLinks, c: Contacts, i: int, held: bool = False) -> None:
    """Write F_t = −along f − viscous of a contact that slides, or that a spring holds.

    It is against its slip, or against `direction` while it has none.
    """
    at = 3 * i
    u1, u2 = c.u[at + 1], c.u[at + 2]
    d1, d2, speed = c.direction[i, 0], c.direction[i, 1], math.hypot(u1, u2)
    moves = speed > STILL and (u1 * d1 + u2 * d2 > 0.0 or c.friction.shared[i] > 0.0)
    if not has_law(links, i):
        if moves:
            d1, d2 = u1 / speed, u2 / speed
        c.problem.along[i, 0], c.problem.along[i, 1] = c.mu[i] * d1, c.mu[i] * d2
        return
    query, what = query_at(links, c, i), SLIDE
    query.delayed = c.friction.delayed[i] if c.friction.lag[i] > 0.0 else speed
    query.direction[0], query.direction[1], query.stuck = d1, d2, 0.0
    query.slip[0], query.slip[1] = u1, u2
    if held:
        what, query.stuck = HOLD, 1.0
        query.w[0], query.w[1] = 0.0, 0.0
    elif not moves and c.friction.sticks[i] != ELASTIC_STICK and c.friction.sticks[i] != SMOOTH:
        query.slip[0], query.slip[1] = speed * d1, speed * d2
    ask_law_of(links, i, what)
    c.problem.along[i, 0], c.problem.along[i, 1] = query.c[0], query.c[1]
    c.viscous[at + 1], c.viscous[at + 2] = query.w[0], query.w[1]


@kernel
def stick_as_spring(links: ContactLinks, c: Contacts, i: int) -> None:
    """Let the slip of contact i along `direction` end, and its spring hold it: write its states."""
    query, speed = query_at(links, c, i), math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])
    query.delayed = c.friction.delayed[i] if c.friction.lag[i] > 0.0 else speed
    query.direction[0], query.direction[1] = c.direction[i, 0], c.direction[i, 1]
    query.slip[0], query.slip[1] = c.u[3 * i + 1], c.u[3 * i + 2]
    ask_law_of(links, i, STICK)


@kernel
def take_states(links: ContactLinks, c: Contacts, z: Array) -> None:
    """Take the states of the laws of friction from z, those of the loop."""
    for i in range(links.k if links.frictions != 0 else 0):
        if c.friction.states[i] > 0.0:
            query, at = query_at(links, c, i), int(c.friction.states_at[i])
            for j in range(query.z.shape[0]):
                query.z[j] = z[at + j]


@kernel
def give_states(links: ContactLinks, c: Contacts, z: Array) -> None:
    """Write the states of the laws of friction into z, zero of a contact that is open, or that has been struck."""
    for i in range(links.k if links.frictions != 0 else 0):
        if c.friction.states[i] > 0.0:
            query, at = query_at(links, c, i), int(c.friction.states_at[i])
            kept = c.mode[i] != FREE and c.event.struck[i] == 0.0
            for j in range(query.z.shape[0]):
                query.z[j] = query.z[j] if kept else 0.0
                z[at + j] = query.z[j]


@kernel
def write_rates(links: ContactLinks, c: Contacts, dz: Array, decay: Array) -> None:
    """Write the rates of the states of the laws of friction, and of their decay, zero of a contact that is open."""
    for i in range(links.k if links.frictions != 0 else 0):
        if c.friction.states[i] > 0.0:
            query, at, closed = query_at(links, c, i), int(c.friction.states_at[i]), c.mode[i] != FREE
            if closed:
                query.slip[0], query.slip[1] = c.u[3 * i + 1], c.u[3 * i + 2]
                query.stuck = 1.0 if c.mode[i] == STUCK else 0.0
                ask_law_of(links, i, RATES)
            for j in range(query.z.shape[0]):
                dz[at + j] = query.dz[j] if closed else 0.0
                decay[at + j] = query.decay[j] if closed else 0.0


@kernel
def advance_states(links: ContactLinks, c: Contacts, span: float, z: Array) -> None:
    """Advance the states of the laws of friction by `span`, s, at the slip of the substep's beginning."""
    take_states(links, c, z)
    for i in range(links.k if links.frictions != 0 else 0):
        if c.friction.states[i] > 0.0 and c.mode[i] != FREE:
            query, at = query_at(links, c, i), int(c.friction.states_at[i])
            query.slip[0], query.slip[1], query.span = c.friction.start_u[i, 0], c.friction.start_u[i, 1], span
            query.stuck = 1.0 if c.mode[i] == STUCK else 0.0
            ask_law_of(links, i, ADVANCE_STATES)
            for j in range(query.z.shape[0]):
                z[at + j] = query.z[j]


@kernel
def remember_speed(c: Contacts, row: int) -> None:
    """Keep the speeds of slip at a row, for friction that is behind them; see `delayed_speed`."""
    past = c.friction.speeds.shape[1]
    for i in range(c.friction.speeds.shape[0] if past > 0 else 0):
        c.friction.speeds[i, row % past] = math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])


@kernel
def write_delayed(c: Contacts, time: float, h: float, last: int) -> None:
    """Write the speed of slip `lag` ago of each contact, m/s, on a line between the rows, `last` the latest of them."""
    past = c.friction.speeds.shape[1]
    for i in range(c.friction.speeds.shape[0] if past > 0 else 0):
        if c.friction.lag[i] <= 0.0:
            continue
        now = math.hypot(c.u[3 * i + 1], c.u[3 * i + 2])
        before = time - c.friction.lag[i]
        x = before / h
        if x <= 0.0 or last < 0:
            c.friction.delayed[i] = c.friction.speeds[i, 0] if last >= 0 and last < past else now
        elif int(x) >= last:
            since = time - last * h
            s = (before - last * h) / since if since > 0.0 else 1.0
            c.friction.delayed[i] = (1.0 - s) * c.friction.speeds[i, last % past] + s * now
        else:
            j = int(x)
            c.friction.delayed[i] = (1.0 - (x - j)) * c.friction.speeds[i, j % past] + (x - j) * c.friction.speeds[
                i, (j + 1) % past
            ]
