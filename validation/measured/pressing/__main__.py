"""The command line: ``python -m validation.measured.pressing``: draw tests, and write their scenarios.

Exit status: 0 done; 2 the input is at fault (one line on standard error).
"""

import io
import sys
from pathlib import Path

from closedloop.base.errors import OutputError
from closedloop.base.files import what_was_written, write_whole
from closedloop.command.border import Parser, as_command
from validation.measured.pressing.judging import OURS, engines, fits_of, swing_pole
from validation.measured.pressing.machine import read, scenario


@as_command("validation.measured.pressing", stopped=())
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    parser = Parser(prog="python -m validation.measured.pressing", description="Draw tests, and write their scenarios.")
    parser.add_argument("--data", metavar="FILE", required=True, help="the measurements, .npz")
    parser.add_argument("--fitted", metavar="FILE", required=True, help="fitted numbers; written if not there yet")
    parser.add_argument("--figures", metavar="DIR", help="draw measured and simulated force of each test, PNG, here")
    parser.add_argument("--scenarios", metavar="DIR", help="write the scenario of each test, .toml, here")
    parser.add_argument(
        "--map", metavar="FILE", help="draw how the loop at rest swings, with the tests in it, PNG, here"
    )
    options = parser.parse_args(words)
    folders = [Path(name) for name in (options.figures, options.scenarios) if name]
    if not folders and not options.map:
        parser.error("say what to do: --figures DIR, --scenarios DIR or --map FILE")
    for folder in folders:
        if not folder.is_dir():
            raise OutputError(f"{folder}: is no folder: name one that exists")
    tests = read(Path(options.data))
    fits = fits_of(tests, Path(options.data), Path(options.fitted))
    written = []
    if options.map:
        from validation.measured.pressing.figures import swing_map

        image = io.BytesIO()
        swing_map(fits[OURS]["values"], tests, swing_pole).savefig(image)
        written.append(write_whole(Path(options.map), image.getvalue()))
    for test in tests if folders else ():
        if options.scenarios:
            text = scenario(fits[OURS]["values"], test).to_toml()
            written.append(write_whole(Path(options.scenarios) / f"{test.name}.toml", text.encode()))
        if options.figures:
            from validation.measured.pressing.figures import touchdown

            found = {one.name: one.simulate(fits[one.name]["values"], test) for one in engines(fits)}
            image = io.BytesIO()
            touchdown(test, found, test.name in fits[OURS]["tests"]).savefig(image)
            written.append(write_whole(Path(options.figures) / f"{test.name}.png", image.getvalue()))
    print(what_was_written(*written))
    return 0


if __name__ == "__main__":
    sys.exit(main())
