"""Ports with one client at a time, and what is bounded there: messages, waiting, clients.

A client that closes its socket, half of it or all of it, that breaks the connection, or that does not read what is sent
to it, is gone; the next one is served. While a client is there, others are refused.
"""

import select
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from closedloop.base.errors import OutputError, printable

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
