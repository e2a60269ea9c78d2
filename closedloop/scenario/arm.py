"""The arm of a scenario: a robot with its tip, gravity, the tool on it and the payload in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from closedloop.errors import ScenarioError
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.scenario import Scenario, ToolSection
from closedloop.surface.plane import unit
from robot_models import RobotModel, Tool


def robot_of(scenario: Scenario, model: RobotModel) -> Robot:
    """Return the robot of a scenario, with its gravity, tool and payload, from the model without tool and payload.

    Raises
    ------
    ScenarioError
        If the tool's axis has no direction, or a tool without mass has a centre of mass or a tensor.
    ModelError
        If it has no such tip, or no body has such a tensor.
    """
    tool, payload = scenario.tool, scenario.model_error.payload
    tip = model.tip if scenario.robot.tip is None else scenario.robot.tip
    tools = []
    unit(tool.axis, "tool.axis")
    if tool.mass == 0.0 and (any(tool.centre) or any(tool.inertia)):
        raise ScenarioError("tool.mass = 0: a tool with a centre of mass or a tensor has a mass; give it, in kg")
    if tip is not None and tool != ToolSection(axis=tool.axis):
        model.require_frame(tip)
        tools.append(Tool(tip, tool.offset, tool.mass, tool.centre, tool.inertia))
        tools[0].tensor()
    if tip is not None and payload:
        model.require_frame(tip)
        tools.append(Tool(tip, mass=payload))  # at the tip as the tool has it
    changes: dict[str, Any] = {"tools": tuple(tools)} if tools else {}
    if scenario.robot.gravity is not None:
        changes["gravity"] = np.array(scenario.robot.gravity)
    return Robot(replace(model, **changes) if changes else model, scenario.robot.tip)


def without_tools(model: RobotModel) -> RobotModel:
    """Return the model without tool and payload, which the scenario says."""
    return replace(model, tools=()) if model.tools else model
