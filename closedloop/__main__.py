"""The console script, and ``python -m closedloop``: ``closedloop wam_slide`` runs, and a first word may be a command:

compile compiles all that ships, lab opens the lab, export writes a run in another format.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from closedloop.command.border import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return the exit status: that of ``python -m closedloop.run``, unless the first word is a
    command.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words[:1] == ["compile"]:
        from closedloop.command.compile_all import compile_command

        return run_command("closedloop", compile_command, words[1:])
    if words[:1] == ["export"]:
        from closedloop.export.command import export_command

        return run_command("closedloop", export_command, words[1:])
    if words[:1] == ["lab"]:
        from closedloop.lab.command import lab_command

        return run_command("closedloop", lab_command, words[1:])
    from closedloop.run import main as run

    return run(words)


if __name__ == "__main__":
    sys.exit(main())
