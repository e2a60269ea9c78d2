"""Opening an interface to a scenario, `closedloop.serve`, and our own messages between a controller and a simulation.

A client that begins with "{" writes JSON: one object a line, and gets one a line. A client that begins with the four
bytes `MAGIC` writes binary messages: two little-endian 32-bit whole numbers, kind and length, then as many bytes. Each
message of the client has one answer. docs/serve.md has the table of both.

In lock-step a torque is one step, and its answer the state after it. In real time the clock runs from the first torque
on: a torque acts from the next instant, one period long and until the next one comes, and the answer is the state one
period after it began to act. While no client is there, time stands still.
"""

import json
import logging
import math
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, plain
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.loop.step.record_row import Row
from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from closedloop.serve.franka.server import Franka
from closedloop.serve.session import Client, Clock, Gone, Interface, Say, Session, Stopped
from closedloop.serve.ur import Ur
from closedloop.simulation.simulator import StepState

MAGIC = b"CLB1"
HEAD, DOUBLES = struct.Struct("<II"), np.dtype("<f8")
# The longest message of a client, bytes: a torque of more joints than any arm has.
LONGEST = 65_536

# What a client can ask for. In a binary message the kind is the place in this list.
DESCRIBE, RESET, STATE, TORQUE, STEP, WRENCH, EVENTS = REQUESTS = (
    "describe", "reset", "state", "torque", "step", "wrench", "events",
)  # fmt: skip
# What answers what cannot be done.
FAULT = "error"
# The kinds of binary answers: a state or a wrench as doubles, a text in JSON, an error as text.
NUMBERS, TEXT, ERROR = range(3)

# A state, in order; "n" numbers for each velocity, "nq" for each position. All are doubles in a binary message.
FIELDS: tuple[tuple[str, int | str], ...] = (
    ("time", 1), ("row", 1), ("done", 1), ("mode", 1), ("contact_force", 1), ("measured_force", 1),
    ("closure_error", 1), ("closure_rate", 1), ("position", 3), ("velocity", 3), ("normal", 3), ("friction_force", 3),
    ("q", "nq"), ("v", "n"), ("acceleration", "n"), ("torque", "n"),
)  # fmt: skip
_OF_ROW = {"normal": "surface_normal"}
_SEEN = ("time", "row", "done", "measured_force", "closure_error")  # not as they are in the row


class Request(NamedTuple):
    """What a client asks for, and the torque (n,), N m, if that is it."""

    kind: str
    torque: Array | None = None


class States:
    """States as one array of doubles, in the order of `FIELDS`.

    `places`, dict of str to slice: where each field is.
    `message`, bytearray: the binary answer with the latest of them.
    """

    def __init__(self, session: Session) -> None:
        model = session.problem.robot.model
        sizes = {"n": model.n, "nq": len(model.coordinate_names)}
        self.names, self.n = model.joint_names, model.n
        self.places: dict[str, slice] = {}
        source: list[int] = []
        for name, size in FIELDS:
            count = sizes[size] if isinstance(size, str) else size
            self.places[name] = slice(len(source), len(source) + count)
            place: Any = 0 if name in _SEEN else Row.place(_OF_ROW.get(name, name), model.n)
            first = place.start if isinstance(place, slice) else place
            source += range(first, first + count)
        self.message = bytearray(HEAD.pack(NUMBERS, 8 * len(source))) + bytes(8 * len(source))
        self._numbers = np.frombuffer(self.message, DOUBLES, -1, HEAD.size)
        self._source = np.array(source)
        self._gap = self.places["closure_error"].start
        self._measured = self.places["measured_force"].start
        self._q = self.places["q"] if sizes["nq"] > model.n else None  # quaternions are not in the row

    def numbers(self, state: StepState, done: bool) -> Array:
        """Return a state as doubles, which stay until the next one."""
        found = self._numbers
        state.recorded.take(self._source, 0, found, "clip")
        found[0], found[1], found[2] = state.time, state.row, done
        found[self._gap], found[self._measured] = state.gap, state.measured
        if self._q is not None:
            found[self._q] = state.q
        return found

    def torque(self, found: Any) -> Request | str:
        """Return the request of a torque (n,) from what a client sent, or what is wrong with it."""
        try:
            torque = np.asarray(found, dtype=np.float64)
            if torque.shape == (self.n,) and all(map(math.isfinite, torque.tolist())):
                return Request(TORQUE, torque)
        except (TypeError, ValueError, OverflowError):
            pass
        return f"torque: must be {self.n} finite numbers, one for each of {', '.join(self.names)}"


def wrench(state: StepState, radius: float) -> Array:
    """Return the force of the surface on the tip and its moment about the base's origin (6,), N and N m, base axes.

    The surface touches a round tip at `radius`, m, from its centre.
    """
    normal = state.normal
    force = state.f * normal + state.friction_force
    return np.concatenate((force, np.cross(state.position - radius * normal, force)))


class JsonLines:
    """One JSON object a line; what is not finite is null."""

    def __init__(self, states: States) -> None:
        self.states = states

    def request(self, client: Client) -> Request | str | None:
        """Return the next message of a client, what is wrong with it, or None if it is not whole yet.

        Raises Gone if what follows cannot be told apart from it.
        """
        end = client.received.find(b"\n")
        if max(end, 0 if end >= 0 else len(client.received)) > LONGEST:
            raise _too_long(len(client.received))
        if end < 0:
            return None
        line = client.take(end + 1)
        try:
            found = json.loads(line)
        except (ValueError, RecursionError):
            return 'not a JSON object on one line, such as {"do": "state"}'
        kind = found.get("do") if isinstance(found, dict) else None
        if not isinstance(kind, str) or kind not in REQUESTS:
            return f'"do": must be one of {", ".join(REQUESTS)}, as in {{"do": "state"}}'
        unknown = set(found) - {"do", TORQUE} if kind == TORQUE else set(found) - {"do"}
        if unknown:
            return f'"{kind}" takes nothing named {", ".join(sorted(unknown))}'
        return self.states.torque(found.get(TORQUE)) if kind == TORQUE else Request(kind)

    def answer(self, kind: str, found: Any) -> bytes:
        """Return an answer: `found` is the latest of `states`, a wrench (6,), a description, events, or an error."""
        if kind == STATE:
            found = self._state(found)
        elif kind == WRENCH:
            found = found.tolist()
        return json.dumps(found if isinstance(found, dict) else {kind: found}, allow_nan=False).encode() + b"\n"

    def _state(self, found: Array) -> dict[str, Any]:
        values = [value if math.isfinite(value) else None for value in found.tolist()]
        state: dict[str, Any] = {}
        for (name, size), place in zip(FIELDS, self.states.places.values(), strict=True):
            state[name] = values[place.start] if size == 1 else values[place]
        return state | {"row": int(state["row"]), "done": bool(state["done"]), "mode": int(state["mode"])}


class Binary:
    """A kind, a length, and the bytes; methods as those of `JsonLines`."""

    def __init__(self, states: States) -> None:
        self.states = states

    def request(self, client: Client) -> Request | str | None:
        """See `JsonLines`."""
        if len(client.received) < HEAD.size:
            return None
        kind, length = HEAD.unpack_from(client.received)
        if length > LONGEST:
            raise _too_long(length)
        if len(client.received) < HEAD.size + length:
            return None
        message = client.take(HEAD.size + length)
        if kind >= len(REQUESTS):
            return f"kind {kind}: must be from 0 to {len(REQUESTS) - 1}"
        name = REQUESTS[kind]
        wanted = 8 * self.states.n if name == TORQUE else 0
        if length != wanted:
            return f"{name}: has {length} bytes, must have {wanted}"
        return self.states.torque(np.frombuffer(message, DOUBLES, -1, HEAD.size)) if wanted else Request(name)

    def answer(self, kind: str, found: Any) -> bytes | bytearray:
        """See `JsonLines`."""
        if kind == STATE:
            return self.states.message
        if kind == WRENCH:
            code, body = NUMBERS, found.astype(DOUBLES, copy=False).tobytes()
        elif kind == FAULT:
            code, body = ERROR, found.encode()
        else:
            code, body = TEXT, json.dumps(found, allow_nan=False).encode()
        return HEAD.pack(code, len(body)) + body


def _too_long(length: int) -> Gone:
    return Gone(f"sent a message of {length} bytes, longer than {LONGEST}: the connection is closed")


Codec = JsonLines | Binary


def codec_of(client: Client, states: States) -> Codec | None:
    """Return the codec of a client from how it begins, None if it has not said enough; magic bytes are taken.

    Raises Gone if it begins in another way.
    """
    begun = bytes(client.received[:4])
    if begun[:1] == b"{":
        return JsonLines(states)
    if begun == MAGIC:
        client.take(len(MAGIC))
        return Binary(states)
    if MAGIC.startswith(begun):
        return None
    raise Gone("is refused: it must begin with { or with the bytes CLB1")


class Plain(Interface):
    """JSON and binary messages over TCP."""

    def serve(self) -> None:
        """See `Interface`."""
        self._states = States(self.session)
        self._events: list[dict[str, Any]] = []
        port = self.ports[0]
        while True:
            self.waiting.ready(None)
            if port.client is not None:
                try:
                    self._talk(port.client)
                except Gone as gone:
                    port.drop(str(gone))

    def _talk(self, client: Client) -> None:
        session, waiting = self.session, self.waiting
        clock = Clock(session.problem.h)
        codec: Codec | None = None
        running, fresh, waits = False, False, False  # the clock; a command since the last instant; an answer is owed
        held: Array | None = None
        while True:
            if not running:
                waiting.wait_for(client)
            elif client in waiting.ready(clock.left()):
                client.receive()
            while client.received and not waits:
                codec = codec_of(client, self._states) if codec is None else codec
                request = None if codec is None else codec.request(client)
                if codec is None or request is None:
                    break
                if not isinstance(request, Request):
                    client.send(codec.answer(FAULT, request))
                elif request.kind not in (TORQUE, STEP):
                    client.send(self._answer(codec, request.kind))
                    running = running and request.kind != RESET
                elif session.done:
                    client.send(codec.answer(FAULT, f"{request.kind}: the scenario is at its end; reset begins anew"))
                elif self.lock_step:
                    session.cycles += 1
                    self._step(request.torque)
                    client.send(self._state(codec))
                else:
                    held, fresh, waits = request.torque, True, True
                    if not running:
                        clock.begin()
                        running = True
            if running and clock.left() == 0.0:
                clock.tick()
                session.late = clock.late
                session.cycles += 1
                session.lost += not fresh
                self._step(held)
                running = not session.done
                if waits and codec is not None:
                    client.send(self._state(codec))
                fresh = waits = False

    def _step(self, torque: Array | None) -> None:
        self._events += [plain(event._asdict()) for event in self.session.step(torque).events]

    def _state(self, codec: Codec) -> bytes | bytearray:
        session = self.session
        return codec.answer(STATE, self._states.numbers(session.state, session.done))

    def _answer(self, codec: Codec, kind: str) -> bytes | bytearray:
        session = self.session
        if kind == DESCRIBE:
            return codec.answer(kind, self._description())
        if kind == EVENTS:
            events, self._events = self._events, []
            return codec.answer(kind, events)
        if kind == WRENCH:
            return codec.answer(kind, wrench(session.state, session.problem.scenario.tool.radius))
        if kind == RESET:
            session.reset()
            self._events = []
        return self._state(codec)

    def _description(self) -> dict[str, Any]:
        """Return what a client needs to know before it begins."""
        problem = self.session.problem
        return {
            "scenario": problem.scenario.name,
            "robot": problem.robot.model.name,
            "joints": list(self._states.names),
            "n": self._states.n,
            "period": problem.h,
            "steps": problem.steps,
            "lock_step": self.lock_step,
            "state": [[name, place.stop - place.start] for (name, _), place in zip(
                FIELDS, self._states.places.values(), strict=True)],
        }  # fmt: skip


# The interfaces, and how long a run may be at least where the scenario's own duration is shorter, s.
INTERFACES: dict[str, tuple[type[Interface], float]] = {
    "json": (Plain, 0.0),
    "franka": (Franka, 600.0),
    "ur": (Ur, 600.0),
}
_log = logging.getLogger("closedloop.serve")


class Served:
    """A scenario that is being served, in a thread of its own; as a context manager it is closed at the end.

    `host`, str: where it listens.
    `ports`, tuple of int: the ports, in the order of its interface: of Franka's the arm's and the gripper's.
    `port`, int: the first of them.
    """

    def __init__(self, interface: Interface, host: str) -> None:
        self._interface = interface
        self.host, self.ports = host, tuple(port.number for port in interface.ports)
        self.port = self.ports[0]
        self._failure: BaseException | None = None
        self._run: Run | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="closedloop-serve")
        self._thread.start()

    def _serve(self) -> None:
        try:
            with suppress(Stopped):
                self._interface.serve()
        except BaseException as failure:  # it is raised where `close` is called
            self._failure = failure
        finally:
            self._interface.close()
            self._ended.set()

    @property
    def session(self) -> Session:
        """The simulation, and how many of its cycles were lost."""
        return self._interface.session

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the serving has ended by itself, at most `timeout` seconds, and return whether it has."""
        return self._ended.wait(timeout)

    def close(self) -> Run:
        """End the serving, and return the record; again the same one.

        Raises SimulationError if the simulation could not go on; its `run` holds the rows until then.
        """
        self._interface.stop()
        self._thread.join()
        if self._failure is not None:
            raise self._failure
        if self._run is None:
            self._run = self.session.run()
        return self._run

    def __enter__(self) -> "Served":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            self.close()
        except SimulationError:
            if kind is None:
                raise


@arguments_checked(overrides="keys and their values, such as {'law.force': 15.0}")
def serve(
    scenario: Scenario | str | Path, as_: str = "json", *, overrides: Mapping[str, Any] | None = None,
    lock_step: bool = False, host: str = "127.0.0.1", port: int | None = None, limits: bool = False,
    say: Say | None = None,
) -> Served:  # fmt: skip
    """Serve a scenario to a controller that is another program, until `close` of what is returned.

    The record is a run like any other. With the interface "json" it has the scenario's duration, and `reset` begins it
    anew; with the others it goes on for at least ten minutes, unless `overrides` name `time.duration`.

    Parameters
    ----------
    scenario : Scenario, str or Path
        A scenario, a shipped name, or a path to a .toml file.
    as_ : "json", "franka" or "ur"
        The interface: messages of our own, JSON or binary (docs/serve.md), those of Franka's arms (docs/franka.md), or
        the data exchange of Universal Robots' (docs/ur.md), which has no lock-step.
    overrides : mapping, optional
        Dotted keys and values, as for `load_scenario`.
    lock_step : bool
        Time goes on with each command, as quickly as it can. Otherwise it goes on with the wall clock.
    host : str
        The address to listen on; "127.0.0.1" is reached from this computer alone.
    port : int, optional
        The first port. If left out: of "json" any that is free, of "franka" 1337 and, for the gripper, 1338, of "ur"
        30004; 0: any.
    limits : bool
        Whether limits of motions and lost commands end a motion, as on the real arm ("franka").
    say : callable, optional
        Is given a line about each client that comes, goes or is refused.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario is at fault, or has no arm that the interface could serve.
    OutputError
        If it cannot listen there.
    """
    if as_ not in INTERFACES:
        raise ScenarioError(f"serve: as {as_!r}: must be one of {', '.join(INTERFACES)}")
    if port is not None and not 0 <= port < 65_535:
        raise ScenarioError(f"serve: port {port}: must be from 0 to 65534")
    changes = overrides or {}
    interface, least = INTERFACES[as_]
    base = scenario.replace(changes) if isinstance(scenario, Scenario) else load_scenario(scenario, changes)
    if "time.duration" not in changes and base.time.duration < least:
        base = base.replace({"time.duration": least})
    opened = interface(
        Session(base), host=host, port=port, lock_step=lock_step, limits=limits, say=_log.info if say is None else say
    )
    return Served(opened, host)
