"""Wrenches from the record of a run: of a face of several contacts, with its centre of pressure, and at a joint.

The reaction at a joint is what its inner side passes on to its outer side. It moves all that hangs on the joint:
Newton's and Euler's equations of the bodies outward of it, less their weight and less the forces on them of surfaces,
of other links, of loop joints and from outside (R. Featherstone, Rigid Body Dynamics
Algorithms, 2008, Sec. 5.3). Along the joint's own axis it is what drive, friction, spring and stop give together.
"""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.mechanics.loops.reactions import loop_wrenches
from closedloop.record.columns.derived import reactions_of, tip_force, tip_moment
from closedloop.record.columns.record import Record
from closedloop.record.columns.touching import (
    contacts_of,
    external_wrenches,
    frames_in_rows,
    moved_wrench,
    placed_frame,
    wrenches_on_links,
)
from closedloop.scenario.arm import robot_of, without_tools
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import names_of, patches_of
from robot_models import RobotModel
from robot_models.errors import shown
from robot_models.loop_joint import WORLD


def numbers_of(scenario: Scenario, name: str) -> list[int]:
    """Return the numbers, from 0, of the contacts of a name: of all points of a face, or of one of them."""
    sections = scenario.contact or ()
    each = {own: [k] for k, own in enumerate(names_of(sections))}
    found = patches_of(sections) | each
    if name not in found:
        there = ", ".join(patches_of(sections)) or "the run has no [[contact]]"
        raise ScenarioError(f"contact_wrench: name = {shown(name)}: there is no such contact: {there}")
    return found[name]


def face_wrench(run: Record, name: str) -> Array:
    """Return force, moment and centre of pressure, (N, 9); see `closedloop.Run.contact_wrench`."""
    numbers = numbers_of(run.scenario, name)
    robot = robot_of(run.scenario, without_tools(run.model))
    mechanism = robot.passes[3]
    axes, origins, _ = frames_in_rows(mechanism, robot.pinocchios(run.q), list(range(1, mechanism.njoints)))
    contacts = contacts_of(run.scenario, mechanism)
    first = contacts[numbers[0]]
    middle = np.mean([contacts[k].point for k in numbers], axis=0)
    about = origins[:, first.point_frame] + axes[:, first.point_frame] @ middle
    force, moment, pressed = np.zeros((3, len(run), 3))
    total = np.zeros(len(run))
    for k in numbers:
        normal = run.link_forces[:, k]
        place, each = contacts[k].forces(normal, run.link_frictions[:, 2 * k : 2 * k + 2], axes, origins, run.time)
        force += each
        moment += np.cross(place - about, each)
        pressed += normal[:, None] * place
        total += normal
    centre = pressed / np.where(total > 0.0, total, np.nan)[:, None]
    return np.hstack([force, moment, centre])


JOINT = "joint"


def check_joint(model: RobotModel, joint: str, frame: str = JOINT) -> None:
    """Refuse a joint or a frame that a robot does not have, and a joint that closes a loop."""
    names = list(model.pinocchio_model().names)[1:]
    if joint not in names:
        beside = "; what loop joints carry is in run.loops" if model.loops else ""
        raise ScenarioError(f"joint_wrench: joint = {shown(joint)}: must be one of {', '.join(names)}{beside}")
    if frame not in (JOINT, WORLD):
        model.require_frame(frame)


def joint_wrench(run: Record, joint: str, frame: str = JOINT) -> Array:
    """Return the wrench at a joint in each row, (N, 6), N and N m; see `closedloop.Run.joint_wrench`."""
    import pinocchio as pin

    check_joint(run.model, joint, frame)
    robot = robot_of(run.scenario, without_tools(run.model))
    _, _, _, mechanism, data = robot.passes
    bare = without_tools(robot.model).pinocchio_model()  # whose frames no tool moves
    number = mechanism.getJointId(joint)
    q, outside = robot.pinocchios(run.q), np.zeros((len(run), mechanism.njoints, 6))
    axes, origins, _ = frames_in_rows(mechanism, q, list(range(1, mechanism.njoints)))
    tip, force = mechanism.frames[mechanism.getFrameId(robot.tip)].parentJoint, tip_force(run)
    about = np.cross(run.position - origins[:, tip], force) + tip_moment(run)
    outside[:, tip] += np.concatenate([force, about], axis=1)
    if run.scenario.contact:
        resists = any(section.resists for section in run.scenario.contact)
        moments = (run.link_rolling_moments, run.link_pivoting_moments) if resists else (None, None)
        carried = (run.link_forces, run.link_frictions, *moments)
        for link, wrench in wrenches_on_links(contacts_of(run.scenario, bare), run.time, axes, origins, carried):
            outside[:, link] += wrench
    for link, place, wrench in external_wrenches(run, bare, robot.tip, axes, origins):
        outside[:, link] += moved_wrench(wrench, place - origins[:, link])
    if run.model.loops:
        for sides, place, wrench in loop_wrenches(robot, run.q, reactions_of(run, robot).reactions):
            for side, sign in zip(sides, (1.0, -1.0), strict=True):
                link = placed_frame(bare, side)[0]
                outside[:, link] += sign * moved_wrench(wrench, place - origins[:, link])
    carrier, within, _ = placed_frame(mechanism, WORLD if frame == JOINT else frame)
    found = np.empty((len(run), 6))
    for k in range(len(run)):
        turned = pin.StdVec_Force()
        for link in range(mechanism.njoints):
            turned.append(pin.Force(axes[k, link].T @ outside[k, link, :3], axes[k, link].T @ outside[k, link, 3:]))
        pin.rnea(mechanism, data, q[k], *map(np.ascontiguousarray, (run.v[k], run.acceleration[k])), turned)
        turn = np.eye(3) if frame == JOINT else (axes[k, carrier] @ within).T @ axes[k, number]
        own = data.f[number]
        found[k] = np.concatenate([turn @ own.linear, turn @ own.angular])
    return found
