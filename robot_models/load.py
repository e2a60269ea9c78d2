"""One loader for every kind of robot: text in, inspected, built once, and handed out as data."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_models import build, described, physics, urdf
from robot_models.coordinates import PARTS, RATES, balls, coordinate_names, in_pinocchios_order, normalised
from robot_models.described import Description, Format, canonical, find, joint_names, names_a_file
from robot_models.errors import ModelError
from robot_models.loop_coordinate import place_coordinates, stands_for, with_coordinates
from robot_models.loop_joint import LoopJoint, check_loops, loop_joint, without
from robot_models.model import RobotModel, default_tip
from robot_models.sidecar import Sidecar

if TYPE_CHECKING:
    from os import PathLike

    import pinocchio as pin

Lock = Mapping[str, float] | Sequence[str]


@np.errstate(all="ignore")  # what overflows is refused by name
def load(
    name: "str | PathLike[str]", *, drive_inertia: bool = True, lock: Lock = (), mocap: Collection[str] = ()
) -> RobotModel:
    """Load a robot: an arm on a fixed base, or a tree of bodies some of which are free.

    Parameters
    ----------
    name
        A shipped robot ("wam4"; see `shipped_names`), a robot of example-robot-data ("panda", "ur5", …), or
        the path of a URDF (.urdf) or MJCF (.xml). A file may have a sidecar of the same name, `my.toml`
        beside `my.urdf` (see `robot_models.sidecar`).
    drive_inertia
        Whether the mass matrix includes the inertia of the drives, as a sidecar, an MJCF or the rotor parameters of
        example-robot-data give it. It is zero where none of them gives it.
    lock
        Joints to hold rigid: a mapping to their values (rad, m), or names alone, which are locked at the
        robot's home posture. A free or a ball joint is held as the file has it, at 0. If it is empty, the robot's own
        default applies (the fingers of "panda" are locked); if not, it replaces the default.
    mocap
        Mocap bodies of an MJCF whose `weld` and `connect` are loop joints; those of others are left out.

    Raises
    ------
    ModelError
        There is no such robot, or it cannot be simulated; the message says what is wrong, where, and what would be
        right. A file may have 16 MB and 100 000 elements, a robot 2000 links and 128 joints that move
        (`robot_models.mechanism`); a larger one is refused before it is built.
    """
    if isinstance(name, str) and not lock and not names_a_file(name):
        return _load_packaged(name, bool(drive_inertia))
    return _load(name, drive_inertia, lock, mocap)


@lru_cache(maxsize=16)
def _load_packaged(name: str, drive_inertia: bool) -> RobotModel:
    """Load a robot that comes with a package, once: its files stay as they are, and a model cannot be changed."""
    return _load(name, drive_inertia, ())


def _load(name: "str | PathLike[str]", drive_inertia: bool, lock: Lock, mocap: Collection[str] = ()) -> RobotModel:
    """See `load`."""
    found = _with_coordinates(find(name, mocap))
    locked = _locked(found, lock)
    built = _built(found, locked, drive_inertia)
    if idle := physics.massless(built.model):
        posture = (
            dict(zip(built.joint_names, _home(found, built), strict=False)) if not balls(built.joint_types) else {}
        )
        locked |= {joint: float(posture.get(joint, 0.0)) for joint in idle}
        said = [f"joint {joint!r} moves no mass: it is held at {locked[joint]:g}" for joint in idle]
        found = replace(found, warnings=[*found.warnings, *said])
        built = _built(found, locked, drive_inertia)
    found = _held(found, locked)
    defaults, model, joints = found.sidecar, built.model, built.joint_names
    home = _geared(_home(found, built), built, defaults.closed_loop)
    if defaults.closed_loop:
        new = [name not in defaults.home for name in coordinate_names(joints, built.joint_types)]
        home = _placed(built, defaults.closed_loop, home, new)
    loops, driven = defaults.closed_loop, defaults.drives
    tip = defaults.tip or default_tip(model, _frames(model), stands_for(loops), None if loops else driven)
    return _finish(built, home, found, locked, tip, None)


@np.errstate(all="ignore")  # what overflows is refused by name
def from_text(
    text: str, format: Format, *, name: str, armature: ArrayLike, tip: str | None, home: ArrayLike,
    locked: Mapping[str, float], gravity: ArrayLike | None = None, description: str = "", source: str = "",
    loops: Sequence[Mapping[str, object]] = (), drives: Sequence[str] = (), undriven: bool = False,
) -> RobotModel:  # fmt: skip
    """Rebuild a robot from the text that a run stored, without reading a file.

    Its dynamics are the same to the last bit. The text is checked in the same way as a file.

    Parameters
    ----------
    text, format, name, tip, locked, description, source
        The fields of that name of the `RobotModel`.
    armature, home : (n,), (nq,)
        Likewise; kg m² and rad.
    gravity : (3,), optional
        m/s² in the base frame; what the text says, or (0, 0, −9.81), if not given.
    loops : sequence of tables, optional
        Its loop joints, see `robot_models.loop_joint`.
    drives : sequence of str, optional
        Joints with a drive; all if left out.
    undriven : bool
        Whether no joint has one.

    Raises
    ------
    ModelError
        As `load`; also if an array has not one finite entry a joint, or the tip is not in the robot.
    """
    if format not in ("urdf", "mjcf"):
        raise ModelError(f"{name}: format is {format!r}: it must be 'urdf' or 'mjcf'")
    own = canonical(text, format, name, name, None)
    own = _held(own, locked)
    closed = tuple(loop_joint(table, name) for table in loops) or own.sidecar.closed_loop
    acting = () if undriven else tuple(drives) or own.sidecar.drives
    sidecar = Sidecar(description=description, source=source, closed_loop=closed, drives=acting)
    found = _with_coordinates(replace(own, sidecar=sidecar))
    built = build.build(found.text, format, locked, name)
    n = built.model.nv
    given = np.ones(n, dtype=bool)
    if found.text != own.text:  # what is given is of the joints that the text had
        given = np.array([joint in joint_names(own.text, format) for joint in built.joint_names])
    m = int(given.sum())
    built.model.armature = np.zeros(n)
    built.model.armature[given] = _vector(armature, m, f"{name}: armature")
    new = np.isin(coordinate_names(built.joint_names, built.joint_types), np.array(built.joint_names)[~given])
    posture = np.zeros(len(new))
    posture[~new] = _vector(home, int(np.sum(~new)), f"{name}: home")
    posture = normalised(posture, built.joint_types, f"{name}: home")
    if found.text != own.text:
        posture = _placed(built, found.sidecar.closed_loop, posture, new)
    if built.model.armature.min() < 0.0:
        raise ModelError(f"{name}: armature has a negative entry: an inertia is zero or more")
    g = None if gravity is None else _vector(gravity, 3, f"{name}: gravity")
    return _finish(built, posture, found, dict(locked), tip, g)


def _with_coordinates(found: Description) -> Description:
    """Return a description in which the loop joints that act have coordinates, see `robot_models.loop_coordinate`."""
    sidecar = found.sidecar
    where = sidecar.where or found.where
    text, loops = with_coordinates(found.text, found.format, sidecar.closed_loop, sidecar.drives or (), where)
    return replace(found, text=text, sidecar=replace(sidecar, closed_loop=loops))


def _locked(found: Description, lock: Lock) -> dict[str, float]:
    if isinstance(lock, str):
        raise ModelError(f"lock is {lock!r}: it must be a list of joints or a table of their values")
    if not lock:
        return dict(found.sidecar.lock)
    if isinstance(lock, Mapping):
        return dict(lock)
    # Home is known in full only once everything is built with all its joints.
    whole = build.build(found.text, found.format, {}, found.where)
    names = coordinate_names(whole.joint_names, whole.joint_types)
    posture = dict(zip(names, _home(found, whole).tolist(), strict=True))
    return {joint: posture.get(joint, 0.0) for joint in lock}  # build() refuses an unknown one by name


def _built(found: Description, locked: Mapping[str, float], drive_inertia: bool) -> build.Built:
    """Return what is built of a description, with the armature that it gives."""
    built = build.build(found.text, found.format, locked, found.where)
    given = found.sidecar.drive_inertia
    if not drive_inertia:
        built.model.armature = np.zeros(built.model.nv)
    elif given:
        built.model.armature = np.array([given.get(joint, 0.0) for joint in built.joint_names])
    return built


def _held(found: Description, locked: Mapping[str, float]) -> Description:
    """Inspect a URDF, and return a description whose couplings and drives are those that are left by a lock.

    The lock of a joint takes the place of the gear that binds it; a gear to a locked joint holds its other one, and one
    between sums of joints binds those that are left.
    """
    warnings = list(found.warnings)
    if found.format == "urdf" and not described.has_passed(found.text, locked):
        warnings += urdf.inspect(found.text, found.where, locked)
    sidecar, loops = found.sidecar, []
    for loop in sidecar.closed_loop:
        if (locked.keys() & loop.joints[:1] and not loop.coefficients) or (
            loop.joints and locked.keys() >= {*loop.joints}
        ):
            continue
        loops.append(without(loop, locked) if locked.keys() & loop.joints else loop)
    drives = None if sidecar.drives is None else tuple(name for name in sidecar.drives if name not in locked)
    if drives and {*drives, *locked} >= set(joint_names(found.text, found.format)):
        drives = None  # every one that is left
    return replace(found, warnings=warnings, sidecar=replace(sidecar, closed_loop=tuple(loops), drives=drives))


def _geared(posture: NDArray[np.float64], built: build.Built, loops: Sequence[LoopJoint]) -> NDArray[np.float64]:
    """Return a posture (nq,) in which the first joint of each gear is where the gear has it.

    Of a gear between sums it is the first joint that is in the first sum alone, if there is one.
    """
    names, q = coordinate_names(built.joint_names, built.joint_types), posture.copy()
    gears = [loop for loop in loops if loop.type == "gear" and {*loop.joints} <= {*names}]
    for _ in gears:  # a gear may drive another
        for loop in gears:
            first, second = loop.sums
            lead = next((joint for joint in first if joint not in second), None)
            if lead is not None:
                x = sum(c * q[names.index(joint)] for joint, c in second.items())
                rest = sum(c * q[names.index(joint)] for joint, c in first.items() if joint != lead)
                value = sum(c * x**k for k, c in enumerate(loop.polynomial))
                q[names.index(lead)] = (value - rest) / first[lead]
    return q


def _placed(
    built: build.Built, loops: Sequence[LoopJoint], posture: NDArray[np.float64], new: ArrayLike
) -> NDArray[np.float64]:
    """Return a posture (nq,) with the new (nq,) ones of the loop joints' coordinates as the rest has them."""
    placed = place_coordinates(built.model, loops, in_pinocchios_order(posture, built.joint_types))
    own = coordinate_names(built.joint_names, built.joint_types)
    return np.where(np.isin(own, list(stands_for(loops))) & np.asarray(new), placed, posture)


def _home(found: Description, built: build.Built) -> NDArray[np.float64]:
    """Return the posture (nq,) that the sources name, else zero, moved into the limits where it is outside."""
    joints, (low, high) = built.joint_names, built.limits
    # Zero, or the middle of the limits where zero is outside them.
    bounded = np.isfinite(low) & np.isfinite(high) & ((low > 0.0) | (high < 0.0))
    posture = np.zeros(len(joints))
    posture[bounded] = 0.5 * (low[bounded] + high[bounded])
    named = found.sidecar.home
    posture = np.array([named.get(joint, value) for joint, value in zip(joints, posture, strict=True)])
    # A published angle may be a turn away from the limits (Kinova's elbow): the same pose is meant.
    for turn in (-2.0 * np.pi, 2.0 * np.pi):
        inside = (low <= posture + turn) & (posture + turn <= high) & ((posture < low) | (posture > high))
        inside &= np.array(built.joint_types) == "revolute"
        posture[inside] += turn
    posture = np.clip(posture, low, high)
    for at in reversed(balls(built.joint_types)):
        name = joints[at].removesuffix(RATES[0])
        quaternion = [named.get(name + part, float(part == PARTS[0])) for part in PARTS]
        posture = np.concatenate([posture[:at], quaternion, posture[at + 3 :]])
    return normalised(posture, built.joint_types, f"{found.where}: home")


def _frames(model: "pin.Model") -> tuple[str, ...]:
    """Return the links, bodies and sites that can be asked for by name.

    Pinocchio refuses to look up a name that occurs twice, which is left out.
    """
    import pinocchio as pin

    times = Counter(frame.name for frame in model.frames)
    usable = (pin.FrameType.BODY, pin.FrameType.OP_FRAME)
    named = (frame.name for frame in model.frames if frame.type in usable)
    return tuple(name for name in named if times[name] == 1)


def _vector(value: ArrayLike, n: int, what: str) -> NDArray[np.float64]:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"{what} is {value!r}: it must be {n} numbers") from None
    if vector.shape != (n,) or not all(map(isfinite, vector)):
        raise ModelError(f"{what} is {value!r}: it must be {n} finite numbers, one for each")
    return vector


def _finish(
    built: build.Built, home: NDArray[np.float64], found: Description, locked: Mapping[str, float], tip: str | None,
    gravity: NDArray[np.float64] | None,
) -> RobotModel:  # fmt: skip
    """Check the mechanism that was built and write it down."""
    model = built.model
    if gravity is None:
        gravity = built.model.gravity.linear
    for what, numbers in (("armature", model.armature), ("home", home), ("gravity", gravity)):
        physics.check_size(what, numbers, found.where)
    if model.nv:
        physics.check_mechanism(model, in_pinocchios_order(home, built.joint_types), found.where)
    joints, (lower, upper) = built.joint_names, built.limits
    made, drives = stands_for(found.sidecar.closed_loop), found.sidecar.drives
    own = [joint for joint in joints if joint not in made]
    if drives is None and made:  # a loop joint that is a joint of the tree has no drive unless named
        drives = tuple(own)
    robot = RobotModel(
        name=found.name, format=found.format, text=found.text, joint_names=joints, armature=model.armature,
        position_lower=lower, position_upper=upper, velocity_limit=model.velocityLimit, effort_limit=model.effortLimit,
        joint_types=built.joint_types, tip=tip, frames=_frames(model), home=home, locked=locked, gravity=gravity,
        description=found.sidecar.description, source=found.sidecar.source,
        notes=described.notes(found.text, found.format, own, model.velocityLimit, model.effortLimit),
        loops=found.sidecar.closed_loop, drives=drives, warnings=found.warnings,
    )  # fmt: skip
    check_loops(robot.loops, robot.drives or (), robot.frames, joints, found.sidecar.where or found.where)
    if tip is not None:
        robot.require_frame(tip)
    return robot
