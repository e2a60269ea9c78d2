"""``closedloop robots``, and ``closedloop robots ur5``: the robots that a scenario can name as robot.model.

With --check: whether H, C, potential energy, the tip's Jacobian and the rows of loops of a robot are those of other
programs on random states.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import one_line, printable
from closedloop.command.border import DONE, Parser, as_command

if TYPE_CHECKING:
    from rich.console import Console

    from closedloop.mechanics.robot.pinocchio import Robot
    from robot_models import RobotModel
    from robot_models.loop_joint import LoopJoint
    from robot_models.tendon import Tendon


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(
        prog="closedloop robots",
        description="List what can be named as robot.model, or show one robot: joints, limits and frames.",
    )
    parser.add_argument("robot", nargs="?", help="a name of the list, or the path of a URDF or MJCF file")
    parser.add_argument(
        "--check", action="store_true", help="compare H, C, energy and Jacobians with MuJoCo's and Pinocchio's"
    )
    options = parser.parse_args(words)
    from rich.console import Console

    console = Console(highlight=False)
    if options.robot is None:
        _print_all(console)
    else:
        import robot_models

        model = robot_models.load(options.robot)
        _print_one(model, console)
        if options.check:
            return _print_checks(model, options.robot, console)
    return DONE


def names() -> tuple[str, ...]:
    """Return the names of all robots, those of this package first."""
    import robot_models
    from robot_models.example_robots import example_names

    return (*robot_models.shipped_names(), *example_names())


def _print_all(console: Console) -> None:
    """Print a line for each robot, and why some cannot be used."""
    import robot_models
    from robot_models import ModelError
    from robot_models.example_robots import NEEDS, installed

    width, tip = max(map(len, names())), 22
    rest = max(console.width - width - tip - 12, 12)
    print(f"{'robot':{width}}  joints  {'tip':{tip}}  names of the joints")
    refused: list[str] = []
    for name in names():
        try:
            model = robot_models.load(name)
        except ModelError as error:
            refused.append(str(error) if name in str(error) else f"{name}: {error}")
        else:
            joints = _cut(", ".join(model.joint_names), rest)
            print(f"{name:{width}}  {model.n:6}  {_cut(model.tip or 'none', tip):{tip}}  {joints}")
    console.print(
        "\nThe tip is that of a scenario which names none. `closedloop robots NAME` shows all joints, their limits and "
        "the frames that can be a tip; a URDF or MJCF file is named by its path."
    )
    if not installed():
        console.print(f"\nRobots of other makers, such as panda and ur5, need {NEEDS}.", markup=False)
    if refused:
        console.print("\nnot to be used as they are:")
    for text in refused:
        console.print(f"  {text}", markup=False, soft_wrap=True)


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 3]}..."


def _print_one(model: RobotModel, console: Console) -> None:
    """Print a robot's joints with their limits, its tip and its frames."""
    from rich import box
    from rich.table import Table

    console.print(f"{model.name}: {model.description or 'no description'}", markup=False)
    if model.source:
        console.print(printable(f"from {model.source}"), markup=False)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("joint", overflow="fold")  # whole: options and columns take it
    table.add_column("kind")
    for title in ("from", "to", "home", "speed", "torque", "drive"):
        table.add_column(title, justify="right", no_wrap=True)
    columns = (model.position_lower, model.position_upper, model.loop_home, model.velocity_limit, model.effort_limit)
    for j, (name, kind) in enumerate(zip(model.joint_names, model.joint_types, strict=True)):
        numbers = [f"{x:.4g}" if math.isfinite(x) else "-" for x in (*(c[j] for c in columns), model.armature[j])]
        table.add_row(name, kind, *numbers)
    console.print(table)
    console.print("rad, rad/s, N m and kg m2; of a prismatic joint m, m/s, N and kg; - where there is no limit")
    if model.balls:
        console.print("of a ball joint the rotation vector, rad, and the angular velocity in its link's axes, rad/s")
    masses = [inertia.mass for inertia in model.pinocchio_model().inertias]
    console.print(f"total mass: {sum(masses):.6g} kg, of which {sum(masses[1:]):.6g} kg move")
    ends = [end for tendon in model.tendons for end in tendon.limits]
    stops = any(map(math.isfinite, (*model.position_lower, *model.position_upper, *ends)))
    if stops:
        console.print("the limits are stops with robot.stops = true, and not without", markup=False)
    passive = [name for name, driven in zip(model.joint_names, model.driven, strict=True) if not driven]
    if passive:
        console.print(f"joints without a drive: {', '.join(passive)}", markup=False)
    for loop in model.loops:
        console.print(f"{'coupling' if loop.type == 'gear' else 'loop'}: {_loop(loop)}", markup=False)
    for pull in model.shared_drives:
        console.print(f"one drive pulls {_sum(pull)}", markup=False)
    for tendon in model.tendons:
        console.print(f"{'tendon' if len(tendon.coefficients) > 1 else 'spring'}: {_tendon(tendon)}", markup=False)
    _print_shapes(model, console)
    for joint, value in model.locked.items():
        console.print(f"held rigid: {joint} at {value:.4g}", markup=False)
    console.print(f"tip: {model.tip or 'none: name one with --robot.tip'}", markup=False)
    console.print(f"frames that can be a tip: {', '.join(model.frames)}", markup=False)
    for note in model.notes:
        console.print(f"note: {note}", markup=False)
    for warning in model.warnings:
        console.print(f"warning: {warning}", markup=False)


def _loop(loop: LoopJoint) -> str:
    """Return what a loop joint binds, in a line."""
    if loop.type != "gear":
        return f"{loop.name}: a {loop.type} between {' and '.join(loop.frames)}"
    one, other = (_sum(each) for each in loop.sums)
    other = f"({other})" if len(loop.sums[1]) > 1 else other
    powers = ("", f" {other}" if other else "", *(f" {other}^{k}" for k in (2, 3, 4) if other))
    terms = [f"{c:.6g}{power}" for c, power in zip(loop.polynomial, powers, strict=False) if c]
    return f"{loop.name}: {one} = {' + '.join(terms) or '0'}"


def _sum(coefficients: Mapping[str, float]) -> str:
    """Return a sum of joints times coefficients, in words."""
    terms = (f"{c:g} {joint}" if c != 1.0 else joint for joint, c in coefficients.items())
    return " + ".join(terms).replace("+ -", "- ")


def _tendon(tendon: Tendon) -> str:
    """Return what acts along a tendon, in a line."""
    length = " + ".join(f"{c:g} {joint}" for joint, c in tendon.coefficients.items())
    acting = []
    if any(tendon.stiffness):
        low, high = tendon.rest
        rest = f"{low:.4g}" if low == high else f"[{low:.4g}, {high:.4g}]"
        acting.append(f"spring {_numbers(tendon.stiffness)} about {rest}")
    if any(tendon.damping):
        acting.append(f"damper {_numbers(tendon.damping)}")
    if tendon.friction:
        acting.append(f"friction {tendon.friction:g}")
    if any(map(math.isfinite, tendon.limits)):
        acting.append(f"range [{tendon.limits[0]:.4g}, {tendon.limits[1]:.4g}]")
    return f"{tendon.name}: {length}: {', '.join(acting)}"


def _numbers(values: Sequence[float]) -> str:
    """Return the coefficients of a polynomial, without zeros at its end."""
    kept = max(k for k, value in enumerate(values) if value) + 1
    return " ".join(f"{value:g}" for value in values[:kept])


def _print_shapes(model: RobotModel, console: Console) -> None:
    """Print how many collision shapes there are of each kind."""
    from collections import Counter

    from robot_models import ModelError
    from robot_models.collision import collision_shapes

    kinds: Counter[str] = Counter()
    for frame in model.frames:
        try:
            kinds.update(shape.kind for shape in collision_shapes(model, frame))
        except ModelError as error:
            console.print(f"shapes: {error}", markup=False)
    listed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    console.print(f"collision shapes: {listed or 'none'}", markup=False)


def _print_checks(model: RobotModel, file: str, console: Console) -> int:
    """Print whether the mechanics are those of other programs; return 1 if they are not."""
    if not model.n:
        console.print("nothing moves: there is nothing to check")
        return DONE
    wrong = False
    for check in checks(model, file):
        if check.apart is None:
            console.print(f"{check.program}: not compared: {check.why}", markup=False)
            continue
        differ = [name for name, apart in check.apart.items() if not apart <= check.most]
        wrong |= bool(differ)
        listed = ", ".join(f"{name} {apart:.1e}" for name, apart in check.apart.items())
        verdict = f"DIFFERENT: {', '.join(differ)};" if differ else "equal"
        console.print(
            f"{check.program}: {verdict} at {STATES} random states, "
            f"by these shares of the largest entry: {listed} (rounding: {check.most:g})",
            markup=False,
        )
    return 1 if wrong else DONE


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

    Attributes
    ----------
    program : str
    apart : dict of float, optional
        Of each quantity the largest difference, relative to its largest entry; None if the program cannot be asked.
    most : float
        What is rounding.
    why : str
        Why it cannot be asked.
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
    """Return closed postures (N, n) about the home posture.

    Raises
    ------
    ValueError
        If none is found.
    """
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

    Raises
    ------
    ValueError
        If MuJoCo refuses the text.
    LookupError
        If it has other joints.
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
