"""The arm of a scenario: a robot with its tip, gravity, the tool on it and the payload in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from closedloop.errors import ScenarioError
from closedloop.friction.law import JointFriction
from closedloop.friction.laws.coulomb_viscous import JointCoulombViscous
from closedloop.robot.pinocchio import Robot
from closedloop.scenario.robot_sections import ToolSection
from closedloop.scenario.scenario import Scenario
from closedloop.surface.plane import unit
from robot_models import RobotModel, Tool
from robot_models.joint_dynamics import joint_dynamics


def robot_of(scenario: Scenario, model: RobotModel) -> Robot:
    """Return the robot of a scenario, with its gravity, tool, payload and elastic joints, from the model without them.

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
    if tip is not None and tool != ToolSection(axis=tool.axis, radius=tool.radius):
        model.require_frame(tip)
        tools.append(Tool(tip, tool.offset, tool.mass, tool.centre, tool.inertia))
        tools[0].tensor()
    if tip is not None and payload:
        model.require_frame(tip)
        tools.append(Tool(tip, mass=payload))  # at the tip as the tool has it
    changes: dict[str, Any] = {"tools": tuple(tools)} if tools else {}
    if scenario.robot.gravity is not None:
        changes["gravity"] = np.array(scenario.robot.gravity)
    if scenario.transmission.elastic:
        changes["elastic"] = True
    return Robot(replace(model, **changes) if changes else model, scenario.robot.tip)


def joint_friction_of(scenario: Scenario, model: RobotModel) -> JointFriction:
    """Return the law of friction in the joints: the scenario's, or that of the robot's file on request.

    Raises
    ------
    ScenarioError
        If both are asked for.
    ModelError
        If the file has none.
    """
    if not scenario.robot.friction:
        return scenario.joint_friction
    if scenario.joint_friction.kind != "none":
        raise ScenarioError(
            f"robot.friction = true with joint_friction.kind = {scenario.joint_friction.kind!r}: friction in "
            "the joints is that of the robot's file or the scenario's; leave out one of them"
        )
    damping, friction = joint_dynamics(model)
    return JointCoulombViscous(kinetic=tuple(friction.tolist()), viscous=tuple(damping.tolist()))


def without_tools(model: RobotModel) -> RobotModel:
    """Return the model without tool, payload and elastic joints, which the scenario says."""
    return replace(model, tools=(), elastic=False) if model.tools or model.elastic else model
