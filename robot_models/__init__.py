"""Robots as data: a few of our own, those of example-robot-data, and any URDF or MJCF file.

    robot = robot_models.load("wam4")
    model = robot.pinocchio_model()

Importing this package imports no engine; `load` does.
"""

from robot_models.described import shipped_names
from robot_models.errors import ClosedLoopError, ModelError
from robot_models.load import from_text, load
from robot_models.model import RobotModel, Tool

__all__ = ["ClosedLoopError", "ModelError", "RobotModel", "Tool", "from_text", "load", "shipped_names"]
