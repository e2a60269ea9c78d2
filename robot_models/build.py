"""From text to a Pinocchio model: one variable a joint, locked joints welded, limits as the text says.

What stands in the end is compared with the text.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from sys import float_info
from typing import TYPE_CHECKING

import numpy as np

from robot_models import mjcf, mjcf_mechanism, mjcf_pinocchio, urdf, urdf_mechanism
from robot_models.compare import check_built
from robot_models.errors import ModelError
from robot_models.physics import check_size, check_sizes

if TYPE_CHECKING:
    import pinocchio as pin


@dataclass(frozen=True)
class Built:
    """A Pinocchio model and the kind of each of its joints, in the order of its columns."""

    model: "pin.Model"
    joint_types: tuple[str, ...]


@np.errstate(all="ignore")  # what overflows is refused by name
def build(text: str, format: str, locked: Mapping[str, float], where: str) -> Built:
    """Build the model that a canonical text describes.

    Parameters
    ----------
    text
        What `urdf.read` or `mjcf.read` returned.
    format
        "urdf" or "mjcf".
    locked
        Joints to weld, and where: rad, or m for a prismatic joint.
    where
        How to name the text in a message.

    Returns
    -------
    Built
        With nq == nv == n ≥ 1. The armature is that of the text (zero for a URDF), the gravity Pinocchio's
        own. A limit that the text does not give, and an effort or velocity limit of 0, is infinite.

    Raises
    ------
    ModelError
        Pinocchio refuses the text or reads another mechanism than it says, a locked joint is not in it, or
        nothing is left to move.
    """
    import pinocchio as pin

    kinds = urdf.joint_types(text) if format == "urdf" else {}
    try:
        model = pin.buildModelFromXML(urdf_mechanism.for_pinocchio(text)) if format == "urdf" else _from_mjcf(text)
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"{where}: Pinocchio cannot read it: {str(error).strip().splitlines()[0]}") from None
    names = list(model.names)[1:]
    for name, value in locked.items():
        if name not in names:
            near = get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"the joints are {', '.join(names)}"
            raise ModelError(f"{where}: cannot lock {name!r}, no joint that moves: {hint}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= float_info.max:
            raise ModelError(f"{where}: cannot lock {name!r} at {value!r}: it must be a finite number")
        check_size("home", value, f"{where}: locked joint {name!r}")
    if locked:
        posture = np.zeros(model.nq)
        for name, value in locked.items():
            posture[model.idx_qs[model.getJointId(name)]] = value
        model = pin.buildReducedModel(model, [model.getJointId(name) for name in locked], posture)
    if model.nv == 0:
        raise ModelError(f"{where} has no joint that moves: a revolute, continuous or prismatic joint is needed")
    if format == "mjcf":
        kinds = mjcf_joint_types(model)
    types = tuple(kinds[name] for name in list(model.names)[1:])
    for side in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit", "effortLimit"):
        bound = np.array(getattr(model, side))
        bound = np.where(np.abs(bound) >= urdf_mechanism.NO_BOUND, np.copysign(np.inf, bound), bound)
        setattr(model, side, bound)
    links = urdf_mechanism.mechanism(text) if format == "urdf" else mjcf_mechanism.mechanism(text, mjcf.STILL)
    check_sizes(links, where)
    check_built(model, links, locked, where)
    return Built(model, types)


def mjcf_joint_types(model: "pin.Model") -> dict[str, str]:
    """Return the joint types of a model built from MJCF, where a hinge without a range is continuous."""
    types = {}
    for joint in range(1, model.njoints):
        short = model.joints[joint].shortname()
        at = model.idx_qs[joint]
        if short.startswith("JointModelP"):
            types[model.names[joint]] = "prismatic"
        else:
            types[model.names[joint]] = "revolute" if np.isfinite(model.upperPositionLimit[at]) else "continuous"
    return types


def _from_mjcf(text: str) -> "pin.Model":
    import pinocchio as pin

    # Pinocchio reads MJCF from a file only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(mjcf_pinocchio.for_pinocchio(text), encoding="utf-8")
        return pin.buildModelFromMJCF(str(path))
