"""Completion by a shell: ``eval "$(closedloop completion bash)"``.

The script is made by shtab from the parsers of the commands and the schema of a scenario; nothing of Python runs while
one types. It is to be made again after an update.
"""

import io
from argparse import ArgumentParser
from contextlib import redirect_stdout, suppress
from inspect import unwrap

from closedloop.command.border import DONE, Left, Parser, as_command
from closedloop.command.table import COMMANDS, imported

SHELLS = "bash", "zsh", "fish"


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(
        prog="closedloop completion",
        description="Print the completion script of a shell: commands, options, scenarios, robots and keys.",
        epilog='Put into ~/.bashrc, ~/.zshrc: eval "$(closedloop completion bash)", or zsh; '
        "for fish: closedloop completion fish > ~/.config/fish/completions/closedloop.fish",
    )
    parser.add_argument("shell", choices=SHELLS)
    shell = parser.parse_args(words).shell
    import shtab

    print(shtab.complete(all_commands(), shell))
    return DONE


def all_commands() -> ArgumentParser:
    """Return a parser of all commands with the words that may follow each option."""
    import shtab

    from closedloop.command.lists import names
    from closedloop.scenario.load import shipped_scenarios
    from closedloop.scenario.messages import all_keys, choices, sections
    from closedloop.scenario.tables import table_type

    keys, robots = all_keys(), list(names())
    keys = [key for key in keys if not table_type(key.partition(".")[0])]
    known = {
        "scenario": shipped_scenarios(),
        "robot": robots,
        "robots": robots,
        "explain": keys,
        "help": list(sections()),
    }
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
