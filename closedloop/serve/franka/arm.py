"""What the controller inside the arm knows of it: its frames, its terms, and the wrench behind torques.

A client gets the arm of the scenario as a URDF, with the names that libfranka looks for, which builds its own model of
it. It needs seven joints joint1 ... joint7, a link link8 (the flange), and an element with limits of the speed that
depend on the position, which a URDF of another source does not have: those here leave the joint's own limit as it is.
"""

import math
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.spatial.transform import Rotation

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, ScenarioError
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.prepare import load_model
from robot_models.mechanism import transform
from robot_models.tool import Tool

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
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_text(body.lever), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(float(body.mass)))
        tensor = np.array(body.inertia)
        places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ET.SubElement(inertial, "inertia", {name: repr(float(tensor[at])) for name, at in places.items()})
        joint = _joint(root, j + 1, "revolute", place.rotation, place.translation)
        ET.SubElement(joint, "axis", xyz=_text(turned.T @ axes[:, j]))
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
    joint = ET.SubElement(root, "joint", name=f"joint{number}", type=kind)
    ET.SubElement(joint, "parent", link=f"link{number - 1}")
    ET.SubElement(joint, "child", link=f"link{number}")
    angles = Rotation.from_matrix(np.array(rotation)).as_euler("xyz")
    ET.SubElement(joint, "origin", xyz=_text(translation), rpy=_text(angles))
    return joint


def _text(numbers: Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)


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
