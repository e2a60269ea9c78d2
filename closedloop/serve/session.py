"""The simulation that is served: its record, in real time or in lock-step, its ports, and its interface.

An interface is ports, with one client at a time, and a loop that serves their clients. A client that closes its socket,
half of it or all of it, that breaks the connection, or that does not read what is sent to it, is gone; the next one is
served. While a client is there, others are refused. Real time has instants at equal distances on the wall clock.

In the browser the lab's page shows the latest seconds as they come, and at the end all of it. The page only shows: it
moves nothing, and what it asks for is another part of the time or another column.
"""

import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from typing import Any, ClassVar, NamedTuple

from closedloop.base.arrays import evenly
from closedloop.base.errors import OutputError, printable
from closedloop.figures.scene.scene import scene_of
from closedloop.jit.kernel import direct
from closedloop.lab.curves import tiles
from closedloop.lab.drawn import FRAMES, Rows, curves, robot_message, run_message, space_message
from closedloop.lab.history import Shown, hello
from closedloop.lab.server import FIRST_PORT
from closedloop.lab.server import Client as Page
from closedloop.loop.events.transitions import collide
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.simulator import Simulator, StepState

# Bytes that are read at once, bytes that may wait to be taken, and the time that a client may take until it has read
# what was sent to it, s. While one client is listened to, others are looked after so often, s.
CHUNK, MOST, PATIENCE, POLL = 65_536, 1_048_576, 1.0, 0.05

Say = Callable[[str], None]


class Stopped(Exception):
    """The server is to end."""


class Gone(Exception):
    """The client is no longer there, or is not to be served further: the argument says why."""


class Request(NamedTuple):
    """A request of a client: what it asks for, the number that its answer has, and its values."""

    command: int
    number: int
    given: tuple[Any, ...]


class Client:
    """The connection of a client.

    `name`, str: its address and port.
    `host`, str: its address.
    `received`, bytearray: what has come and has not been taken yet.
    """

    def __init__(self, sock: socket.socket, address: tuple[str, int]) -> None:
        self.host = address[0]
        self.name = f"{address[0]}:{address[1]}"
        self.received = bytearray()
        self.sock = sock
        sock.settimeout(PATIENCE)
        with suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._reader = sock.dup()  # the same connection, with a timeout of its own
        self._reader.settimeout(POLL)
        self._chunk = bytearray(CHUNK)
        self._part = memoryview(self._chunk)

    def fileno(self) -> int:
        """Return the number that `select` needs."""
        return self.sock.fileno()

    def receive(self) -> bool:
        """Read what is there, and return whether there was something within `POLL`.

        Raises Gone if the client has closed its end, or sends more than is taken.
        """
        try:
            count = self._reader.recv_into(self._chunk)
        except TimeoutError:
            return False
        except OSError as error:
            raise Gone(f"broke the connection ({error.strerror or error})") from None
        if not count:
            raise Gone("")
        self.received += self._part[:count]
        if len(self.received) > MOST:
            raise Gone(f"sends faster than it waits for answers, {len(self.received)} bytes: the connection is closed")
        return True

    def take(self, count: int) -> bytes:
        """Return the first bytes that have come, and remove them."""
        part = bytes(memoryview(self.received)[:count])
        del self.received[:count]
        return part

    def requests(self, head: struct.Struct, bodies: Mapping[int, struct.Struct], of: str) -> Iterator[Request]:
        """Return the whole requests that have come, each begun by a head: command, number, length with the head.

        `of` names in messages whose commands they are.

        Raises Gone if there is no such command, or its length is another.
        """
        while len(self.received) >= head.size:
            command, number, size = head.unpack_from(self.received)
            body = bodies.get(command)
            if body is None:
                raise Gone(f"sent what is no command of {of} ({command}, {size} bytes): the connection is closed")
            if size != head.size + body.size:
                raise Gone(f"sent command {command} with {size} bytes, not {head.size + body.size}: it is closed")
            if len(self.received) < size:
                return
            yield Request(command, number, body.unpack(self.take(size)[head.size :]))

    def send(self, message: bytes | bytearray) -> None:
        """Send a message whole.

        Raises Gone if the client does not take it.
        """
        try:
            self.sock.sendall(message)
        except OSError as error:
            raise Gone(f"does not take its answers ({error.strerror or error})") from None

    def close(self) -> None:
        """End the connection."""
        with suppress(OSError):
            self._reader.close()
            self.sock.close()


class Port:
    """A port on which one client at a time is served.

    `number`, int: the port.
    `client`, Client or None: the present client.
    Raises OutputError if nobody can listen there.
    """

    def __init__(self, host: str, number: int, say: Say) -> None:
        self._say = say
        self.client: Client | None = None
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._listener = socket.create_server((host, number), family=family, backlog=128)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(f"cannot listen on port {number} of {host}: {reason}; name another with --port") from None
        self._listener.setblocking(False)
        self.number: int = self._listener.getsockname()[1]

    def fileno(self) -> int:
        """Return the number that `select` needs."""
        return self._listener.fileno()

    def admit(self) -> None:
        """Accept who has come, or refuse them while a client is served."""
        try:
            sock, address = self._listener.accept()
        except OSError:  # it has gone again
            return
        if self.client is None:
            self.client = Client(sock, address)
            self._say(f"client {self.client.name} is connected")
            return
        sock.close()
        self._say(f"client {address[0]}:{address[1]} is refused: {self.client.name} is connected")

    def drop(self, why: str = "") -> None:
        """End the connection of the present client, and say why."""
        if self.client is not None:
            self.client.close()
            self._say(f"client {self.client.name} {printable(why) or 'is gone'}")
            self.client = None

    def close(self) -> None:
        """Stop listening."""
        self.drop("is left: the server ends")
        self._listener.close()


class Ports:
    """Ports that are waited for together, until another thread stops it."""

    def __init__(self, *ports: Port) -> None:
        self._ports = ports
        self._wake, self._woken = socket.socketpair()
        self._polled = 0.0

    def stop(self) -> None:
        """Let `ready` raise, now or the next time: for another thread."""
        with suppress(OSError):
            self._wake.send(b".")

    def ready(self, timeout: float | None, others: Iterable[socket.socket | Client] = ()) -> set[object]:
        """Wait until there is something to read or the time is over, and return from whom: clients and `others`.

        Raises Stopped after `stop`.
        """
        clients = [port.client for port in self._ports if port.client is not None]
        waited: list[Any] = [*clients, *others, self._woken, *self._ports]
        found, _, _ = select.select(waited, (), (), timeout)
        if not found:
            return set()
        ready: set[object] = set(found)
        if self._woken in ready:
            raise Stopped
        for port in self._ports:
            if port in ready:
                ready.discard(port)
                if port.client not in ready:  # what it says comes first: it may be that it is gone
                    port.admit()
        return ready

    def wait_for(self, client: Client) -> None:
        """Wait until a client has sent something, and read it: quicker than `ready` and `receive`.

        Raises Stopped or Gone as by those.
        """
        while True:
            received = client.receive()
            now = time.perf_counter()
            if not received or now - self._polled > POLL:
                self._polled = now
                self.ready(0.0)
            if received:
                return

    def close(self) -> None:
        """Close all ports."""
        for port in self._ports:
            port.close()
        self._wake.close()
        self._woken.close()


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
        with ExitStack() as opened:
            self.ports = tuple(opened.enter_context(closing(Port(host, number, say))) for number in wanted)
            opened.pop_all()  # they stay open
        self.waiting = Ports(*self.ports)
        try:
            self.prepare(host)
        except BaseException:
            self.close()
            raise

    def prepare(self, host: str) -> None:
        """Make what serving needs, and refuse an arm that cannot be served; `host` is where it listens."""

    def serve(self) -> None:
        """Serve clients until `stop`, which raises Stopped here, or until the record is full.

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


# The part of the run that is shown while it goes on, s of its own time, and how often, s.
RECENT, OFTEN = 5.0, 0.1
# It takes no larger part of the processor's time than one over this: the simulation is served by the same process.
SHARE = 10.0
# How soon the thread that draws leaves the interpreter to the one that serves, s; Python's own is 5 ms.
SWITCH = 5e-4
GOES_ON = "it is served, and goes on: its last {:g} s, without what is known only at its end"


class Watch:
    """The lab's page of a session, from now until `finish`.

    `url`, str: its address, with the token that lets in.
    Raises OutputError if it cannot listen there.
    """

    def __init__(self, session: Session, *, port: int = FIRST_PORT) -> None:
        self._session, problem = session, session.problem
        self._rows = max(2, round(RECENT / problem.h))
        self._run: Run | None = None
        self._count, self._done = 0, False
        self._switch = sys.getswitchinterval()
        self._page = Shown(f"closedloop: {problem.scenario.name}", port=port, run=self._message)
        self.url = self._page.url
        sys.setswitchinterval(min(SWITCH, self._switch))
        about = {"scenario": problem.scenario.to_toml(), "command": ""}
        self._page.tell("hello", hello(problem.scenario, problem.robot.model, live=False) | about)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="closedloop-watch", daemon=True)
        self._thread.start()

    def finish(self, run: Run, line: str) -> None:
        """Show the whole run, with the line that says where it is, and close the page."""
        self._ended.set()
        self._thread.join()
        sys.setswitchinterval(self._switch)
        if len(run):
            self._done, summary = True, run.summary()
            self._page.tell("strip", {"tiles": tiles(run, summary)})
            self._show(run, evenly(len(run), FRAMES), summary["clearance"])
        self._page.tell("goodbye", {"line": line})
        self._page.close()

    def _follow(self) -> None:
        """Show the latest rows again and again, where somebody looks and there are others than before."""
        took, last = 0.0, (-1.0, -1)
        while not self._ended.wait(max(OFTEN, (SHARE - 1.0) * took)):
            run = self._session.latest(self._rows) if self._page.clients else None
            if run is None or (float(run.time[-1]), len(run)) == last:
                continue
            began, last, loaded = time.thread_time(), (float(run.time[-1]), len(run)), self._run is not None
            self._show(run, [len(run) - 1])
            took = time.thread_time() - began if loaded else 0.0  # at first the shapes of the arm are read

    def _show(self, run: Run, rows: Rows, passing: dict[str, Any] | None = None) -> None:
        self._count += 1
        scene, first = scene_of(run), self._run is None
        self._run = run
        if first:
            self._page.tell("robot", robot_message(scene) | {"robot": 1})
        self._page.tell("space", space_message(scene, rows, passing) | {"robot": 1})
        self._page.tell_run()

    def _message(self, client: Page) -> dict[str, Any] | None:
        run = self._run
        if run is None:
            return None
        drawn = curves(run, client.window if self._done else None, client.columns)
        line = f"{len(run) - 1} steps, served" if self._done else GOES_ON.format(RECENT)
        return run_message(run, drawn, n=self._count, partial=not self._done, follow=not self._done, line=line) | (
            {} if self._done else {"stopped": ""}
        )
