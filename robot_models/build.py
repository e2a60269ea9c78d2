"""From text to a Pinocchio model: one variable a joint, locked joints welded, limits as the text says.

What stands in the end is compared with the text, link by link and joint by joint. Pinocchio's readers drop what they
cannot parse with no more than a line on standard error, and a robot that lacks a link's mass runs as smoothly as one
that has it. Whatever their reason, here it shows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from sys import float_info
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_models import urdf
from robot_models.coordinates import BALL, RATES, free_joints, separated
from robot_models.errors import ModelError
from robot_models.mechanism import Array, Link, Weight, displaced, lumped
from robot_models.physics import check_size, check_sizes

if TYPE_CHECKING:
    import pinocchio as pin

#: Relative difference that is taken for none. Rounding stays below 1e-12, even for hundreds of links welded together
#: (some 1e-16 for each sum and turn), and a digit that matters to anyone is far above.
EQUAL = 1e-9

# What a position loses by rounding, relative to the longest offset in the text: some sums of offsets cancel.
_ROUNDING = 1e-13


def check_built(model: "pin.Model", links: Sequence[Link], locked: Mapping[str, float], where: str) -> None:
    """Refuse a model that is not the text's.

    model: what Pinocchio built, locked joints welded
    links: what the text says; parents before their children
    locked: joints that were welded, and where: rad (m)
    Raises `ModelError` if a link is missing, stands or hangs elsewhere, or what a joint carries has another mass,
    centre of mass or tensor; a joint has another axis, limit or armature; or a number is not finite.
    """
    import pinocchio as pin

    body = {f.name: f for f in model.frames if f.type == pin.FrameType.BODY}
    site = {f.name: f for f in model.frames if f.type == pin.FrameType.OP_FRAME}
    length = max((float(np.abs(link.placement[:3, 3]).max()) for link in links), default=0.0)
    carriers: list[int] = []  # of each link, the joint of the model that carries it; 0 is the base
    poses: list[Array] = []  # (4, 4) of each link in the frame of its carrier
    for link in links:
        carrier, pose = (carriers[link.parent], poses[link.parent]) if link.parent >= 0 else (0, np.eye(4))
        pose = pose @ link.placement
        at = f"{where}: {'site' if link.site else 'link'} {link.name!r}"
        if link.kind == "fixed" or link.joint in locked:
            pose = pose @ displaced(link, locked.get(link.joint, 0.0)) @ link.offset
        else:
            carrier = _check_joint(model, link, carrier, pose, length, f"{where}: joint {link.joint!r}")
            pose = link.offset
        if not np.isfinite(pose).all():
            raise ModelError(f"{at} has a pose that is not finite: some number is far too large")
        frame = (site if link.site else body).get(link.name)
        if frame is None or frame.parentJoint != carrier or not _same_pose(frame.placement, pose, length):
            raise _misplaced(at, frame.placement if frame else None, pose)
        carriers.append(carrier)
        poses.append(pose)
    moving = {link.joint for link in links if link.kind != "fixed" and link.joint not in locked}
    if extra := [name for name in list(model.names)[1:] if name not in moving]:
        raise ModelError(f"{where}: Pinocchio's model has a joint {extra[0]!r} that is not in the text")
    for joint in range(model.njoints):
        carried = [k for k, carrier in enumerate(carriers) if carrier == joint and not links[k].site]
        _check_weight(model.inertias[joint], [links[k] for k in carried], [poses[k] for k in carried], length, where)


def _check_joint(model: "pin.Model", link: Link, parent: int, placement: Array, length: float, at: str) -> int:
    """Return the joint's index in the model."""
    names = list(model.names)
    if link.joint not in names:
        raise ModelError(f"{at} is not in Pinocchio's model")
    joint = names.index(link.joint)
    if not np.isfinite(placement).all():
        raise ModelError(f"{at} has a pose that is not finite: some number is far too large")
    held = model.jointPlacements[joint]
    if model.parents[joint] != parent or not _same_pose(held, placement, length):
        raise _misplaced(at, held, placement)
    # The subspace of the joint's motion is its axis: the lower half of a revolute joint's, the upper of a slider's.
    v, count, bounds = model.idx_vs[joint], model.nvs[joint], link.bounds
    if link.kind in ("ball", "free"):
        if count != {"ball": 3, "free": 6}[link.kind] or model.nqs[joint] != count + 1:
            raise ModelError(f"{at} is of another type in Pinocchio's model")
        if not np.abs(model.armature[v : v + count] - link.armature).max() <= EQUAL * link.armature:
            raise _differs(at, "armature", np.array(model.armature[v : v + count]), link.armature)
        return joint
    motion = np.array(model.joints[joint].createData().S).ravel()
    wanted = np.concatenate([link.axis, np.zeros(3)] if link.kind == "prismatic" else [np.zeros(3), link.axis])
    if not np.abs(motion - wanted).max() <= EQUAL:
        raise _differs(at, "axis", motion, wanted)
    q = model.idx_qs[joint]
    for what, is_, said in (
        ("lower limit", model.lowerPositionLimit[q], bounds.lower),
        ("upper limit", model.upperPositionLimit[q], bounds.upper),
        ("velocity limit", model.velocityLimit[v], bounds.velocity),
        ("effort limit", model.effortLimit[v], bounds.effort),
        ("armature", model.armature[v], link.armature),
    ):
        if not (is_ == said or (np.isfinite(said) and abs(is_ - said) <= EQUAL * abs(said))):
            raise _differs(at, what, is_, said)
    return joint


def _check_weight(held: "pin.Inertia", links: list[Link], poses: list[Array], length: float, where: str) -> None:
    """Compare what one joint carries: all links that are rigidly held together."""
    weights = [link.weight for link in links]
    said = lumped(weights, poses)
    named = ", ".join(repr(link.name) for link in links if link.weight.mass or link.weight.tensor.any())
    at = f"{where}: link{'s' * (',' in named)} {named or repr(links[0].name if links else 'world')}"
    mass = sum(abs(weight.mass) for weight in weights)
    if np.isfinite(mass) and not abs(held.mass - said.mass) <= EQUAL * mass:
        raise _differs(_culprit(at, where, links, poses, held), "mass", held.mass, said.mass)
    centres = [pose[:3, :3] @ weight.centre + pose[:3, 3] for weight, pose in zip(weights, poses, strict=True)]
    reach = max((float(np.linalg.norm(centre)) for centre in centres), default=0.0)
    numbers = np.concatenate([[said.mass * (reach + length) * (reach + length)], said.centre, said.tensor.ravel()])
    if not np.isfinite(numbers).all():
        raise ModelError(f"{at}: the inertia is not finite: some number is far too large")
    if said.mass and not np.abs(held.lever - said.centre).max() <= EQUAL * reach + _ROUNDING * length:
        raise _differs(at, "centre of mass", np.array(held.lever), said.centre)
    size = sum(float(np.abs(weight.tensor).max()) for weight in weights) + float(np.abs(said.tensor).max())
    if not np.abs(held.inertia - said.tensor).max() <= EQUAL * size + _ROUNDING * mass * (reach + length) * (
        reach + length
    ):
        raise _differs(at, "inertia tensor", np.array(held.inertia)[*_UPPER], said.tensor[*_UPPER])


_UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))


def _culprit(at: str, where: str, links: list[Link], poses: list[Array], held: "pin.Inertia") -> str:
    """Name the one link whose absence explains the mass that is there; all of them where none does."""
    for absent in range(len(links)):
        rest: Weight = lumped(
            [link.weight for k, link in enumerate(links) if k != absent],
            [pose for k, pose in enumerate(poses) if k != absent],
        )
        if links[absent].weight.mass and abs(held.mass - rest.mass) <= EQUAL * abs(links[absent].weight.mass):
            return f"{where}: link {links[absent].name!r}"
    return at


def _same_pose(held: "pin.SE3", said: Array, length: float) -> bool:
    turn = float(np.abs(held.rotation - said[:3, :3]).max())
    shift = float(np.abs(held.translation - said[:3, 3]).max())
    return turn <= EQUAL and shift <= EQUAL * float(np.abs(said[:3, 3]).max()) + _ROUNDING * length


def _misplaced(at: str, held: "pin.SE3 | None", said: Array) -> ModelError:
    if held is None:
        return ModelError(f"{at} is not in Pinocchio's model")
    moved = np.abs(held.translation - said[:3, 3]).max() > EQUAL * np.abs(said[:3, 3]).max()
    if moved:
        return _differs(at, "place", np.array(held.translation), said[:3, 3])
    return _differs(at, "orientation", np.array(held.rotation).ravel(), said[:3, :3].ravel())


def _differs(at: str, what: str, held: object, said: object) -> ModelError:
    return ModelError(
        f"{at}: Pinocchio read another {what} ({_short(held)}) than the text says ({_short(said)}): "
        "write its numbers plainly"
    )


def _short(value: object) -> str:
    if isinstance(value, np.ndarray):
        return " ".join(f"{x:.9g}" for x in value)
    return f"{value:.9g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Built:
    """A Pinocchio model, and name and kind of each of its velocities, in the order of its columns."""

    model: "pin.Model"
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]

    @property
    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper limit of each velocity's own position, rad (m); a ball joint has none."""
        low, high = np.full(self.model.nv, -np.inf), np.full(self.model.nv, np.inf)
        for joint in range(1, self.model.njoints):
            if self.model.nvs[joint] == 1:
                at, q = self.model.idx_vs[joint], self.model.idx_qs[joint]
                low[at], high[at] = self.model.lowerPositionLimit[q], self.model.upperPositionLimit[q]
        return low, high


@np.errstate(all="ignore")  # what overflows is refused by name
def build(text: str, format: str, locked: Mapping[str, float], where: str) -> Built:
    """Build the model that a canonical text describes.

    text: what `urdf.read` or `mjcf.read` returned
    format: "urdf" or "mjcf"
    locked: joints to weld, and where: rad, or m for a prismatic joint; 0, as the text has it, for one that turns freely
    It has nv = n velocities, free joints taken apart (`robot_models.coordinates`). The armature is that of the text
    (zero for a URDF), the gravity Pinocchio's own. A limit that the text does not give, and an effort or velocity limit
    of 0, is infinite.
    Raises `ModelError` if Pinocchio refuses the text or reads another mechanism than it says, or a locked joint is not
    in it.
    """
    import pinocchio as pin

    kinds = urdf.joint_types(text) if format == "urdf" else {}
    try:
        model = pin.buildModelFromXML(urdf.for_pinocchio(text)) if format == "urdf" else _of_mjcf(text, {}, where)
    except ModelError:
        raise
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"{where}: Pinocchio cannot read it: {str(error).strip().splitlines()[0]}") from None
    model = separated(model, [name for name, kind in kinds.items() if kind == "spherical"], sliding=False)
    names = list(model.names)[1:]
    for name, value in locked.items():
        if name not in names:
            near = get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"the joints are {', '.join(names)}"
            raise ModelError(f"{where}: cannot lock {name!r}, no joint that moves: {hint}")
        if model.nvs[model.getJointId(name)] > 1 and value != 0.0:
            held = "what turns freely is held as the file has it, at 0"
            raise ModelError(f"{where}: cannot lock {name!r} at {value!r}: {held}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= float_info.max:
            raise ModelError(f"{where}: cannot lock {name!r} at {value!r}: it must be a finite number")
        check_size("home", value, f"{where}: locked joint {name!r}")
    if locked and format == "mjcf":
        model = _of_mjcf(text, locked, where)
    elif locked:
        posture = pin.neutral(model)
        for name, value in locked.items():
            if value != 0.0:  # neutral is a quaternion where a joint turns freely
                posture[model.idx_qs[model.getJointId(name)]] = value
        numbers = [model.getJointId(name) for name in locked]
        own = _name_apart(model)  # Pinocchio looks for the frame of a joint by its name alone
        for joint in range(1, model.njoints):
            model.names[joint] = own.get(model.names[joint], model.names[joint])
        for frame in model.frames:
            if frame.type == pin.FrameType.JOINT:  # of one taken apart it had another name
                frame.name = model.names[frame.parentJoint]
        model = pin.buildReducedModel(model, numbers, posture)
        back = {new: name for name, new in own.items()}
        for joint in range(1, model.njoints):
            model.names[joint] = back.get(model.names[joint], model.names[joint])
    if locked and model.nv == 0:
        raise ModelError(f"{where} has no joint that moves: the lock holds them all; leave one out of it")
    if format == "mjcf":
        kinds = mjcf_joint_types(model)
    for side in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit", "effortLimit"):
        bound = np.array(getattr(model, side))
        bound = np.where(np.abs(bound) >= urdf.NO_BOUND, np.copysign(np.inf, bound), bound)
        setattr(model, side, bound)
    if format == "urdf":
        links = urdf.mechanism(text)
        check_sizes(links, where)
        check_built(model, links, locked, where)
        _name_apart(model)
    model = separated(model, free_joints(model))
    columns: list[tuple[str, str]] = []
    for joint in range(1, model.njoints):
        name = model.names[joint]
        if model.nvs[joint] == 1:
            columns.append((name, kinds.get(name, "prismatic")))
        else:
            columns += [(name + rate, BALL) for rate in RATES]
    named, types = tuple(name for name, _ in columns), tuple(kind for _, kind in columns)
    for name in named:
        if named.count(name) > 1:
            raise ModelError(f"{where}: two coordinates are named {name!r}: give its joints other names")
    return Built(model, named, types)


def _name_apart(model: "pin.Model") -> dict[str, str]:
    """Give frames of joints another name than a link's, by which that could not be asked for; return the new names."""
    import pinocchio as pin

    links = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    new = {}
    for frame in model.frames:
        if frame.type != pin.FrameType.BODY and frame.name in links:
            new[frame.name] = f"{frame.name} joint"
            frame.name = new[frame.name]
    return new


def mjcf_joint_types(model: "pin.Model") -> dict[str, str]:
    """Return the joint types of a model built from MJCF, where a hinge without a range is continuous."""
    types = {}
    for joint in range(1, model.njoints):
        short = model.joints[joint].shortname()
        at = model.idx_qs[joint]
        if model.nvs[joint] > 1:
            types[model.names[joint]] = BALL
        elif short.startswith("JointModelP"):
            types[model.names[joint]] = "prismatic"
        else:
            types[model.names[joint]] = "revolute" if np.isfinite(model.upperPositionLimit[at]) else "continuous"
    return types


def _of_mjcf(text: str, locked: Mapping[str, float], where: str) -> "pin.Model":
    from robot_models.mjcf import (
        compiled,  # here: they import MuJoCo
        pinocchio_model,
    )

    return pinocchio_model(compiled(text, where), locked, where)
