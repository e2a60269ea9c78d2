"""Completion by a shell: ``eval "$(closedloop completion bash)"``.

The script is made from the table of commands, from what --help says of each, and from the schema of a scenario; nothing
of Python runs while one types. It is to be made again after an update.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

from closedloop.command.border import DONE, Parser, as_command
from closedloop.command.table import COMMANDS, Command, imported


class Words(NamedTuple):
    """What can be typed."""

    options: Mapping[str, list[str]]  # command to its options
    arguments: Mapping[str, list[str]]  # command to the words that it takes beside them; files come on top
    values: Mapping[str, list[str]]  # option to the words that may follow it


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(
        prog="closedloop completion",
        description="Print the completion script of a shell: commands, options, scenarios, robots and keys.",
        epilog='Put into ~/.bashrc, ~/.zshrc: eval "$(closedloop completion bash)", or zsh; '
        "for fish: closedloop completion fish > ~/.config/fish/completions/closedloop.fish",
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))
    shell = parser.parse_args(words).shell
    print({"bash": bash, "zsh": zsh, "fish": fish}[shell](collect()))
    return DONE


def collect() -> Words:
    """Return the words that can be typed next."""
    from closedloop.command.robots import names
    from closedloop.scenario.describe import all_keys, choices, sections
    from closedloop.scenario.file import shipped_scenarios
    from closedloop.scenario.tables import table_type

    keys = all_keys()
    robots = list(names())
    values = {f"--{key}": found for key in keys if (found := choices(key))}
    values |= {"--help": list(sections()), "--explain": keys, "--robot": robots, "--robot.model": robots}
    options: dict[str, list[str]] = {}
    arguments: dict[str, list[str]] = {}
    known = {"scenario": shipped_scenarios(), "robot": robots}
    for command in COMMANDS:
        said = _help_of(command)
        options[command.name] = sorted(set(re.findall(r"(?m)^ +(?:-\w(?: \[\w+\])?, )?(--[a-z][a-z-]*)", said)))
        if command.takes == "scenario":
            options[command.name] += [f"--{key}" for key in keys if not table_type(key.partition(".")[0])]
        own = [word for group in re.findall(r"(?m)^ +\{([\w,]+)\}", said) for word in group.split(",")]
        arguments[command.name] = list(dict.fromkeys(own)) or known.get(command.takes, [])
        values |= {option: group.split(",") for option, group in re.findall(r"(--[a-z-]+) \{([\w,]+)\}", said)}
    return Words(options, arguments, values)


def _help_of(command: Command) -> str:
    """Return what a command says of itself, nothing if it is not installed."""
    said = io.StringIO()
    try:
        run = imported(command)
    except ImportError:
        return ""
    with redirect_stdout(said), redirect_stderr(io.StringIO()):
        run(["--help"])
    return said.getvalue()


def bash(words: Words) -> str:
    """Return the script for bash."""
    return f"""\
_closedloop() {{
    local cur="${{COMP_WORDS[COMP_CWORD]}}" words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{_names()}"
    else
        case "${{COMP_WORDS[COMP_CWORD-1]}}" in
{_cases(words.values, 'words="', '"', 12)}
            *) case "${{COMP_WORDS[1]}}:$cur" in
{_cases(_patterns(words), 'words="', '"', 16)}
            esac ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$cur"))
}}
complete -o bashdefault -o default -F _closedloop closedloop"""


def zsh(words: Words) -> str:
    """Return the script for zsh."""
    return f"""\
#compdef closedloop
_closedloop() {{
    local -a found
    if (( CURRENT == 2 )); then
        found=({_names()})
    else
        case "${{words[CURRENT-1]}}" in
{_cases(words.values, "found=(", ")", 12)}
            *) case "${{words[2]}}:${{words[CURRENT]}}" in
{_cases(_patterns(words), "found=(", ")", 16)}
            esac; [[ "${{words[CURRENT]}}" == -* ]] || _files ;;
        esac
    fi
    compadd -a found
}}
compdef _closedloop closedloop"""


def fish(words: Words) -> str:
    """Return the script for fish."""
    lines = [
        f"complete -c closedloop -f -n __fish_use_subcommand -a {command.name} -d {_quoted(command.help)}"
        for command in COMMANDS
    ]
    for name, options in words.options.items():
        only = f"complete -c closedloop -n '__fish_seen_subcommand_from {name}'"
        if words.arguments[name]:
            lines.append(f"{only} -a {_quoted(' '.join(words.arguments[name]))}")
        for option in options:
            values = words.values.get(option)
            takes = f" -x -a {_quoted(' '.join(values))}" if values and option != "--help" else ""
            lines.append(f"{only} -l {option.removeprefix('--')}{takes}")
    return "\n".join(lines)


def _names() -> str:
    return " ".join(command.name for command in COMMANDS)


def _patterns(words: Words) -> dict[str, list[str]]:
    """Return COMMAND:WORD, as the case of a shell matches it, and what the word may become."""
    found = {f"{name}:-*": options for name, options in words.options.items() if options}
    return found | {f"{name}:*": list(taken) for name, taken in words.arguments.items() if taken}


def _cases(cases: Mapping[str, Iterable[str]], before: str, after: str, indent: int) -> str:
    return "\n".join(f"{' ' * indent}{case}) {before}{' '.join(words)}{after} ;;" for case, words in cases.items())


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "\\'") + "'"
