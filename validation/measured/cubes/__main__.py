"""The command line: ``python -m validation.measured.cubes``: fit, compare laws, draw, film, open the lab.

Exit status: 0 done; 2 the input is at fault (one line on standard error).
"""

import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from closedloop.base.errors import OutputError
from closedloop.base.files import what_was_written, write_whole
from closedloop.command.border import Parser, as_command
from closedloop.command.serve import wait_for
from validation.measured.cubes import comparing
from validation.measured.cubes.engine import ClosedLoopCube, Toss, first_row, mean_errors, read
from validation.measured.cubes.figures import film, opened, toss_of

LAWS = ("newton", "poisson", "stronge")


@as_command("validation.measured.cubes", stopped=())
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    names = [engine.name for engine in comparing.engines()]
    parser = Parser(prog="python -m validation.measured.cubes", description="Fit engines to tosses, and draw them.")
    parser.add_argument(
        "--fit", nargs="*", metavar="ENGINE", choices=names, help=f"fit these, or all installed: {', '.join(names)}"
    )
    parser.add_argument("--laws", action="store_true", help="compare laws of restitution and of friction")
    parser.add_argument("--impacts", action="store_true", help="restitution and friction of single corners, no engine")
    parser.add_argument(
        "--geometry", action="store_true", help="centre of mass, slope of the board, heights of the sides, no engine"
    )
    parser.add_argument("--figures", metavar="DIR", help="draw errors over time, best and worst tosses, as PNG")
    parser.add_argument(
        "--film", nargs=2, metavar=("TOSS", "FILE"),
        help="write a film of toss number TOSS, simulated and measured, a .gif or a .mp4, or the lab's page, a .html",
    )  # fmt: skip
    parser.add_argument(
        "--lab", metavar="TOSS", help="open the lab: toss number TOSS, with sliders, beside the measured one"
    )
    options = parser.parse_args(words)
    told = options.laws or options.impacts or options.geometry
    if not told and options.fit is options.figures is options.film is options.lab is None:
        parser.error("say what to do, such as --fit, --figures DIR, --film TOSS FILE or --lab TOSS; see --help")
    if options.fit is not None:
        _fit(options.fit or names)
    if options.laws:
        _laws()
    if options.impacts:
        print("\n".join(comparing.impact_lines(read())))
    if options.geometry:
        print("\n".join(comparing.geometry_lines(read())))
    if options.figures is not None:
        _figures(Path(options.figures))
    if options.film is not None:
        number, path = options.film
        print(what_was_written(film(_toss(parser, "--film", number), Path(path))))
    if options.lab is not None:
        wait_for(opened(_toss(parser, "--lab", options.lab)), browser=True)
    return 0


def _toss(parser: Parser, option: str, number: str) -> Toss:
    """Return the toss of a number from the command line."""
    if not number.isdigit():
        parser.error(f"{option} {number}: must be the number of a toss")
    return toss_of(read(), int(number))


def _fit(names: Sequence[str]) -> None:
    """Fit engines, and write their values where `validation.measured cubes` reads them."""
    written = comparing.fits() if comparing.FITTED.exists() else {}
    for engine in (each for each in comparing.engines() if each.name in names):
        found = comparing.fit(engine, comparing.training(read()), told=print)
        values = {p.name: x for p, x in zip(engine.parameters, found.values, strict=True)}
        written[engine.name] = {"values": values, "cost": found.cost, "simulations": found.simulations}
    write_whole(str(comparing.FITTED), f"{json.dumps(written, indent=2)}\n".encode())


def _laws() -> None:
    """Print the mean errors of each law of restitution, and without friction or restitution, all else as fitted."""
    shipped = read()
    tosses = comparing.held_out(shipped, shipped)
    values = comparing.fitted(ClosedLoopCube())
    starts = [first_row(toss) for toss in tosses]
    cases = [(law, law, values) for law in LAWS]
    cases += [("without restitution", "newton", [values[0], 0.0, *values[2:]])]
    cases += [("without friction", "newton", [0.0, *values[1:]])]
    for name, law, used in cases:
        position, rotation = np.nanmean(mean_errors(tosses, ClosedLoopCube(law).simulate(used, starts, tosses)), axis=0)
        print(f"{name:20} {position:6.1f} % {rotation:6.1f}°")


def _figures(folder: Path) -> None:
    from validation.measured.cubes.figures import best_and_worst, errors_over_time

    if not folder.is_dir():
        raise OutputError(f"--figures {folder}: is no folder: name one that exists")
    shipped = read()
    tosses = comparing.held_out(shipped, shipped)
    results = {engine.name: comparing.tried(engine, tosses) for engine in comparing.engines()}
    drawn = {
        "cube_errors": errors_over_time(tosses, results),
        "cube_tosses": best_and_worst(tosses, results["closedloop"]),
    }
    for name, figure in drawn.items():
        image = io.BytesIO()
        figure.savefig(image)
        write_whole(folder / f"{name}.png", image.getvalue())


if __name__ == "__main__":
    sys.exit(main())
