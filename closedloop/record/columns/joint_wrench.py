"""The reaction wrench at a joint: what its inner side passes on to its outer side, from the record of a run.

It is what moves all that hangs on the joint: Newton's and Euler's equations of the bodies outward of it, less their
weight and less the forces of surfaces and of other links on them (R. Featherstone, Rigid Body Dynamics Algorithms,
2008, Sec. 5.3). Along the joint's own axis it is what drive, friction, spring and stop give together.
"""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.record.columns.derived import tip_force, tip_moment
from closedloop.record.columns.record import Record
from closedloop.record.columns.touching import contacts_of, frames_in_rows, placed_frame, wrenches_on_links
from closedloop.scenario.arm import robot_of, without_tools
from robot_models import RobotModel
from robot_models.errors import shown
from robot_models.loop_joint import WORLD

JOINT = "joint"


def check_joint(model: RobotModel, joint: str, frame: str = JOINT) -> None:
    """Refuse a joint or a frame that a robot does not have, and a robot with loops."""
    if model.loops:
        raise ScenarioError(
            f"joint_wrench: {model.name} has loops, and what their joints carry is in run.loops: only a tree's joints "
            "have a wrench of their own"
        )
    names = list(model.pinocchio_model().names)[1:]
    if joint not in names:
        raise ScenarioError(f"joint_wrench: joint = {shown(joint)}: must be one of {', '.join(names)}")
    if frame not in (JOINT, WORLD):
        model.require_frame(frame)


def joint_wrench(run: Record, joint: str, frame: str = JOINT) -> Array:
    """Return the wrench at a joint in each row, (N, 6), N and N m; see `closedloop.Run.joint_wrench`."""
    import pinocchio as pin

    check_joint(run.model, joint, frame)
    robot = robot_of(run.scenario, without_tools(run.model))
    _, _, _, mechanism, data = robot.passes
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
        for link, wrench in wrenches_on_links(contacts_of(run.scenario, mechanism), run.time, axes, origins, carried):
            outside[:, link] += wrench
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
