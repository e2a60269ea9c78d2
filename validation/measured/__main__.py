"""The command line: ``python -m validation.measured tx40 --json out.json``.

Exit status: 0 what is published or measured is reproduced; 1 something is not; 2 the input is at fault (one line on
standard error).
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

from closedloop.base.errors import OutputError
from closedloop.base.files import write_whole
from closedloop.command.border import Parser, as_command

AGREES, DIFFERS = 0, 1
ROBOTS = {
    "cubes": "tosses of a cube: where it goes, beside other engines",
    "tx40": "Stäubli TX40: friction and drives beside the published ones",
    "ur10": "UR10: torques where they were not fitted",
    "kr300": "KUKA KR300: the same, and the stiffness of its joints from two encoders",
    "pressing": "UR10e: its force mode comes down on a surface; not in the package, give --data",
}
SHIPPED = [name for name in ROBOTS if name != "pressing"]


@as_command("validation.measured", stopped=())
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    listed = "\n".join(f"  {name:8} {what}" for name, what in ROBOTS.items())
    parser = Parser(
        prog="python -m validation.measured",
        description=f"Compare with measurements of real robots.\n\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "robots", nargs="*", metavar="ROBOT", help="which ones (default: all whose data come with the package)"
    )
    parser.add_argument("--data", metavar="FILE", help="read this .npz file in place of the one shipped, in its format")
    parser.add_argument("--json", metavar="FILE", help="write the numbers as JSON; of several robots, by name")
    parser.add_argument(
        "--fitted", metavar="FILE", help="pressing: numbers fitted before, JSON; written if the file is not there yet"
    )
    options = parser.parse_args(words)
    for name in options.robots:
        if name not in ROBOTS:
            parser.error(f"no robot {name!r}: they are {', '.join(ROBOTS)}")
    names = options.robots or SHIPPED
    if options.data and len(names) != 1:
        parser.error("--data: name the one robot that it is of")
    if options.fitted and names != ["pressing"]:
        parser.error("--fitted: goes with pressing")
    if options.json and not Path(options.json).parent.is_dir():
        raise OutputError(f"--json {options.json}: cannot be written: name a file in a folder that exists")
    results = {}
    faults: list[str] = []
    for name in names:
        judge = importlib.import_module(f"validation.measured.{name}").judge
        files = [Path(file) if file else None for file in (options.data, options.fitted)]
        judged = judge(*(files if name == "pressing" else files[:1]))
        print(f"{judged.robot} ({judged.source})", *judged.lines, *judged.notes, "", sep="\n")
        results[name] = judged.numbers | {"differs": judged.faults}
        faults += [f"{name}: {fault}" for fault in judged.faults]
    print("\n".join(faults) if faults else "every value that has a bound is within it")
    if options.json:
        text = json.dumps(results[names[0]] if len(names) == 1 else results, indent=2, allow_nan=False)
        try:
            write_whole(options.json, f"{text}\n".encode())
        except OutputError as error:
            raise OutputError(f"--json {error}") from None
    return DIFFERS if faults else AGREES


if __name__ == "__main__":
    sys.exit(main())
