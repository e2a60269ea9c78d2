"""The arm of a scenario: a robot with its tip, gravity, the tool on it and the payload in it, and where it starts."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError, ScenarioError
from closedloop.jit.parameters import lists_per_joint
from closedloop.mechanics.friction.law import JointFriction
from closedloop.mechanics.friction.laws.coulomb_viscous import JointCoulombViscous
from closedloop.mechanics.loops.moved import MovedFrame
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import unit
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel, Tool
from robot_models.bodies import FreeBody, with_bodies
from robot_models.coordinates import PARTS, PLACES, RATES, in_pinocchios_order, normalised, with_rotation_vectors
from robot_models.loop_coordinate import coordinate_rates, place_coordinates
from robot_models.tendon import joint_dynamics, loop_dynamics, rough_tendons


def start_posture(scenario: Scenario, model: RobotModel) -> Array:
    """Return q (n,) at the start as the loop has it: a joint that turns freely by its rotation vector, rad."""
    q = start_positions(scenario, model)
    if not model.balls:
        return q
    try:
        return with_rotation_vectors(normalised(q, model.joint_types, "start.q"), model.joint_types)
    except ModelError as error:
        raise ScenarioError(str(error)) from None


def start_positions(scenario: Scenario, model: RobotModel) -> Array:
    """Return q (nq,) at the start: `start.q`, or home; what moves freely and is left out is where its [[body]] is."""
    given, names = scenario.start.q, model.coordinate_names
    if given is not None and len(given) == len(names):
        return np.array(given)
    placed = dict(zip(names, model.home.tolist(), strict=True))
    for body in scenario.body or ():
        pose = zip((*PLACES, *PARTS), (*body.position, *body.quaternion), strict=True)
        placed |= {body.name + end: value for end, value in pose}
    return _whole("start.q", given, np.array([placed[name] for name in names]), names, model)


def start_velocities(scenario: Scenario, model: RobotModel) -> Array:
    """Return q̇ (n,) at the start, with each [[body]] as it moves; of `start.v` see `start_positions`."""
    names, given = model.joint_names, scenario.start.v
    if given is not None and len(given) == len(names):
        return np.array(given)
    moving = dict.fromkeys(names, 0.0)
    for body in scenario.body or ():
        rates = zip((*PLACES, *RATES), (*body.velocity, *body.spin), strict=True)
        moving |= {body.name + end: value for end, value in rates}
    return _whole("start.v", given, np.array([moving[name] for name in names]), names, model)


def _whole(
    key: str, given: tuple[float, ...] | None, values: Array, names: tuple[str, ...], model: RobotModel
) -> Array:
    """Return `values` with the entries of a list that lacks some: it has those of what is not free."""
    if given is None:
        return values
    held = np.isin(names, np.array(model.joint_names)[~model.free])
    if len(given) == held.sum():
        values[held] = given
        return values
    what = f"{model.name} has {len(names)} joints" if not model.balls else f"for {model.name} it has {len(names)}"
    less = f", or {held.sum()} without those that move freely" if 0 < held.sum() < len(names) else ""
    raise ScenarioError(f"{key} has {len(given)} entries: {what}{less}, in the order {', '.join(names)}")


def is_of_model(key: str) -> bool:
    """Whether an overridden key says which robot it is, or which bodies are beside it."""
    return key.startswith(("robot.", "body", "mocap")) and key != "robot.tip"


def beside_bodies(scenario: Scenario, model: RobotModel) -> RobotModel:
    """Return a robot with each [[body]] of a scenario beside it; itself if it has bodies of these names."""
    own = {model.joint_names[j].removesuffix(PLACES[0]) for j in model.bodies}
    return with_bodies(model, [body for body in free_bodies(scenario) if body.name not in own])


def free_bodies(scenario: Scenario) -> list[FreeBody]:
    """Return each [[body]] of a scenario."""
    return [
        FreeBody(each.name, each.shape, each.size, each.mass, each.position, each.quaternion, each.inertia)
        for each in scenario.body or ()
    ]


def robot_of(scenario: Scenario, model: RobotModel) -> Robot:
    """Return the robot of a scenario, with gravity, tool, payload and elastic joints, from the model without them."""
    model = beside_bodies(scenario, model)
    tool, payload = scenario.tool, scenario.model_error.payload
    tip = model.tip if scenario.robot.tip is None else scenario.robot.tip
    tools = []
    unit(tool.axis, "tool.axis")
    if tool.mass == 0.0 and (any(tool.centre) or any(tool.inertia)):
        raise ScenarioError("tool.mass = 0: a tool with a centre of mass or a tensor has a mass; give it, in kg")
    if tip is not None and any((*tool.offset, tool.mass, *tool.centre, *tool.inertia)):
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
    robot = Robot(model.changed(**changes) if changes else model, scenario.robot.tip)
    return Robot(robot.model, robot.tip, moved_frames(scenario, robot)) if scenario.mocap else robot


def moved_frames(scenario: Scenario, robot: Robot) -> tuple[MovedFrame, ...]:
    """Return each [[mocap]] where the robot has it; ScenarioError if no loop holds it, fixed to the world."""
    found: list[MovedFrame] = []
    for k, section in enumerate(scenario.mocap or ()):
        where = f"mocap.{k}.frame = {section.frame!r}"
        fixed = robot.frames_at_rest() - {name for frame in found for name in frame.names}
        if section.frame not in fixed:
            known = ", ".join(sorted(fixed)) or "it has none"
            raise ScenarioError(f"{where}: must be a frame of the robot that is fixed to the world: {known}")
        names = robot.fixed_to(section.frame)
        if not any(name in names for loop in robot.model.loops for name in loop.frames):
            raise ScenarioError(
                f"{where}: no loop joint holds onto it: an MJCF has a <weld> or <connect> to this mocap body, and the "
                "sidecar of a URDF a [[closed_loop]] of this frame"
            )
        _, axes, origin = robot.frame_at(section.frame, robot.model.home)
        found.append(MovedFrame(names, section.motion, axes, origin))
    return tuple(found)


def joint_friction_of(scenario: Scenario, model: RobotModel) -> JointFriction:
    """Return the law of friction in the joints: the scenario's, or the file's, of loops always, else on request."""
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
    """Return where stops are, lower and upper, (n,), rad (m), infinite: none; of loops always, else on request."""
    there = np.array([scenario.robot.stops or name in model.loop_coordinates for name in model.joint_names])
    return np.where(there, model.position_lower, -np.inf), np.where(there, model.position_upper, np.inf)


def acting_tendons(scenario: Scenario, model: RobotModel) -> Array:
    """Return what of the robot's tendons rubs and stops, on request, see `robot_models.tendon.rough_tendons`."""
    return rough_tendons(model.tendons, model.joint_names, scenario.robot.friction, scenario.robot.stops)


def has_stops(scenario: Scenario, model: RobotModel) -> bool:
    """Whether a joint has a hard stop."""
    if scenario.robot.stops or not model.loop_coordinates:
        return scenario.robot.stops
    return bool(np.isfinite(stop_limits(scenario, model)).any())


@lru_cache(maxsize=8)
def without_tools(model: RobotModel) -> RobotModel:
    """Return the model without tool, payload and elastic joints, which the scenario says."""
    return replace(model, tools=(), elastic=False) if model.tools or model.elastic else model


def with_all_entries(scenario: Scenario, model: RobotModel) -> Scenario:
    """Return a scenario whose start, law and friction have entries for joints without any, as free bodies' friction."""
    names, driven = model.loop_coordinates, model.joint_names if model.drives is None else model.drives
    given = np.array([name not in names or name in driven for name in model.joint_names], dtype=bool) & ~model.free
    count = int(given.sum())
    if count == model.n:
        return scenario

    start = _started(scenario, model, given) if names else {}
    lists = {
        name: tuple(_filled(values, given).tolist())
        for name, values in lists_per_joint(scenario.law).items()
        if len(values) == count
    }
    held = ~model.of_bodies
    in_joints = {
        name: tuple(_filled(values, held).tolist())
        for name, values in lists_per_joint(scenario.joint_friction).items()
        if len(values) == held.sum() < model.n
    }
    if not start and not lists and not in_joints:
        return scenario
    sections = ("start", start), ("law", lists), ("joint_friction", in_joints)
    return scenario.model_copy(
        update={name: getattr(scenario, name).model_copy(update=values) for name, values in sections if values}
    )


def _filled(values: Any, given: NDArray[np.bool_]) -> Array:
    """Return values with a zero for each joint that is not given."""
    whole = np.zeros(len(given))
    whole[given] = values
    return whole


def _started(scenario: Scenario, model: RobotModel, given: NDArray[np.bool_]) -> dict[str, Any]:
    """Return start.q and start.v with the coordinates of loop joints that they leave out, where they do."""
    q, v, count, start = scenario.start.q, scenario.start.v, int(given.sum()), {}
    types, built, posture = model.joint_types, model.pinocchio_model(), model.home
    held, own = (np.isin(model.coordinate_names, np.array(model.joint_names)[these]) for these in (~model.free, given))
    if q is not None:
        if len(q) not in (count, held.sum(), len(held)):
            return {}
        posture = posture.copy()
        everything = np.ones(len(held), dtype=bool)
        posture[{count: own, len(held): everything}.get(len(q), held)] = q
        if len(q) == count:
            placed = place_coordinates(built, model.loops, in_pinocchios_order(posture, types))
            posture = np.where(held & ~own, placed, posture)
            start["q"] = tuple(posture[held].tolist())
    if v is not None and len(v) == count:
        found = _filled(v, given)
        rates = coordinate_rates(built, model.loops, in_pinocchios_order(posture, types), found)
        start["v"] = tuple(np.where(given, found, rates)[~model.free].tolist())
    return start
