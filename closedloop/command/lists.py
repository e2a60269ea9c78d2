"""``closedloop robots``, ``scenarios`` and ``version``: lists, and one robot; ``completion``: what a shell completes.

``robots ROBOT --check``: whether H, C, potential energy, the tip's Jacobian and the rows of loops of a robot are those
of other programs on random states.

The script of ``eval "$(closedloop completion bash)"`` is made by shtab from the parsers of the commands and the schema
of a scenario; nothing of Python runs while one types. It is to be made again after an update.
"""

from __future__ import annotations

import io
import math
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout, suppress
from inspect import unwrap
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from closedloop.base.errors import printable
from closedloop.command.border import DONE, Left, Parser, as_command
from closedloop.command.table import COMMANDS, ROBOT_CHECK, imported

if TYPE_CHECKING:
    from rich.console import Console

    from robot_models import RobotModel
    from robot_models.loop_joint import LoopJoint
    from robot_models.tendon import Tendon


@as_command()
def robots(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(
        prog="closedloop robots",
        description="List what can be named as robot.model, or show one robot: joints, limits and frames.",
    )
    parser.add_argument("robot", nargs="?", help="a name of the list, or the path of a URDF or MJCF file")
    parser.options({"--check": "compare H, C, energy and Jacobians with MuJoCo's and Pinocchio's"})
    options = parser.parse_args(words)
    from rich.console import Console

    console = Console(highlight=False)
    if options.robot is None:
        _print_all(console)
    else:
        import robot_models

        model = robot_models.load(options.robot)
        _print_one(model, console)
        if options.check and not model.n:
            console.print("nothing moves: there is nothing to check")
        elif options.check:
            lines, wrong = resolve_name(ROBOT_CHECK)(model, options.robot)
            for line in lines:
                console.print(line, markup=False)
            return 1 if wrong else DONE
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


def list_of_scenarios() -> str:
    """Return the names of the shipped scenarios and what each is, a line each."""
    from closedloop.scenario.load import load_scenario, shipped_scenarios

    names = shipped_scenarios()
    width = max(map(len, names))
    return "\n".join(f"{name:{width}}  {load_scenario(name).description}" for name in names)


def versions() -> str:
    """Return the versions of Python and of the packages whose arithmetic a run depends on, on one line."""
    from closedloop.record.save import package_versions

    return ", ".join(f"{name} {version}" for name, version in package_versions().items())


@as_command()
def scenarios(words: list[str]) -> int:
    """List the shipped scenarios, and return the exit status."""
    Parser(
        prog="closedloop scenarios", description="List the shipped scenarios, for `closedloop run NAME`."
    ).parse_args(words)
    print(list_of_scenarios())
    return DONE


@as_command()
def version(words: list[str]) -> int:
    """Print the versions that a run depends on, and return the exit status."""
    Parser(prog="closedloop version", description="Print the versions that a run depends on.").parse_args(words)
    print(versions().replace(", ", "\n"))
    return DONE


@as_command()
def completion(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(
        prog="closedloop completion",
        description="Print the completion script of a shell: commands, options, scenarios, robots and keys.",
        epilog='Put into ~/.bashrc, ~/.zshrc: eval "$(closedloop completion bash)", or zsh; '
        "for fish: closedloop completion fish > ~/.config/fish/completions/closedloop.fish",
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))
    shell = parser.parse_args(words).shell
    import shtab

    print(shtab.complete(all_commands(), shell))
    return DONE


def all_commands() -> ArgumentParser:
    """Return a parser of all commands with the words that may follow each option."""
    import shtab

    from closedloop.scenario.load import shipped_scenarios
    from closedloop.scenario.messages import all_keys, choices, sections
    from closedloop.scenario.tables import table_type

    keys, robots = all_keys(), list(names())
    keys = [key for key in keys if not table_type(key.partition(".")[0])]
    known = {"scenario": shipped_scenarios(), "explain": keys, "help": list(sections())}
    known |= dict.fromkeys(("robot", "robots"), robots)
    whole = ArgumentParser(prog="closedloop")
    commands = whole.add_subparsers()
    for command in COMMANDS:
        found = None
        with suppress(ImportError), redirect_stdout(io.StringIO()):  # it may not be installed
            try:
                unwrap(imported(command))(["--help"])
            except Left as left:
                found = left.args[0]
        if found is None:
            continue
        parser = commands.add_parser(command.name, help=command.help, parents=[found], add_help=False)
        for action in parser._actions:
            if action.choices is None and action.dest in known:
                action.choices = known[action.dest]
            elif action.choices is None and action.nargs != 0:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
        for key in keys if command.takes == "scenario" else ():
            parser.add_argument(f"--{key}", choices=robots if key == "robot.model" else choices(key) or None)
    return whole
