"""Whether H and C of a robot are those of other programs on random states: ``closedloop robots FILE --check``."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import one_line

if TYPE_CHECKING:
    from closedloop.mechanics.robot.pinocchio import Robot
    from robot_models import RobotModel

STATES, SEED = 20, 0
#: Relative difference that is rounding: of Pinocchio, which sums in the same order, and of MuJoCo, which does not.
PINOCCHIO, MUJOCO = 1e-12, 1e-9


class Check(NamedTuple):
    """What a program says.

    Attributes
    ----------
    program : str
    worst : float, optional
        Largest difference of H or C, relative to their largest entry; None if the program cannot be asked.
    most : float
        What is rounding.
    why : str
        Why it cannot be asked.
    """

    program: str
    worst: float | None
    most: float
    why: str = ""


def checks(model: RobotModel, file: str) -> list[Check]:
    """Return what Pinocchio and MuJoCo say of H and C as the simulator has them, at random states.

    MuJoCo reads an MJCF from its file, and a URDF from the model's own text.
    """
    from closedloop.jit.interpreted import interpreted
    from closedloop.jit.kernel import plain
    from closedloop.mechanics.robot.pinocchio import Robot
    from closedloop.mechanics.robot.tree import tree_terms, work_size

    robot, rng, n = Robot(model, model.tip or model.frames[-1]), np.random.default_rng(SEED), model.n
    states = []
    for _ in range(STATES):
        q, v = _posture(model, rng), rng.normal(size=n)
        H, C, work = np.zeros((n, n)), np.zeros(n), np.zeros(int(plain(work_size)(n)))
        of_tip = np.zeros((3, n)), np.zeros(3), np.zeros(3)
        interpreted(tree_terms)(robot.tree, robot.rotation_vectors(q), v, work, H, C, of_tip)
        states.append((q, v, np.triu(H) + np.triu(H, 1).T, C))
    theirs = [robot.terms(q, v) for q, v, _, _ in states]
    found = [Check("Pinocchio", _worst(states, [(terms.mass_matrix, terms.bias) for terms in theirs]), PINOCCHIO)]
    try:
        found.append(Check("MuJoCo", _worst(states, _of_mujoco(robot, file, states)), MUJOCO))
    except (ValueError, LookupError) as error:
        found.append(Check("MuJoCo", None, MUJOCO, one_line(str(error))))
    return found


def _posture(model: RobotModel, rng: np.random.Generator) -> Array:
    """Return random positions (nq,)."""
    from robot_models.coordinates import normalised

    return normalised(rng.normal(size=len(model.home)), model.joint_types, "q")


def _worst(states: list[Any], theirs: list[tuple[Array, Array]]) -> float:
    return max(
        float(np.max(np.abs(own - their)) / max(float(np.max(np.abs(their))), 1e-9))
        for (_, _, *ours), both in zip(states, theirs, strict=True)
        for own, their in zip(ours, both, strict=True)
    )


def _of_mujoco(robot: Robot, file: str, states: list[Any]) -> list[tuple[Array, Array]]:
    """Return H and C as MuJoCo has them.

    Raises
    ------
    ValueError
        If MuJoCo refuses the text.
    LookupError
        If it has other joints.
    """
    import mujoco

    model = robot.model
    if any(model.locked.values()) or (model.locked and model.format == "mjcf"):
        raise LookupError("joints are held rigid, which MuJoCo cannot be told")
    if model.format == "mjcf":
        compiled = (
            mujoco.MjModel.from_xml_path(file) if Path(file).is_file() else mujoco.MjModel.from_xml_string(model.text)
        )
        order = np.arange(compiled.nv)
        if compiled.nv != model.n:
            raise LookupError(f"its model has {compiled.nv} velocities")
    else:
        if model.balls:
            raise LookupError("it has no URDF with joints that turn freely")
        spec = mujoco.MjSpec.from_string(_bare(model))
        spec.compiler.fusestatic = spec.compiler.balanceinertia = False
        compiled = spec.compile()
        order = np.array([compiled.joint(name).dofadr[0] for name in model.joint_names])
    compiled.opt.gravity[:] = model.gravity
    compiled.dof_armature[order] = model.rigid_armature
    data, found = mujoco.MjData(compiled), []
    for q, v, _, _ in states:
        data.qpos[order if model.format == "urdf" else slice(None)] = q
        data.qvel[order] = v
        mujoco.mj_forward(compiled, data)
        full = np.zeros((compiled.nv, compiled.nv))
        mujoco.mj_fullM(compiled, data, full)
        found.append((full[np.ix_(order, order)], (data.qfrc_bias - data.qfrc_spring)[order]))
    return found


def _bare(model: RobotModel) -> str:
    """Return the links and joints of a URDF, those held at zero fixed, without shapes and their files."""
    root = ET.fromstring(model.text)
    for element in list(root):
        if element.tag not in ("link", "joint"):
            root.remove(element)
        if element.get("name") in model.locked and element.tag == "joint":
            element.set("type", "fixed")
        for child in list(element):
            if child.tag in ("visual", "collision", "mimic", "dynamics"):
                element.remove(child)
    return ET.tostring(root, encoding="unicode")
