"""The arm of a scenario: a robot with its tip, the tool on it and the payload in it."""

from __future__ import annotations

from dataclasses import replace

from closedloop.errors import ScenarioError
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.scenario import Scenario, ToolSection
from robot_models import RobotModel, Tool


def robot_of(scenario: Scenario, model: RobotModel) -> Robot:
    """Return the robot of a scenario, with its tool and payload, from the model without them.

    Raises
    ------
    ModelError
        If it has no such tip, or no body has such a tensor.
    ScenarioError
        If a tool without mass has a centre of mass or a tensor.
    """
    tool, payload = scenario.tool, scenario.model_error.payload
    tip = model.tip if scenario.robot.tip is None else scenario.robot.tip
    tools = []
    if tool.mass == 0.0 and (any(tool.centre) or any(tool.inertia)):
        raise ScenarioError("tool.mass = 0: a tool with a centre of mass or a tensor has a mass; give it, in kg")
    if tip is not None and tool != ToolSection():
        model.require_frame(tip)
        tools.append(Tool(tip, tool.offset, tool.mass, tool.centre, tool.inertia))
        tools[0].tensor()
    if tip is not None and payload:
        model.require_frame(tip)
        tools.append(Tool(tip, mass=payload))  # at the tip as the tool has it
    return Robot(replace(model, tools=tuple(tools)) if tools else model, scenario.robot.tip)


def without_tools(model: RobotModel) -> RobotModel:
    """Return the model without tool and payload, which the scenario says."""
    return replace(model, tools=()) if model.tools else model
