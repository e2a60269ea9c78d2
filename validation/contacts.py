"""Faults planted in what solves several contacts, and what the laws of contact say of the answers.

The laws are written by hand here, from the velocities before and after, the impulses and the mobility alone: no
contact opens inwards, no impulse pulls or leaves its cone, what slides is rubbed against its slip with μ f, what parts
has no impulse, u⁺ = u⁻ + W P, and e says how fast what strikes parts.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.impact import apply_impulses
from closedloop.mechanics.contacts.memory import ContactMemory, make_contact_memory
from validation.plant import Catch, catch_of

# Cases of every fault, and what the laws may be off, of the largest impulse and velocity.
CASES, TOLERANCE = 12, 1e-10


@dataclass(frozen=True)
class Answer:
    """Impulses (k, 3), N s, and the velocities after them, m/s: rows n, t1, t2 of each contact."""

    P: Array
    after: Array


@dataclass(frozen=True)
class Fault:
    """A fault: in what the solver is given, or in what it answers; `spoil` and `answer` leave what they do not touch.

    spoil: changes the memory that the solver reads
    answer: answer, memory -> the faulty answer
    """

    name: str
    spoil: Callable[[ContactMemory], None] = lambda memory: None
    answer: Callable[[Answer, ContactMemory], Answer] = lambda answer, memory: answer


def bodies_that_meet(rng: np.random.Generator) -> ContactMemory:
    """Return a rigid body that two or three of its points strike on a floor with, with friction and restitution."""
    k = int(rng.integers(2, 4))
    memory = make_contact_memory(3 * 3, k)  # a fault gives each contact three joints of its own
    c = memory.contacts
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, rng.normal(size=3))
    side /= np.linalg.norm(side)
    frame = np.stack([normal, side, np.cross(normal, side)])
    for i in range(k):
        arm = rng.normal(size=3)
        for a in range(3):
            c.X[3 * i + a, :6] = np.concatenate([frame[a], 2.0 * np.cross(arm, frame[a])])
    c.u[:] = c.X[:, :6] @ (rng.normal(size=6) + 3.0 * np.concatenate([-normal + side, np.zeros(3)]))
    c.mu[:], c.restitution[:] = rng.uniform(0.1, 0.8, k), 0.4
    return memory


def ask(memory: ContactMemory, fault: Fault | None = None) -> Answer:
    """Return what an impact makes of a memory's contacts, with a fault in it or without; the memory stays sound."""
    links, sound = memory
    asked = make_contact_memory(int(links.n), int(links.k))
    asked.contacts.memory[:] = sound.memory
    if fault:
        fault.spoil(asked)
    c = asked.contacts
    if interpreted(apply_impulses)(asked.links, c, 1e-9) != OK:
        return Answer(np.full((int(links.k), 3), np.inf), np.full((int(links.k), 3), np.inf))
    answer = Answer(np.array(c.F).reshape(-1, 3), (sound.u + sound.X @ (sound.X.T @ c.F)).reshape(-1, 3))
    return fault.answer(answer, memory) if fault else answer


def errors(memory: ContactMemory, answer: Answer) -> dict[str, float]:
    """Return what the laws of contact are off, each relative to the largest impulse and velocity."""
    c, P, after = memory.contacts, answer.P, answer.after
    before = np.array(c.u).reshape(-1, 3)
    share = _restitution_given(memory, P, after)
    bounced = after[:, 0] + share * c.restitution * np.minimum(before[:, 0], 0.0)
    slip, friction = np.hypot(after[:, 1], after[:, 2]), np.hypot(P[:, 1], P[:, 2])
    force, speed = float(np.max(np.abs(P))), float(np.max(np.abs(before)))
    against = np.sum(P[:, 1:] * after[:, 1:], axis=1) + c.mu * P[:, 0] * slip
    found = {
        "opening": float(np.max(-bounced)) / speed,
        "pull": float(np.max(-P[:, 0])) / force,
        "cone": float(np.max(friction - c.mu * P[:, 0])) / force,
        "complementarity": float(np.max(np.abs(P[:, 0] * bounced))) / (force * speed),
        "friction": float(np.max(np.abs(against))) / (force * speed),
        "motion": float(np.max(np.abs(after.ravel() - c.u - c.X @ (c.X.T @ P.ravel())))) / speed,
    }
    return {name: value if np.isfinite(value) else np.inf for name, value in found.items()}


def _restitution_given(memory: ContactMemory, P: Array, after: Array) -> float:
    """Return by what factor restitution was lessened where energy asks for that: the least that rebounds has."""
    c = memory.contacts
    pushed = (P[:, 0] > 1e-9 * np.max(np.abs(P))) & (np.array(c.u)[::3] < 0.0)
    if not pushed.any() or not np.all(np.isfinite(after)):
        return 1.0
    share = float(np.min(-after[pushed, 0] / (c.restitution[pushed] * np.array(c.u)[::3][pushed])))
    return share if 0.0 <= share < 1.0 and _gains(memory) else 1.0


def _gains(memory: ContactMemory) -> bool:
    """Whether the sound impact had to lessen its restitution."""
    links, sound = memory
    asked = make_contact_memory(int(links.n), int(links.k))
    asked.contacts.memory[:] = sound.memory
    interpreted(apply_impulses)(asked.links, asked.contacts, 1e-9)
    return bool(asked.contacts.event.restitution_share < 1.0)


def _wider(memory: ContactMemory) -> None:
    memory.contacts.mu[:] *= 1.001


def _no_normal(memory: ContactMemory) -> None:
    """Take the first contact's row along its normal from all."""
    c = memory.contacts
    c.X[0], c.u[0] = 0.0, 0.0


def _rubbed(factor: float) -> Callable[[Answer, ContactMemory], Answer]:
    """Return a fault: tangential impulses times a factor."""

    def answer(answer: Answer, memory: ContactMemory) -> Answer:
        c, P = memory.contacts, answer.P * [1.0, factor, factor]
        return Answer(P, np.array(c.u + c.X @ (c.X.T @ P.ravel())).reshape(-1, 3))

    return answer


def _sign_of_velocity(answer: Answer, memory: ContactMemory) -> Answer:
    return Answer(answer.P, 2.0 * np.array(memory.contacts.u).reshape(-1, 3) - answer.after)


def _one_by_one(memory: ContactMemory) -> None:
    """Let no contact know of the others."""
    c = memory.contacts
    for i in range(int(memory.links.k)):
        rows = slice(3 * i, 3 * i + 3)
        own = np.linalg.cholesky(c.X[rows] @ c.X[rows].T)
        c.X[rows] = 0.0
        c.X[rows, rows] = own


FAULTS = (
    Fault("coefficient of the cone 0.1 % too large", _wider),
    Fault("normal row of a contact dropped", _no_normal),
    Fault(
        "mobility of a row 0.1 % too large",
        lambda memory: np.copyto(memory.contacts.X[0], 1.001 * memory.contacts.X[0]),
    ),
    Fault("contacts solved one by one", _one_by_one),
    Fault("friction along the slip", answer=_rubbed(-1.0)),
    Fault("restitution applied to the tangential impulse", answer=_rubbed(1.4)),
    Fault("sign of the velocity that an impulse adds", answer=_sign_of_velocity),
)


def cases(seed: int) -> Iterator[ContactMemory]:
    """Yield the cases of a seed."""
    rng = np.random.default_rng(seed)
    for _ in range(CASES):
        yield bodies_that_meet(rng)


def plant_on_contacts(seed: int = 0, faults: Sequence[Fault] = FAULTS) -> list[Catch]:
    """Plant every fault in the impact of several contacts, and return what the laws of contact say of it."""
    return [
        catch_of(
            fault.name,
            "contacts",
            (errors(memory, ask(memory, fault)) for memory in cases(seed)),
            TOLERANCE,
            "the laws of contact",
        )
        for fault in faults
    ]
