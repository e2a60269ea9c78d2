"""The servers of the arm and of its gripper: commands over TCP, a state and a command over UDP in each cycle of 1 ms.

In lock-step the simulation advances with each command of a running motion, and stands still otherwise; a state is sent
again if no command comes, since a client may read several before it commands. In real time a cycle lasts a millisecond
while a client is connected; between motions the arm holds its place.

The gripper moves the sliding joints that the scenario's robot has behind its seven, its fingers. A finger follows a
wanted position that moves with the commanded speed, pulled by a spring and a damper whose force is at most that of the
command. Where the scenario has no free finger, the width stays, and every motion fails.
"""

import math
import socket
import time
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, OutputError, ScenarioError
from closedloop.serve.franka import wire
from closedloop.serve.franka.generator import JOINTS, LOST, Arm, Generator, Impedance, Reflexes
from closedloop.serve.session import Client, Clock, Gone, Interface, Port, Session

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


PERIOD = 1e-3
# Lock-step: when a state is sent again, s. The first one is sent twice, since libfranka reads one to see that the
# motion has begun. Then so late that no client that computes meanwhile gets a state which it has answered already.
AGAIN_FIRST, AGAIN, BETWEEN = 2e-3, 0.05, 1e-3
# While commands come, other messages are looked for so often, s.
POLL = 0.01
# After a stop in lock-step the arm brakes until it moves no joint by more than this, rad/s; cycles, at least and at
# most: the filters forget what has stopped it, and the client does not wait for a state for longer than it would.
AT_REST, SHORTEST_BRAKE, LONGEST_BRAKE = 1e-3, 20, 400
# Joint 4 beyond which the elbow is turned over, rad, as the maker states it.
ELBOW_FLIP = -0.467002423653011
# Cycles that the success rate is of.
RATED = 100


class Franka(Interface):
    """The arm's interface and its gripper's."""

    numbers = (wire.ROBOT_PORT, wire.GRIPPER_PORT)

    def prepare(self, host: str) -> None:
        """See `Interface`."""
        problem = self.session.problem
        self._substeps = round(PERIOD / problem.h)
        if self._substeps < 1 or abs(self._substeps * problem.h - PERIOD) > 1e-9:
            raise ScenarioError(f"time.step = {problem.h:g}: must be 0.001, or a whole share of it, for as franka")
        self.arm = Arm(problem.scenario, problem.robot)
        self._udp = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._udp.bind((host, 0))
        except OSError as error:
            raise OutputError(f"cannot send from {host}: {error.strerror or error}; name another --host") from None
        self._udp.setblocking(False)
        self._udp_reader = self._udp.dup()  # the same port, with a timeout
        self._udp_reader.settimeout(AGAIN_FIRST)
        self._polled = 0.0
        self.motion = Generator(self.arm, PERIOD)
        self.springs = Impedance(self.arm, PERIOD)
        self.reflexes = Reflexes(self.arm, PERIOD)
        self.gripper = Gripper(self.session, self.arm.fingers, self._udp)
        self._state = wire.StateMessage()
        self._state.write(
            F_T_NE=self.arm.F_T_NE, F_T_EE=self.arm.F_T_NE, NE_T_EE=self.arm.NE_T_EE, EE_T_K=self.arm.EE_T_K,
            O_ddP_O=(0.0, 0.0, -9.81),
        )  # fmt: skip
        self._message = 0
        self._clock = Clock(PERIOD)
        self._to: tuple[str, int] | None = None
        self._n, self._reads = problem.robot.n, problem.scenario.reads_encoders
        self._torque = np.zeros(JOINTS)  # commanded, without gravity
        self._measured = np.zeros(JOINTS)
        self._errors: set[int] = set()
        self._reasons: set[int] = set()
        self._recent: deque[bool] = deque(maxlen=RATED)
        self._lost = 0
        self._move: tuple[Client, int] | None = None
        self._command: wire.Command | None = None
        self._mode = wire.MODE_IDLE
        self._set_idle()
        self._look()
        self.motion.rest_at(self._q)
        self._advance(self._hold())  # the arm holds itself, and the scenario's law presses no longer

    def close(self) -> None:
        """See `Interface`."""
        super().close()
        if hasattr(self, "_udp"):
            self._udp_reader.close()
            self._udp.close()

    def serve(self) -> None:
        """See `Interface`."""
        arm, hand = self.ports
        while not self.session.done:
            client = arm.client
            if client is None or self._to is None:
                self._wait(None if client is None and hand.client is None else BETWEEN)
            else:
                self._send_state()
                self._cycle()
            if self.gripper.busy and self._move is None and (self.lock_step or self._to is None):
                self._advance(self._hold())
            self.gripper.report(hand)
        self.say("the record is full: the server ends; --time.duration makes it longer")

    def _cycle(self) -> None:
        """Wait until the next state is to be sent, with what happens until then."""
        if not self.lock_step:
            self._real_cycle()
            return
        if self._move is None:
            self._wait(BETWEEN)
            return
        self._wait_for_command(AGAIN_FIRST if self._sent == 1 and not self._begun else AGAIN)
        command = self._command
        self._command = None
        if command is not None and self._move is not None:
            self.session.cycles += 1
            self._drive(command)

    def _real_cycle(self) -> None:
        """A cycle of a millisecond of the wall clock."""
        clock = self._clock
        while True:
            left = clock.left()
            self._wait(left)
            if self._to is None:
                return
            if left == 0.0:
                break
        clock.tick()
        self.session.late = clock.late
        command = self._command
        self._command = None
        if self._move is None:
            self._advance(self._hold())
            return
        self._recent.append(command is not None)
        if command is not None or self.session.cycles > self._cycles_before:  # before the first there is none to lose
            self.session.cycles += 1
            self._lost = 0 if command is not None else self._lost + 1
            self.session.lost += command is None
        if self.limits and self._lost > LOST:
            self._end(wire.MOVE_REFLEX, {wire.COMMUNICATION})
            self._advance(self._hold())
        else:
            self._drive(command)

    def _wait_for_command(self, timeout: float) -> None:
        """Wait for the command of a cycle alone, and look after all others only now and then: they cost time."""
        until = time.perf_counter() + timeout
        while self._command is None and self._move is not None:
            there, now = self._take_command(self._udp_reader), time.perf_counter()
            if not there or now - self._polled > POLL:
                self._polled = now
                self._wait(0.0)
            if now > until:
                return

    def _wait(self, timeout: float | None) -> None:
        """Wait for clients and answer them; a command of this cycle is kept."""
        arm, hand = self.ports
        ready = self.waiting.ready(timeout, (self._udp,))
        while self._udp in ready and self._take_command(self._udp):
            pass
        for port, receive in ((arm, self._receive), (hand, self.gripper.receive)):
            if port.client is not None and port.client in ready:
                try:
                    receive(port.client)
                except Gone as gone:
                    port.drop(str(gone))
        if arm.client is None and self._to is not None:  # what a client that is gone has begun ends
            self._to = None
            if self._move is not None:
                self._set_idle()
                self._stop_here()
        if hand.client is None:
            self.gripper.leave()

    def _take_command(self, udp: socket.socket) -> bool:
        """Read a datagram and keep it if it is a command that answers the present state; return whether there was one.

        The newest command is kept.
        """
        try:
            message, address = udp.recvfrom(2048)
        except OSError:  # there is none, or the client's port is closed
            return False
        if self._to is not None and self._move is not None and address[0] == self._to[0]:
            command = wire.command_of(message)
            if command is not None and command.message >= self._first:
                self._command = command
        return True

    # Commands over TCP

    def _receive(self, client: Client) -> None:
        client.receive()
        for command, number, given in client.requests(wire.HEAD, wire.REQUESTS, "libfranka"):
            if self._to is None and command != wire.CONNECT:
                raise Gone("sent a command before it connected: the connection is closed")
            self._handle(client, command, number, given)

    def _answer(self, client: Client, command: int, number: int, status: int, rest: bytes = b"") -> None:
        client.send(wire.HEAD.pack(command, number, wire.HEAD.size + 1 + len(rest)) + bytes([status]) + rest)

    def _handle(self, client: Client, command: int, number: int, given: tuple[Any, ...]) -> None:
        rest, status = b"", wire.SUCCESS
        if command == wire.CONNECT:
            version, port = given
            fits = version == wire.ROBOT_VERSION
            status, rest = (wire.SUCCESS if fits else wire.INCOMPATIBLE), wire.ROBOT_VERSION.to_bytes(2, "little")
            self._to = (client.host, port) if fits else None
            self._clock.begin()
        elif command == wire.GET_MODEL:
            rest = self.arm.urdf.encode()
        elif command == wire.MOVE:
            self._begin(client, number, given[0], given[1], given[8])
            return
        elif command == wire.STOP_MOVE:
            if self._move is not None:
                self._end(wire.MOVE_PREEMPTED)
        elif command == wire.RECOVER:
            self._errors = set()
            self.reflexes.recover()
            if self._mode == wire.MODE_REFLEX:
                self._mode = wire.MODE_IDLE
        elif self._move is not None:
            status = wire.NOT_POSSIBLE
        elif not self._set(command, np.array(given)):
            status = wire.INVALID_ARGUMENT
        self._answer(client, command, number, status, rest)

    def _set(self, command: int, given: Array) -> bool:
        """Take over a setting, and return whether it can be."""
        if not np.isfinite(given).all():
            return False
        not_negative = (wire.SET_COLLISION, wire.SET_JOINT_IMPEDANCE, wire.SET_CARTESIAN_IMPEDANCE)
        if command in not_negative and (given < 0.0).any():
            return False
        if command == wire.SET_COLLISION:
            self.reflexes.set_thresholds(given)
        elif command == wire.SET_JOINT_IMPEDANCE:
            self.springs.joints = given
        elif command == wire.SET_CARTESIAN_IMPEDANCE:
            self.springs.end_effector = given
        elif command == wire.SET_LOAD:
            try:
                self.arm.set_load(given[0], given[1:4], given[4:])
            except ModelError:
                return False
            mass, centre, tensor = self.arm.load
            self._state.write(m_load=mass, F_x_Cload=centre, I_load=tensor)
        elif command in (wire.SET_NE_TO_EE, wire.SET_EE_TO_K):
            T = wire.pose_of(given)
            R = T[:3, :3]
            if np.abs(R.T @ R - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0.0 or (T[3] != (0, 0, 0, 1)).any():
                return False
            self.arm.set_frames(*((T, self.arm.EE_T_K) if command == wire.SET_NE_TO_EE else (self.arm.NE_T_EE, T)))
            self._state.write(
                F_T_EE=self.arm.F_T_NE @ self.arm.NE_T_EE, NE_T_EE=self.arm.NE_T_EE, EE_T_K=self.arm.EE_T_K
            )
            self.motion.pose = self.arm.end_effector(self.motion.q)[0]
        return True

    def _begin(self, client: Client, number: int, controller: int, generator: int, asynchronous: bool) -> None:
        """Begin a motion, or refuse it."""
        known = controller <= wire.EXTERNAL and generator <= wire.NO_GENERATOR
        if self._mode != wire.MODE_IDLE:
            self._answer(client, wire.MOVE, number, wire.MOVE_NOT_POSSIBLE)
        elif not known or asynchronous or (generator == wire.NO_GENERATOR and controller != wire.EXTERNAL):
            self._answer(client, wire.MOVE, number, wire.MOVE_INVALID)
        else:
            self._answer(client, wire.MOVE, number, wire.MOVE_STARTED)
            self._move = (client, number)
            self._mode, self._generator, self._controller = wire.MODE_MOVE, generator, controller
            self._command = None
            self._first, self._sent = self._message + 1, 0
            self._reasons, self._lost, self._cycles_before = set(), 0, self.session.cycles
            self._recent.clear()
            self._begun = False
            if self.lock_step or self._torque.any():
                self.motion.rest_at(self._q)

    def _end(self, status: int, errors: frozenset[int] | set[int] = frozenset()) -> None:
        """End the motion, and tell the client why; after an error the arm has to be recovered."""
        assert self._move is not None
        client, number = self._move
        stopped = status != wire.SUCCESS
        self._set_idle()
        if errors:
            self._errors, self._reasons, self._mode = set(errors), set(errors), wire.MODE_REFLEX
        try:
            self._answer(client, wire.MOVE, number, status)
        except Gone as gone:
            self.ports[0].drop(str(gone))
        self._stop_here()
        if stopped and self.lock_step:
            for k in range(LONGEST_BRAKE):
                if (k >= SHORTEST_BRAKE and np.abs(self._v).max() < AT_REST) or self.session.done:
                    break
                self._advance(self._hold())

    def _set_idle(self) -> None:
        self._move = self._command = None
        self._mode, self._generator, self._controller = wire.MODE_IDLE, wire.NO_GENERATOR, wire.EXTERNAL
        self._first = self._sent = self._cycles_before = 0
        self._begun = False

    def _stop_here(self) -> None:
        self.motion.rest_at(self._q)
        self._torque = np.zeros(JOINTS)

    # The simulation

    def _hold(self) -> Array:
        return self.springs.at_joints(self._q, self._v, self.motion.q, self.motion.dq)

    def _drive(self, command: wire.Command | None) -> None:
        """Advance by a cycle with a command, or without the one that has not come."""
        motion, generator = self.motion, self._generator
        first, self._begun = not self._begun, True
        before = self._torque
        if command is not None:
            if not command.sensible:
                self._end(wire.MOVE_INPUT_ERROR)
                return
            motion.follow(generator, command)
        else:
            motion.go_on(generator, self._lost > LOST)
        errors: set[int] = set()
        if self.limits and command is not None:
            errors = self.reflexes.of_command(generator, motion, first)
        if self._controller == wire.EXTERNAL:
            if command is not None:
                self._torque = command.torque
            torque = self._torque + self.arm.gravity(self._q)
            if generator == wire.NO_GENERATOR:
                motion.q, motion.dq = self._q, self._v
            errors |= self.reflexes.of_torque(self._torque, before if self.limits and not first else None)
        else:
            if self._controller == wire.JOINT_IMPEDANCE:
                torque = self._hold()
            else:
                T_d = motion.wanted_pose(generator)
                torque = self.springs.at_end_effector(self._q, self._v, motion.q, motion.dq, T_d)
            self._torque = torque - self.arm.gravity(self._q)
        if errors:
            self._end(wire.MOVE_REFLEX, errors)
            return
        self._advance(torque)
        errors = self.reflexes.collided() | self.reflexes.of_state(self._q, self._v, self.limits)
        if errors:
            self._end(wire.MOVE_REFLEX, errors)
        elif command is not None and (command.torque_finished or command.motion_finished):
            self._end(wire.SUCCESS)
        elif self.lock_step:
            self._first, self._sent = self._message + 1, 0

    def _advance(self, torque: Array) -> None:
        """Step the simulation by a millisecond with the torque of the arm, and look at what came of it."""
        for _ in range(self._substeps):
            if self.session.done:
                return
            self.session.step(self.gripper.with_fingers(torque))
        self._look()

    def _look(self) -> None:
        """Take over the state of the simulation."""
        state, n = self.session.state, self._n
        row = state.recorded
        q, v, acceleration, measured = (row[at : at + JOINTS] for at in (0, n, 2 * n, 3 * n))
        if self._reads:
            q, v = state.measured_position[:JOINTS], state.measured_velocity[:JOINTS]
        T, J = self.arm.end_effector(q)
        self.reflexes.update(measured - self.arm.robot.inverse_dynamics(q, v, acceleration), T, J, self.motion)
        self._rate = (measured - self._measured) / PERIOD
        self._q, self._v, self._measured, self._T = q, v, measured, T

    def _send_state(self) -> None:
        """Send the state over UDP, with the next number."""
        motion, reflexes, q = self.motion, self.reflexes, self._q
        moves = self._move is not None
        wanted = (motion.q[2], 1.0 if motion.q[3] > ELBOW_FLIP else -1.0)
        self._state.write(
            O_T_EE=self._T, elbow=(q[2], 1.0 if q[3] > ELBOW_FLIP else -1.0), elbow_d=wanted, tau_J=self._measured,
            tau_J_d=self._torque, dtau_J=self._rate, q=q, q_d=motion.q, dq=self._v, dq_d=motion.dq, theta=q,
            dtheta=self._v, tau_ext_hat_filtered=reflexes.torque, O_F_ext_hat_K=reflexes.wrench,
            K_F_ext_hat_K=reflexes.wrench_in_K,
        )  # fmt: skip
        if not moves or self._generator != wire.NO_GENERATOR:  # else what was wanted last stays
            T_d = motion.wanted_pose(self._generator) if moves else self._T
            self._state.write(
                O_T_EE_d=T_d, O_T_EE_c=T_d, O_dP_EE_d=motion.twist, O_dP_EE_c=motion.twist,
                O_ddP_EE_c=motion.acceleration, elbow_c=wanted, delbow_c=(motion.dq[2], 0.0),
                ddelbow_c=(motion.ddq[2], 0.0), ddq_d=motion.ddq,
            )  # fmt: skip
        if reflexes.watches:
            self._state.write(
                joint_contact=reflexes.contact[:JOINTS], cartesian_contact=reflexes.contact[JOINTS:],
                joint_collision=reflexes.collision[:JOINTS], cartesian_collision=reflexes.collision[JOINTS:],
            )  # fmt: skip
        generator = wire.GENERATOR_IDLE if not moves else _SHOWN[self._generator]
        controller = self._controller if moves else wire.CONTROLLER_OTHER
        rate = 0.0 if not moves else sum(self._recent) / len(self._recent) if self._recent else 1.0
        self._message, self._sent = self._message + 1, self._sent + 1
        message = self._state.bytes(
            self._message, generator, controller, _flags(self._errors), _flags(self._reasons), self._mode, rate
        )
        assert self._to is not None
        with suppress(OSError):  # its buffer is full, or the client's port is closed: TCP will say so
            self._udp.sendto(message, self._to)


# Motion generators of Move as the state shows them.
_SHOWN = {
    wire.JOINT_POSITION: 1, wire.JOINT_VELOCITY: 2, wire.CARTESIAN_POSE: 3, wire.CARTESIAN_VELOCITY: 4,
    wire.NO_GENERATOR: 5,
}  # fmt: skip


def _flags(errors: set[int]) -> bytes:
    return bytes(number in errors for number in range(wire.ERRORS))
