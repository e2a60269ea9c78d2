"""Opening an interface to a scenario: `closedloop.serve`."""

import logging
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError, SimulationError
from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from closedloop.serve.franka.server import Franka
from closedloop.serve.messages import Plain
from closedloop.serve.session import Interface, Say, Session, Stopped
from closedloop.serve.ur import Ur

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
