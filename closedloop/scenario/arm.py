"""The arm of a scenario: a robot with its tip, gravity, the tool on it and the payload in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import ModelError, ScenarioError
from closedloop.jit.parameters import per_joint
from closedloop.mechanics.friction.law import JointFriction
from closedloop.mechanics.friction.laws.coulomb_viscous import JointCoulombViscous
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.plane import unit
from closedloop.scenario.robot_sections import ToolSection
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel, Tool
from robot_models.coordinates import normalised, with_rotation_vectors
from robot_models.joint_dynamics import joint_dynamics, loop_dynamics

Array = NDArray[np.float64]


def start_posture(scenario: Scenario, model: RobotModel) -> Array:
    """Return q (n,) at the start as the loop has it: a joint that turns freely by its rotation vector, rad.

    Raises
    ------
    ScenarioError
        If `start.q` has not one entry for each coordinate, or a quaternion in it has no length.
    """
    if scenario.start.q is None:
        q = model.home.copy()
    else:
        q = np.array(per_joint("start.q", scenario.start.q, len(model.coordinate_names)))
    if not model.balls:
        return q
    try:
        return with_rotation_vectors(normalised(q, model.joint_types, "start.q"), model.joint_types)
    except ModelError as error:
        raise ScenarioError(str(error)) from None


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
    """Return the law of friction in the joints: the scenario's, or that of the robot's file.

    What a loop joint of the file says of friction acts; what a joint says, on request.

    Raises
    ------
    ScenarioError
        If there are both.
    ModelError
        If it is asked for, and the file has none.
    """
    if not scenario.robot.friction:
        damping, friction = loop_dynamics(model)
        if not (np.any(damping) or np.any(friction)):
            return scenario.joint_friction
        if scenario.joint_friction.kind != "none":
            raise ScenarioError(
                f"joint_friction.kind = {scenario.joint_friction.kind!r}: loop joints of {model.name} have friction in "
                "the robot's sidecar: leave out that, or joint_friction"
            )
        return JointCoulombViscous(kinetic=tuple(friction.tolist()), viscous=tuple(damping.tolist()))
    if scenario.joint_friction.kind != "none":
        raise ScenarioError(
            f"robot.friction = true with joint_friction.kind = {scenario.joint_friction.kind!r}: joint friction "
            "comes from the robot's file or from the scenario; leave out one of them"
        )
    damping, friction = joint_dynamics(model)
    return JointCoulombViscous(kinetic=tuple(friction.tolist()), viscous=tuple(damping.tolist()))


def stop_limits(scenario: Scenario, model: RobotModel) -> tuple[Array, Array]:
    """Return where the joints have hard stops, lower and upper, (n,), rad (m), infinite where there is none.

    The limits of a loop joint always are stops; those of the robot's joints if the scenario says so.
    """
    there = np.array([scenario.robot.stops or name in model.loop_coordinates for name in model.joint_names])
    return np.where(there, model.position_lower, -np.inf), np.where(there, model.position_upper, np.inf)


def has_stops(scenario: Scenario, model: RobotModel) -> bool:
    """Whether a joint has a hard stop."""
    limits = stop_limits(scenario, model)
    return scenario.robot.stops or bool(np.isfinite(limits).any())


def without_tools(model: RobotModel) -> RobotModel:
    """Return the model without tool, payload and elastic joints, which the scenario says."""
    return replace(model, tools=(), elastic=False) if model.tools or model.elastic else model
