"""External torques, and what ends a motion: contacts, collisions, and, where asked for, the limits of motions.

External torques are what the model of the controller does not explain, τ_J − (H q̈ + C), so positive where the arm
pushes against the environment; they and the wrench at K that they make are filtered by a low pass of first order.
"""

from __future__ import annotations

import math
import operator

import numpy as np

from closedloop.base.arrays import Array
from closedloop.serve.franka.arm import Arm
from closedloop.serve.franka.description import JOINTS
from closedloop.serve.franka.generator import Generator
from closedloop.serve.franka.wire import (
    CARTESIAN_COMMAND_ACCELERATION,
    CARTESIAN_COMMAND_JERK,
    CARTESIAN_COMMAND_VELOCITY,
    CARTESIAN_POSE,
    CARTESIAN_REFLEX,
    CARTESIAN_START_INVALID,
    CARTESIAN_VELOCITY,
    JOINT_COMMAND_ACCELERATION,
    JOINT_COMMAND_JERK,
    JOINT_COMMAND_POSITION,
    JOINT_COMMAND_VELOCITY,
    JOINT_POSITION,
    JOINT_POSITION_LIMITS,
    JOINT_REFLEX,
    JOINT_START_INVALID,
    JOINT_VELOCITY,
    JOINT_VELOCITY_LIMITS,
    TORQUE_DISCONTINUITY,
    TORQUE_RANGE,
)

# Cut-off frequency of the external torques, Hz: the default of libfranka for commands. The arm's is not published.
CUTOFF = 100.0
# Limits that the maker states for the FR3: of joints, rad/s², rad/s³; of the rate of a torque, N m/s; of the end
# effector, m/s and rad/s, m/s² and rad/s², m/s³ and rad/s³.
JOINT_ACCELERATION, JOINT_JERK, TORQUE_RATE = 10.0, 5000.0, 1000.0
CARTESIAN = ((3.0, 2.5), (9.0, 17.0), (4500.0, 8500.0))
# What a limit may be exceeded by: states are 32-bit floats, whose rounding of 1e-7 is 0.1 in a second difference.
SLACK = 1.05
# Without limits a motion ends where a joint is so many times as quick as its limit.
RUNAWAY = 2.0
# Commands that may be lost one after the other.
LOST = 20


def beyond(values: Array, limits: list[float]) -> bool:
    """Return whether a value is larger than its limit, up or down: of so few, quicker than with arrays."""
    return any(map(operator.gt, map(abs, values.tolist()), limits))


class Reflexes:
    """The filtered external torques and wrench, and what they have set off.

    Attributes
    ----------
    torque, wrench, wrench_in_K : arrays (7,), (6,), (6,)
        External torques, N m, and the wrench at K in base axes and in its own, N and N m.
    contact, collision : arrays (13,)
        1 where a torque (7,) or a component of the wrench in K (6,) is above its lower threshold, and where it has been
        above its upper one since the last recovery.
    watches : bool
        Whether the client has set thresholds.
    """

    def __init__(self, arm: Arm, period: float) -> None:
        self._arm, self._h = arm, period
        self._share = -math.expm1(-2.0 * math.pi * CUTOFF * period)
        self._lower, self._upper, self.watches = np.full((2, 13), math.inf), np.full((2, 13), math.inf), False
        self.torque, self.wrench, self.wrench_in_K = np.zeros(JOINTS), np.zeros(6), np.zeros(6)
        self.contact, self.collision, self._collided = np.zeros(13), np.zeros(13), False
        model = arm.robot.model
        self._within = model.position_lower, model.position_upper
        self._speed, self._effort = model.velocity_limit, model.effort_limit.tolist()
        self._runaway = (RUNAWAY * self._speed).tolist()

    def set_thresholds(self, given: Array) -> None:
        """Take over the (52,) thresholds of a client: of torques, then of forces, each as lower and upper ones while
        the motion accelerates, and lower and upper ones otherwise.
        """
        torques, forces = given[:28].reshape(4, 7), given[28:].reshape(4, 6)
        both = np.hstack((torques, forces))
        self._lower, self._upper, self.watches = both[[0, 2]], both[[1, 3]], True

    def update(self, torque: Array, T: Array, J: Array, motion: Generator) -> None:
        """Take an external torque (7,) into the filter; T and J are those of `Arm.end_effector`."""
        self.torque += self._share * (torque - self.torque)
        self.wrench, self.wrench_in_K = self._arm.wrench(self.torque, T, J)
        if not self.watches:
            return
        values = np.abs(np.concatenate((self.torque, self.wrench_in_K)))
        which = 0 if any(motion.ddq.tolist()) else 1
        self.contact = (values > self._lower[which]).astype(float)
        if beyond(values, self._upper[which].tolist()):
            self.collision = np.maximum(self.collision, values > self._upper[which])
            self._collided = True

    def recover(self) -> None:
        """Forget collisions."""
        self.collision, self._collided = np.zeros(13), False

    def collided(self) -> set[int]:
        """Return the errors of collisions."""
        if not self._collided:
            return set()
        found = {JOINT_REFLEX} if self.collision[:JOINTS].any() else set()
        return found | ({CARTESIAN_REFLEX} if self.collision[JOINTS:].any() else set())

    def of_state(self, q: Array, v: Array, limits: bool) -> set[int]:
        """Return the errors of a joint that runs away or, with limits, that is outside of them or quicker than them."""
        found = set()
        if limits and ((q < self._within[0]).any() or (q > self._within[1]).any()):
            found.add(JOINT_POSITION_LIMITS)
        if beyond(v, self._speed.tolist() if limits else self._runaway):
            found.add(JOINT_VELOCITY_LIMITS)
        return found

    def of_torque(self, torque: Array, before: Array | None) -> set[int]:
        """Return the errors of a commanded torque (7,), N m; of its rate where it came after another."""
        found = set()
        if before is not None and (np.abs(torque - before) > SLACK * TORQUE_RATE * self._h).any():
            found.add(TORQUE_DISCONTINUITY)
        if beyond(torque, self._effort):
            found.add(TORQUE_RANGE)
        return found

    def of_command(self, kind: int, motion: Generator, first: bool) -> set[int]:
        """Return the errors of a command that the generator has followed; the first one must begin where the arm is."""
        if kind in (JOINT_POSITION, JOINT_VELOCITY):
            limits = (
                (JOINT_COMMAND_VELOCITY, motion.dq, self._speed),
                (JOINT_COMMAND_ACCELERATION, motion.ddq, np.full(JOINTS, JOINT_ACCELERATION)),
                (JOINT_COMMAND_JERK, motion.jerk, np.full(JOINTS, JOINT_JERK)),
            )
            found = {error for error, rate, limit in limits if (np.abs(rate) > SLACK * limit).any()}
            if (motion.q < self._within[0]).any() or (motion.q > self._within[1]).any():
                found.add(JOINT_COMMAND_POSITION)
            return {JOINT_START_INVALID} if first and kind == JOINT_POSITION and found else found
        if kind in (CARTESIAN_POSE, CARTESIAN_VELOCITY):
            errors = CARTESIAN_COMMAND_VELOCITY, CARTESIAN_COMMAND_ACCELERATION, CARTESIAN_COMMAND_JERK
            rates = motion.twist, motion.acceleration, motion.twist_jerk
            found = {
                error
                for error, rate, (linear, angular) in zip(errors, rates, CARTESIAN, strict=True)
                if np.linalg.norm(rate[:3]) > SLACK * linear or np.linalg.norm(rate[3:]) > SLACK * angular
            }
            return {CARTESIAN_START_INVALID} if first and kind == CARTESIAN_POSE and found else found
        return set()
