"""Robots by the command line: the list, one of them, and whether its H and C are those of other programs.

The robots that a scenario can name as robot.model: ``closedloop robots``, and ``closedloop robots ur5``.

Whether H and C of a robot are those of other programs on random states: ``closedloop robots FILE --check``.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
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
    parser.add_argument("--check", action="store_true", help="compare H and C with MuJoCo's and Pinocchio's")
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
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("joint")
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
    one, *other = loop.joints
    powers = ("", f" {other[0]}" if other else "", *(f" {other[0]}^{k}" for k in (2, 3, 4) if other))
    terms = [f"{c:.6g}{power}" for c, power in zip(loop.polynomial, powers, strict=False) if c]
    return f"{loop.name}: {one} = {' + '.join(terms) or '0'}"


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
    """Print whether H and C are those of other programs; return 1 if they are not."""

    if not model.n:
        console.print("nothing moves: there is nothing to check")
        return DONE
    wrong = False
    for check in checks(model, file):
        if check.worst is None:
            console.print(f"{check.program}: not compared: {check.why}", markup=False)
            continue
        equal = check.worst <= check.most
        wrong |= not equal
        console.print(
            f"{check.program}: H and C {'are equal' if equal else 'DIFFER'} at {STATES} random states, "
            f"by {check.worst:.1e} of their largest entry (rounding: {check.most:g})"
        )
    return 1 if wrong else DONE


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
