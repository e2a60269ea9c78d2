"""A robot's mechanics beside other programs': ``closedloop robots NAME --check``.

H, C, potential energy, the tip's Jacobian and the rows of loops at random states, by the kernels of a run, by Pinocchio
and by MuJoCo.
"""

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
    from robot_models.loop_joint import LoopJoint


def said(model: RobotModel, file: str) -> tuple[list[str], bool]:
    """Return a line for each program, and whether any of them says something else."""
    lines, wrong = [], False
    for check in checks(model, file):
        if check.apart is None:
            lines.append(f"{check.program}: not compared: {check.why}")
            continue
        differ = [name for name, apart in check.apart.items() if not apart <= check.most]
        wrong |= bool(differ)
        listed = ", ".join(f"{name} {apart:.1e}" for name, apart in check.apart.items())
        verdict = f"DIFFERENT: {', '.join(differ)};" if differ else "equal"
        lines.append(
            f"{check.program}: {verdict} at {STATES} random states, "
            f"by these shares of the largest entry: {listed} (rounding: {check.most:g})"
        )
    return lines, wrong


STATES, SEED = 20, 0
#: Relative difference that is rounding: of Pinocchio, which sums in the same order, and of MuJoCo, which does not.
PINOCCHIO, MUJOCO = 1e-12, 1e-9
#: Names of what is compared.
MATRIX, BIAS, ENERGY, TIP, LOOPS = "H", "C", "potential energy", "Jacobian of the tip", "rows of loops"
# How far the postures at which loops are compared start from the home posture, rad (m), before they are closed.
_AROUND = 0.05
# Singular values that count as none, relative to the largest of the rows of loops.
_DEPENDENT = 1e-9
# MuJoCo's numbers of kinds.
_EQUALITY, _SITE, _WELD = 0, 6, 1

#: What one program says: of each name an array, states first.
Said = dict[str, Array]


class Check(NamedTuple):
    """What a program says.

    apart: of each quantity the largest difference, relative to its largest entry; None if the program cannot be asked
    most: what is rounding
    why: why it cannot be asked
    """

    program: str
    apart: dict[str, float] | None
    most: float
    why: str = ""


def checks(model: RobotModel, file: str) -> list[Check]:
    """Return how far what the simulator computes is from what Pinocchio and MuJoCo do, at random states.

    MuJoCo reads an MJCF from its file, and a URDF from the model's own text, without its loops: these are compared with
    Pinocchio's constraints. Energies are compared by their difference
    from the first state's, and loops at closed postures: by the errors that are left, and by the projection on the
    space of their rows, because the rows of one constraint can be written in several ways.
    """
    from closedloop.mechanics.loops.reactions import loop_rows
    from closedloop.mechanics.robot.pinocchio import Robot

    robot, rng, n = Robot(model, model.tip or model.frames[-1]), np.random.default_rng(SEED), model.n
    states = [(_posture(model, rng), rng.normal(size=n)) for _ in range(STATES)]
    theirs, ours = [robot.terms(q, v) for q, v in states], _of_kernels(robot, states)
    pinocchios = {
        MATRIX: np.array([terms.mass_matrix for terms in theirs]),
        BIAS: np.array([terms.bias for terms in theirs]),
        TIP: np.array([terms.jacobian for terms in theirs]),
        ENERGY: robot.potential_energy(robot.rotation_vectors(np.array([q for q, _ in states]))),
    }
    found = [Check("Pinocchio", _apart(robot, ours, pinocchios), PINOCCHIO)]
    try:
        closed = _closed(robot, rng) if model.loops else np.zeros((0, n))
        if model.loops and model.format == "mjcf":
            rows, errors = loop_rows(robot, closed, np.zeros_like(closed))
            ours[LOOPS] = np.array([_held(*both) for both in zip(rows, errors, strict=True)])
        elif model.loops:
            found.append(_loops_by_pinocchio(robot, closed))
            closed = closed[:0]
        found.append(Check("MuJoCo", _apart(robot, ours, _of_mujoco(robot, file, states, closed)), MUJOCO))
    except (ValueError, LookupError) as error:
        found.append(Check("MuJoCo", None, MUJOCO, one_line(str(error))))
    return found


def _posture(model: RobotModel, rng: np.random.Generator) -> Array:
    """Return random positions (nq,)."""
    from robot_models.coordinates import normalised

    return normalised(rng.normal(size=len(model.home)), model.joint_types, "q")


def _of_kernels(robot: Robot, states: list[tuple[Array, Array]]) -> Said:
    """Return what the kernels of a run compute."""
    from closedloop.jit.interpreted import interpreted
    from closedloop.jit.kernel import plain
    from closedloop.mechanics.robot.tree import tree_potential_energy, tree_terms, work_size

    n, found = robot.n, []
    for q, v in states:
        q = robot.rotation_vectors(q)
        H, C, J, work = np.zeros((n, n)), np.zeros(n), np.zeros((3, n)), np.zeros(int(plain(work_size)(n)))
        energy = interpreted(tree_potential_energy)(robot.tree, q, work)
        interpreted(tree_terms)(robot.tree, q, v, work, H, C, (J, np.zeros(3), np.zeros(3)))
        found.append((np.triu(H) + np.triu(H, 1).T, C, J, energy))
    return {
        name: np.array(each) for name, each in zip((MATRIX, BIAS, TIP, ENERGY), zip(*found, strict=True), strict=True)
    }


def _closed(robot: Robot, rng: np.random.Generator) -> Array:
    """Return closed postures (N, n) about the home posture. Raises `ValueError` if none is found."""
    from closedloop.mechanics.loops.assemble import closed_start

    model = robot.model
    home, found = robot.rotation_vectors(np.asarray(model.loop_home)), []
    low, high = model.position_lower, model.position_upper
    for _ in range(STATES):
        q = np.clip(home + _AROUND * rng.normal(size=robot.n), low, high)
        found.append(closed_start(robot, q, np.zeros(robot.n), assemble=True)[0])
    return np.array(found)


def _held(rows: Array, errors: Array) -> Array:
    """Return what rows (m, n) hold, however they are written, and by how much their errors (m,) say it does not.

    The first is the orthogonal projection on their space, of n² numbers; some rows may depend on others.
    """
    return np.append(np.linalg.pinv(rows, rcond=_DEPENDENT) @ rows, np.max(np.abs(errors), initial=0.0))


def _apart(robot: Robot, ours: Said, theirs: Said) -> dict[str, float]:
    """Return of each quantity that both have how far it is apart, relative to its largest entry."""
    # Where the mass moves at one height alone, rounding of C and of the energy is that of its weight times its reach.
    weight = sum(each.mass for each in robot.model.pinocchio_model().inertias[1:]) * np.linalg.norm(robot.gravity)
    found = {}
    for name, their in theirs.items():
        own, least = ours[name], max(1e-9, float(weight) * robot.reach if name in (BIAS, ENERGY) else 0.0)
        if name == ENERGY:
            least = max(float(np.max(np.abs(their))), least)
            own, their = own - own[0], their - their[0]
        found[name] = float(np.max(np.abs(own - their)) / max(float(np.max(np.abs(their))), least))
    return found


def _of_mujoco(robot: Robot, file: str, states: list[tuple[Array, Array]], closed: Array) -> Said:
    """Return what MuJoCo computes; of loops, at closed postures.

    Raises `ValueError` if MuJoCo refuses the text; `LookupError` if it has other joints.
    """
    import mujoco

    from robot_models.coordinates import with_quaternions

    model = robot.model
    if any(model.locked.values()) or (model.locked and model.format == "mjcf"):
        raise LookupError("joints are held rigid, which an MJCF cannot state")
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
    compiled.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(compiled)
    site, body = (
        mujoco.mj_name2id(compiled, kind, robot.tip) for kind in (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY)
    )
    found: dict[str, list[Any]] = {name: [] for name in (MATRIX, BIAS, ENERGY)}
    for q, v in states:
        data.qpos[order if model.format == "urdf" else slice(None)] = q
        data.qvel[order] = v
        mujoco.mj_forward(compiled, data)
        full, J = np.zeros((compiled.nv, compiled.nv)), np.zeros((3, compiled.nv))
        mujoco.mj_fullM(compiled, data, full)
        mujoco.mj_energyPos(compiled, data)
        found[MATRIX].append(full[np.ix_(order, order)])
        found[BIAS].append((data.qfrc_bias - data.qfrc_spring)[order])
        found[ENERGY].append(data.energy[0])
        if body >= 0:
            mujoco.mj_jacBody(compiled, data, J, None, body)
        elif site >= 0:
            mujoco.mj_jacSite(compiled, data, J, None, site)
        else:
            continue  # a frame that the sidecar adds
        found.setdefault(TIP, []).append(J[:, order])
    for q in closed:
        data.qpos[:], data.qvel[:] = with_quaternions(q, model.joint_types), 0.0
        mujoco.mj_forward(compiled, data)
        rows = [i for i in range(data.nefc) if data.efc_type[i] == _EQUALITY and _moves(compiled, int(data.efc_id[i]))]
        jacobian = data.efc_J.reshape(-1, compiled.nv)
        found.setdefault(LOOPS, []).append(_held(jacobian[rows], data.efc_pos[rows]))
    return {name: np.array(each) for name, each in found.items()}


# Of the motion of one side of a loop joint against the other, along x, y, z and about them with z its axis: what is 0.
_BOUND = {
    "point": (0, 1, 2), "hinge": (0, 1, 2, 3, 4), "slider": (0, 1, 3, 4, 5), "cylinder": (0, 1, 3, 4),
    "planar": (2, 3, 4), "weld": (0, 1, 2, 3, 4, 5),
}  # fmt: skip


def _loops_by_pinocchio(robot: Robot, closed: Array) -> Check:
    """Return how far the rows of loops are from Pinocchio's constraint Jacobians at closed postures.

    Of a distance, a universal joint and a gear, for which Pinocchio has none, they follow from its Jacobians of links.
    """
    import pinocchio as pin

    from closedloop.mechanics.loops.reactions import loop_rows
    from robot_models.coordinates import in_pinocchios_order, with_quaternions

    model, built = robot.model, robot.model.pinocchio_model()
    rows, errors = loop_rows(robot, closed, np.zeros_like(closed))
    ours = {LOOPS: np.array([_held(G, e) for G, e in zip(rows, errors, strict=True)])}
    held = [(loop, () if loop.type == "gear" else _sides(built, loop)) for loop in model.loops]
    data, theirs = built.createData(), []
    for q in closed:
        at = in_pinocchios_order(with_quaternions(q, model.joint_types), model.joint_types)
        pin.computeJointJacobians(built, data, at)
        each = [_gear_row(built, at, loop) if not sides else _rows(built, data, loop, sides) for loop, sides in held]
        theirs.append(_held(np.concatenate([G for G, _ in each]), np.concatenate([e for _, e in each])))
    return Check("Pinocchio's constraints", _apart(robot, ours, {LOOPS: np.array(theirs)}), MUJOCO)


def _gear_row(built: Any, q: Array, loop: LoopJoint) -> tuple[Array, Array]:
    """Return row (1, n) and error (1,) of a gear at Pinocchio's positions."""
    P, rows, values = np.polynomial.Polynomial(loop.polynomial), np.zeros((2, built.nv)), np.zeros(2)
    for k, each in enumerate(loop.sums):
        for name, coefficient in each.items():
            joint = built.joints[built.getJointId(name)]
            rows[k, joint.idx_v] = coefficient
            values[k] += coefficient * q[joint.idx_q]
    return (rows[0] - P.deriv()(values[1]) * rows[1])[None], np.array([values[0] - P(values[1])])


def _rows(built: Any, data: Any, loop: LoopJoint, sides: tuple[Any, ...]) -> tuple[Array, Array]:
    """Return rows (k, n) and errors (k,) of a loop joint between two links, with the Jacobians of joints computed."""
    import pinocchio as pin

    if loop.type in _BOUND:
        own, held = (
            list(_BOUND[loop.type]),
            pin.RigidConstraintModel(pin.ContactType.CONTACT_6D, built, *sides, pin.LOCAL),
        )
        state = held.createData()
        held.calc(built, data, state)
        apart = (data.oMi[sides[0]] * sides[1]).actInv(data.oMi[sides[2]] * sides[3])
        return pin.getConstraintJacobian(built, data, held, state)[own], pin.log6(apart).vector[own]
    moves, turns, points, axes = [], [], [], []
    for joint, placed in (sides[:2], sides[2:]):
        there = data.oMi[joint] * placed
        J = pin.getJointJacobian(built, data, joint, pin.LOCAL_WORLD_ALIGNED) if joint else np.zeros((6, built.nv))
        moves.append(J[:3] - pin.skew(there.translation - data.oMi[joint].translation) @ J[3:])
        turns.append(J[3:])
        points.append(there.translation)
        axes.append(there.rotation[:, 2])
    apart, moving = points[0] - points[1], moves[0] - moves[1]
    if loop.type == "distance":
        length = float(np.linalg.norm(apart))
        return (apart / length @ moving)[None], np.array([length - loop.length])
    perpendicular = np.cross(*axes) @ (turns[0] - turns[1])  # of a universal joint
    return np.vstack([moving, perpendicular]), np.append(apart, axes[0] @ axes[1])


def _sides(built: Any, loop: LoopJoint) -> tuple[Any, ...]:
    """Return of either side of a loop joint the joint of Pinocchio's model that carries it, and its placement there."""
    import pinocchio as pin

    from robot_models.loop_joint import WITH_AXIS, WORLD

    sides: list[Any] = []
    turn = np.eye(3)
    for name, point, axis in zip(loop.frames, loop.points, loop.axes, strict=True):
        if sides and loop.type in ("weld", "slider"):
            turn = np.array(loop.turn) @ turn
        elif loop.type in WITH_AXIS:
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(axis)).matrix()
        placed, joint = pin.SE3(turn, np.array(point)), 0
        if name != WORLD:
            frame = built.frames[built.getFrameId(name)]
            placed, joint = frame.placement * placed, frame.parentJoint
        sides += [joint, placed]
    return tuple(sides)


def _moves(compiled: Any, k: int) -> bool:
    """Tell whether an equality of MuJoCo is a loop here: those to mocap bodies are left out."""
    ends, kind = (compiled.eq_obj1id[k], compiled.eq_obj2id[k]), compiled.eq_objtype[k]
    bodies = [compiled.site_bodyid[i] if kind == _SITE else i for i in ends] if compiled.eq_type[k] <= _WELD else []
    return all(compiled.body_mocapid[i] < 0 for i in bodies)


def _bare(model: RobotModel) -> str:
    """Return the links and joints of a URDF, those held at zero fixed, without shapes and their files."""
    from validation.engines.interface import bare_urdf

    root = ET.fromstring(bare_urdf(model.text))
    for joint in root.iterfind("joint"):
        if joint.get("name") in model.locked:
            joint.set("type", "fixed")
    return ET.tostring(root, encoding="unicode")
