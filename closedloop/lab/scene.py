"""What is drawn of a run in space, as data: shapes and where they are, arrows, paths, the surface, the events.

Nothing here knows how it is drawn. The lab, the page of `Run.show` and the tests read the same scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from closedloop.lab.shapes import Shape, robot_shapes
from closedloop.record.run import Run
from closedloop.surface.plane import contact_frame, unit
from robot_models import RobotModel

Array = NDArray[np.float64]

# Names and colours of the arrows, red, green, blue from 0 to 1: of Okabe and Ito's palette.
ARROWS: dict[str, tuple[float, float, float]] = {
    "contact force": (0.0, 0.447, 0.698),
    "friction": (0.835, 0.369, 0.0),
    "commanded force": (0.0, 0.62, 0.451),
}
PATH, WANTED = (0.80, 0.47, 0.65), (0.0, 0.62, 0.451)
# The largest force of a run is drawn as long as this share of the arm's reach.
LONGEST = 0.3
# The patch of the surface reaches this far beyond the path, m, or a share of the path's size.
MARGIN, SHARE = 0.06, 0.3


class Arrow(NamedTuple):
    """A force at the tip: where it acts (3,), m, and the force (3,), N, both in the base frame."""

    name: str
    tail: Array
    force: Array


class Mark(NamedTuple):
    """An event in space: its instant, s, its kind, and the tip's position (3,), m."""

    time: float
    kind: str
    position: Array


@dataclass(frozen=True)
class Scene:
    """A run in space.

    Attributes
    ----------
    run : Run
    tip : str
        The frame that touches the surface.
    """

    run: Run
    tip: str

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The robot's shapes, each in the frame of a joint."""
        return robot_shapes(self.run.model, self.tip)

    @cached_property
    def frame(self) -> Array:
        """The contact frame (3, 3): rows n, t1, t2, base axes."""
        return contact_frame(unit(self.run.scenario.surface.normal, "surface.normal"))

    @cached_property
    def offset(self) -> float:
        """The distance d of the surface n·p = d from the base's origin, m."""
        return float(self.frame[0] @ self.run.position[0] - self.run.closure_error[0])

    @cached_property
    def patch(self) -> Array:
        """The corners (4, 3), m, base frame, of a rectangle of the surface around both paths, in their order."""
        points = np.vstack([self.run.position, self.run.reference_tip])
        along = points[np.all(np.isfinite(points), axis=1)] @ self.frame[1:].T
        low, high = along.min(axis=0), along.max(axis=0)
        margin = max(MARGIN, SHARE * float(np.max(high - low)))
        (a, b), (c, d) = low - margin, high + margin
        corners: Array = np.array([[a, b], [c, b], [c, d], [a, d]]) @ self.frame[1:] + self.offset * self.frame[0]
        return corners

    @cached_property
    def marks(self) -> list[Mark]:
        """The events of the contact."""
        return [Mark(event.time, event.kind, event.position) for event in self.run.events]

    def joint_places(self, row: int) -> tuple[Array, Array]:
        """Return the axes (n + 1, 3, 3) and origins (n + 1, 3), m, of the base and of each joint's frame in a row."""
        return _places(self.run.model).at(self.run.q[row])

    def tip_place(self, row: int) -> Array:
        """Return the tip (3,), m, base frame, from the joints' frames as they are drawn, not from the record."""
        places = _places(self.run.model)
        frame = places.model.frames[places.model.getFrameId(self.tip)]
        axes, origins = self.joint_places(row)
        tip: Array = origins[frame.parentJoint] + axes[frame.parentJoint] @ frame.placement.translation
        return tip

    def arrows(self, row: int) -> list[Arrow]:
        """Return the forces at the tip in a row: of the surface on the tip, and the commanded one on the surface."""
        run, normal = self.run, self.frame[0]
        forces = (
            run.contact_force[row] * normal, np.array(run.friction_force[row]), -run.reference_force[row] * normal
        )  # fmt: skip
        return [Arrow(name, run.position[row], force) for name, force in zip(ARROWS, forces, strict=True)]

    @cached_property
    def arm_hides_force(self) -> bool:
        """Whether the last link stands above the surface at the start, where the contact force is drawn."""
        above = self.joint_places(0)[1][self.last_joint] - self.tip_place(0)
        return float(self.frame[0] @ above) > 0.0

    @cached_property
    def last_joint(self) -> int:
        """The number of the joint that moves the tip."""
        model = _places(self.run.model).model
        return int(model.frames[model.getFrameId(self.tip)].parentJoint)

    @cached_property
    def size(self) -> float:
        """The arm's reach, m, or the extent of the path if that is larger."""
        places = _places(self.run.model)
        reach = sum(float(np.linalg.norm(place.translation)) for place in list(places.model.jointPlacements)[1:])
        return max(reach, float(np.ptp(self.run.position, axis=0).max(initial=0.0)), 0.1)

    @cached_property
    def metres_per_newton(self) -> float:
        """A round scale for arrows at which the largest usual force of this run is as long as `LONGEST` says."""
        forces = np.abs(np.concatenate([self.run.contact_force, self.run.reference_force]))
        usual = float(np.percentile(forces[np.isfinite(forces)], 99)) if np.isfinite(forces).any() else 0.0
        return round_down(LONGEST * self.size / usual) if usual > 0.0 else 0.01


def scene_of(run: Run) -> Scene:
    """Return a run of at least one row in space."""
    tip = run.scenario.robot.tip or run.model.tip
    assert tip is not None  # a robot without one is refused before anything is simulated
    return Scene(run, tip)


def round_down(x: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above x > 0."""
    power = 10.0 ** math.floor(math.log10(x))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= x * (1.0 + 1e-12))


def thin_out(points: Array, most: int = 400) -> Array:
    """Return so many of the points (N, 3) at most, evenly spaced in their order, with the first and the last."""
    finite: Array = points[np.all(np.isfinite(points), axis=1)]
    rows = np.linspace(0, len(finite) - 1, min(most, len(finite))).round().astype(int)
    thinned: Array = finite[np.unique(rows)]
    return thinned


def quaternions(axes: Array) -> Array:
    """Return the unit quaternions (k, 4), the real part first, of rotation matrices (k, 3, 3)."""
    found = np.array([pin.Quaternion(np.ascontiguousarray(each)).coeffs() for each in axes])
    return found[:, [3, 0, 1, 2]]


class _Places:
    """A robot's joint frames at a posture."""

    def __init__(self, model: RobotModel) -> None:
        self.model: Any = model.pinocchio_model()

    def at(self, q: Array) -> tuple[Array, Array]:
        data = self.model.createData()  # of its own: several threads draw
        pin.forwardKinematics(self.model, data, np.ascontiguousarray(q))
        places: Sequence[Any] = list(data.oMi)
        return np.array([p.rotation for p in places]), np.array([p.translation for p in places])


@lru_cache(maxsize=8)
def _places(model: RobotModel) -> _Places:
    return _Places(model)
