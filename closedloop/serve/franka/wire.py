"""The messages of Franka's interface: numbers of commands, modes and errors, and the layout of what is sent.

Facts from the headers research_interface/robot and research_interface/gripper of libfranka-common, robot server version
10 and gripper server version 3. All is little-endian and without padding.
"""

import math
import struct
from typing import Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array

ROBOT_VERSION, GRIPPER_VERSION = 10, 3
ROBOT_PORT, GRIPPER_PORT = 1337, 1338

# The head of a command and of its answer: command, number of the request, length with the head.
HEAD, GRIPPER_HEAD = struct.Struct("<III"), struct.Struct("<HII")

(
    CONNECT, MOVE, STOP_MOVE, SET_COLLISION, SET_JOINT_IMPEDANCE, SET_CARTESIAN_IMPEDANCE, SET_GUIDING, SET_EE_TO_K,
    SET_NE_TO_EE, SET_LOAD, RECOVER, GET_MODEL,
) = range(12)  # fmt: skip

# The bodies of requests.
REQUESTS = {
    CONNECT: struct.Struct("<HH"),
    MOVE: struct.Struct("<II6d?7d"),
    STOP_MOVE: struct.Struct("<"),
    SET_COLLISION: struct.Struct("<52d"),
    SET_JOINT_IMPEDANCE: struct.Struct("<7d"),
    SET_CARTESIAN_IMPEDANCE: struct.Struct("<6d"),
    SET_GUIDING: struct.Struct("<6??"),
    SET_EE_TO_K: struct.Struct("<16d"),
    SET_NE_TO_EE: struct.Struct("<16d"),
    SET_LOAD: struct.Struct("<13d"),
    RECOVER: struct.Struct("<"),
    GET_MODEL: struct.Struct("<"),
}

# Answers: of all commands; of Connect; of setters; of Move.
SUCCESS, NOT_POSSIBLE, INCOMPATIBLE, INVALID_ARGUMENT = 0, 1, 1, 2
(MOVE_STARTED, MOVE_PREEMPTED, MOVE_NOT_POSSIBLE, MOVE_INVALID, MOVE_REFLEX, MOVE_INPUT_ERROR) = 1, 2, 5, 7, 8, 10

# Motion generators and controllers as Move has them, and as the state shows them.
JOINT_POSITION, JOINT_VELOCITY, CARTESIAN_POSE, CARTESIAN_VELOCITY, NO_GENERATOR = range(5)
JOINT_IMPEDANCE, CARTESIAN_IMPEDANCE, EXTERNAL = range(3)
GENERATOR_IDLE, CONTROLLER_OTHER = 0, 3
MODE_IDLE, MODE_MOVE, MODE_REFLEX = 1, 2, 4

# Errors, by their numbers.
ERRORS = 41
JOINT_POSITION_LIMITS, JOINT_VELOCITY_LIMITS, JOINT_REFLEX, CARTESIAN_REFLEX = 0, 3, 6, 7
JOINT_START_INVALID, JOINT_COMMAND_POSITION, JOINT_COMMAND_VELOCITY = 11, 12, 13
JOINT_COMMAND_ACCELERATION, JOINT_COMMAND_JERK = 14, 15
CARTESIAN_START_INVALID, CARTESIAN_COMMAND_VELOCITY, CARTESIAN_COMMAND_ACCELERATION, CARTESIAN_COMMAND_JERK = (
    16, 18, 19, 20,
)  # fmt: skip
COMMUNICATION, TORQUE_DISCONTINUITY, TORQUE_RANGE = 25, 32, 34

# The command of a cycle: q_c, dq_c, O_T_EE_c, O_dP_EE_c, elbow_c, whether the elbow counts, motion finished, tau_J_d,
# torque finished.
_COMMAND = struct.Struct("<Q7d7d16d6d2d??7d?")


# No command has such a norm of its numbers, rad, m, N m and their rates.
HUGE = 1e6


class Command(NamedTuple):
    """What a client commands for a cycle; the pose is column by column, see `pose_of`."""

    message: int
    q: tuple[float, ...]
    dq: tuple[float, ...]
    pose: tuple[float, ...]
    twist: tuple[float, ...]
    elbow: tuple[float, float] | None
    motion_finished: bool
    torque: Array
    torque_finished: bool
    sensible: bool  # whether its numbers are finite, and their norm is smaller than `HUGE`


def command_of(message: bytes) -> Command | None:
    """Return the command in a datagram, None if it has not the length of one."""
    if len(message) != _COMMAND.size:
        return None
    found = _COMMAND.unpack(message)
    sensible = math.hypot(*found[1:39], *found[41:48]) < HUGE
    return Command(
        found[0], found[1:8], found[8:15], found[15:31], found[31:37], (found[37], found[38]) if found[39] else None,
        found[40], np.array(found[41:48]), found[48], sensible,
    )  # fmt: skip


def pose_of(columns: Any) -> Array:
    """Return a pose (4, 4) from its 16 numbers, column by column."""
    return np.array(columns).reshape(4, 4).T


# The numbers of a state, each a 32-bit float, in this order; poses column by column.
STATE: tuple[tuple[str, int], ...] = (
    ("O_T_EE", 16), ("O_T_EE_d", 16), ("F_T_EE", 16), ("EE_T_K", 16), ("F_T_NE", 16), ("NE_T_EE", 16), ("m_ee", 1),
    ("I_ee", 9), ("F_x_Cee", 3), ("m_load", 1), ("I_load", 9), ("F_x_Cload", 3), ("elbow", 2), ("elbow_d", 2),
    ("tau_J", 7), ("tau_J_d", 7), ("dtau_J", 7), ("q", 7), ("q_d", 7), ("dq", 7), ("dq_d", 7), ("ddq_d", 7),
    ("joint_contact", 7), ("cartesian_contact", 6), ("joint_collision", 7), ("cartesian_collision", 6),
    ("tau_ext_hat_filtered", 7), ("O_F_ext_hat_K", 6), ("K_F_ext_hat_K", 6), ("O_dP_EE_d", 6), ("O_ddP_O", 3),
    ("elbow_c", 2), ("delbow_c", 2), ("ddelbow_c", 2), ("O_T_EE_c", 16), ("O_dP_EE_c", 6), ("O_ddP_EE_c", 6),
    ("theta", 7), ("dtheta", 7), ("accelerometer_top", 18), ("accelerometer_bottom", 18),
)  # fmt: skip
_FLOATS = sum(size for _, size in STATE)
# Behind them: motion generator, controller, errors now, errors that ended the last motion, mode, success rate.
_END = struct.Struct(f"<BB{ERRORS}s{ERRORS}sBf")
_ID = struct.Struct("<Q")
_MATRICES = {name for name, size in STATE if size == 16}


class StateMessage:
    """The message with a state: `write` its numbers, then take its `bytes`."""

    def __init__(self) -> None:
        self._buffer = bytearray(_ID.size + 4 * _FLOATS + _END.size)
        numbers = np.frombuffer(self._buffer, "<f4", _FLOATS, _ID.size)
        self._parts: dict[str, Any] = {}
        at = 0
        for name, size in STATE:
            part = numbers[at : at + size]
            self._parts[name] = part.reshape(4, 4).T if name in _MATRICES else part
            at += size

    def write(self, **values: Any) -> None:
        """Write numbers by their names; a pose as (4, 4)."""
        for name, value in values.items():
            self._parts[name][...] = value

    def bytes(
        self, message: int, generator: int, controller: int, errors: bytes, reasons: bytes, mode: int, rate: float
    ) -> bytearray:
        """Return the message with this number, modes, errors and success rate; it stays until the next one."""
        _ID.pack_into(self._buffer, 0, message)
        _END.pack_into(self._buffer, _ID.size + 4 * _FLOATS, generator, controller, errors, reasons, mode, rate)
        return self._buffer


GRIPPER_CONNECT, GRIPPER_HOMING, GRIPPER_GRASP, GRIPPER_MOVE, GRIPPER_STOP = range(5)
# Grasp: width, m, tolerances inwards and outwards, m, speed, m/s, force, N. Move: width, speed.
GRIPPER_REQUESTS = {
    GRIPPER_CONNECT: struct.Struct("<HH"),
    GRIPPER_HOMING: struct.Struct("<"),
    GRIPPER_GRASP: struct.Struct("<5d"),
    GRIPPER_MOVE: struct.Struct("<2d"),
    GRIPPER_STOP: struct.Struct("<"),
}
GRIPPER_SUCCESS, GRIPPER_FAIL, GRIPPER_UNSUCCESSFUL, GRIPPER_ABORTED = range(4)
# Number of the message, width, largest width, whether something is grasped, temperature.
GRIPPER_STATE = struct.Struct("<Idd?H")
