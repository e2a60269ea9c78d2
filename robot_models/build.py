"""From text to a Pinocchio model: one variable a joint, locked joints welded, limits as the text says.

What stands in the end is compared with the text.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from sys import float_info
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_models import urdf, urdf_mechanism
from robot_models.compare import check_built
from robot_models.coordinates import BALL, RATES
from robot_models.errors import ModelError
from robot_models.physics import check_size, check_sizes
from robot_models.separate import free_joints, separated

if TYPE_CHECKING:
    import pinocchio as pin


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
    It has nv = n velocities, free joints taken apart (`robot_models.separate`). The armature is that of the text
    (zero for a URDF), the gravity Pinocchio's own. A limit that the text does not give, and an effort or velocity limit
    of 0, is infinite.
    Raises `ModelError` if Pinocchio refuses the text or reads another mechanism than it says, or a locked joint is not
    in it.
    """
    import pinocchio as pin

    kinds = urdf.joint_types(text) if format == "urdf" else {}
    try:
        model = (
            pin.buildModelFromXML(urdf_mechanism.for_pinocchio(text)) if format == "urdf" else _of_mjcf(text, {}, where)
        )
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
        bound = np.where(np.abs(bound) >= urdf_mechanism.NO_BOUND, np.copysign(np.inf, bound), bound)
        setattr(model, side, bound)
    if format == "urdf":
        links = urdf_mechanism.mechanism(text)
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
    from robot_models.mjcf import compiled  # here: they import MuJoCo
    from robot_models.mjcf_tree import pinocchio_model

    return pinocchio_model(compiled(text, where), locked, where)
