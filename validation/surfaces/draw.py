"""Random cases: shapes, materials and motions take turns, all else is drawn."""

from dataclasses import replace
from typing import Any

import numpy as np

from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.motions.breathing import Breathing
from closedloop.mechanics.surface.motions.conveyor import Conveyor
from closedloop.mechanics.surface.motions.none import NoMotion
from closedloop.mechanics.surface.motions.turntable import Turntable
from validation.oracle import surface as by_hand
from validation.oracle.spatial import Array
from validation.oracle.surface import Shape
from validation.surfaces.cases import (
    FRICTION,
    MATERIALS,
    SHAPES,
    SLIDES,
    SMOOTH,
    STICKS,
    Case,
    Tumble,
    contact_of,
    displacement_of,
    oracle_with_tool,
    shape_of,
)
from validation.tolerances import condition

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
