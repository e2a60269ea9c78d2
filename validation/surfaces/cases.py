"""Random states on random surfaces: the shape, its motion, what it is made of, the tool, and a torque."""

import json
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from closedloop.mechanics.surface.motion import SurfaceMotion
from validation.oracle import Oracle
from validation.oracle import surface as by_hand
from validation.oracle.closure import stabiliser_gains
from validation.oracle.spatial import Array
from validation.oracle.surface import Displacement, Shape, SurfaceContact

# A stabiliser whose answer to the closure error is of the size of everything else.
GAINS = stabiliser_gains(0.7, 0.05)
# Coulomb's μ of a tip that slides, and of one that sticks whatever acts on it.
FRICTION, GLUE = 0.3, 1e3

GRID = np.round(0.02 * np.sin(np.add.outer(np.arange(7) * 1.1, np.arange(8) * 0.8)), 4)
SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"kind": "plane"},
    "sphere": {"kind": "sphere", "radius": 0.4},
    "bowl": {"kind": "sphere", "radius": 0.5, "inside": True},
    "cylinder": {"kind": "cylinder", "radius": 0.3},
    "ellipsoid": {"kind": "ellipsoid", "a": 0.5, "b": 0.35, "c": 0.3},
    "height field": {"kind": "height_field", "heights": tuple(map(tuple, GRID.tolist())), "spacing": 0.08},
}
SMOOTH, SLIDES, STICKS = "rigid", "rigid, slides", "rigid, sticks"
SOFT, SOFT_SLIDES = "Kelvin–Voigt", "Hunt–Crossley, slides"
MATERIALS: dict[str, dict[str, Any]] = {
    SMOOTH: {},
    SLIDES: {"friction": {"kind": "coulomb", "coefficient": FRICTION}},
    STICKS: {"friction": {"kind": "coulomb", "coefficient": GLUE}},
    SOFT: {"compliance": {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 150.0}},
    SOFT_SLIDES: {
        "compliance": {"kind": "hunt_crossley", "stiffness": 5e5, "exponent": 1.5, "dissipation": 2.0},
        "friction": {"kind": "coulomb", "coefficient": FRICTION},
    },
}


class Tumble(SurfaceMotion):
    """Turning and shifting at once, neither at a constant rate."""

    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @staticmethod
    def move(t: float, par: Any, m: Any) -> None:
        """Write an angle that is a cubic in t, and a shift that is t + t² along a direction."""
        m.angle = par.turn[0] * t + par.turn[1] * t * t + par.turn[2] * t * t * t
        m.rate = par.turn[0] + 2.0 * par.turn[1] * t + 3.0 * par.turn[2] * t * t
        m.acceleration = 2.0 * par.turn[1] + 6.0 * par.turn[2] * t
        for i in range(3):
            m.axis[i], m.centre[i] = par.axis[i], par.centre[i]
            m.shift[i] = par.shift[i] * (t + t * t)
            m.shift_rate[i] = par.shift[i] * (1.0 + 2.0 * t)
            m.shift_acceleration[i] = 2.0 * par.shift[i]


@dataclass(frozen=True)
class Case:
    """One state on one surface.

    name, index: of the robot, and the case's number within its seed
    robot, tip, tool: the robot without its tool, the frame that carries it or touches, and [tool] of the scenario,
        empty for none
    shape, section: which of `SHAPES`, and [surface] of the scenario
    material: which of `MATERIALS`
    moving, t: the motion of the surface, and the instant, s
    origin: (3,), of the surface at t = 0, m, base frame
    anchor: (3,), where a tip that sticks is held, m, axes of the surface
    q, v, torque: (n,)
    """

    name: str
    index: int
    robot: Any
    tip: str
    tool: dict[str, Any]
    shape: str
    section: dict[str, Any]
    material: str
    moving: SurfaceMotion
    t: float
    origin: Array
    anchor: Array
    q: Array
    v: Array
    torque: Array

    @property
    def sticks(self) -> bool:
        """Whether the tip sticks."""
        return self.material == STICKS

    @property
    def axes(self) -> Array:
        """Axes of the surface at t = 0, rows x, y, z (3, 3), base frame."""
        return by_hand.frame_of(np.asarray(self.section["normal"]))[[1, 2, 0]]

    def __str__(self) -> str:
        motion = {"none": "at rest"}.get(self.moving.kind, self.moving.kind.rpartition(":")[2].lower())
        return f"{self.name}, case {self.index}: {self.shape}, {motion}, {self.material}"


def oracle_with_tool(robot: Any, tip: str, tool: dict[str, Any]) -> Oracle:
    """Return the oracle of a robot with a tool, written into the robot's text as one more link."""
    return _oracle(robot, tip, json.dumps(tool))


@lru_cache(maxsize=8)
def _oracle(robot: Any, tip: str, told: str) -> Oracle:
    tool = json.loads(told)
    if not tool:
        return Oracle.from_model(robot, tip)
    root = ET.fromstring(robot.text)
    link = ET.SubElement(root, "link", name="mounted_tool")
    body = ET.SubElement(link, "inertial")
    # [tool] has its centre of mass in the frame that carries it, a link in its own, which is at the tool's tip.
    ET.SubElement(body, "origin", xyz=_words(np.subtract(tool["centre"], tool["offset"])), rpy="0 0 0")
    ET.SubElement(body, "mass", value=repr(tool["mass"]))
    entries = zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), tool["inertia"], strict=True)
    ET.SubElement(body, "inertia", {key: repr(value) for key, value in entries})
    joint = ET.SubElement(root, "joint", name="mounted_tool_joint", type="fixed")
    ET.SubElement(joint, "parent", link=tip)
    ET.SubElement(joint, "child", link="mounted_tool")
    ET.SubElement(joint, "origin", xyz=_words(np.array(tool["offset"])), rpy="0 0 0")
    kept = {name: getattr(robot, name) for name in ("format", "joint_names", "armature", "locked", "gravity")}
    text = ET.tostring(root, encoding="unicode")
    return Oracle.from_model(SimpleNamespace(**kept, text=text, tip="mounted_tool"), "mounted_tool")


def _words(numbers: Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def shape_of(case: Case) -> Shape:
    """Return the shape of a case, by hand."""
    par = case.section
    match par["kind"]:
        case "plane":
            return by_hand.plane()
        case "sphere":
            return by_hand.round_body(par["radius"], par.get("inside", False))
        case "cylinder":
            return by_hand.round_body(par["radius"], axis=case.axes @ np.asarray(par["axis"]))
        case "ellipsoid":
            return by_hand.ellipsoid(par["a"], par["b"], par["c"])
        case _:
            return by_hand.height_field(np.array(par["heights"]), par["spacing"])


def displacement_of(moving: Any, t: float) -> Displacement:
    """Return a surface's displacement at t, s, by hand."""
    still, up = np.zeros(3), np.array([0.0, 0.0, 1.0])
    if isinstance(moving, Tumble):
        powers = np.array([[t, t * t, t**3], [1.0, 2 * t, 3 * t * t], [0.0, 2.0, 6 * t]])
        along = np.array([t + t * t, 1.0 + 2.0 * t, 2.0])
        shift = np.outer(along, moving.shift)
        return Displacement(powers @ moving.turn, np.array(moving.axis), np.array(moving.centre), shift)
    match moving.kind:
        case "turntable":
            axis = np.array(moving.axis) / np.linalg.norm(moving.axis)
            return Displacement(moving.speed * np.array([t, 1.0, 0.0]), axis, np.array(moving.centre), np.zeros((3, 3)))
        case "conveyor":
            return Displacement(still, up, still, np.outer([t, 1.0, 0.0], moving.velocity))
        case "breathing":
            w = 2.0 * np.pi * moving.frequency
            going = np.array([1.0 - np.cos(w * t), w * np.sin(w * t), w * w * np.cos(w * t)])
            direction = np.array(moving.direction) / np.linalg.norm(moving.direction)
            return Displacement(still, up, still, np.outer(moving.amplitude / 2 * going, direction))
        case _:
            return Displacement(still, up, still, np.zeros((3, 3)))


def push_of(case: Case) -> Any:
    """Return f, N, of depth, m, and its rate, m/s, by hand; None of a rigid surface."""
    par = MATERIALS[case.material].get("compliance")
    if par is None:
        return None
    k = par["stiffness"]
    if par["kind"] == "kelvin_voigt":
        return lambda depth, speed: k * depth + par["damping"] * speed
    return lambda depth, speed: k * abs(depth) ** par["exponent"] * (np.sign(depth) + par["dissipation"] * speed)


def contact_of(case: Case) -> SurfaceContact:
    """Return a case as the oracle solves it."""
    return SurfaceContact(
        oracle_with_tool(case.robot, case.tip, case.tool), shape_of(case), case.origin, case.axes,
        displacement_of(case.moving, case.t), GAINS, push_of(case),
        FRICTION if case.material in (SLIDES, SOFT_SLIDES) else 0.0,
    )  # fmt: skip
