"""A scenario to begin with: ``closedloop new my_slide --robot ur5`` writes my_slide.toml, which runs as it is."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from closedloop.base.errors import OutputError, ScenarioError, one_line, printable
from closedloop.base.files import what_was_written, write_whole
from closedloop.command.border import DONE, Parser, as_command

if TYPE_CHECKING:
    from closedloop.mechanics.robot.pinocchio import Robot
    from closedloop.scenario.scenario import Scenario


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    options = _parser().parse_args(words)
    file = Path(options.name if options.name.endswith(".toml") else f"{options.name}.toml")
    if os.path.lexists(file):
        raise OutputError(f"{file}: is there already and is not replaced; choose another name")
    if not file.parent.is_dir():
        raise OutputError(f"{file}: cannot be written: there is no folder {str(file.parent)!r}")
    if options.force is not None and not 0.0 < options.force <= MOST_FORCE:
        raise ScenarioError(f"--force {options.force:g}: must be greater than 0 and at most {MOST_FORCE:g} N")
    from closedloop.command.first_slide import first_slide, held
    from closedloop.mechanics.robot.pinocchio import Robot
    from closedloop.scenario.load import parse_scenario
    from robot_models.described import names_a_file

    robot = Robot(held(options.robot), options.tip)
    scenario, model = first_slide(robot, options.robot, options.force), options.robot
    if names_a_file(model) and not os.path.isabs(model):  # named from the scenario's own folder
        model = Path(os.path.relpath(model, file.parent)).as_posix()
    text = scenario_text(scenario, robot, model)
    parse_scenario(text, file.stem, str(file))  # refuses a name that is none
    write_whole(file, text.encode(), replace=False)
    print(printable(f"{what_was_written(file)}: {_what(scenario, robot)}"))
    others = [name for name in robot.model.frames if name != robot.tip]
    why = "as asked" if options.tip else "the frame of a tool or the end of the longest chain"
    print(printable(f"the tip is {robot.tip}, {why}; others, see --tip: {', '.join(others[-MOST_TIPS:])}"))
    if scenario.robot.stops:
        print("joints strike hard stops at the limits of the robot's file: robot.stops")
    if robot.model.locked:
        print(printable(f"held rigid, see robot.lock: {', '.join(robot.model.locked)}"))
    print(printable(f"run it with: closedloop run {file}"))
    return DONE


MOST_TIPS = 12  # that are listed
MOST_FORCE = 1e4  # N; what is beyond no arm of the lists bears


def _parser() -> Parser:
    parser = Parser(
        prog="closedloop new",
        description="Write a commented scenario in which a robot presses on a level surface, or a wall if its tip "
        "hardly moves up and down, and slides along it. What turns freely is held where its file has it. Start, path "
        "and gains are chosen so that it runs as it is, with a good verdict.",
    )
    parser.add_argument("name", metavar="NAME", help="its name, and that of the file NAME.toml; none is replaced")
    parser.add_argument("--robot", default="wam4", help="a name of `closedloop robots`, or a file (default wam4)")
    parser.add_argument("--tip", metavar="FRAME", help="frame that touches the surface (default: the robot's own)")
    parser.add_argument(
        "--force", type=float, metavar="N", help="force to press with (default 10, less for an arm that cannot)"
    )
    return parser


def scenario_text(scenario: Scenario, robot: Robot, model: str) -> str:
    """Return a scenario of `first_slide` as a commented file; `model` is what robot.model is to say in it."""
    law, normal = scenario.law.model_dump(), list(scenario.surface.normal)
    start = scenario.start.q
    assert isinstance(start, tuple)
    width = max(len(f"{q!r},") for q in start)
    assembled = (
        "assemble = true  # close the loops and couplings of the robot from there\n" if robot.model.loops else ""
    )
    posture = "\n".join(
        f"    {f'{q!r},':{width}}  # {one_line(name)}" for q, name in zip(start, robot.joint_names, strict=True)
    )
    return f"""\
# {_what(scenario, robot)}
# Run it with `closedloop run FILE`. `closedloop run --help law` lists all keys of a
# section, `closedloop run --explain law.kp` explains one.
description = {_quoted(_what(scenario, robot))}

[robot]
model = {_quoted(model)}  # `closedloop robots {one_line(model)}` shows its joints and frames
tip = {_quoted(robot.tip)}  # the frame that touches the surface
stops = {"true" if scenario.robot.stops else "false"}  # joints strike hard stops at their limits
{_lock(scenario)}
[surface]
normal = {normal}  # out of the surface, base frame: it is {_surface(scenario)}
offset = "start"  # it goes through the tip at the start
contact = "bilateral"  # the tip is held to it; with "unilateral" it may leave

[start]
q = [  # rad, m for a sliding joint: away from singular poses and from the limits
{posture}
]
{assembled}
[reference]
{_path(scenario)}
[law]
kind = "paper"  # Eq. 33: joint PD control along the path, and the force
kp = {list(law["kp"])}  # N m/rad, one for each joint
kd = {list(law["kd"])}  # N m s/rad
force = {law["force"]}  # N, with which the tip presses

[stabiliser]
kind = "baumgarte"  # keeps the tip on the surface
damping_ratio = 0.707
time_constant = 0.001  # s

[time]
duration = {scenario.time.duration}  # s
step = {scenario.time.step}  # s
integrator = "{scenario.time.integrator}"
"""


def _lock(scenario: Scenario) -> str:
    """Return the line that says which joints are held rigid, if there are any."""
    import tomli_w

    lock = scenario.robot.lock or {}
    held = ", ".join(tomli_w.dumps({joint: value}).strip() for joint, value in lock.items())
    return f"lock = {{ {held} }}  # held rigid there, rad (m); 0: as the file has it\n" if lock else ""


def _path(scenario: Scenario) -> str:
    path = scenario.reference.model_dump()
    if path["kind"] == "hold":
        return 'kind = "hold"  # the tip stays where it is: it moves along one line only\n'
    return f"""\
kind = "line"
direction = {list(path["direction"])}  # along the surface, base frame
speed = {path["speed"]}  # m/s, on average
start = {path["start"]}  # s
stop = {path["stop"]}  # s
timing = "minimum_jerk"  # from rest to rest
"""


def _surface(scenario: Scenario) -> str:
    from closedloop.command.first_slide import LEVEL

    return "level" if tuple(scenario.surface.normal) == LEVEL else "a wall"


def _what(scenario: Scenario, robot: Robot) -> str:
    path = scenario.reference.model_dump()
    pressing = f"{one_line(robot.model.name)} presses with {scenario.law.force:g} N"
    surface = "a level surface" if _surface(scenario) == "level" else "a wall"
    if path["kind"] == "hold":
        return f"{pressing} on {surface}"
    return f"{pressing} and slides {1000.0 * path['speed'] * (path['stop'] - path['start']):g} mm along {surface}"


def _quoted(text: str) -> str:
    import tomli_w

    return tomli_w.dumps({"x": text}).partition("=")[2].strip()
