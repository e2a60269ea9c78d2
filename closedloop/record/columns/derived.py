"""Columns of a run that follow from its others: worked out when they are first asked for, and not in run.nc.

They are attributes of a `Run`, and stand beside the recorded ones in CSV and pandas.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import Array
from closedloop.control.reference.orientation import turned_by
from closedloop.mechanics.loops.reactions import LoopReactions, loop_reactions, loop_rows, share_of_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.plane import unit
from closedloop.record.columns.record import Record
from closedloop.record.columns.touching import contact_torques
from closedloop.scenario.arm import has_stops, robot_of, stop_limits, without_tools
from robot_models.coordinates import with_rotation_vectors

# A joint nearer to its limit than this, rad (m), may be at its stop, where the stabiliser keeps it.
AT_STOP = 1e-7
# Labels of the parts of a wrench.
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")


class DerivedColumn(NamedTuple):
    """Dimensions, unit and meaning, as of a `closedloop.record.columns.recorded.Column`, and what works it out."""

    dims: tuple[str, ...]
    units: str
    meaning: str
    of: Callable[[Record], Array]


def loop_positions(run: Record) -> Array:
    """Return the joint positions as the loop has them, (N, n), rad (m): a rotation vector for each quaternion."""
    return with_rotation_vectors(run.q, run.model.joint_types)


def tip_force(run: Record) -> Array:
    """Return f n and friction, (N, 3), N, base axes."""
    return run.contact_force[:, None] * run.surface_normal + run.friction_force


def reactions_of(run: Record, robot: Robot) -> LoopReactions:
    """Return what the loops of a mechanism carried, its robot being that of the run's scenario."""
    torque = _drive(run) + run.joint_friction + _of_contacts(run, robot)
    return loop_reactions(robot, run.q, run.v, run.acceleration, torque, tip_force(run), at_stop(run))


def _drive(run: Record) -> Array:
    """Return what drives the links in each row, (N, n), N m (N): Q, or what elastic joints pass on."""
    return run.transmitted_torque if run.scenario.transmission.elastic else run.torque


def tip_moment(run: Record) -> Array:
    """Return the moment of the force of the surface about the tip's centre, (N, 3), N m, base axes."""
    return np.cross(-run.scenario.tool.radius * run.surface_normal, run.friction_force)


def _of_contacts(run: Record, robot: Robot) -> Array:
    """Return the torques of the contacts of links in each row, and of the moment at the tip, (N, n), N m (N)."""
    of_tip = np.zeros(run.v.shape)
    if run.scenario.tool.radius > 0.0:
        for k, moment in enumerate(tip_moment(run)):
            of_tip[k] = robot.frame_jacobian(run.q[k])[3:].T @ moment
    if not run.scenario.contact:
        return of_tip
    model = without_tools(robot.model).pinocchio_model()
    q = robot.pinocchios(run.q)
    resists = any(section.resists for section in run.scenario.contact)
    moments = (run.link_rolling_moments, run.link_pivoting_moments) if resists else ()
    of_links = contact_torques(run.scenario, model, run.time, q, run.link_forces, run.link_frictions, *moments)
    return of_tip + of_links


def wrist_wrench(run: Record) -> Array:
    """Return what `Robot.wrist_wrench` says of each row, (N, 6)."""
    robot = robot_of(run.scenario, without_tools(run.model))
    return robot.wrist_wrench(run.q, run.v, run.acceleration, tip_force(run), tip_moment(run))


def tool_angle(run: Record) -> Array:
    """Return the angle between `tool.axis` and -n in each row, (N,), degrees."""
    robot = robot_of(run.scenario, without_tools(run.model))
    axis = robot.tip_axes(run.q) @ unit(run.scenario.tool.axis, "tool.axis")
    across = np.linalg.norm(np.cross(axis, run.surface_normal), axis=1)
    return np.degrees(np.arctan2(across, -np.sum(axis * run.surface_normal, axis=1)))


def orientation_error(run: Record) -> Array:
    """Return the angle between the tip's frames at q and at q_des in each row, (N,), degrees."""
    robot = robot_of(run.scenario, without_tools(run.model))
    return np.degrees(turned_by(robot.tip_axes(run.q), robot.tip_axes(run.reference_position)))


def stop_torque(run: Record) -> Array:
    """Return what the stops of the joints give in each row, (N, n), N m (N); zero of a joint that is at none."""
    if not has_stops(run.scenario, run.model):
        return np.zeros(run.v.shape)
    robot = robot_of(run.scenario, without_tools(run.model))
    known = _drive(run) + run.joint_friction + _of_contacts(run, robot)
    found = robot.needed_torque(run.q, run.v, run.acceleration, tip_force(run)) - known
    there = at_stop(run)
    if robot.model.loops:
        rows, _ = loop_rows(robot, run.q, run.v)
        return share_of_rows(rows, found, there)[1]
    return np.where(there, found, 0.0)


def at_stop(run: Record) -> NDArray[np.bool_]:
    """Return which joints are at a stop in each row, (N, n); all False where there are no stops."""
    lower, upper = stop_limits(run.scenario, run.model)
    q = loop_positions(run)
    return (q >= upper - AT_STOP) | (q <= lower + AT_STOP)


DERIVED: dict[str, DerivedColumn] = {
    "tip_force": DerivedColumn(
        ("time", "axis"), "N", "force of the surface on the tip, friction included, base frame", tip_force
    ),
    "wrist_wrench": DerivedColumn(
        ("time", "component"), "N | N m", "force and moment of the arm on what is fixed to the frame robot.tip, tool "
        "and payload, as a sensor there reads them: in that frame's axes and about its origin", wrist_wrench,
    ),
    "tool_angle": DerivedColumn(
        ("time",), "deg", "angle between the tool's axis and the normal into the surface", tool_angle
    ),
    "orientation_error": DerivedColumn(
        ("time",), "deg", "angle by which the tip's frame is turned away from that of q_des", orientation_error
    ),
    "stop_torque": DerivedColumn(
        ("time", "joint"), "N m", "torque of the stops on the joints, where robot.stops asks for them", stop_torque
    ),
}  # fmt: skip
