"""A face of a link that presses with its area: `at` of a [[contact]] as points of a soft pad, each with its share.

    at = { disc = 0.03, rings = 3 }                    a disc of 30 mm, of 1 + 6 + 12 + 18 points
    at = { rectangle = [0.04, 0.02], points = [5, 3] } of the sides 40 and 20 mm

The pad is an elastic foundation (Winkler's): what it gives at one place does not depend on the others. So the pressure
at a place is the depth there times the stiffness of an area, k/A, and a point stands for a cell of the area A/n with
k/n and d/n. All cells are equally large, and the points of a face pressed whole have its area's exact second moments.
So its force and the moment of a tilt are exact; where a part of the face is clear of the surface, the error is that of
cells which are cut by the edge of what presses.

K. L. Johnson, Contact Mechanics, 1985, Sec. 4.3 (the elastic foundation).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.mechanics.surface.compliances.hunt_crossley import HuntCrossley
from closedloop.mechanics.surface.compliances.kelvin_voigt import KelvinVoigt
from closedloop.mechanics.surface.placed import contact_frame, unit

# Kinds of compliance whose force is shared by points, and the parameters that are.
SHARED: dict[str, tuple[type[Any], tuple[str, ...]]] = {
    "kelvin_voigt": (KelvinVoigt, ("stiffness", "damping")), "hunt_crossley": (HuntCrossley, ("stiffness",)),
}  # fmt: skip
RINGS, MOST_POINTS = 3, 400
FORMS = "{ disc = radius, rings = 3 } or { rectangle = [length, width], points = [5, 3] }, with centre and normal"


def disc(radius: float, rings: int) -> Array:
    """Return points (n, 2), m, of a disc: one in the middle and 6, 12, 18 ... around it, n = 1 + 3 k (k + 1)."""
    found = [np.zeros((1, 2))]
    count = 1 + 3 * rings * (rings + 1)
    for k in range(1, rings + 1):
        inner, outer = (1 + 3 * i * (i + 1) for i in (k - 1, k))  # cells within, and with this ring
        middle = radius * np.sqrt((inner + outer) / (2.0 * count))  # the root of the mean square of its radii
        # In the middle cell all is at the centre: the first ring takes over its second moment.
        middle = np.sqrt(middle**2 + radius**2 / (2.0 * count) / 6.0) if k == 1 else middle
        angle = 2.0 * np.pi * (np.arange(6 * k) + 0.5 * (k % 2)) / (6 * k)
        found.append(middle * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.vstack(found)


def rectangle(length: float, width: float, points: tuple[int, int]) -> Array:
    """Return points (n, 2), m, of a rectangle: those in the middles of cells, spread by 1/√(1 − 1/n²) along a side."""
    sides = [
        0.5 * side * (2.0 * np.arange(n) + 1.0 - n) / n / np.sqrt(1.0 - 1.0 / n**2)
        for side, n in zip((length, width), points, strict=True)
    ]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)


def points_of_face(face: dict[str, Any], name: str) -> list[list[float]]:
    """Return the points of a face, m, axes of its link.

    Raises
    ------
    ScenarioError
        If the face is none.
    """
    where = f"contact {name!r}: at"
    kinds = {"disc": "rings", "rectangle": "points"}
    kind = next((each for each in kinds if each in face), None)
    if kind is None or set(face) - {kind, kinds[kind], "centre", "normal"}:
        raise ScenarioError(f"{where}: must be {FORMS}, not {face}")
    try:
        if kind == "disc":
            flat = disc(_length(face["disc"]), _count(face.get("rings", RINGS), 1))
        else:
            length, width = map(_length, face["rectangle"])
            across, up = (_count(n, 2) for n in face.get("points", (5, 5)))
            flat = rectangle(length, width, (across, up))
        centre = np.array(face.get("centre", (0.0, 0.0, 0.0)), dtype=float)
        frame = contact_frame(unit(face.get("normal", (0.0, 0.0, 1.0)), "normal"))
        if centre.shape != (3,) or not np.all(np.isfinite(centre)):
            raise ValueError
    except (TypeError, ValueError, KeyError):
        raise ScenarioError(
            f"{where}: must be {FORMS}: lengths above 0 in metres, at least 1 ring or 2 points"
        ) from None
    if len(flat) > MOST_POINTS:
        raise ScenarioError(f"{where}: has {len(flat)} points; at most {MOST_POINTS}")
    found: list[list[float]] = (centre + flat @ frame[1:]).tolist()
    return found


def share_of(compliance: Any, count: int, name: str) -> dict[str, Any]:
    """Return the compliance of each of so many points that share that of a face.

    Raises
    ------
    ScenarioError
        If it has none that can be shared.
    """
    kind = compliance.get("kind") if isinstance(compliance, dict) else None
    if kind not in SHARED:
        said = "compliance: a face presses with the pressure of a soft pad: give it as kind = "
        raise ScenarioError(f"contact {name!r}: {said}{' or '.join(map(repr, SHARED))}")
    law, names = SHARED[kind]
    whole = {key: compliance.get(key, law.model_fields[key].default) for key in names}
    numbers = {key: value / count for key, value in whole.items() if isinstance(value, int | float)}
    return compliance | numbers


def _length(value: Any) -> float:
    if not 0.0 < float(value) < np.inf:
        raise ValueError
    return float(value)


def _count(value: Any, least: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < least:
        raise ValueError
    return int(value)
