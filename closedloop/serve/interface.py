"""What every interface is: ports, and a loop that serves their clients."""

from __future__ import annotations

from typing import ClassVar

from closedloop.serve.session import Session
from closedloop.serve.sockets import Port, Ports, Say


class Interface:
    """An interface to a session; a subclass answers clients in `serve`, in a thread of its own.

    Attributes
    ----------
    ports : tuple of Port
        Where it listens.
    numbers : tuple of int
        The ports that its real counterpart has, 0: any that is free.

    Parameters
    ----------
    session : Session
        The simulation.
    host, port : str and int or None
        Where it listens: `port` and those after it, None: `numbers`, 0: any that are free.
    lock_step : bool
        Whether time goes on only with each command; else it goes on with the wall clock.
    limits : bool
        Whether limits act as on the real arm, where the interface has such.
    say : callable
        Is given a line about each client that comes, goes or is refused.
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
            for door in opened:
                door.close()
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
