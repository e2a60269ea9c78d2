"""The command line of the studies: ``closedloop study drift``."""

import argparse
import sys
from pathlib import Path

from closedloop.base.files import made_folder
from closedloop.command.border import DONE, Parser, as_command

STUDIES = {
    "drift": "closure drift against step, speed and stabiliser; Baumgarte's limit",
    "controllers": "every controller on every kind of friction: force and path error",
    "surfaces": "every controller on an oscillating surface, and for several stiffnesses",
}


@as_command("closedloop study")
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    studies = "\n".join(f"  {name:12} {what}" for name, what in STUDIES.items())
    parser = Parser(
        prog="closedloop study",
        description="Run a study.\n\n" + studies,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("--out", metavar="DIR", help="where results go (default: out/study_NAME)")
    parser.add_argument("--quick", action="store_true", help="fewer points, in a few seconds")
    parser.add_argument("--json", action="store_true", help="print the results as JSON instead of tables")
    options = parser.parse_args(words)
    folder = made_folder(options.out or Path("out") / f"study_{options.study}")
    from validation.studies import controllers, drift, surfaces

    study = {"drift": drift, "controllers": controllers, "surfaces": surfaces}[options.study]
    study.run(folder, quick=options.quick, as_json=options.json)
    return DONE


if __name__ == "__main__":
    sys.exit(main())
