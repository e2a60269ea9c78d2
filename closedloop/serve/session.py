"""The simulation that is served: its record, in real time or in lock-step, and its interface.

An interface is ports, and a loop that serves their clients. Real time has instants at equal distances on the wall
clock.
"""

import time
from typing import ClassVar

from closedloop.jit.kernel import direct
from closedloop.loop.events.transitions import collide
from closedloop.scenario.scenario import Scenario
from closedloop.serve.sockets import Port, Ports, Say
from closedloop.simulation.simulator import Simulator
from closedloop.simulation.state import StepState

# A server that is later than this does not catch up: the simulation stands still meanwhile, s. It catches up in cycles
# that are this share of a period long, so that a client can still answer in each.
LATEST, SHORTEST = 0.02, 0.6


class Clock:
    """Instants that are one period apart.

    `late`, int: instants that were skipped because the server came more than `LATEST` late.
    """

    def __init__(self, period: float) -> None:
        self.period, self.late = period, 0
        self._next = self._soonest = 0.0

    def begin(self) -> None:
        """Let the next instant be one period from now."""
        self._next = time.perf_counter() + self.period

    def left(self) -> float:
        """Return how long it is until the next instant, s; 0 if it has passed."""
        return max(0.0, max(self._next, self._soonest) - time.perf_counter())

    def tick(self) -> None:
        """Go on to the instant after this one."""
        now = time.perf_counter()
        self._next += self.period
        self._soonest = now + SHORTEST * self.period
        behind = now - self._next
        if behind > LATEST:
            skipped = int(behind / self.period)
            self.late += skipped
            self._next += skipped * self.period


class Session(Simulator):
    """A simulation that clients drive one after the other, and how many of its cycles had a command.

    `cycles`, `lost`, int: steps since the last reset during which a client drove, and those of them for which no
        command came in time.
    `late`, int: instants of real time that this computer was too late for, see `Clock`.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        direct(collide, 0)  # compile it now: an impact must not while a client waits
        self.reset()

    def reset(self) -> StepState:
        """Begin anew; the record of what was before is dropped."""
        self.cycles = self.lost = self.late = 0
        return super().reset()


class Interface:
    """An interface to a session; a subclass answers clients in `serve`, in a thread of its own.

    `ports`: where it listens.
    `numbers`: the ports that its real counterpart has, 0: any that is free.
    `session`: the simulation.
    `host`, `port`: where it listens: `port` and those after it, None: `numbers`, 0: any that are free.
    `lock_step`: whether time goes on only with each command; else it goes on with the wall clock.
    `limits`: whether limits act as on the real arm, where the interface has such.
    `say`: is given a line about each client that comes, goes or is refused.
    """

    numbers: ClassVar[tuple[int, ...]] = (0,)

    def __init__(
        self, session: Session, *, host: str, port: int | None, lock_step: bool, limits: bool, say: Say
    ) -> None:
        self.session, self.lock_step, self.limits, self.say = session, lock_step, limits, say
        wanted = self.numbers if port is None else tuple(port + k if port else 0 for k in range(len(self.numbers)))
        opened: list[Port] = []
        try:
            for number in wanted:
                opened.append(Port(host, number, say))
        except BaseException:
            for each in opened:
                each.close()
            raise
        self.ports = tuple(opened)
        self.waiting = Ports(*self.ports)

    def serve(self) -> None:
        """Serve clients until `stop`, or until the record is full.

        Raises
        ------
        SimulationError
            If the simulation cannot go on.
        """
        raise NotImplementedError

    def stop(self) -> None:
        """Let `serve` end: for another thread."""
        self.waiting.stop()

    def close(self) -> None:
        """Stop listening."""
        self.waiting.close()
