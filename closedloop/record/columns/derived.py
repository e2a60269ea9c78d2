"""Columns that are made of recorded ones, and those that a user adds.

Columns that follow from others are worked out when they are first asked for, and are not in run.nc. They are
attributes of a `Run`, and stand beside the recorded ones in CSV and pandas.

Only some runs have the states of their control laws, and what functions of one's own add. What such a column is cannot
be looked up in a table: a `Run` has it as `added`, and its file as the attribute `added`.

Wrenches follow from the record too: of a face of several contacts, with its centre of pressure, and at a joint.

The reaction at a joint is what its inner side passes on to its outer side. It moves all that hangs on the joint:
Newton's and Euler's equations of the bodies outward of it, less their weight and less the forces on them of surfaces,
of other links, of loop joints and from outside (R. Featherstone, Rigid Body Dynamics Algorithms, 2008, Sec. 5.3). Along
the joint's own axis it is what drive, friction, spring and stop give together.
"""

import json
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from traceback import extract_tb
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closedloop.base.arrays import Array
from closedloop.base.errors import LawError, ScenarioError, one_line
from closedloop.control.law import Compensation, ControlLaw
from closedloop.control.reference.path import turned_by
from closedloop.jit.parameters import state_block
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.mechanics.loops.reactions import LoopReactions, loop_reactions, loop_rows, loop_wrenches, share_of_rows
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.surface.placed import unit
from closedloop.record.columns import touching
from closedloop.record.columns.record import CONTACT_COLUMNS, RESISTANCE_COLUMNS, Column, Record
from closedloop.scenario.arm import acting_tendons, has_stops, robot_of, stop_limits, without_tools
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import labels_of, names_of, patches_of, tangents_of
from robot_models import RobotModel
from robot_models.coordinates import with_rotation_vectors
from robot_models.errors import shown
from robot_models.loop_joint import WORLD
from robot_models.tendon import ROUGH, STOPS


def columns_by_contact(sections: tuple[ContactSection, ...]) -> dict[str, tuple[str, int]]:
    """Return name -> column of `CONTACT_COLUMNS`, and the place in it; one along a tangent ends in ``_t1``, ``_t2``."""
    labels = labels_of(sections)
    ways = {"contact": labels, "contact_tangent": tangents_of(labels)}
    return {
        f"{name}_{label}": (name, k)
        for name, spec in CONTACT_COLUMNS.items()
        if name not in RESISTANCE_COLUMNS or any(section.resists for section in sections)
        for k, label in enumerate(ways[spec.dims[1]])
    }


# A joint nearer to its limit than this, rad (m), may be at its stop, where the stabiliser keeps it.
AT_STOP = 1e-7
# Labels of the parts of a wrench.
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")


class DerivedColumn(NamedTuple):
    """Dimensions, unit and meaning, as of a `closedloop.record.columns.record.Column`, and what works it out."""

    dims: tuple[str, ...]
    units: str
    meaning: str
    of: Callable[[Record], Array]


def part_labels(run: Record, name: str) -> tuple[str, ...]:
    """Return what the parts of a column of a run are called: joints, axes, contacts ..., or numbers; none of (N,)."""
    dims = (run.specs.get(name) or DERIVED[name]).dims
    if len(dims) == 1:
        return ()
    contacts = labels_of(run.scenario.contact or ())
    known = {
        "joint": run.model.joint_names, "coordinate": run.model.coordinate_names, "axis": ("x", "y", "z"),
        "component": WRENCH, "contact": contacts, "contact_tangent": tangents_of(contacts),
    }  # fmt: skip
    return known.get(dims[1]) or tuple(map(str, range(1, getattr(run, name).shape[1] + 1)))


def loop_positions(run: Record) -> Array:
    """Return the joint positions as the loop has them, (N, n), rad (m): a rotation vector for each quaternion."""
    return with_rotation_vectors(run.q, run.model.joint_types)


def tip_force(run: Record) -> Array:
    """Return f n and friction, (N, 3), N, base axes."""
    return run.contact_force[:, None] * run.surface_normal + run.friction_force


def reactions_of(run: Record, robot: Robot) -> LoopReactions:
    """Return what the loops of a mechanism carried, its robot being that of the run's scenario."""
    torque = _drive(run) + run.joint_friction + _of_contacts(run, robot)
    forces = tip_force(run), at_stop(run), stop_rows(run)
    return loop_reactions(robot, run.time, run.q, run.v, run.acceleration, torque, *forces)


def _drive(run: Record) -> Array:
    """Return what drives the links in each row, (N, n), N m (N): Q, or what elastic joints pass on."""
    return run.transmitted_torque if run.scenario.transmission.elastic else run.torque


def tip_moment(run: Record) -> Array:
    """Return the moment of the force of the surface about the tip's centre, (N, 3), N m, base axes."""
    return np.cross(-run.scenario.tool.radius * run.surface_normal, run.friction_force)


def _of_contacts(run: Record, robot: Robot) -> Array:
    """Return the torques of contacts of links, of the moment at the tip and of forces from outside, (N, n), N m (N)."""
    of_tip = np.zeros(run.v.shape)
    if run.scenario.tool.radius > 0.0:
        for k, moment in enumerate(tip_moment(run)):
            of_tip[k] = robot.frame_jacobian(run.q[k])[3:].T @ moment
    model, q = without_tools(robot.model).pinocchio_model(), robot.pinocchios(run.q)
    if run.scenario.external_force:
        axes, origins, jacobians = touching.frames_in_rows(model, q)
        for link, place, wrench in touching.external_wrenches(run, model, robot.tip, axes, origins):
            of_tip += np.einsum("kij,ki->kj", jacobians[link], touching.moved_wrench(wrench, place - origins[:, link]))
    if not run.scenario.contact:
        return of_tip
    resists = any(section.resists for section in run.scenario.contact)
    moments = (run.link_rolling_moments, run.link_pivoting_moments) if resists else ()
    of_links = touching.contact_torques(run.scenario, model, run.time, q, run.link_forces, run.link_frictions, *moments)
    return of_tip + of_links


def wrist_wrench(run: Record) -> Array:
    """Return what `Robot.wrist_wrench` says of each row, (N, 6)."""
    robot = robot_of(run.scenario, without_tools(run.model))
    force, moment = tip_force(run), tip_moment(run)
    if any(section.link is None for section in run.scenario.external_force or ()):
        mechanism = without_tools(robot.model).pinocchio_model()
        axes, origins, _ = touching.frames_in_rows(mechanism, robot.pinocchios(run.q))
        outside = touching.external_wrenches(run, mechanism, robot.tip, axes, origins)
        for section, (_, place, wrench) in zip(run.scenario.external_force or (), outside, strict=True):
            if section.link is None:
                about = touching.moved_wrench(wrench, place - run.position)
                force, moment = force + about[:, :3], moment + about[:, 3:]
    return robot.wrist_wrench(run.q, run.v, run.acceleration, force, moment)


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
    there, stops = at_stop(run), stop_rows(run)
    if robot.model.loops or len(stops) > robot.n:
        rows = loop_rows(robot, run.q, run.v, run.time)[0] if robot.model.loops else np.zeros((len(run.q), 0, robot.n))
        return share_of_rows(rows, found, there, stops=stops)[1]
    return np.where(there, found, 0.0)


def stop_rows(run: Record) -> Array:
    """Return what stops hold, (n + t, n): each joint, then each tendon that rubs or has stops, by its coefficients."""
    return np.vstack([np.eye(run.model.n), acting_tendons(run.scenario, run.model)[:, ROUGH:]])


def at_stop(run: Record) -> NDArray[np.bool_]:
    """Return which of `stop_rows` are at a stop in each row, (N, n + t); all False where there are no stops."""
    tendons = acting_tendons(run.scenario, run.model)
    joints = stop_limits(run.scenario, run.model)
    lower, upper = (np.concatenate([each, tendons[:, STOPS + k]]) for k, each in enumerate(joints))
    places = loop_positions(run) @ stop_rows(run).T
    return (places >= upper - AT_STOP) | (places <= lower + AT_STOP)


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
        ("time", "joint"), "N m", "torque of the stops of joints and tendons on the joints, where robot.stops asks "
        "for them", stop_torque,
    ),
}  # fmt: skip


Function = Callable[[Any], ArrayLike]
Recorded = Mapping[str, Function | tuple[Function, str]]
"""Columns of one's own: by name a function of the `Run`, -> (N,) or (N, k); or that and the unit of what it returns."""

# A name that CSV, MATLAB, NetCDF and Python take as it is.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,59}")
# The integral of the force error is a state of nearly every law, and zero without its gain.
_USUAL = "force_error"
# Names of a file's dimensions and labels, which no column may have.
RESERVED = frozenset(
    {"joint", "coordinate", "joint_type", "axis", "event", "contact", "contact_tangent", "component", "kind"}
)


class StatesOf(NamedTuple):
    """What the states of a law and its compensation depend on."""

    law: type[ControlLaw]
    compensation: type[Compensation]
    kinds: tuple[str, str]
    integral: bool  # whether `law.force_integral` asks for the integral of the force error
    n: int  # joints

    @classmethod
    def of(cls, scenario: Scenario, n: int) -> "StatesOf":
        """Return that of a scenario."""
        law, compensation = scenario.law, scenario.compensation
        kinds = law.kind, compensation.kind
        return cls(type(law), type(compensation), kinds, law.force_integral != 0.0, n)


@lru_cache(maxsize=128)
def state_columns(of: StatesOf) -> dict[str, tuple[Column, int | slice]]:
    """Return the columns ``law_NAME`` and ``compensation_NAME`` of a run, and the place of each state.

    The places are among the states of the law and its compensation, in the loop's order. A joint's state is a column
    (N, n).
    """
    found: dict[str, tuple[Column, int | slice]] = {}
    before = 0
    for section, part, kind in zip(("law", "compensation"), (of.law, of.compensation), of.kinds, strict=True):
        block = state_block(part)
        for name, shape in block.layout.shape.items():
            if name == _USUAL and section == "law" and not of.integral:
                continue
            place = block.place(name, of.n)
            where = slice(before + place.start, before + place.stop) if isinstance(place, slice) else before + place
            dims = ("time", "joint") if shape else ("time",)
            found[f"{section}_{name}"] = Column(dims, "", f"state {name} of {section}.kind = {kind}"), where
        before += block.count(of.n)
    return found


@lru_cache(maxsize=128)
def recorded_states(of: StatesOf) -> int:
    """Return how many numbers of a row are states of the law and its compensation: all of them, or none."""
    return sum(state_block(part).count(of.n) for part in (of.law, of.compensation)) if state_columns(of) else 0


def check_names(record: Recorded, taken: set[str]) -> None:
    """Refuse names of columns that are taken or no names, and what is no function."""
    for name, given in record.items():
        if not (isinstance(name, str) and _NAME.fullmatch(name)):
            raise ScenarioError(
                f"record: {str(name)[:80]!r}: must be a letter and up to 59 letters, digits and underscores after it"
            )
        if name in taken:
            raise ScenarioError(f"record: {name!r}: a run has this already; use another name")
        function, unit = given if isinstance(given, tuple) and len(given) == 2 else (given, "")
        if not callable(function) or not isinstance(unit, str):
            raise ScenarioError(
                f'record: {name!r}: must be a function of the run, or such a function and a unit: (function, "W")'
            )


def own_columns(run: Record, record: Recorded) -> tuple[dict[str, NDArray[Any]], dict[str, Column]]:
    """Return the columns that functions of one's own give of a run of at least one row, and what each is.

    One that raises something, or returns anything but a finite real number, or k of them, a row is refused.
    """
    values, columns = {}, {}
    for name, given in record.items():
        function, unit = given if isinstance(given, tuple) else (given, "")
        values[name] = _values(run, name, function)
        text = (getattr(function, "__doc__", None) or "").strip().partition("\n")[0]
        said = f"{getattr(function, '__module__', '?')}:{getattr(function, '__qualname__', type(function).__name__)}"
        dims = ("time",) if values[name].ndim == 1 else ("time", f"{name}_part")
        columns[name] = Column(dims, unit, text or f"returned by {said}")
    return values, columns


def _values(run: Record, name: str, function: Function) -> NDArray[Any]:
    rows, end = len(run), float(run.time[-1])
    try:
        answer: Any = function(run)
    except (Exception, SystemExit) as error:
        what = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
        raise LawError(f"record: {name!r}: {_where(error)}{what}", end, run) from error
    try:
        found = np.array(answer)
    except (TypeError, ValueError):  # lists of different lengths
        found = np.array(None)
    must = f"must be one real number a row, ({rows},), or k of them, ({rows}, k)"
    if found.dtype.kind not in "biuf":
        raise LawError(f"record: {name!r}: the function returned {one_line(repr(answer))[:60]}: {must}", end, run)
    if found.ndim not in (1, 2) or found.shape[0] != rows or found.size == 0:
        raise LawError(f"record: {name!r}: the function returned an array of shape {found.shape}: {must}", end, run)
    bad = ~np.isfinite(found.reshape(rows, -1)).all(axis=1)
    if bad.any():
        first = int(np.argmax(bad))
        shown = found.reshape(rows, -1)[first]
        raise LawError(
            f"record: {name!r}: in row {first}, t = {run.time[first]:g} s, it is {shown[~np.isfinite(shown)][0]}: must "
            "be finite", end, run,
        )  # fmt: skip
    return found.astype(float)


def _where(error: BaseException) -> str:
    """Return 'file:line: ' of where a function failed, "" of one that is not Python's."""
    frames = extract_tb(error.__traceback__)[1:]  # the first is the caller
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}: " if frames else ""


def as_text(added: Mapping[str, Column]) -> str:
    """Return the text that a file has of them."""
    return json.dumps({name: [list(dims), units, meaning] for name, (dims, units, meaning) in added.items()})


def from_text(text: str) -> dict[str, Column]:
    """Return what `as_text` wrote."""
    return {name: Column(tuple(dims), units, meaning) for name, (dims, units, meaning) in json.loads(text).items()}


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
    axes, origins, _ = touching.frames_in_rows(mechanism, robot.pinocchios(run.q))
    contacts = touching.contacts_of(run.scenario, mechanism)
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
    axes, origins, _ = touching.frames_in_rows(mechanism, q)
    tip, force = mechanism.frames[mechanism.getFrameId(robot.tip)].parentJoint, tip_force(run)
    about = np.cross(run.position - origins[:, tip], force) + tip_moment(run)
    outside[:, tip] += np.concatenate([force, about], axis=1)
    if run.scenario.contact:
        resists = any(section.resists for section in run.scenario.contact)
        moments = (run.link_rolling_moments, run.link_pivoting_moments) if resists else (None, None)
        carried = (run.link_forces, run.link_frictions, *moments)
        for link, wrench in touching.wrenches_on_links(
            touching.contacts_of(run.scenario, bare), run.time, axes, origins, carried
        ):
            outside[:, link] += wrench
    for link, place, wrench in touching.external_wrenches(run, bare, robot.tip, axes, origins):
        outside[:, link] += touching.moved_wrench(wrench, place - origins[:, link])
    if run.model.loops:
        for sides, place, wrench in loop_wrenches(robot, run.q, reactions_of(run, robot).reactions):
            for side, sign in zip(sides, (1.0, -1.0), strict=True):
                link = touching.placed_frame(bare, side)[0]
                outside[:, link] += sign * touching.moved_wrench(wrench, place - origins[:, link])
    carrier, within, _ = touching.placed_frame(mechanism, WORLD if frame == JOINT else frame)
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
