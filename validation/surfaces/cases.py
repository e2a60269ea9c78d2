"""Random states on random surfaces: the shape, its motion, what it is made of, the tool, and a torque.

Random cases: shapes, materials and motions take turns, all else is drawn.
"""

import json
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.motions.breathing import Breathing
from closedloop.mechanics.surface.motions.conveyor import Conveyor
from closedloop.mechanics.surface.motions.none import NoMotion
from closedloop.mechanics.surface.motions.turntable import Turntable
from validation.engines.interface import condition
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


# How far the tip is off the surface, and from the surface's origin along it, m.
OFF, ALONG = 0.002, 0.08
# A contact is compared at states where Eq. 24 magnifies rounding by no more than this.
WORST_CONDITION = 1e4


def draw_motion(rng: np.random.Generator, r: Array, which: int) -> SurfaceMotion:
    """Draw a motion that passes by a point r (3,), m."""
    near = r + rng.normal(scale=0.3, size=3)
    match which % 5:
        case 0:
            return NoMotion()
        case 1:
            return Breathing(direction=tuple(rng.normal(size=3)), amplitude=0.05, frequency=1.5)
        case 2:
            return Turntable(axis=tuple(rng.normal(size=3)), centre=tuple(near), speed=1.5)
        case 3:
            return Conveyor(velocity=tuple(rng.normal(scale=0.3, size=3)))
        case _:
            turn, shift = rng.normal(size=3), rng.normal(scale=0.2, size=3)
            return Tumble(axis=tuple(_unit(rng)), centre=tuple(near), turn=tuple(turn), shift=tuple(shift))


def draw_case(name: str, robot: Any, tip: str, seed: int, index: int) -> Case:
    """Draw case number `index` of `seed`: shapes, materials and motions take turns, all else is random.

    A pose in which the tip is nearly held by the arm itself is drawn again.
    """
    for attempt in range(100):
        made = _draw(name, robot, tip, np.random.default_rng([seed, index, attempt]), index)
        if well_posed(made):
            break
    return made


def _draw(name: str, robot: Any, tip: str, rng: np.random.Generator, index: int) -> Case:
    shapes, materials = list(SHAPES), list(MATERIALS)
    tool = _draw_tool(rng) if index % 3 == 2 and robot.format == "urdf" else {}
    n = len(robot.joint_names)
    low = np.where(np.isfinite(robot.position_lower), robot.position_lower, -np.pi)
    q = rng.uniform(low, np.where(np.isfinite(robot.position_upper), robot.position_upper, np.pi))
    oracle = oracle_with_tool(robot, tip, tool)
    r, normal = oracle.position(q), _unit(rng)
    material = materials[(index + index // len(shapes)) % len(materials)]
    U, sizes, _ = np.linalg.svd(oracle.jacobian(q))
    movable = U[:, : int(np.sum(sizes > 1e-9 * sizes[0]))]
    if movable.shape[1] < 3:  # a planar arm: the surface is in its way, and friction is not asked to hold it sideways
        material = SMOOTH if material == STICKS else material
        normal = movable @ (movable.T @ normal)
        normal /= np.linalg.norm(normal)
    shape = shapes[index % len(shapes)]
    section = SHAPES[shape] | {"normal": tuple(normal)}
    if shape == "cylinder":
        angle = rng.uniform(0.0, np.pi)
        section["axis"] = tuple(by_hand.frame_of(normal)[1:].T @ [np.cos(angle), np.sin(angle)])
    moving, t = draw_motion(rng, r, index), float(rng.uniform(0.0, 0.2))
    made = Case(
        name, index, robot, tip, tool, shape, section, material, moving, t, np.zeros(3), np.zeros(3), q,
        rng.normal(size=n), rng.normal(scale=20.0, size=n),
    )  # fmt: skip
    at, moved = _on_surface(shape_of(made), rng), displacement_of(moving, t)
    turn = moved.rotation
    there = r - turn @ made.axes.T @ at
    origin = moved.centre + turn.T @ (there - moved.centre - moved.shift[0])
    return replace(made, origin=origin, anchor=at + 0.5 * OFF * rng.normal(size=3))


def well_posed(case: Case) -> bool:
    """Whether Eq. 24 magnifies rounding by no more than `WORST_CONDITION`, and friction does not jam (Painlevé)."""
    contact = contact_of(case)
    H, A = contact.oracle.mass_matrix(case.q), contact.touch(case.q, case.v).A
    S = A @ np.linalg.solve(H, A.T)
    jams = case.material == SLIDES and S[0, 0] < 2.0 * FRICTION * float(np.hypot(S[0, 1], S[0, 2]))
    return not jams and condition(H, A if case.sticks else A[:1]) < WORST_CONDITION


def _on_surface(shape: Shape, rng: np.random.Generator) -> Array:
    """Draw a point near the surface, in its axes: off it by `OFF` or so, on either side."""
    p = np.array([*(ALONG * rng.uniform(-1.0, 1.0, 2)), 0.0])
    for _ in range(50):
        p[2] -= float(np.real(shape.level(p))) / shape.gradient(p)[2]
    return np.asarray(p + OFF * rng.normal() * shape.gradient(p))


def _draw_tool(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a tool of some ten centimetres."""
    thick = rng.uniform(1e-3, 2e-3, 3)
    return {
        "offset": rng.uniform(-0.1, 0.1, 3).tolist(), "mass": float(rng.uniform(0.2, 1.0)),
        "centre": rng.uniform(-0.05, 0.05, 3).tolist(), "inertia": [*thick.tolist(), 1e-4, -1e-4, 2e-4],
    }  # fmt: skip


def _unit(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))
