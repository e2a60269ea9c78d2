"""A surface in its place: what is asked of it from Python, and the memory that the loop asks it by; and the plane."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arguments import fields_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.families import is_users
from closedloop.jit import background
from closedloop.jit.calls import entry_address
from closedloop.jit.interim import at_hand
from closedloop.jit.interpreted import interpreted, twin_address
from closedloop.jit.parameters import pack
from closedloop.jit.user_code import of_users
from closedloop.mechanics.surface import contact
from closedloop.mechanics.surface.geometry import Pose, Touch, turned_back
from closedloop.mechanics.surface.kinds.none import NoSurface
from closedloop.mechanics.surface.kinds.plane import PlaneSurface
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.motions.none import NoMotion
from closedloop.mechanics.surface.surface import Surface
from robot_models.cached import cached_property


def unit(vector: ArrayLike, key: str) -> Array:
    """Return the (3,) unit vector along `vector`, read-only; `key` names it in messages.

    Raises ScenarioError if it is not three finite numbers, or has no direction.
    """
    return _unit_of(vector, key) if isinstance(vector, tuple) else _unit(vector, key)


def _unit(vector: ArrayLike, key: str) -> Array:
    v = np.array(vector, dtype=np.float64)
    if v.shape != (3,) or not np.all(np.isfinite(v)):
        raise ScenarioError(f"{key} = {vector!r}: must be three finite numbers")
    # Scaling by the largest entry first keeps tiny and huge vectors from under- or overflowing.
    largest = float(np.max(np.abs(v)))
    if largest == 0.0:
        raise ScenarioError(f"{key} = [0, 0, 0]: has no direction; give a vector such as [0, 0, 1]")
    v /= largest
    v /= np.linalg.norm(v)
    v += 0.0  # no entry is −0
    v.setflags(write=False)
    return v


_unit_of = lru_cache(maxsize=128)(_unit)  # of the direction that a section has


def contact_frame(normal: ArrayLike) -> Array:
    """Return the (3, 3) contact frame of a unit normal (3,): rows n, t1, t2, right-handed, base axes, read-only.

    The tangents are +x and +y turned by the least rotation that takes +z to n. So a level surface has (t1, t2) =
    (x, y), and the frame changes smoothly with n except at n = −z, where many rotations are the least: there it is half
    a turn about x. (Any choice of tangents must jump somewhere.)
    """
    return _contact_frame(*np.asarray(normal, dtype=np.float64).tolist())


@lru_cache(maxsize=128)
def _contact_frame(x: float, y: float, z: float) -> Array:
    n = [x, y, z]
    across = math.hypot(x, y)
    turns_over = across < 1e-290 and z < 0.0
    c, s = (x / across, y / across) if across > 1e-290 else (1.0, 0.0)
    turned = 1.0 - z
    t1 = [1.0 - turned * c * c, -turned * c * s, -x]
    t2 = [-turned * c * s, 1.0 - turned * s * s, -y]
    frame = np.array([n, [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]] if turns_over else [n, t1, t2]) + 0.0  # no entry is −0
    frame.setflags(write=False)
    return frame


@dataclass(frozen=True)
@fields_checked
class Plane:
    """The plane n·p = d in the base frame (Eq. 11).

    Attributes
    ----------
    normal : (3,) array
        Unit normal n in the base frame; it points out of the surface, to the side where the robot is.
    offset : float
        Distance d of the plane from the base origin along n, m.
    """

    normal: Array
    offset: float

    @classmethod
    def of(cls, normal: ArrayLike, offset: float) -> "Plane":
        """Make a plane from any non-zero normal, which is normalised; `offset` refers to the unit normal.

        Raises
        ------
        ScenarioError
            If the normal is not three finite numbers or has no direction, or the offset is not finite.
        """
        n = unit(normal, "surface.normal")
        if not np.isfinite(offset):
            raise ScenarioError(f'surface.offset = {offset}: must be a finite number of metres, or "start"')
        n.setflags(write=False)
        return cls(n, float(offset))

    @classmethod
    def through(cls, point: ArrayLike, normal: ArrayLike) -> "Plane":
        """Make the plane with this normal through `point` (3,), m, base frame."""
        plane = cls.of(normal, 0.0)
        return cls(plane.normal, float(plane.normal @ np.asarray(point, dtype=np.float64)))

    def gap(self, point: ArrayLike) -> float:
        """Closure error e = n·p − d of a point (3,), m; positive off the surface."""
        return float(self.normal @ np.asarray(point, dtype=np.float64) - self.offset)


class Touching(NamedTuple):
    """A point and the surface at an instant."""

    gap: float  # distance from the surface, m; to first order in it, for a φ that is no distance
    frame: Array  # (3, 3): contact frame: rows n, t1, t2, base frame
    # carried, turning (3,): the tip's velocity and acceleration in the contact frame are u = N ṙ − carried and u̇ = N
    # r̈ + turning
    carried: Array
    turning: Array
    level: float  # φ
    inside: float  # distance from the surface's edge, m, negative beyond it; inf without one


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """A surface in its place, and its motion."""

    # section, motion: what it is, and how it moves
    section: Surface
    motion: SurfaceMotion
    frame: Array  # (3, 3): rows n, t1, t2 of the contact frame at its origin at t = 0, base frame
    origin: Array  # (3,): a point of it at t = 0, with the normal n, m, base frame
    below_start: bool  # whether it is placed `surface.gap` below the tip at the start
    # of a ball that touches it in place of a point, m: gaps are those of the ball about the point that is asked for
    radius: float = 0.0
    where: str = "surface"  # key of its section, for messages

    @classmethod
    def of(
        cls, section: Surface, motion: SurfaceMotion, tip: Array, depth: float = 0.0, radius: float = 0.0,
        where: str = "surface",
    ) -> "PlacedSurface":  # fmt: skip
        """Place the surface of a scenario whose tip is at `tip` (3,), m, base frame, at the start.

        One that is soft, and placed below the tip, is placed so that the tip is `depth` in it, m. The tip is the centre
        of a ball of this radius, m. `where` is the key of the section in messages.

        Raises ScenarioError if its parameters do not go together.
        """
        normal = unit(section.normal, f"{where}.normal")
        given = section.place(normal)
        if given is not None and section.gap:
            key = "offset" if isinstance(section, PlaneSurface) else "point"
            raise ScenarioError(f'{where}.gap: acts with {key} = "start" only; leave it out')
        origin = tip - (radius + section.gap - depth) * normal if given is None else given
        return cls(section, motion, contact_frame(normal), origin, given is None, radius, where)

    def below(self, tip: Array, depth: float) -> "PlacedSurface":
        """Return it where `of` places it for another tip at the start."""
        if not self.below_start:
            return self
        moved: PlacedSurface = object.__new__(PlacedSurface)
        vars(moved).update(vars(self), origin=tip - (self.radius + self.section.gap - depth) * self.normal)
        for name in ("_interpreted", "offset"):  # which have the origin
            vars(moved).pop(name, None)
        return moved

    @cached_property
    def fixed_plane(self) -> bool:
        """Whether it is a plane at rest without an edge, or none: its frame is constant, and the loop does not ask."""
        return isinstance(self.section, NoSurface) or (
            isinstance(self.section, PlaneSurface) and not self.moves and not self.ends
        )

    @property
    def ends(self) -> bool:
        """Whether it has an edge."""
        return math.isfinite(self.section.bounds()[0])

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return not isinstance(self.motion, NoMotion)

    @property
    def extent(self) -> float:
        """How far from the origin of its axes a block at rest reaches that a point touches, m; inf of all else."""
        half = np.array(self.section.solid()[2:]) * (1.0, 1.0, 2.0)  # its origin is in the middle of a face
        if self.moves or self.radius > 0.0 or not half[2] > 0.0:
            return math.inf
        return float(np.linalg.norm(self.origin) + np.linalg.norm(half))

    @cached_property
    def offset(self) -> float:
        """n·p of its origin at t = 0, m: d of a plane; of a ball's centre where it touches that plane."""
        if isinstance(self.section, PlaneSurface) and self.section.offset != "start":
            return float(self.section.offset) + self.radius
        return float(self.normal @ self.origin) + self.radius

    @property
    def normal(self) -> Array:
        """Unit normal (3,) at its origin at t = 0, base frame."""
        return self.frame[0]

    def entries(self) -> dict[str, Any]:
        """Return what the loop calls, by the names that its state has for it; none of a plane at rest."""
        return {} if self.fixed_plane else self.all_entries()

    def all_entries(self) -> dict[str, Any]:
        """Return the same where the loop asks every surface, a plane at rest too."""
        found = {"surface": contact.surface_entry(type(self.section))}
        return found | ({"surface_motion": contact.motion_entry(type(self.motion))} if self.moves else {})

    def memory(self) -> contact.SurfaceMemory:
        """Return memory by which it is asked; `Links.motion` is to be set for a surface that moves."""
        (par, motion_par), bounds = self._packed, self.section.bounds()
        solid = self.section.solid() if self.radius == 0.0 else (0.0,) * 5  # a ball goes round the edges
        return contact.make_memory(
            par, motion_par, (self.section.list_length(), self.motion.list_length()), self.origin,
            self.frame[[1, 2, 0]], bounds, self.radius, solid,
        )  # fmt: skip

    @cached_property
    def _packed(self) -> tuple[Array, Array]:
        """The numbers of the surface and of its motion: a path asks for them at each of its knots."""
        with of_users(self.section, f"{self.where}.kind"):
            par = pack(self.section, self.section.list_length(), "surface")
        with of_users(self.motion, f"{self.where}_motion.kind"):
            return par, pack(self.motion, self.motion.list_length(), "surface_motion")

    @cached_property
    def _interpreted(self) -> contact.SurfaceMemory:
        memory = self.memory()
        if self.moves:
            memory.links.motion = twin_address(contact.motion_entry(type(self.motion)))
        return memory

    def touching(self, r: Array, velocity: Array | None = None, t: float = 0.0) -> Touching:
        """Return how a point at r (3,), m, that moves with `velocity` (3,), m/s, base frame, is to the surface at t, s.

        Raises ScenarioError if the surface has no normal there.
        """
        if self.fixed_plane:
            gap = float(self.normal @ r) - self.offset
            return Touching(gap, self.frame, np.zeros(3), np.zeros(3), gap, math.inf)
        links, ask = self._interpreted
        ask.time, ask.r[:], ask.velocity[:] = t, r, 0.0 if velocity is None else velocity
        with np.errstate(all="ignore"), of_users(self.section, f"{self.where}.kind"):
            answer = interpreted(contact.surface_entry(type(self.section)))(int(links.address), contact.CONTACT)
        touch = Touch(ask.touch)
        if answer == contact.NO_NORMAL:
            raise ScenarioError(
                f"{self.where}.kind = {self.section.kind}: has no normal at {np.round(r, 4).tolist()} m"
            )
        gap = float(touch.level / touch.size)
        inside = contact.edge_distance(touch.at, ask.bounds, ask.solid)
        return Touching(gap, ask.frame.copy(), touch.carried.copy(), touch.turning.copy(), float(touch.level), inside)

    def frame_at_rest(self, r: Array, t: float) -> Array:
        """Return the contact frame (3, 3) at r (3,), m, at t, s, with tangents that do not turn with the surface."""
        frame = self.touching(r, t=t).frame
        if not self.moves:
            return frame
        c, s = interpreted(turned_back)(self.frame[[1, 2, 0]], frame)
        return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ frame

    def pose(self, t: float) -> Pose:
        """Return where a surface that moves is at t, s, and how it moves: until it is asked again."""
        links, ask = self._interpreted
        ask.time = t
        with of_users(self.motion, f"{self.where}_motion.kind"):
            interpreted(contact.motion_entry(type(self.motion)))(int(links.address), 0)
        return Pose(ask.pose)

    def displacement(self, t: float) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and the shift (3,), m, base frame, by which it is displaced at t, s."""
        if not self.moves:
            return np.eye(3), np.zeros(3)
        pose, axes = self.pose(t), self._interpreted.ask.axes
        turn: Array = pose.axes.T @ axes
        return turn, pose.origin - turn @ self.origin

    def _say_what_is_raised(self, memory: contact.SurfaceMemory, t: float, r: Array) -> None:
        """Ask a user's class again, interpreted, at a point r (3,), m, and an instant t, s; it may raise something."""
        kinds: dict[str, tuple[Any, Any]] = {
            f"{self.where}.kind": (self.section, contact.surface_entry),
            f"{self.where}_motion.kind": (self.motion, contact.motion_entry),
        }
        memory.ask.time, memory.ask.r[:], memory.links.motion = t, r, 0
        for key, (member, entry_of) in kinds.items():
            if is_users(member):
                with np.errstate(all="ignore"), of_users(member, key):
                    interpreted(entry_of(type(member)))(memory.address, contact.LEVEL)

    def follow(self, level: float, times: Array, motion: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Return a motion of a point moved along `normal` onto the level φ = `level`, of the surface as it moves.

        `level`: φ of the motion that is returned.
        `times` (N,): s.
        `motion`, tuple of (N, 3) arrays: position, m, velocity, m/s, and acceleration, m/s², base frame.
        Raises ScenarioError if the surface does not lie in that direction from one of the points.
        """
        found, done = self.at_each(contact.put_on_surface, (np.array(self.normal), level), times, motion)
        if done < times.size:
            where = np.round(motion[0][done], 4).tolist()
            try:
                self.touching(motion[0][done], t=float(times[done]))
            except ScenarioError:
                raise ScenarioError(
                    f"reference: at t = {times[done]:.4g} s the path comes to {where} m, where the surface has no "
                    "normal, as the gradient of its φ vanishes there; make the path shorter"
                ) from None
            raise ScenarioError(
                f"reference: at t = {times[done]:.4g} s the path is at {where} m, from where the surface cannot be "
                "reached along its normal at the start; make the path shorter"
            )
        return found[0], found[1], found[2]

    def normals(self, times: Array, r: Array, velocity: Array) -> tuple[Array, Array]:
        """Return the unit normals n at points of a motion, and their rates ṅ, 1/s, base frame; each (N, 3).

        `times` (N,): s.
        `r`, `velocity`, (N, 3) arrays: position, m, and velocity, m/s, base frame.
        Raises ScenarioError if there is no normal at one of the points.
        """
        if self.fixed_plane:
            return np.tile(self.normal, (times.size, 1)), np.zeros((times.size, 3))
        found, done = self.at_each(contact.normals_on_surface, (), times, (r, velocity))
        if done < times.size:
            raise ScenarioError(
                f"reference: at t = {times[done]:.4g} s the path is at {np.round(r[done], 4).tolist()} m, where the "
                "surface has no normal"
            )
        return found[0], found[1]

    def at_each(
        self, kernel: Callable[..., int], leading: tuple[Any, ...], times: Array, motion: tuple[Array, ...]
    ) -> tuple[list[Array], int]:
        """Return what a kernel makes of the points of a motion, and how many it got through.

        It is called compiled where it and the surface are at hand, else interpreted, while they are compiled.
        """
        kernels = [kernel, *self.entries().values()]
        if self.fixed_plane:
            kernels.append(contact.surface_entry(type(self.section)))
        ready = all(map(at_hand, kernels))
        address = entry_address if ready else twin_address
        memory = self.memory()
        if self.moves:
            memory.links.motion = address(contact.motion_entry(type(self.motion)))
        if not ready:
            background.start([each for each in kernels if not at_hand(each)])
        found = [np.array(each, dtype=np.float64, order="C") for each in motion]
        place = address(contact.surface_entry(type(self.section)))
        call = kernel if ready else interpreted(kernel)
        with np.errstate(all="ignore"), of_users(self.section, f"{self.where}.kind"):
            done = call(place, memory.address, *leading, np.ascontiguousarray(times), *found)
        if done < times.size and ready:  # of what a user's class has raised compiled code keeps no message
            self._say_what_is_raised(memory, float(times[done]), motion[0][done])
        return found, done
