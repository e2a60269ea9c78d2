"""A UR10: the torque of a log predicted where it was not fitted.

The torques are motor currents times the published drive gains, smoothed by the authors. Drive inertia comes out
negative at the wrist, which no drive has, and is not given: friction that answers late to a change of speed has the
same column, −(delay) F_v q̈. Torques moved in time by −16 to 56 ms, a Stribeck, a square root or a cubic term do not
mend it. The published friction of this robot, a sigmoid of the velocity, differs from dry and viscous friction near
rest only, where torques do not count here: a Stribeck term changes no error by more than 0.4 %. Source of log and
drive gains: V. Petrone, E. Ferrentino, P. Chiacchio, The dynamic model of the UR10 robot and its ROS2 integration,
IEEE Trans. Industrial Informatics (2025), doi 10.1109/TII.2025.3534415.
"""

from pathlib import Path

from closedloop.studies.identify.identify import identify
from closedloop.studies.identify.motion import Log
from validation.measured.judged import Judged, add_forward, add_parameters, add_torques, columns

CUTOFF = 5.0  # Hz; the torques were smoothed
SLOW = 0.03  # the velocity's sign is sure above this share of the largest: torque and motion were smoothed


def judge(given: Path | None = None) -> Judged:
    """Identify the robot, and judge its torques where they were not fitted."""
    read = columns("ur10_log.npz", {"time": 0, "q": 6, "v": 6, "effort": 6}, given)
    source = "ur10_log.npz" if given is None else str(given)
    log = Log(read["time"], read["q"], read["effort"], v=read["v"], source=source)
    result = identify(log, "ur10", cutoff=CUTOFF, slow=SLOW)
    judged = Judged("Universal Robots UR10", "unisa-acg/inverse-dynamics-solver, BSD-3")
    add_parameters(judged, result, ("viscous", "dry", "offset", "drive_inertia"))
    add_torques(judged, result, "the last quarter of each tenth of the log")
    add_forward(judged, result, log)
    return judged
