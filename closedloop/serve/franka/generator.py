"""The motion generator inside the arm of Franka, its controllers, what they know of the arm, and what ends a motion.

What the client commands becomes wanted positions of the joints. A pose or a twist of the end effector becomes a motion
of the joints of least norm, or, with an elbow, the one in which joint 3 is where the elbow says. A command that does
not come is extrapolated with the last acceleration.

The controllers are springs at the joints or at the end effector, with dampers that fit them.

    τ = f + D (q̇_d − q̇) + C        joints: f = K (q_d − q)        end effector: f = Jᵀ K_x e + springs of the rest

K_x e is of the end effector's distance from its wanted pose; along motions that do not move it, weak springs pull to
q_d. The dampers belong to the modes of H and K, H V = 1, K V = H V Λ: D = H V diag(2 ζ √λ) Vᵀ H (A. Albu-Schäffer, C.
Ott, U. Frese, G. Hirzinger, ICRA 2003). The torque is held for a period h: a mode quicker than that allows is as stiff
and as damped as it can be, λ <= 1/h², 2 ζ √λ <= 1/h. No torque is larger than the effort limit of its joint.

What ends a motion are contacts, collisions, and, where asked for, the limits of motions. External torques are what the
model of the controller does not explain, τ_J − (H q̈ + C), so positive where the arm pushes against the environment;
they and the wrench at K that they make are filtered by a low pass of first order.

A client gets the arm of the scenario as a URDF, with the names that libfranka looks for, which builds its own model of
it. It needs seven joints joint1 ... joint7, a link link8 (the flange), and an element with limits of the speed that
depend on the position, which a URDF of another source does not have: those here leave the joint's own limit as it is.
"""

import math
import operator
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
from scipy.linalg import eigh
from scipy.linalg.lapack import dposv
from scipy.spatial.transform import Rotation

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, ScenarioError
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.scenario import Scenario
from closedloop.serve.franka import wire
from closedloop.simulation.prepare import load_model
from robot_models.mechanism import transform
from robot_models.mechanism import turned as rotation_about
from robot_models.model import Tool
from robot_models.urdf import add_inertial, add_joint
from robot_models.xml_text import words

JOINTS = 7
# What stands for a limit that there is none of, and a deceleration, rad/s², that makes the limit of the speed that of
# the joint up to its end.
_NO_LIMIT, _AT_ONCE = 1e3, 1e9


def describe(robot: Robot, flange: str) -> str:
    """Return the URDF of an arm of seven joints; its masses are those of the links and of all that is fixed to them.

    `robot`: the arm.
    `flange`: the frame that is link8.
    """
    model, limits = robot.model.pinocchio_model(), robot.model
    root = ET.Element("robot", name=f"closedloop_{limits.name}")
    ET.SubElement(root, "link", name="link0")
    axes = robot.frame_jacobian(np.zeros(JOINTS))[3:]
    turned = np.eye(3)
    for j in range(JOINTS):
        place, body = model.jointPlacements[j + 1], model.inertias[j + 1]
        turned = turned @ place.rotation
        link = ET.SubElement(root, "link", name=f"link{j + 1}")
        add_inertial(link, body.mass, np.array(body.inertia), body.lever)
        joint = _joint(root, j + 1, "revolute", place.rotation, place.translation)
        ET.SubElement(joint, "axis", xyz=words(turned.T @ axes[:, j]))
        ET.SubElement(
            joint, "limit", lower=_limit(limits.position_lower[j]), upper=_limit(limits.position_upper[j]),
            velocity=_limit(limits.velocity_limit[j]), effort=_limit(limits.effort_limit[j]),
        )  # fmt: skip
        ET.SubElement(joint, "position_based_velocity_limits", velocity_offset="0", deceleration_limit=repr(_AT_ONCE))
    ET.SubElement(root, "link", name="link8")
    place = model.frames[model.getFrameId(flange)].placement
    _joint(root, JOINTS + 1, "fixed", place.rotation, place.translation)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode")


def _joint(root: ET.Element, number: int, kind: str, rotation: Array, translation: Array) -> ET.Element:
    joint = add_joint(root, f"joint{number}", kind, f"link{number - 1}", f"link{number}")
    angles = Rotation.from_matrix(np.array(rotation)).as_euler("xyz")
    ET.SubElement(joint, "origin", xyz=words(translation), rpy=words(angles))
    return joint


def _limit(value: float) -> str:
    return repr(float(value) if math.isfinite(value) else math.copysign(_NO_LIMIT, value))


FLANGE = "link8"
# Below this ratio of the pivots of the Jacobian no wrench is told, as near a singularity.
SINGULAR = 1e-3
_REST = np.zeros(JOINTS)


class Arm:
    """The arm of a scenario as its own controller has it.

    Frames: O the base, F the flange, NE the nominal end effector, here the tip of the scenario, EE the end effector
    that the client sets from there, K the stiffness frame that it sets from EE. Poses are (4, 4).

    `fingers`, int: how many joints the simulated robot has after the arm's seven: those of a hand.
    `urdf`, str: the description for the client.
    `F_T_NE`, `NE_T_EE`, `EE_T_K`, (4, 4) arrays: the frames.
    `load`, tuple: mass, kg, centre of mass (3,), m, in F, and tensor about it, (9,), kg m², that the client has set.
    `robot`, Robot: the arm with its load.
    Raises ScenarioError if the robot has not seven joints that turn, and sliding ones of a hand after them.
    """

    def __init__(self, scenario: Scenario, simulated: Robot) -> None:
        model = simulated.model
        types = model.joint_types
        turning = len(types) >= JOINTS and all(kind in ("revolute", "continuous") for kind in types[:JOINTS])
        if not turning or any(kind != "prismatic" for kind in types[JOINTS:]) or model.loops or len(types) > JOINTS + 2:
            raise ScenarioError(
                f"robot.model = {scenario.robot.model!r}: cannot be served as an arm of Franka: it must have seven "
                f"joints that turn, and at most two that slide, of a hand, after them; it has {', '.join(types)}"
            )
        self.fingers = model.n - JOINTS
        if self.fingers:  # the controller takes them for fixed
            held = dict(model.locked) | dict.fromkeys(model.joint_names[JOINTS:], 0.0)
            section = scenario.robot.model_copy(update={"lock": held})
            model = load_model(scenario.model_copy(update={"robot": section}))
        self._model, self._tip = model, simulated.tip
        self._flange = next((name for name in model.frames if name.endswith(FLANGE)), simulated.tip)
        self.robot = Robot(model, self._tip)
        self.urdf = describe(self.robot, self._flange)
        axes, origin = (part[0] for part in self.robot.frame_poses(self._flange, np.zeros((1, JOINTS))))
        T = self.robot.tip_frame(np.zeros(JOINTS))[0]
        self.F_T_NE = transform(axes.T @ T[:3, :3], axes.T @ (T[:3, 3] - origin))
        self.set_frames(np.eye(4), np.eye(4))
        self.load: tuple[float, Array, Array] = (0.0, np.zeros(3), np.zeros(9))

    def set_frames(self, NE_T_EE: Array, EE_T_K: Array) -> None:
        """Take over the frames of the client."""
        self.NE_T_EE, self.EE_T_K = NE_T_EE, EE_T_K
        self._at_tip, self._at_ee = np.array_equal(NE_T_EE, np.eye(4)), np.array_equal(EE_T_K, np.eye(4))

    def set_load(self, mass: float, centre: Array, tensor: Array) -> None:
        """Take over a load at the flange: it is in the model of the controller, not in the simulation.

        Raises ModelError if no body has such a mass and tensor.
        """
        if not mass >= 0.0:
            raise ModelError(f"a load of {mass} kg: must not be negative")
        Y = tensor.reshape(3, 3)
        load = Tool(
            self._flange, mass=mass, centre=tuple(centre.tolist()),
            inertia=(Y[0, 0], Y[1, 1], Y[2, 2], Y[0, 1], Y[0, 2], Y[1, 2]),
        )  # fmt: skip
        load.tensor()
        tools = (*self._model.tools, load) if mass else self._model.tools
        self.robot = Robot(replace(self._model, tools=tools), self._tip)
        self.load = (mass, centre, tensor)

    def end_effector(self, q: Array) -> tuple[Array, Array]:
        """Return the pose of EE in O (4, 4) and its Jacobian (6, 7), velocity above angular velocity, base axes."""
        T, J = self.robot.tip_frame(q)
        return (T, J) if self._at_tip else (T @ self.NE_T_EE, moved(J, T[:3, :3] @ self.NE_T_EE[:3, 3]))

    def gravity(self, q: Array) -> Array:
        """Return the torque that holds the arm and its load against gravity (7,), N m."""
        return self.robot.inverse_dynamics(q, _REST, _REST)

    def wrench(self, torque: Array, T: Array, J: Array) -> tuple[Array, Array]:
        """Return the wrench at K that a torque (7,) of the joints balances: in base axes, and in the axes of K.

        It is the one of least squares, J_Kᵀ F = τ; zeros near a singular pose. T and J are those of `end_effector`.
        """
        R = T[:3, :3]
        if not self._at_ee:
            J, R = moved(J, R @ self.EE_T_K[:3, 3]), R @ self.EE_T_K[:3, :3]
        factor, F, wrong = dposv(J @ J.T, J @ torque)
        size = factor.diagonal().tolist()
        if wrong or min(size) < SINGULAR * max(size):
            return np.zeros(6), np.zeros(6)
        return F, (F.reshape(2, 3) @ R).ravel()


def moved(J: Array, arm: Array) -> Array:
    """Return the Jacobian (6, n) of a point that lies by `arm` (3,), m, base axes, from that of J."""
    if not arm.any():
        return J
    found = J.copy()
    found[:3] += np.cross(J[3:].T, arm).T
    return found


def turned(axes: Array, wanted: Array) -> Array:
    """Return the rotation from axes to wanted ones, columns (3, 3), as sin(angle) times its axis (3,), base axes."""
    found: Array = 0.5 * np.cross(axes.T, wanted.T).sum(axis=0)
    return found


# Steps of Newton's method for a pose: a cycle moves it by millimetres, and each step squares the error.
NEWTON_STEPS = 3
# Where commands stay away, what is left of the velocity after each cycle.
SLOWER = 0.95
# Singular values of the Jacobian below this share of the largest are no directions in which it moves.
RANK = 1e-4


class Generator:
    """Wanted positions of the joints, and what has been commanded.

    `q`, `dq`, `ddq`, `jerk`, (7,) arrays: wanted positions, rad, and their rates.
    `pose`, (4, 4) array: commanded pose of the end effector; where joints are commanded that of the start, see
        `wanted_pose`.
    `twist`, `acceleration`, `twist_jerk`, (6,) arrays: its velocity, m/s and rad/s, and the rates of that, base axes.
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

    def wanted_pose(self, kind: int) -> Array:
        """Return the pose (4, 4) that is wanted of the end effector: the commanded one, or that of commanded joints."""
        return self._arm.end_effector(self.q)[0] if kind in (wire.JOINT_POSITION, wire.JOINT_VELOCITY) else self.pose

    def follow(self, kind: int, command: wire.Command) -> None:
        """Take over a command for the present cycle."""
        h, q = self._h, self.q
        if kind == wire.JOINT_POSITION:
            self._joints(np.array(command.q), (np.array(command.q) - q) / h)
        elif kind == wire.JOINT_VELOCITY:
            dq = np.array(command.dq)
            self._joints(q + h * dq, dq)
        elif kind == wire.CARTESIAN_POSE:
            before, pose = self.pose, wire.pose_of(command.pose)
            step = np.concatenate((pose[:3, 3] - before[:3, 3], turned(before[:3, :3], pose[:3, :3])))
            self._commanded(step / h)
            self.pose = pose
            self._reach(command.elbow)
        elif kind != wire.NO_GENERATOR:
            self._twisted(np.array(command.twist), command.elbow)

    def go_on(self, kind: int, stop: bool) -> None:
        """Extrapolate with the acceleration as it is, or, where commands stay away for long, come to a stop."""
        if kind in (wire.JOINT_POSITION, wire.JOINT_VELOCITY):
            dq = SLOWER * self.dq if stop else self.dq + self._h * self.ddq
            self._joints(self.q + self._h * dq, dq)
        elif kind != wire.NO_GENERATOR:
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
        if (speed := float(np.linalg.norm(twist[3:]))) > 0.0:
            moved[:3, :3] = rotation_about(twist[3:] / speed, self._h * speed) @ moved[:3, :3]
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
            q += np.linalg.lstsq(J, e, rcond=RANK)[0]
        self._joints(q, (q - self.q) / self._h)


# How far a joint may move, rad, and a stiffness change, as a share, until the modes are found anew.
MOVED = 0.01
# Damping ratio ζ; and the stiffness along motions that do not move the end effector, N m/rad.
DAMPING_RATIO, REST_STIFFNESS = 0.7, 20.0


class Impedance:
    """The springs that the client has set: N m/rad at the joints (7,), N/m and N m/rad at the end effector (6,)."""

    def __init__(self, arm: Arm, period: float) -> None:
        self._arm, self._h = arm, period
        self._modes: tuple[Array, Array, Array, Array] | None = None
        self._most = arm.robot.model.effort_limit
        self.joints = np.array([3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0])
        self.end_effector = np.array([3000.0, 3000.0, 3000.0, 300.0, 300.0, 300.0])

    def at_joints(self, q: Array, v: Array, q_d: Array, dq_d: Array) -> Array:
        """Return the torque (7,), N m, with gravity, of springs at the joints."""
        return self._torque(q, v, dq_d, self.joints * (q_d - q), np.diag(self.joints))

    def at_end_effector(self, q: Array, v: Array, q_d: Array, dq_d: Array, T_d: Array) -> Array:
        """Return the torque (7,), N m, with gravity, of springs between the end effector and T_d (4, 4)."""
        T, J = self._arm.end_effector(q)
        e = np.concatenate((T_d[:3, 3] - T[:3, 3], turned(T[:3, :3], T_d[:3, :3])))
        rest = REST_STIFFNESS * (np.eye(JOINTS) - np.linalg.pinv(J) @ J)
        stiffness = J.T @ (self.end_effector[:, None] * J) + rest
        return self._torque(q, v, dq_d, J.T @ (self.end_effector * e) + rest @ (q_d - q), stiffness)

    def _torque(self, q: Array, v: Array, dq_d: Array, f: Array, K: Array) -> Array:
        at = self._modes
        if at is None or abs(q - at[0]).max() > MOVED or abs(K - at[1]).max() > MOVED * at[1].max():
            H = self._arm.robot.mass_matrix(q)
            squares, V = eigh(K, H)
            squares, P = np.maximum(squares, 0.0), H @ V
            damping = np.minimum(2.0 * DAMPING_RATIO * np.sqrt(squares), 1.0 / self._h)
            softer = 1.0 / np.maximum(1.0, squares * self._h * self._h)
            at = self._modes = q, K, P * softer @ V.T, P * damping @ P.T
        _, _, spring, damper = at
        C = self._arm.robot.inverse_dynamics(q, v, np.zeros(JOINTS))
        found: Array = np.clip(spring @ f + damper @ (dq_d - v) + C, -self._most, self._most)
        return found


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

    `torque`, `wrench`, `wrench_in_K`, arrays (7,), (6,), (6,): external torques, N m, and the wrench at K in base axes
        and in its own, N and N m.
    `contact`, `collision`, arrays (13,): 1 where a torque (7,) or a component of the wrench in K (6,) is above its
        lower threshold, and where it has been above its upper one since the last recovery.
    `watches`, bool: whether the client has set thresholds.
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
        found = {wire.JOINT_REFLEX} if self.collision[:JOINTS].any() else set()
        return found | ({wire.CARTESIAN_REFLEX} if self.collision[JOINTS:].any() else set())

    def of_state(self, q: Array, v: Array, limits: bool) -> set[int]:
        """Return the errors of a joint that runs away or, with limits, that is outside of them or quicker than them."""
        found = set()
        if limits and ((q < self._within[0]).any() or (q > self._within[1]).any()):
            found.add(wire.JOINT_POSITION_LIMITS)
        if beyond(v, self._speed.tolist() if limits else self._runaway):
            found.add(wire.JOINT_VELOCITY_LIMITS)
        return found

    def of_torque(self, torque: Array, before: Array | None) -> set[int]:
        """Return the errors of a commanded torque (7,), N m; of its rate where it came after another."""
        found = set()
        if before is not None and (np.abs(torque - before) > SLACK * TORQUE_RATE * self._h).any():
            found.add(wire.TORQUE_DISCONTINUITY)
        if beyond(torque, self._effort):
            found.add(wire.TORQUE_RANGE)
        return found

    def of_command(self, kind: int, motion: Generator, first: bool) -> set[int]:
        """Return the errors of a command that the generator has followed; the first one must begin where the arm is."""
        if kind in (wire.JOINT_POSITION, wire.JOINT_VELOCITY):
            limits = (
                (wire.JOINT_COMMAND_VELOCITY, motion.dq, self._speed),
                (wire.JOINT_COMMAND_ACCELERATION, motion.ddq, np.full(JOINTS, JOINT_ACCELERATION)),
                (wire.JOINT_COMMAND_JERK, motion.jerk, np.full(JOINTS, JOINT_JERK)),
            )
            found = {error for error, rate, limit in limits if (np.abs(rate) > SLACK * limit).any()}
            if (motion.q < self._within[0]).any() or (motion.q > self._within[1]).any():
                found.add(wire.JOINT_COMMAND_POSITION)
            return {wire.JOINT_START_INVALID} if first and kind == wire.JOINT_POSITION and found else found
        if kind in (wire.CARTESIAN_POSE, wire.CARTESIAN_VELOCITY):
            errors = wire.CARTESIAN_COMMAND_VELOCITY, wire.CARTESIAN_COMMAND_ACCELERATION, wire.CARTESIAN_COMMAND_JERK
            rates = motion.twist, motion.acceleration, motion.twist_jerk
            found = {
                error
                for error, rate, (linear, angular) in zip(errors, rates, CARTESIAN, strict=True)
                if np.linalg.norm(rate[:3]) > SLACK * linear or np.linalg.norm(rate[3:]) > SLACK * angular
            }
            return {wire.CARTESIAN_START_INVALID} if first and kind == wire.CARTESIAN_POSE and found else found
        return set()
