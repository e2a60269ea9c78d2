"""The robot as data: everything that is needed to build it again, and nothing that must be looked up.

And a tool on the tip, or a load in it: where its own tip is, and its mass. If nobody names a tip, it is the frame of a
tool, or the end of the longest chain. Frames that no drive moves, as those of a body beside the robot, come last.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robot_models.cached import cached_property
from robot_models.coordinates import PLACES, RATES, balls, coordinate_names, coordinate_types, with_rotation_vectors
from robot_models.errors import ModelError
from robot_models.loop_joint import LoopJoint
from robot_models.mechanism import symmetric
from robot_models.tendon import Tendon, pulls, springs, tendons

if TYPE_CHECKING:
    import pinocchio as pin

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Tool:
    """A rigid body fixed to a frame of the robot; all vectors in the axes of that frame.

    Attributes
    ----------
    frame : str
        The frame it is fixed to. Mounted, the frame's origin is the tool's tip.
    offset : (3,) tuple
        The tool's tip, m.
    mass : float
        kg.
    centre : (3,) tuple
        Centre of mass, m.
    inertia : (6,) tuple
        Tensor about the centre of mass, kg m²: xx, yy, zz, xy, xz, yz.
    """

    frame: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def tensor(self) -> Vector:
        """Return the tensor (3, 3).

        Raises `ModelError` if no body has such a tensor: its principal moments must be >= 0, and none may exceed the
        sum of the other two.
        """
        tensor = symmetric(*self.inertia)
        if not any(self.inertia):
            return tensor
        low, middle, high = np.linalg.eigvalsh(tensor)
        slack = 1e-9 * max(abs(high), abs(low))
        if low < -slack or high > low + middle + slack:
            raise ModelError(
                f"the tool's tensor has principal moments {low:.4g}, {middle:.4g}, {high:.4g} kg m²: none may be "
                "negative, or larger than the other two together"
            )
        return tensor

    def mount(self, model: "pin.Model") -> None:
        """Fix the tool to its frame in a Pinocchio model, which is modified."""
        import pinocchio as pin

        index = model.getFrameId(self.frame)
        frame = model.frames[index]
        body = pin.Inertia(self.mass, np.array(self.centre), self.tensor())
        model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
        model.frames[index].placement = frame.placement * pin.SE3(np.eye(3), np.array(self.offset))


def carried_by(tools: "tuple[Tool, ...]", frame: str) -> "tuple[pin.Inertia, Vector]":
    """Return the inertia of all bodies fixed to a frame, in its axes and about its origin, and the tip (3,), m, in it.

    Each body but the first is fixed to the tip of the one before it, as `Tool.mount` does it.
    """
    import pinocchio as pin

    carried, tip = pin.Inertia.Zero(), np.zeros(3)
    for tool in tools:
        if tool.frame == frame:
            body = pin.Inertia(tool.mass, np.array(tool.centre), tool.tensor())
            carried = carried + pin.SE3(np.eye(3), tip).act(body)
            tip = tip + np.array(tool.offset)
    return carried, tip


# Names of tool frames as makers have them, the most telling first; each a whole word of the frame's name.
_TOOLS = ("tcp", "tool", "tool0", "ee", "eef", "endeffector", "gripperframe", "grip", "grasp", "flange", "attachment")
# Joints of fingers, and frames that touch nothing, by a word of their names.
_FINGER = re.compile(
    r"finger|thumb|knuckle|gripper|jaw|claw|pinky|phalan|(^|_)(index|middle|ring|little)(_|\d|$)", re.I
)
_IDLE = re.compile(
    r"imu|camera|sensor|optical|lidar|laser|range|sonar|accelerometer|velodyne|visual|collision|inerti|antenna|marker",
    re.I,
)


def default_tip(
    model: "pin.Model", usable: Collection[str], made: Collection[str], driven: Collection[str] | None = None
) -> str | None:
    """Return the frame of a tool, else the last link of the longest chain of joints; fingers and sensors come last.

    usable: names of frames that can be a tip
    made: names of joints and links that stand for loop joints
    driven: joints with a drive, where each frame is moved by the joints of its own chain alone; None if all have one
    Returns None if nothing moves.
    """
    import pinocchio as pin

    above = [[model.names[j] for j in list(support)[1:]] for support in model.supports]
    of_finger = [any(map(_FINGER.search, chain)) for chain in above]
    frames = [(frame, above[frame.parentJoint], of_finger[frame.parentJoint]) for frame in model.frames]
    bearers = {0}  # the base; what bears a bearer is one, so that each is reached once
    for frame, _, finger in frames:
        if frame.type == pin.FrameType.BODY and frame.name in usable and frame.name not in made:
            while not (finger or _IDLE.search(frame.name)) and frame.parentFrame not in bearers:
                bearers.add(frame.parentFrame)
                frame, _, finger = frames[frame.parentFrame]
    best: tuple[tuple[bool, bool, int, bool, int, int, int], str] | None = None
    for index, (frame, chain, finger) in enumerate(frames):
        if frame.name not in usable or frame.name in made or frame.parentJoint == 0:
            continue
        words = re.split(r"[^a-z0-9]+", frame.name.lower())
        words += [one + other for one, other in pairwise(words)]
        tool = min((i for i, word in enumerate(_TOOLS) if word in words), default=len(_TOOLS))
        is_tool = tool < len(_TOOLS)
        if not is_tool and (frame.type != pin.FrameType.BODY or index in bearers):
            continue
        reach = 0 if finger else len(chain)
        moved = driven is None or not {*driven}.isdisjoint(chain)
        rank = (moved, is_tool and reach > 0, reach, not _IDLE.search(frame.name), -tool, len(chain), index)
        best = max(best, (rank, frame.name)) if best else (rank, frame.name)
    return best[1] if best else None


#: A joint is within its limits up to this, rad (m): angles are printed with some five digits, and a posture moves where
#: loops are closed, or a stop is stabilised.
AT_LIMIT = 1e-5
#: Drives that pull the same joints are independent above this share of their largest singular value: above rounding.
RANK = 1e-12


def _is_kept(array: Vector) -> bool:
    """Whether nobody can write to an array of floats: that of another model, which is then the same object."""
    return array.dtype == np.float64 and array.base is None and not array.flags.writeable


def _read_only(array: Any) -> Any:
    """Return an array to which nobody can write from now on."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A tree of links on a base, moved by n velocities.

    A hinge or a slider has one of them, a ball joint three, a free joint six. A robot without ball joints and free
    joints has as many positions as velocities, nq = n. A free joint is represented by three sliders and a ball joint,
    see `robot_models.coordinates`.

    All arrays are read-only. Angles are in rad, lengths in m; for a prismatic joint read m, m/s, N and kg
    where rad, rad/s, N m and kg m² stand. The columns of every array are `joint_names`, in that order,
    which is the order of the columns of Pinocchio's model.
    """

    name: str
    format: Literal["urdf", "mjcf"]
    #: Self-contained XML. With `locked` it gives the mechanism; with `armature` and `gravity`, the dynamics.
    text: str
    joint_names: tuple[str, ...]
    #: (n,) joint-side drive inertia, kg m²; it adds to the diagonal of the mass matrix.
    armature: Vector
    #: (n,) rad; −∞ where there is none.
    position_lower: Vector
    #: (n,) rad; ∞ where there is none.
    position_upper: Vector
    #: (n,) rad/s; ∞ where there is none, which a URDF writes as 0. A run is judged by it, not held to it.
    velocity_limit: Vector
    #: (n,) N m; ∞ where there is none, which a URDF writes as 0. A run is judged by it, not held to it.
    effort_limit: Vector
    #: "revolute", "continuous", "prismatic", or "ball" three times.
    joint_types: tuple[str, ...]
    #: The frame that touches the surface unless the user names another.
    tip: str | None
    #: Names that can be a tip: links, bodies and sites.
    frames: tuple[str, ...]
    #: (nq,) a sensible posture inside the limits, rad.
    home: Vector
    #: Joints of the text that are held rigid, and where: rad.
    locked: Mapping[str, float] = field(default_factory=dict)
    #: (3,) m/s² in the base frame.
    gravity: Vector = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    description: str = ""
    source: str = ""
    #: What the text says and a run does not act on, a line each: friction, limits.
    notes: tuple[str, ...] = ()
    #: Bodies fixed to frames of the robot, in this order: a tool, a load.
    tools: tuple[Tool, ...] = ()
    #: What of the file is left out, or is not as it should be, a line each.
    warnings: list[str] = field(default_factory=list)
    #: What closes its loops; joint names, frames and arrays are those of the tree that is left without them.
    loops: tuple[LoopJoint, ...] = ()
    #: Joints with a drive; None: all. The others turn freely.
    drives: tuple[str, ...] | None = None
    #: Whether the drives stand behind springs: their inertia is then not in the mass matrix.
    elastic: bool = False
    #: Whether the links that stand for coordinates of loop joints share no mass, see `robot_models.loop_coordinate`.
    whole: bool = False

    def __post_init__(self) -> None:
        self._keep(entry.name for entry in fields(self))
        object.__setattr__(self, "locked", MappingProxyType(dict(self.locked)))

    def _keep(self, names: Iterable[str]) -> None:
        """Have nobody write to those of these attributes that are arrays."""
        for name in names:
            value = getattr(self, name)
            if isinstance(value, np.ndarray) and not _is_kept(value):
                object.__setattr__(self, name, _read_only(np.array(value, dtype=np.float64)))

    def __reduce__(self) -> tuple[Any, ...]:
        # A mapping proxy cannot be pickled, and unpickled arrays would be writable: construct anew instead,
        # so that a model can be sent to the workers of a sweep.
        values = [getattr(self, entry.name) for entry in fields(self)]
        return RobotModel, tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    @property
    def n(self) -> int:
        """Number of velocities: of joints, if none turns freely."""
        return len(self.joint_names)

    @cached_property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the positions, (nq,); of a quaternion w, x, y, z."""
        return coordinate_names(self.joint_names, self.joint_types) if self.balls else self.joint_names

    @cached_property
    def coordinate_types(self) -> tuple[str, ...]:
        """Types of the positions, (nq,): those of `joint_types`, and "quaternion" four times for a ball joint."""
        return coordinate_types(self.joint_types)

    @cached_property
    def loop_home(self) -> Vector:
        """(n,) `home` as a simulation has it inside: rotation vectors instead of quaternions."""
        return with_rotation_vectors(self.home, self.joint_types)

    @cached_property
    def balls(self) -> tuple[int, ...]:
        """The first velocity of each ball joint."""
        return tuple(balls(self.joint_types))

    @cached_property
    def measured(self) -> Vector:
        """1 of each joint that an encoder reads, (n,), 0 of a coordinate of a joint that turns freely."""
        return _read_only(np.where(self.free, 0.0, 1.0))

    @cached_property
    def bodies(self) -> tuple[int, ...]:
        """The first velocity of each free joint."""
        ends = tuple(zip(range(-3, 0), PLACES, strict=True))
        found = []
        for j in self.balls:
            name = self.joint_names[j].removesuffix(RATES[0])
            if j >= 3 and all(self.joint_names[j + k] == name + end for k, end in ends):
                found.append(j - 3)
        return tuple(found)

    @cached_property
    def of_bodies(self) -> NDArray[np.bool_]:
        """(n,) whether each velocity is of a free joint, which holds its body nowhere."""
        found = np.zeros(self.n, dtype=bool)
        for j in self.bodies:
            found[j : j + 6] = True
        return _read_only(found)

    def pinocchio_model(self) -> "pin.Model":
        """Build a fresh Pinocchio model, with nv == n; its positions are those of `coordinates.in_pinocchios_order`.

        Armature, gravity and limits are those of this robot; locked joints are welded; a continuous joint
        is a revolute one without bounds. The model is the caller's to change.

        Raises `ModelError` if the text was tampered with and can no longer be built.
        """
        model = self._built.copy()
        model.armature = self.rigid_armature
        model.gravity.linear = np.array(self.gravity)
        for tool in self.tools:
            tool.mount(model)
        if self.whole:
            from robot_models.loop_coordinate import give_back

            give_back(model, self.loops)
        return model

    @cached_property
    def driven(self) -> NDArray[np.bool_]:
        """(n,) whether each joint has a drive; a free joint or a ball joint has none."""
        found = np.array([self.drives is None or name in self.drives for name in self.joint_names]) & ~self.free
        return _read_only(found)

    @cached_property
    def pulls(self) -> tuple[Mapping[str, float], ...]:
        """What each drive pulls, if one pulls several joints; none else: the torque of a joint for a force of one."""
        return pulls(self.text, self.joint_names) if self.format == "mjcf" else ()

    @property
    def shared_drives(self) -> tuple[Mapping[str, float], ...]:
        """Those of `pulls` that pull several joints."""
        return tuple(pull for pull in self.pulls if len(pull) > 1)

    @cached_property
    def undriven(self) -> Vector:
        """(u, n) orthonormal directions of joint torque to which the drives give none.

        Of a joint without a drive, that of its torque. The drives that pull several joints give the torques Σ f J, with
        J the coefficients of each; the directions perpendicular to these are among them.
        """
        together = {joint for pull in self.shared_drives for joint in pull}
        pulled = np.array([joint in together for joint in self.joint_names], dtype=bool) & self.driven
        found: Vector = np.eye(self.n)[~self.driven]
        if pulled.any():
            given = np.array([[pull.get(joint, 0.0) for joint in self.joint_names] for pull in self.pulls])[:, pulled]
            _, sizes, directions = np.linalg.svd(given)
            lost = directions[np.count_nonzero(sizes > RANK * sizes[0]) :]
            found = np.concatenate([found, np.zeros((len(lost), self.n))])
            found[len(found) - len(lost) :, pulled] = lost
        return _read_only(found)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """(n,) whether each velocity is of a free joint or a ball joint."""
        found = np.zeros(self.n, dtype=bool)
        for j in (*self.balls, *self.bodies):
            found[j : j + 3] = True
        return _read_only(found)

    @property
    def rigid_armature(self) -> Vector:
        """(n,) drive inertia that is in the mass matrix, kg m²: not that of drives behind springs."""
        return np.where(self.driven & self.elastic, 0.0, self.armature)

    @cached_property
    def tendons(self) -> tuple[Tendon, ...]:
        """What acts along linear combinations of joint positions: springs of joints, fixed tendons."""
        return tendons(self.text, self.joint_names, self.locked) if self.format == "mjcf" else ()

    @cached_property
    def springs(self) -> NDArray[np.float64]:
        """A row for each spring, see `robot_models.tendon.springs`."""
        return _read_only(springs(self.tendons, self.joint_names))

    @property
    def loop_coordinates(self) -> tuple[str, ...]:
        """Names of the joints that are coordinates of loop joints."""
        return tuple(name for loop in self.loops for name in loop.coordinates)

    def changed(self, **changes: Any) -> "RobotModel":
        """Return the robot with other tools, gravity or springs in its joints; what its text says is known already."""
        other = object.__new__(type(self))
        vars(other).update({**vars(self), "_built": self._built, "known": self.known, **changes})
        other._keep(changes)
        return other

    @cached_property
    def known(self) -> dict[Any, Any]:
        """What others have made of its joints, frames and links, which is the same where it is `changed`."""
        return {}

    @property
    def without_tools(self) -> tuple[Any, ...]:
        """What it is made of but for the tools: the same objects for a robot that was `changed` in them alone."""
        return self._built, self.gravity, self.elastic, self.armature, self.home, self.tip, self.drives, self.whole

    @cached_property
    def _built(self) -> "pin.Model":
        """What `robot_models.build` makes of the text, once: reading and checking it takes as long as 3000 steps."""
        from robot_models.build import build

        return build(self.text, self.format, self.locked, self.name).model

    def require_frame(self, tip: str) -> str:
        """Return `tip` if it names a frame of the robot.

        Raises `ModelError` if it does not; the message lists the nearest names.
        """
        if tip in self.frames:
            return tip
        near = get_close_matches(tip, self.frames, n=3, cutoff=0.4) or list(self.frames[-3:])
        raise ModelError(f"{self.name} has no frame {tip!r}: did you mean {' or '.join(map(repr, near))}?")
