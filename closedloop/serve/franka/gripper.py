"""The gripper: commands for the sliding joints that the scenario's robot has behind its seven, its fingers.

A finger follows a wanted position that moves with the commanded speed, pulled by a spring and a damper whose force is
at most that of the command. Where the scenario has no free finger, the width stays, and every motion fails.
"""

import math
import socket
import time
from contextlib import suppress
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.serve.franka import wire
from closedloop.serve.franka.generator import JOINTS
from closedloop.serve.session import Session
from closedloop.serve.sockets import Client, Gone, Port

# The widest opening of a hand without limits, m, and the temperature that a client is told, °C.
WIDEST, TEMPERATURE = 0.08, 30
# Of a motion without its own: speed, m/s, and force, N.
SPEED, FORCE = 0.05, 70.0
# The drive of a finger: frequency, 1/s, and damping ratio.
FREQUENCY, DAMPING_RATIO = 200.0, 1.0
# A finger has stopped if it is slower than this, m/s, for so many steps; it is there within so much, m.
STOPPED, STEPS, NEAR = 1e-3, 50, 1e-3
# How far behind its goal a grasp wants to go, m: farther than any force stretches the spring.
BEYOND = 1.0
# The share of its force with which a grasp presses as it should.
WHOLE = 0.99
# The longest time that a command may take, s, and how often a state is sent, s.
LONGEST, EVERY = 20.0, 0.03


class Gripper:
    """The server of the gripper.

    `busy`, bool: whether a command is being carried out.
    `session`: the simulation.
    `fingers`: free fingers: none, one that stands for both, or two.
    `udp`: from which states are sent.
    """

    def __init__(self, session: Session, fingers: int, udp: socket.socket) -> None:
        self._session, self._fingers, self._udp = session, fingers, udp
        problem = session.problem
        model = problem.robot.model
        self._h = problem.h
        self._held = sum(value for name, value in model.locked.items() if "finger" in name)
        upper = model.position_upper[JOINTS:]
        self._widest = self._held + float(upper.sum()) if fingers and np.isfinite(upper).all() else WIDEST
        self._mass = np.diag(problem.robot.terms(session.state.q, session.state.v).mass_matrix)[JOINTS:]
        self._wanted = np.array(session.state.q[JOINTS:])
        self._goal, self._speed, self._force, self._closes = self._wanted.copy(), SPEED, FORCE, False
        self._grasp: tuple[float, float, float] | None = None  # width, and how much less and more it may be
        self._order: tuple[Client, int, int] | None = None
        self._still = self._taken = self._message = 0
        self._to: tuple[str, int] | None = None
        self._next = 0.0
        self.grasped = False

    @property
    def busy(self) -> bool:
        """See above."""
        return self._order is not None

    @property
    def width(self) -> float:
        """The distance of the fingers, m."""
        return self._held + float(self._session.state.q[JOINTS:].sum())

    def with_fingers(self, torque: Array) -> Array:
        """Return the torque of the arm (7,) with the forces of the fingers behind it, N, and note what they do."""
        if not self._fingers:
            return torque
        state = self._session.state
        q, v = state.q[JOINTS:], state.v[JOINTS:]
        step = self._speed * self._h
        self._closes = self._closes and bool((q > self._goal + NEAR).any())
        # Until a grasp is closed it wants to go on, so that the whole force presses on what is in the way.
        goal = self._goal - BEYOND if self._closes else self._goal
        self._wanted = np.clip(goal, self._wanted - step, self._wanted + step)
        # A finger that is held up does not let the spring grow without end.
        stretch = self._force / (self._mass * FREQUENCY**2)
        self._wanted = np.clip(self._wanted, q - stretch, q + stretch)
        force = self._mass * (FREQUENCY**2 * (self._wanted - q) - 2.0 * DAMPING_RATIO * FREQUENCY * v)
        self._note(q, v, not self._closes or bool((force < -WHOLE * self._force).all()))
        return np.concatenate((torque, np.clip(force, -self._force, self._force)))

    def _note(self, q: Array, v: Array, presses: bool) -> None:
        """End a command whose fingers are there, or have stopped; a grasp only once it presses as it should."""
        self._taken += 1
        self._still = self._still + 1 if presses and np.abs(v).max() < STOPPED else 0
        if self._order is None:
            if self.grasped and self._grasp is not None and not self._within(*self._grasp):
                self.grasped = False
            return
        there = bool(np.abs(self._goal - q).max() < NEAR)
        if self._still < STEPS and self._taken * self._h < LONGEST:
            return
        if self._grasp is not None:
            self.grasped = not there and self._within(*self._grasp)
            self._finish(wire.GRIPPER_SUCCESS if self.grasped else wire.GRIPPER_UNSUCCESSFUL)
        else:
            self._finish(wire.GRIPPER_SUCCESS if there else wire.GRIPPER_UNSUCCESSFUL)

    def _within(self, width: float, inner: float, outer: float) -> bool:
        return width - inner < self.width < width + outer

    def receive(self, client: Client) -> None:
        """Read what a client has sent, and obey."""
        client.receive()
        for command, number, given in client.requests(wire.GRIPPER_HEAD, wire.GRIPPER_REQUESTS, "a gripper"):
            if self._to is None and command != wire.GRIPPER_CONNECT:
                raise Gone("sent a command before it connected: the connection is closed")
            self._handle(client, command, number, given)

    def _handle(self, client: Client, command: int, number: int, given: tuple[Any, ...]) -> None:
        if command == wire.GRIPPER_CONNECT:
            version, port = given
            fits = version == wire.GRIPPER_VERSION
            self._to = (client.host, port) if fits else None
            self._answer(client, command, number, 0 if fits else 1, wire.GRIPPER_VERSION.to_bytes(2, "little"))
            return
        if self._order is not None:
            self._finish(wire.GRIPPER_ABORTED)
        if command == wire.GRIPPER_STOP:
            self._goal, self._closes = self._wanted.copy(), False
            self._answer(client, command, number, wire.GRIPPER_SUCCESS)
            return
        if not all(map(math.isfinite, given)) or any(value < 0.0 for value in given):
            self._answer(client, command, number, wire.GRIPPER_FAIL)
            return
        if not self._fingers:
            self._answer(client, command, number, wire.GRIPPER_UNSUCCESSFUL)
            return
        self._order, self._still, self._taken, self.grasped, self._grasp = (client, command, number), 0, 0, False, None
        self._closes = command == wire.GRIPPER_GRASP
        width, self._speed, self._force = self._widest, SPEED, FORCE
        if command == wire.GRIPPER_GRASP:
            width, inner, outer, self._speed, self._force = given
            self._grasp = (width, inner, outer)
            width = 0.0  # until something is in the way
        elif command == wire.GRIPPER_MOVE:
            width, self._speed = given
        self._goal = np.full(self._fingers, max(0.0, min(width, self._widest) - self._held) / self._fingers)

    def _answer(self, client: Client, command: int, number: int, status: int, rest: bytes = b"") -> None:
        size = wire.GRIPPER_HEAD.size + 2 + len(rest)
        client.send(wire.GRIPPER_HEAD.pack(command, number, size) + status.to_bytes(2, "little") + rest)

    def _finish(self, status: int) -> None:
        assert self._order is not None
        client, command, number = self._order
        self._order = None
        with suppress(Gone):  # it is found gone when it is read from
            self._answer(client, command, number, status)

    def leave(self) -> None:
        """Forget a client that is gone; the fingers stay where they are."""
        if self._to is not None:
            self._to, self._order, self._closes = None, None, False
            self._goal = self._wanted.copy()

    def report(self, port: Port) -> None:
        """Send the state, some thirty times a second."""
        if self._to is None or port.client is None or time.perf_counter() < self._next:
            return
        self._next = time.perf_counter() + EVERY
        self._message += 1
        state = wire.GRIPPER_STATE.pack(self._message, self.width, self._widest, self.grasped, TEMPERATURE)
        with suppress(OSError):
            self._udp.sendto(state, self._to)
