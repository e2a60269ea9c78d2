"""The interface of Universal Robots' arms for data: Real-Time Data Exchange (RTDE), protocol version 2.

Facts from the maker's RTDE guide and client library (Universal_Robots_Client_Library). All is big-endian. A message is
a head, its length with the head and a letter, and a body. A client names the fields it wants to get and to set, and
then gets them at the rate it has requested. docs/ur.md says what is emulated and what is not.
"""

import math
import struct
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.serve.session import Client, Clock, Gone, Interface

PORT, VERSION = 30004, 2
# The controller's version that a client is told: major, minor, bugfix, build.
CONTROLLER = (5, 11, 0, 0)
JOINTS, REGISTERS = 6, 48
# The rate of the newer arms, Hz, and the longest message that is read, bytes.
RATE, LONGEST = 500.0, 2048
HEAD = struct.Struct(">HB")
PROTOCOL, CONTROLLER_VERSION, TEXT, DATA, OUTPUTS, INPUTS, START, PAUSE = map(ord, "VvMUOISP")

TYPES = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d", "VECTOR3D": "3d",
    "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip
_KINDS = {name: letters for letters, names in {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
    "actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0 "
    "standard_analog_output1 tcp_force_scalar payload io_current euromap67_24V_voltage euromap67_24V_current "
    "tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature joint_position_deviation_ratio "
    "collision_detection_ratio",
    "VECTOR3D": "actual_tool_accelerometer elbow_position elbow_velocity payload_cog",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
    "actual_current_window actual_current_as_torque joint_control_output actual_TCP_pose actual_TCP_speed "
    "actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage "
    "ft_raw_wrench payload_inertia tcp_offset",
    "VECTOR6INT32": "joint_mode",
    "INT32": "robot_mode safety_mode safety_status tool_output_voltage time_scale_source",
    "UINT32": "runtime_state robot_status_bits safety_status_bits analog_io_types output_bit_registers0_to_31 "
    "output_bit_registers32_to_63 euromap67_input_bits euromap67_output_bits tool_mode tool_analog_input_types "
    "script_control_line",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
}.items() for name in names.split()}  # fmt: skip
_SETTABLE = {name: kind for kind, names in {
    "UINT32": "speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "UINT8": "standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
    "configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask "
    "standard_analog_output_type tool_output_mode tool_digital_output0_mode tool_digital_output1_mode",
    "VECTOR6D": "external_force_torque",
}.items() for name in names.split()}  # fmt: skip
for _kind, _name in (("INT32", "int"), ("DOUBLE", "double")):
    _SETTABLE |= {f"input_{_name}_register_{k}": _kind for k in range(REGISTERS)}
    _KINDS |= {f"output_{_name}_register_{k}": _kind for k in range(REGISTERS)}
_SETTABLE |= {f"input_bit_register_{k}": "BOOL" for k in range(64, 128)}  # those before are set in words of 32
_KINDS |= {f"{way}put_bit_register_{k}": "BOOL" for way in ("in", "out") for k in range(128)}
GIVEN, SETTABLE = {**_SETTABLE, **_KINDS}, _SETTABLE

# What input_int_register_18 asks for: the scenario's law, torques, or a force.
MODE, LAW, TORQUE, FORCE = "input_int_register_18", 0, 1, 2
# Where their values are: N m; N, base axes.
TORQUES = tuple(f"input_double_register_{k}" for k in range(JOINTS))
FORCES = tuple(f"input_double_register_{k}" for k in range(18, 21))
# With a force the arm is damped in proportion to its inertia, 1/s.
DAMPING = 5.0


class Link:
    """What one client has requested: fields that it gets, in every how many cycles, and fields that it sets."""

    def __init__(self) -> None:
        self.agreed, self.runs, self.every = False, False, 1
        self.outputs: tuple[str, ...] = ()
        self.recipes: list[tuple[tuple[str, ...], struct.Struct]] = []


class Ur(Interface):
    """RTDE over TCP, for several clients at once, in real time."""

    numbers = (PORT,)

    def prepare(self, host: str) -> None:
        """See `Interface`."""
        self._links: dict[Client, Link] = {}
        problem = self.session.problem
        tool = problem.scenario.tool
        self._robot, self._radius = problem.robot, tool.radius
        self._tool = {
            "payload": tool.mass, "payload_cog": tool.centre, "payload_inertia": tool.inertia,
            "tcp_offset": (*tool.offset, 0.0, 0.0, 0.0),
        }  # fmt: skip
        kinds = problem.robot.model.joint_types
        if len(kinds) != JOINTS or any(kind not in ("revolute", "continuous") for kind in kinds):
            raise ScenarioError(
                f"robot.model = {problem.scenario.robot.model!r}: cannot be served as an arm of Universal Robots: it "
                f"must have six joints that turn; it has {', '.join(kinds)}"
            )
        self._substeps = round(1.0 / RATE / problem.h)
        if self._substeps < 1 or abs(self._substeps * problem.h - 1.0 / RATE) > 1e-9:
            raise ScenarioError(f"time.step = {problem.h:g}: must be 0.002, or a whole share of it, for as ur")
        if self.lock_step:
            raise ScenarioError("serve: as ur: has no lock-step, since its clients wait for nothing; leave it out")
        self._set: dict[str, Any] = {}  # fields as they were set last
        self._owners: dict[str, Client] = {}

    def serve(self) -> None:
        """See `Interface`."""
        port, clock, cycle = self.ports[0], Clock(1.0 / RATE), 0
        while not self.session.done:
            left = clock.left() if self._links else None
            ready = self.waiting.ready(left, self._links)
            if (new := port.client) is not None:
                port.client = None
                if not self._links:
                    clock.begin()
                self._links[new] = Link()
            for client in [each for each in self._links if each in ready]:
                self._guarded(client, self._receive)
            if left == 0.0 and self._links:
                clock.tick()
                self.session.late = clock.late
                self._advance()
                cycle += 1
                due = [each for each, link in self._links.items() if link.runs and cycle % link.every == 0]
                values = self._values() if due else {}
                for client in due:
                    kinds = [(values.get(name, 0), GIVEN[name]) for name in self._links[client].outputs]
                    packed = [(TYPES[kind], np.broadcast_to(value, _count(kind)).tolist()) for value, kind in kinds]
                    body = b"\x01" + b"".join(struct.pack(f">{letters}", *numbers) for letters, numbers in packed)
                    self._guarded(client, self._answer, DATA, body)
        self.say("the record is full: the server ends; --time.duration makes it longer")

    def close(self) -> None:
        """See `Interface`."""
        for client in list(self._links):
            self._drop(client, "is left: the server ends")
        super().close()

    def _guarded(self, client: Client, do: Any, *more: Any) -> None:
        try:
            do(client, *more)
        except Gone as gone:
            self._drop(client, str(gone))

    def _drop(self, client: Client, why: str) -> None:
        """Let a client go; what it has set may be set by others, and the scenario's law acts if it chose another."""
        del self._links[client]
        if self._owners.get(MODE) is client:
            self._set[MODE] = LAW
        self._owners = {name: owner for name, owner in self._owners.items() if owner is not client}
        self.ports[0].client = client
        self.ports[0].drop(why)

    def _receive(self, client: Client) -> None:
        client.receive()
        while len(client.received) >= HEAD.size:
            size, kind = HEAD.unpack_from(client.received)
            if not HEAD.size <= size <= LONGEST:
                raise Gone(f"sent a message of {size} bytes, not {HEAD.size} to {LONGEST}: the connection is closed")
            if len(client.received) < size:
                return
            self._handle(client, kind, client.take(size)[HEAD.size :])

    def _handle(self, client: Client, kind: int, body: bytes) -> None:
        link = self._links[client]
        if kind == PROTOCOL and len(body) == 2:
            link.agreed = int.from_bytes(body, "big") == VERSION
            self._answer(client, kind, bytes([link.agreed]))
        elif kind == CONTROLLER_VERSION:
            self._answer(client, kind, struct.pack(">4I", *CONTROLLER))
        elif not link.agreed:
            raise Gone(f"did not ask for version {VERSION} of RTDE: the connection is closed")
        elif kind == OUTPUTS and len(body) >= 8:
            (rate,) = struct.unpack_from(">d", body)
            link.outputs = _names(body[8:])
            link.every = max(1, round(RATE / rate)) if math.isfinite(rate) and rate >= 1.0 else round(RATE)
            known = all(name in GIVEN for name in link.outputs)
            types = [GIVEN.get(name, "NOT_FOUND") for name in link.outputs]
            link.runs = link.runs and known
            self._answer(client, kind, bytes([known]) + ",".join(types).encode())
        elif kind == INPUTS:
            self._answer(client, kind, self._recipe(client, link, _names(body)))
        elif kind in (START, PAUSE):
            link.runs = kind == START and bool(link.outputs) and all(name in GIVEN for name in link.outputs)
            self._answer(client, kind, bytes([link.runs or kind == PAUSE or not link.outputs]))
        elif kind == DATA:
            self._take(link, body)
        elif kind != TEXT:
            raise Gone(f"sent what is no message of RTDE (type {kind}, {len(body)} bytes): the connection is closed")

    def _answer(self, client: Client, kind: int, body: bytes) -> None:
        client.send(HEAD.pack(HEAD.size + len(body), kind) + body)

    def _recipe(self, client: Client, link: Link, names: tuple[str, ...]) -> bytes:
        """Return the answer to a client that wants to set fields: the number of its recipe, 0: none, and the types."""
        types = [
            "IN_USE" if self._owners.get(name, client) is not client else SETTABLE.get(name, "NOT_FOUND")
            for name in names
        ]
        number = 0
        if not {"IN_USE", "NOT_FOUND"} & set(types) and len(link.recipes) < 255:
            link.recipes.append((names, struct.Struct(">" + "".join(TYPES[each] for each in types))))
            self._owners |= dict.fromkeys(names, client)
            number = len(link.recipes)
        return bytes([number]) + ",".join(types).encode()

    def _take(self, link: Link, body: bytes) -> None:
        """Take over fields that a client sets."""
        if not body or not 1 <= body[0] <= len(link.recipes):
            raise Gone("sent values without a recipe for them: the connection is closed")
        names, packed = link.recipes[body[0] - 1]
        if len(body) != 1 + packed.size:
            raise Gone(f"sent {len(body) - 1} bytes of values, not {packed.size}: the connection is closed")
        values = iter(packed.unpack_from(body, 1))
        found = {name: [next(values) for _ in range(_count(SETTABLE[name]))] for name in names}
        if not all(math.isfinite(value) for part in found.values() for value in part):
            raise Gone("sent a number that is not finite: the connection is closed")
        self._set |= found | {name: value[0] for name, value in found.items() if len(value) == 1}

    def _advance(self) -> None:
        session, robot = self.session, self._robot
        mode = self._set.get(MODE, LAW)
        torque: Array | None = None
        if mode in (TORQUE, FORCE):
            q, v, rest = session.state.measured_position, session.state.measured_velocity, np.zeros(JOINTS)
            torque = robot.inverse_dynamics(q, rest, rest)
            given = np.array([self._set.get(name, 0.0) for name in (TORQUES if mode == TORQUE else FORCES)])
            torque += given if mode == TORQUE else robot.position_and_jacobian(q)[1].T @ given
            if mode == FORCE:
                torque -= DAMPING * robot.mass_matrix(q) @ v
            torque = np.clip(torque, -robot.model.effort_limit, robot.model.effort_limit)
        for _ in range(self._substeps):
            if not session.done:
                session.step(torque)
        session.cycles += 1

    def _values(self) -> dict[str, Any]:
        state = self.session.state
        q, v, torque = state.measured_position, state.measured_velocity, state.torque
        T, J = self._robot.tip_frame(q)
        axes, origin = T[:3, :3], T[:3, 3]
        pose = np.concatenate((origin, Rotation.from_matrix(axes).as_rotvec()))
        normal = state.normal
        force = state.f * normal + state.friction_force
        moment = np.cross(-self._radius * normal, force)
        wrench = np.concatenate((force, moment))
        # in the axes of the flange, about its origin, with the weight and the inertia of the tool; of the same sign
        raw = -self._robot.wrist_wrench(*(x[None] for x in (state.q, state.v, state.acceleration, force, moment)))[0]
        mirrored = {name.replace("input", "output", 1): value for name, value in self._set.items()}
        return self._set | mirrored | {
            "timestamp": state.time, "target_q": q, "actual_q": q, "target_qd": v, "actual_qd": v,
            "target_qdd": state.acceleration, "target_moment": torque, "actual_current_as_torque": torque,
            "actual_TCP_pose": pose, "target_TCP_pose": pose, "actual_TCP_speed": J @ v, "target_TCP_speed": J @ v,
            "actual_TCP_force": wrench, "ft_raw_wrench": raw, "tcp_force_scalar": float(np.linalg.norm(force)),
            "speed_scaling": 1.0, "target_speed_fraction": 1.0, **self._tool, **RUNNING,
        }  # fmt: skip


# How the state of an arm is told that runs a program: powered, normal, joints running.
RUNNING = {
    "robot_mode": 7, "safety_mode": 1, "safety_status": 1, "runtime_state": 2, "robot_status_bits": 3,
    "safety_status_bits": 1, "joint_mode": 253,
}  # fmt: skip


def _names(body: bytes) -> tuple[str, ...]:
    """Return the names of fields; clients of users end their list with a comma."""
    listed = body.decode("ascii", "replace").removesuffix(",")
    return tuple(listed.split(",")) if listed else ()


def _count(kind: str) -> int:
    digits = TYPES[kind][:-1]
    return int(digits) if digits else 1
