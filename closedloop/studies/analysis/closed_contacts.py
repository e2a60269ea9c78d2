"""The contacts of links that are closed at an instant, as the linear loop has them.

A rigid one that slides binds n, one that sticks t1 and t2 as well, like rows of loop joints; a soft one binds nothing
along n. The forces are those that the run's own kernel solves for in these modes.
"""

from operator import attrgetter
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import SimulationError
from closedloop.loop.step.memory import Loop
from closedloop.mechanics.closure.contact_force import FREE, STUCK
from closedloop.mechanics.contacts.memory import ContactMemory
from closedloop.scenario.tables import names_of
from closedloop.simulation.engines.problem import Problem

# What of the contacts' memory is their state, beside what the scenario says of them.
STATE = (
    "mode", "near", "direction", "anchor", "past_edge", "side", "located", "inside",
    "gaps.cleared", "gaps.floor", "gaps.unloaded",
    "friction.pulls", "friction.start_slip", "friction.start_u",
)  # fmt: skip


def contacts_of(problem: Problem, loop: Loop, time: float) -> dict[str, Array]:
    """Return the state of the contacts of links if one is closed, else nothing; refuse what is not linearised."""
    if loop.state.coupled == 0:
        return {}
    memory: ContactMemory = loop.w.kept["contacts"]
    links, c = memory.links, memory.contacts
    friction, resistance = c.friction, c.friction.resistance.owner >= 0.0
    closed, points = c.mode != FREE, np.arange(links.k) < links.points
    stops = closed & (np.arange(links.k) >= links.points) & (np.arange(links.k) < links.points + links.stops)
    names = ("tip", *names_of(problem.scenario.contact or ()))

    def refuse(why: str) -> SimulationError:
        return SimulationError(f"linearise: at t = {time:g} s {why}; take another instant", time)

    if np.any(stops):
        number = int(c.joint[np.flatnonzero(stops)[0]])
        who = f"joint {problem.robot.joint_names[number]}" if number < problem.robot.n else "a tendon"
        raise refuse(f"{who} is at its stop, which is not linearised")
    if links.undecided != 0 or links.stepped != 0:
        raise refuse("no modes of the contacts are found, and their forces are those of a time step")
    if np.any(resistance & closed):
        owner = names[int(c.friction.resistance.owner[np.flatnonzero(resistance & closed)[0]])]
        raise refuse(f"contact {owner!r} resists rolling or pivoting, which is not linearised")
    remembers = points & closed & ((friction.states > 0.0) | (friction.lag > 0.0))
    remembers[0] = False
    if np.any(remembers):
        name = names[int(np.flatnonzero(remembers)[0])]
        raise refuse(f"contact {name!r} is closed, whose friction has a memory, which is not linearised")
    return {name: np.array(attrgetter(name)(c)) for name in STATE}


def put_contacts(state: dict[str, Array], loop: Loop) -> None:
    """Write the state of contacts into a loop's memory."""
    memory: ContactMemory = loop.w.kept["contacts"]
    for name, value in state.items():
        attrgetter(name)(memory.contacts)[:] = value
    memory.links.undecided = memory.links.fresh = memory.links.stepped = memory.links.chattering = 0
    loop.state.coupled = 1


class ClosedContacts:
    """The closed contacts of links in a loop's memory, while it is evaluated again and again.

    Attributes
    ----------
    names : tuple of str
        Of those that are closed.
    """

    def __init__(self, problem: Problem, loop: Loop) -> None:
        self._loop, memory = loop, loop.w.kept["contacts"]
        self._numbers: Any = memory.contacts
        self._links = memory.links
        self._saved = memory.contacts.memory.copy(), memory.links.memory.copy()
        self._modes = np.array(memory.contacts.mode)
        names = names_of(problem.scenario.contact or ())
        self._closed = [i for i in range(1, len(names) + 1) if self._modes[i] != FREE]
        self.names = tuple(names[i - 1] for i in self._closed)
        self._normals = np.array([3 * i for i in self._closed], dtype=np.intp)
        rows: list[int] = []
        for i in self._closed:
            rows += [] if memory.contacts.soft[i] != 0.0 else [3 * i]
            rows += [3 * i + 1, 3 * i + 2] if self._modes[i] == STUCK else []
        self._rows = np.array(rows, dtype=np.intp)

    @property
    def sizes(self) -> dict[str, int]:
        """How many numbers `read` returns: rates of the rows that bind, and normal forces."""
        return {"rates": self._rows.size, "presses": self._normals.size}

    def put_back(self) -> None:
        """Write the state again that the contacts had at first."""
        self._numbers.memory[:], self._links.memory[:] = self._saved

    def read(self) -> tuple[Array, Array] | None:
        """Return the rates u of the rows that bind (m,), m/s, and the normal forces (k,), N; None in other modes."""
        if self._loop.state.coupled == 0 or self._links.undecided != 0 or self._links.stepped != 0:
            return None
        if not np.array_equal(self._numbers.mode, self._modes):
            return None
        return self._numbers.u[self._rows], self._numbers.F[self._normals]

    def rows(self) -> Array:
        """Return the rows that bind at the state evaluated last (m, n)."""
        return np.array(self._numbers.G[self._rows])
