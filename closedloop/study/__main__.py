"""The command line of the studies: ``python -m closedloop.study drift``.

Exit status: 0 done; 2 the input is at fault (one line on standard error).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from closedloop.errors import ClosedLoopError, OutputError, ScenarioError, one_line

STUDIES = {
    "drift": "closure drift against step, speed, integrator and stabiliser; the stability limit of Baumgarte",
    "controllers": "every controller on every kind of friction: settling, force error, path error",
}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ScenarioError(f"command line: {message}; see --help")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    studies = "\n".join(f"  {name:12} {what}" for name, what in STUDIES.items())
    parser = _Parser(
        prog="closedloop.study",
        description="Run a study.\n\n" + studies,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("--out", metavar="DIR", help="where results go (default: out/study_NAME)")
    parser.add_argument("--quick", action="store_true", help="fewer points, in a few seconds")
    parser.add_argument("--json", action="store_true", help="print the results as JSON instead of tables")
    try:
        options = parser.parse_args(sys.argv[1:] if arguments is None else list(arguments))
        folder = Path(options.out) if options.out else Path("out") / f"study_{options.study}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise OutputError(f"--out {str(folder)!r}: cannot be written: {reason}; name another folder") from None
        if options.study == "drift":
            from closedloop.study import drift

            drift.run(folder, quick=options.quick, as_json=options.json)
        else:
            from closedloop.study import controllers

            controllers.run(folder, quick=options.quick, as_json=options.json)
    except ClosedLoopError as error:
        print(f"closedloop.study: {one_line(str(error))}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
