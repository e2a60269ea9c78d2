"""The base class of paths: a section of the scenario that gives the desired motion of the tip; and checks of paths.

A user's path is a class derived from `Path`, with its parameters as typed fields and the one method `tip_path`.
Those that ship are in `closedloop.control.reference.paths`, one file each, written the same way.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Literal, Protocol

import numpy as np
from pydantic import Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Parameters, is_users
from closedloop.base.sections import Size
from closedloop.control.reference.on_surface import on_surface
from closedloop.control.reference.orientation import Held
from closedloop.control.reference.tip_path import TipPath
from closedloop.jit.user_code import of_users
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.mechanics.surface.surface import Surface

TURNS = Size(1e6, "", "no path goes round so often", 1e-9)

# Sine of the angle by which a direction may point out of the surface: 1e-9 of the way, a nanometre in a metre.
OUT_OF_SURFACE = 1e-9


class Between(Protocol):
    """A section that has a start and a stop, s."""

    @property
    def start(self) -> float: ...  # noqa: D102
    @property
    def stop(self) -> float: ...  # noqa: D102


def direction_along(direction: Sequence[float], normal: Array) -> Array:
    """Return the unit vector (3,) of reference.direction, which must be along the surface with this unit normal (3,).

    Raises
    ------
    ScenarioError
        If it has no direction, or points out of the surface; names the nearest that does not.
    """
    along = unit(direction, "reference.direction")
    out = float(normal @ along)
    if abs(out) > OUT_OF_SURFACE:
        inside = along - out * normal
        size = float(np.linalg.norm(inside))
        near = (inside / size).round(12) + 0.0 if size > 1e-9 else None
        hint = "" if near is None else f"; the nearest direction along it is {near.tolist()}"
        raise ScenarioError(f"reference.direction = {list(direction)}: must lie in the surface{hint}")
    return along


def interval(section: Between) -> tuple[float, float]:
    """Return reference.start and reference.stop, s."""
    if not section.stop > section.start:
        raise ScenarioError(
            f"reference.stop = {section.stop:g}: must be later than reference.start = {section.start:g}"
        )
    return section.start, section.stop


def not_zero(value: float, key: str) -> float:
    """Return the value; refuse zero."""
    if value == 0.0:
        raise ScenarioError(f"{key} = 0: must not be zero")
    return value


# Tolerance of the start of a user's path, m: rounding, with no effect on the closure.
ORIGIN = 1e-9


class Path(Parameters):
    """[reference]: the motion of the tip."""

    folder: ClassVar[str] = "closedloop.control.reference.paths"
    in_plane: ClassVar[bool] = True  # it is drawn in the tangent plane, so that on a plane at rest it lies already

    on_surface: Literal["projected", "geodesic", "no"] = Field(
        "projected",
        description="how it is mapped onto a curved or moving surface: projected along the normal at the start; "
        "geodesic: with the same lengths, angles and speed; no: not at all",
    )

    orientation: Held = Field(
        "free",
        description='orientation of the tool: "free", "normal" (tool.axis held against the normal of the surface), '
        '"start" (as it is at the start), or the rotation vector of the frame robot.tip in the base frame, rad',
    )

    @abstractmethod
    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the path from `origin` (3,), m, on a surface with the unit normal (3,) `normal`, base frame.

        It must begin at `origin`: that is where the tip is at the start of the run.

        Raises
        ------
        ScenarioError
            If the parameters do not go together: a direction out of the surface, a stop before the start ...
        """


PATHS = Family(Path, usual="hold")  # type: ignore[type-abstract]  # it makes no instance of the base


@np.errstate(all="ignore")  # what overflows is refused by name when it is followed
def tip_path(section: Path, origin: Array, normal: Array) -> TipPath:
    """Return the path from `origin` (3,), m, on a surface with this unit normal (3,), base frame.

    Raises
    ------
    ScenarioError
        If the section is at fault: a direction out of the surface, a stop before the start ... Or a user's path is: it
        raises something, or returns no path from `origin`.
    """
    with of_users(section, "reference.kind"):
        path = section.tip_path(origin, normal)
        if not isinstance(path, TipPath):
            raise TypeError(f"tip_path returned {type(path).__name__}, not a TipPath")
        first = path.sample(np.zeros(1))[0][0] if is_users(section) else None
    if first is not None and not np.max(np.abs(first - origin)) <= ORIGIN:
        raise ScenarioError(
            f"reference.kind = {section.kind}: its path begins at {first.round(6).tolist()} m, where the tip starts at "
            f"{origin.round(6).tolist()} m"
        )
    return path


def path_normal(section: Path, surface: Surface) -> Array:
    """Return the unit normal (3,) of the plane that a path is drawn in, base frame: that of the surface at the start.

    Without a surface a path may have any direction: of the normals across it, it is the nearest to `surface.normal`.
    """
    normal = unit(surface.normal, "surface.normal")
    direction = None if surface.kind != "none" else getattr(section, "direction", None)
    if direction is None:
        return normal
    along = unit(direction, "reference.direction")
    across = normal - (normal @ along) * along
    size = float(np.linalg.norm(across))
    return across / size if size > 1e-6 else contact_frame(along)[1]


def path_on(section: Path, origin: Array, surface: PlacedSurface, duration: float) -> TipPath:
    """Return the path from `origin` (3,), m, base frame, laid onto a surface for a run of `duration`, s.

    Raises
    ------
    ScenarioError
        As `tip_path`, or if the surface does not lie under the path, or the path leaves it.
    """
    path = tip_path(section, origin, path_normal(section, surface.section))
    if section.on_surface == "no" or (surface.fixed_plane and section.in_plane):
        return path
    return on_surface(path, surface, duration, geodesic=section.on_surface == "geodesic")
