"""The console script, and ``python -m closedloop``: one command, ``closedloop run wam_slide``, of those in its table.

A scenario may stand without `run`: ``closedloop wam_slide``. The module of a command is imported by its name in the
table when the command is asked for, and no other one: each command starts as fast as it does alone.
"""

import sys
from collections.abc import Sequence

from closedloop.command.table import COMMANDS, Command, find, imported, overview


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return the exit status, that of the command which its first word names."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words[:1] in (["--help"], ["-h"]):
        return _say(overview())
    if words[:1] == ["--version"]:
        words = ["version", *words[1:]]
    command = find(words[0]) if words else None
    if command is not None:
        return _start(command, words[1:])
    if words and (words[0].startswith("-") or _is_scenario(words[0])):
        from closedloop.run import main as run

        return run(words)
    return _refuse(words)


def _start(command: Command, words: list[str]) -> int:
    """Import the command's module and run it; one that is not installed is refused."""
    module = command.main.partition(":")[0]
    try:
        run = imported(command)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise
        package = module.partition(".")[0]
        found = getattr(sys.modules.get(package), "__file__", None)
        instead = f"the package {package!r} in {found} is another one" if found else f"{package!r} is not installed"
        return _refuse([command.name], f"{command.name}: needs the module {module}, and {instead}")
    return run(words)


def _is_scenario(word: str) -> bool:
    from closedloop.scenario.load import shipped_scenarios

    return word.endswith((".toml", ".nc")) or word in shipped_scenarios()


def _say(text: str) -> int:
    from closedloop.command.border import DONE, run_command

    def show(words: list[str]) -> int:
        print(text)
        return DONE

    return run_command("closedloop", show, [])


def _refuse(words: list[str], line: str = "") -> int:
    """Refuse a command line with one line: what is wrong, and what would be right."""
    from difflib import get_close_matches

    from closedloop.base.errors import ScenarioError
    from closedloop.command.border import run_command
    from closedloop.scenario.load import shipped_scenarios

    if not words:
        line = "name a command, such as `closedloop run wam_slide`; closedloop --help lists them"
    elif not line:
        known = [*(command.name for command in COMMANDS), *shipped_scenarios()]
        near = get_close_matches(words[0][:100], known, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]!r}?" if near else "closedloop --help lists the commands"
        line = f"there is no command and no scenario {words[0][:100]!r}; {hint}"

    def refuse(words: list[str]) -> int:
        raise ScenarioError(line)

    return run_command("closedloop", refuse, [])


if __name__ == "__main__":
    sys.exit(main())
