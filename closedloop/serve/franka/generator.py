"""The motion generator inside the arm: what the client commands becomes wanted positions of the joints.

A pose or a twist of the end effector becomes a motion of the joints of least norm, or, with an elbow, the one in which
joint 3 is where the elbow says. A command that does not come is extrapolated with the last acceleration.
"""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.serve.franka.arm import Arm, turned
from closedloop.serve.franka.description import JOINTS
from closedloop.serve.franka.wire import CARTESIAN_POSE, JOINT_POSITION, JOINT_VELOCITY, NO_GENERATOR, Command

# Steps of Newton's method for a pose: a cycle moves it by millimetres, and each step squares the error.
NEWTON_STEPS = 3
# Where commands stay away, what is left of the velocity after each cycle.
SLOWER = 0.95
# Singular values of the Jacobian below this share of the largest are no directions in which it moves.
SINGULAR = 1e-4


class Generator:
    """Wanted positions of the joints, and what has been commanded.

    Attributes
    ----------
    q, dq, ddq, jerk : (7,) arrays
        Wanted positions, rad, and their rates.
    pose : (4, 4) array
        Commanded pose of the end effector; where joints are commanded, the pose that they give.
    twist, acceleration, twist_jerk : (6,) arrays
        Its velocity, m/s and rad/s, and the rates of that, base axes.
    """

    def __init__(self, arm: Arm, period: float) -> None:
        self._arm, self._h = arm, period
        self._quickest = 2.0 * arm.robot.model.velocity_limit
        self.rest_at(np.zeros(JOINTS))

    def rest_at(self, q: Array) -> None:
        """Want the arm to stay at q."""
        self.q = q.copy()
        self.dq, self.ddq, self.jerk = np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS)
        self.pose = self._arm.end_effector(q)[0]
        self.twist, self.acceleration, self.twist_jerk = np.zeros(6), np.zeros(6), np.zeros(6)

    def follow(self, kind: int, command: Command) -> None:
        """Take over a command for the present cycle."""
        h, q = self._h, self.q
        if kind == JOINT_POSITION:
            self._joints(np.array(command.q), (np.array(command.q) - q) / h)
        elif kind == JOINT_VELOCITY:
            dq = np.array(command.dq)
            self._joints(q + h * dq, dq)
        elif kind == CARTESIAN_POSE:
            before = self.pose
            step = np.concatenate((command.pose[:3, 3] - before[:3, 3], turned(before[:3, :3], command.pose[:3, :3])))
            self._commanded(step / h)
            self.pose = command.pose
            self._reach(command.elbow)
        elif kind != NO_GENERATOR:
            self._twisted(np.array(command.twist), command.elbow)

    def go_on(self, kind: int, stop: bool) -> None:
        """Extrapolate with the acceleration as it is, or, where commands stay away for long, come to a stop."""
        if kind in (JOINT_POSITION, JOINT_VELOCITY):
            dq = SLOWER * self.dq if stop else self.dq + self._h * self.ddq
            self._joints(self.q + self._h * dq, dq)
        elif kind != NO_GENERATOR:
            self._twisted(SLOWER * self.twist if stop else self.twist + self._h * self.acceleration, None)

    def _joints(self, q: Array, dq: Array) -> None:
        """Want the joints at q; the speed of that is at most twice the limit of theirs."""
        dq = np.clip(dq, -self._quickest, self._quickest)
        ddq = (dq - self.dq) / self._h
        self.jerk = (ddq - self.ddq) / self._h
        self.q, self.dq, self.ddq = q, dq, ddq

    def _commanded(self, twist: Array) -> None:
        acceleration = (twist - self.twist) / self._h
        self.twist_jerk = (acceleration - self.acceleration) / self._h
        self.twist, self.acceleration = twist, acceleration

    def _twisted(self, twist: Array, elbow: tuple[float, float] | None) -> None:
        """Move the commanded pose with a twist for a period."""
        self._commanded(twist)
        moved = self.pose.copy()
        moved[:3, 3] += self._h * twist[:3]
        moved[:3, :3] = _rotation(self._h * twist[3:]) @ moved[:3, :3]
        self.pose = moved
        self._reach(elbow)

    def _reach(self, elbow: tuple[float, float] | None) -> None:
        """Move the joints to where the end effector has the commanded pose."""
        q = self.q.copy()
        for _ in range(NEWTON_STEPS):
            T, J = self._arm.end_effector(q)
            e = np.concatenate((self.pose[:3, 3] - T[:3, 3], turned(T[:3, :3], self.pose[:3, :3])))
            if elbow is not None:
                J, e = np.vstack((J, np.eye(JOINTS)[2])), np.append(e, elbow[0] - q[2])
            q += np.linalg.lstsq(J, e, rcond=SINGULAR)[0]
        self._joints(q, (q - self.q) / self._h)


def _rotation(vector: Array) -> Array:
    """Return the rotation (3, 3) about a vector by its length, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + W
    found: Array = np.eye(3) + np.sin(angle) / angle * W + (1.0 - np.cos(angle)) / (angle * angle) * W @ W
    return found
