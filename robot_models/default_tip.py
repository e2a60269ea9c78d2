"""Which frame of a robot touches a surface if nobody says: the frame of a tool, or the end of the longest chain.

Frames that no drive moves, as those of a body beside the robot, come last.
"""

import re
from collections.abc import Collection
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pinocchio as pin

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
