"""The commands: what ``closedloop`` and ``python -m closedloop`` can be followed by.

A command is one line here. Its module is imported when the command is used, and not before: the table names it as text.
`validate` is the only one outside of this package, which never imports the harness: the console starts it by its name,
as ``python -m validation.run`` does.
"""

from collections.abc import Callable
from pkgutil import resolve_name
from typing import NamedTuple


class Command(NamedTuple):
    """A command."""

    # name, help: the word that picks it, and what it does, on one line of the overview
    name: str
    help: str
    main: str  # MODULE:FUNCTION; the function takes the words after the command, and returns the exit status
    # what its words may be, for the completion of a shell: "scenario", "run", "robot", or nothing known
    takes: str = ""


COMMANDS = (
    Command("run", "simulate a scenario, or repeat a run.nc", "closedloop.run:main", "scenario"),
    Command("new", "write a scenario for a robot, ready to run", "closedloop.command.new:main"),
    Command("show", "print the report of a saved run", "closedloop.command.saved:show", "run"),
    Command("plot", "draw the figures of a saved run", "closedloop.command.saved:plot", "run"),
    Command("sweep", "run a scenario many times, into a table", "closedloop.command.sweep:as_process", "scenario"),
    Command("study", "run a study: drift, controllers", "validation.studies.__main__:main"),
    Command("analyse", "margins, poles and limits of the force loop", "closedloop.command.logs:analyse", "scenario"),
    Command("tune", "find the gains that minimise a value of the runs", "closedloop.command.logs:tune", "scenario"),
    Command("identify", "find a robot's parameters from a log", "closedloop.command.logs:identify"),
    Command("excite", "design a motion that identifies parameters", "closedloop.command.logs:excite"),
    Command("compare", "compare a log or a saved run with a scenario", "closedloop.command.logs:compare"),
    Command("validate", "compare the simulator with other engines", "validation.run:main"),
    Command("robots", "list the robots, or show one: joints, frames", "closedloop.command.lists:robots", "robot"),
    Command("scenarios", "list the scenarios of the package", "closedloop.command.lists:scenarios"),
    Command("lab", "open the lab: sliders, the arm in space, curves", "closedloop.command.serve:open_lab", "scenario"),
    Command("serve", "let another program drive a scenario", "closedloop.command.serve:main", "scenario"),
    Command("export", "write a saved run as CSV, MCAP, GIF ...", "closedloop.command.saved:export", "run"),
    Command("compile", "compile everything now, for images and clusters", "closedloop.command.compile_all:main"),
    Command("completion", "print the completion script of a shell", "closedloop.command.lists:completion"),
    Command("version", "print the versions that a run depends on", "closedloop.command.lists:version"),
)


# What compares a robot's mechanics with other programs', for ``closedloop robots --check``.
ROBOT_CHECK = "validation.robot_check:said"


# Commands that are spelled otherwise in American English.
AMERICAN = {"analyse": "analyze"}


def imported(command: Command) -> Callable[[list[str]], int]:
    """Import the module of a command and return its function."""
    return resolve_name(command.main)


def find(name: str) -> Command | None:
    """Return the command with this name, or with its American spelling; None if there is none."""
    return next((command for command in COMMANDS if name in (command.name, AMERICAN.get(command.name))), None)


def overview() -> str:
    """Return the help of ``closedloop`` itself: its commands, a line each."""
    width = max(len(command.name) for command in COMMANDS)
    return "\n".join(
        [
            "usage: closedloop COMMAND ...",
            "",
            "Simulate robot arms whose tip presses on a surface, and study force control.",
            "",
            *(f"  {command.name:{width}}  {command.help}" for command in COMMANDS),
            "",
            "closedloop COMMAND --help explains a command. To begin: closedloop run wam_slide",
        ]
    )
