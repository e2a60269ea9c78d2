"""The base class of paths, sections of the scenario that give the desired motion of the tip; and the tool along a path.

A user's path is a class derived from `Path`, with its parameters as typed fields and the one method `tip_path`.
Those that ship are in `closedloop.control.reference.paths`, one file each, written the same way.

The inverse kinematics of the reference holds the orientation of the tool
(`closedloop.control.reference.inverse_kinematics`), so that q_des carries it: the laws in joint space follow q_des, and
those in tip space pull the motion of the joints that the tip leaves free to it
(`closedloop.control.tip_space.posture`).

A tool whose round tip is too large for a hollow of the surface is refused before anything is simulated.

And the desired contact force over time, and lists of instants, points and forces in a section.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from pydantic import BeforeValidator, Field

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import Family, Parameters, is_users
from closedloop.base.sections import FORCE, PLACE, Instant, Number, Positive, Section, Size, Unit, usual
from closedloop.control.reference.inverse_kinematics import AXIS, FRAME, POSITION, RANK_TOLERANCE
from closedloop.control.reference.tip_path import TipPath, on_surface
from closedloop.jit.user_code import of_users
from closedloop.mechanics.surface.along import shape_at
from closedloop.mechanics.surface.placed import PlacedSurface, contact_frame, unit
from closedloop.mechanics.surface.surface import Surface
from robot_models.errors import shown

if TYPE_CHECKING:
    from closedloop.mechanics.robot.pinocchio import Robot


def _numbers(value: Any, what: str) -> tuple[float, ...]:
    if not isinstance(value, (list, tuple)) or not value:
        raise ValueError(f"must be a list of {what}")
    for index, entry in enumerate(value):
        if isinstance(entry, bool) or not isinstance(entry, (int, float)):
            raise ValueError(f"entry {index} is {shown(entry)}: must be a number")
        try:
            number = float(entry)
        except OverflowError:
            raise ValueError(f"entry {index} must be a number below 1e308") from None
        if not math.isfinite(number):
            raise ValueError(f"entry {index} is {number}: must be finite, not NaN or infinite")
    return tuple(float(entry) for entry in value)


def _instants(value: Any) -> tuple[float, ...]:
    times = _numbers(value, "instants, s")
    if times[0] < 0.0:
        raise ValueError(f"entry 0 is {times[0]:g}: must not be negative")
    for index in range(1, len(times)):
        if not times[index] > times[index - 1]:
            raise ValueError(
                f"entry {index} is {times[index]:g}: must be later than entry {index - 1}, {times[index - 1]:g}"
            )
    return times


def _at_least_two(times: tuple[float, ...]) -> tuple[float, ...]:
    if len(times) < 2:
        raise ValueError("must have at least two entries")
    return times


def _points(value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, (list, tuple)):
        raise ValueError("must be a list of points, each three numbers")
    points = []
    for index, entry in enumerate(value):
        try:
            point = _numbers(entry, "three numbers")
        except ValueError as error:
            raise ValueError(f"point {index}: {error}") from None
        if len(point) != 3:
            raise ValueError(f"point {index} has {len(point)} numbers: must be three numbers")
        points.append(point)
    return tuple(points)


Forces = Annotated[tuple[float, ...], BeforeValidator(lambda value: _numbers(value, "forces, N"))]
Instants = Annotated[tuple[float, ...], BeforeValidator(_instants), Unit("s")]
MotionInstants = Annotated[tuple[float, ...], BeforeValidator(lambda value: _at_least_two(_instants(value))), Unit("s")]
Points = Annotated[tuple[Annotated[tuple[float, float, float], PLACE], ...], BeforeValidator(_points)]


# i·h and the instant of a jump may differ by rounding: earlier by this share of the instant counts as the instant.
ROUNDING = 1e-12

FREQUENCY = Size(1e6, "Hz", "no step resolves more", 1e-12)


class ConstantForceSection(Section):
    """[force_profile] kind = "constant": law.force, always."""

    kind: Literal["constant"] = "constant"


class StepForceSection(Section):
    """[force_profile] kind = "step": law.force, and another force from an instant on."""

    kind: Literal["step"] = "step"
    to: Annotated[Number, FORCE] = Field(description="desired force after the step, N")
    at: Instant = Field(description="instant of the step, s")


class SineForceSection(Section):
    """[force_profile] kind = "sine": a sine about law.force."""

    kind: Literal["sine"] = "sine"
    amplitude: Annotated[Number, FORCE] = Field(description="amplitude of the sine, N; negative begins downwards")
    frequency: Annotated[Positive, FREQUENCY] = Field(description="frequency of the sine, Hz")
    start: Instant = Field(0.0, description="instant at which the sine begins, s; law.force before")


class WaypointForceSection(Section):
    """[force_profile] kind = "waypoints": linear in time between given forces; law.force before the first instant."""

    kind: Literal["waypoints"] = "waypoints"
    times: Instants = Field(description="instants at which the desired force is as given, s, increasing")
    forces: Annotated[Forces, FORCE] = Field(description="desired force at those instants, N; the last stays")


ForceProfile = Annotated[
    ConstantForceSection | StepForceSection | SineForceSection | WaypointForceSection,
    Field(discriminator="kind"),
    usual(ConstantForceSection),
]


def force_at(section: ForceProfile, base: float, t: Array) -> Array:
    """Return f_des (N,), N, at times t (N,), s; at a jump the right limit.

    `base`: law.force, N.
    Raises ScenarioError if a profile of waypoints has not as many forces as instants.
    """
    t = np.asarray(t, dtype=np.float64)
    if isinstance(section, ConstantForceSection):
        return np.full(t.shape, base)
    later = t + ROUNDING * np.maximum(1.0, np.abs(t))
    if isinstance(section, StepForceSection):
        return np.where(later >= section.at, section.to, base)
    if isinstance(section, SineForceSection):
        since = np.maximum(t - section.start, 0.0)
        return base + section.amplitude * np.sin(2.0 * np.pi * section.frequency * since)
    if len(section.times) != len(section.forces):
        raise ScenarioError(
            f"force_profile.forces has {len(section.forces)} entries: must have one for each of the "
            f"{len(section.times)} force_profile.times"
        )
    return np.where(later >= section.times[0], np.interp(t, section.times, section.forces), base)


TURN = Size(1e3, "rad", "a turn more changes nothing")
WORDS = ("free", "normal", "start")
# How far the tool may be from its orientation at the start, rad: that of a posture given to three digits, 1 degree.
ASKEW = math.radians(1.0)


def _orientation(value: Any) -> Any:
    if isinstance(value, str) and value in WORDS:
        return value
    numbers = isinstance(value, (list, tuple)) and len(value) == 3
    if not numbers or not all(isinstance(x, (int, float)) and abs(x) <= TURN.most for x in value):
        words = ", ".join(f'"{word}"' for word in WORDS)
        raise ValueError(f"must be {words}, or three numbers, the rotation vector of the tip's frame, rad")
    return value


Held = Annotated[
    Literal["free", "normal", "start"]
    | tuple[Annotated[Number, TURN], Annotated[Number, TURN], Annotated[Number, TURN]],
    BeforeValidator(_orientation),
]


@dataclass(frozen=True)
class Orientation:
    """What is held of the tip's orientation."""

    rows: int  # `POSITION` (nothing), `AXIS` or `FRAME`, see `closedloop.control.reference.inverse_kinematics`
    axes: Array  # (3, 3): columns: axes of the tip's frame, in that frame, of which `AXIS` holds the last
    frame: Array  # (3, 3): of `FRAME`: the same as wanted, base frame
    surface: PlacedSurface | None = None  # of `AXIS`: the surface whose normal the axis is held against
    said: str = ""  # key and value that ask for it, for messages

    def axis_along(self, times: Array, r: Array, velocity: Array) -> Array:
        """Return the wanted axis of the tool and its rate, 1/s, (N, 6), at points of the tip's path, base frame."""
        if self.surface is None:
            return np.zeros((times.size, 6))
        normals, rates = self.surface.normals(times, r, velocity)
        return np.hstack([-normals, -rates])

    def in_link(self, robot: Robot, q: Array) -> Array:
        """Return the axes in those of the tip's link as the robot's tree has them; `q` (n,) is any posture."""
        return np.asarray(robot.link_axes(q).T @ robot.tip_axes(q[None])[0] @ self.axes)

    def askew(self, robot: Robot, q: Array) -> float:
        """Return the angle by which the tool is turned away from its orientation at the start, rad."""
        axes = robot.tip_axes(q[None])[0] @ self.axes
        if self.rows == AXIS:
            wanted = self.axis_along(np.zeros(1), robot.position(q)[None], np.zeros((1, 3)))[0, :3]
            return float(np.arctan2(np.linalg.norm(np.cross(axes[:, 2], wanted)), axes[:, 2] @ wanted))
        return float(turned_by(axes, self.frame)) if self.rows == FRAME else 0.0

    def check_joints(self, robot: Robot, q: Array) -> None:
        """Refuse an arm that has not the joints to hold position and orientation at once."""
        if self.rows == POSITION:
            return
        J = robot.frame_jacobian(q)
        if self.rows == AXIS:
            J = np.vstack([J[:3], contact_frame((robot.tip_axes(q[None])[0] @ self.axes)[:, 2])[1:] @ J[3:]])
        moved = int(np.sum(robot.support))
        if moved < self.rows:
            raise ScenarioError(
                f"{self.said}: position and orientation of the tool together take {self.rows} joints, and "
                f"{robot.model.name} has {moved} that move it; leave it out, or take an arm with more joints"
            )
        sizes = np.linalg.svd(J, compute_uv=False)
        if sizes[-1] <= RANK_TOLERANCE * sizes[0]:
            raise ScenarioError(
                f"{self.said}: the start is a singular pose, in which the joints cannot turn the tool and leave the "
                "tip where it is; start elsewhere (start.q)"
            )


FREE_ORIENTATION = Orientation(POSITION, np.zeros((3, 3)), np.zeros((3, 3)))


def turned_by(axes: Array, wanted: Array) -> Array:
    """Return the angles between frames, (..., 3, 3) rotations, rad: |A − B| = √8 sin(θ/2), Frobenius' norm."""
    apart = np.linalg.norm(axes - wanted, axis=(-2, -1))
    return np.asarray(2.0 * np.arcsin(np.minimum(1.0, apart / math.sqrt(8.0))))


def orientation_of(
    held: str | tuple[float, float, float], axis: Array, robot: Robot, q: Array, surface: PlacedSurface
) -> Orientation:
    """Return what reference.orientation asks for.

    `held`: "free", "normal", "start", or the rotation vector of the tip's frame, rad, base frame.
    `axis` (3,): axis of the tool, a unit vector in the tip's frame.
    `surface`: whose normal it is held against.
    """
    if held == "free":
        return FREE_ORIENTATION
    if held == "normal":
        axes = contact_frame(axis)[[1, 2, 0]].T
        return Orientation(AXIS, axes, np.zeros((3, 3)), surface, 'reference.orientation = "normal"')
    if held == "start":
        frame = robot.tip_axes(q[None])[0]
        return Orientation(FRAME, np.eye(3), frame, None, 'reference.orientation = "start"')
    from scipy.spatial.transform import Rotation

    frame = np.asarray(Rotation.from_rotvec(held).as_matrix())
    return Orientation(FRAME, np.eye(3), frame, None, f"reference.orientation = {list(held)}")


# Instants at which the path is looked at, and by which share the tool may be larger than the hollow: rounding.
PATH_CHECKS, NARROWER = 200, 1e-9


def hollow_radii(surface: PlacedSurface, times: Array, r: Array) -> Array:
    """Return the smallest radius of curvature of the hollows at points of a surface, (N,), m; inf where there is none.

    `times` (N,): s.
    `r` (N, 3): points on it at these instants, m, base frame.
    """
    shape, found = shape_at(surface), np.full(times.size, math.inf)
    for k, t in enumerate(times):
        turn, shift = surface.displacement(float(t))
        point = turn.T @ (r[k] - shift)
        n = shape(point, np.zeros(3))[0]
        if not np.all(np.isfinite(n)):
            continue  # there is no normal: refused where the path is laid onto the surface
        tangents = contact_frame(n)[1:]
        rates = np.array([shape(point, e)[1] for e in tangents])  # of n, for a metre along either tangent
        bend = rates @ tangents.T
        least = float(np.linalg.eigvalsh(0.5 * (bend + bend.T))[0])
        if least < 0.0:
            found[k] = -1.0 / least
    return found


def refuse_tool_too_large(surface: PlacedSurface, tip: TipPath, radius: float) -> None:
    """Refuse a tool with a tip of this radius, m, where the path comes to a hollow that is narrower."""
    if radius == 0.0 or surface.fixed_plane:
        return
    times = tip.instants(PATH_CHECKS) if tip.segments else np.zeros(1)
    r, velocity = tip.sample(times)[:2]
    refuse_narrow(surface, times, r - radius * surface.normals(times, r, velocity)[0], radius)


def refuse_narrow(surface: PlacedSurface, times: Array, r: Array, radius: float) -> None:
    """Refuse a ball of this radius, m, that touches a surface at points r (N, 3), m, if it does not fit there."""
    hollow = hollow_radii(replace(surface, radius=0.0), times, r)
    k = int(np.argmin(hollow))
    if radius > hollow[k] * (1.0 + NARROWER):
        raise ScenarioError(
            f"tool.radius = {radius:g}: at t = {times[k]:.4g} s the path is at {np.round(r[k], 4).tolist()} m, where "
            f"the surface is hollow with a radius of {hollow[k]:.4g} m: a tool so large touches it beside its tip; "
            "must be no larger than that"
        )


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

    Raises ScenarioError if it has no direction, or points out of the surface; names the nearest that does not.
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

    Raises ScenarioError if the section is at fault: a direction out of the surface, a stop before the start ... Or a
        user's path is: it raises something, or returns no path from `origin`.
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

    Raises ScenarioError as `tip_path`, or if the surface does not lie under the path, or the path leaves it.
    """
    path = tip_path(section, origin, path_normal(section, surface.section))
    if section.on_surface == "no" or (surface.fixed_plane and section.in_plane):
        return path
    return on_surface(path, surface, duration, geodesic=section.on_surface == "geodesic")
