"""A tool on the tip, or a load in it: where its own tip is, and its mass.

If nobody names a tip, it is the frame of a tool, or the end of the longest chain. Frames that no drive moves, as those
of a body beside the robot, come last.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_models.errors import ModelError

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
        xx, yy, zz, xy, xz, yz = self.inertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
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
