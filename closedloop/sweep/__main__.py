"""The command line of sweeps: ``python -m closedloop.sweep wam_slide --over law.force=5:15:101 --out force.parquet``.

Exit status: 0 done, and runs that failed are rows that say why; 2 the input is at fault (one line on standard error);
3 a cluster was lost on the way, and 130 interrupted: the same command goes on from there; 4 done, but the verdict of
some run is bad, with --strict.
"""

from __future__ import annotations

import argparse
import sys
import time as clock
from collections.abc import Sequence
from pathlib import Path

from closedloop.command import DONE, NOT_GOOD, Parser, run_command
from closedloop.report.verdict import GOOD


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return run_command(
        "closedloop.sweep", _main, arguments, interrupted="interrupted; the same command goes on from here"
    )


def _main(words: list[str]) -> int:
    return _plot(words[1:]) if words[:1] == ["plot"] else _sweep(words)


def _sweep(arguments: list[str]) -> int:
    from closedloop.run import split_overrides

    overrides, rest = split_overrides(arguments)
    options = _sweep_parser().parse_args(rest)
    from closedloop.preparation import load_model
    from closedloop.progress import count
    from closedloop.run import announce_compiling
    from closedloop.scenario import load_scenario
    from closedloop.sweep import Design, Sweep, parse_axis, run_sweep
    from closedloop.sweep.design import GRID, LATIN, RANDOM

    kind = RANDOM if options.random is not None else LATIN if options.latin is not None else GRID
    axes = [parse_axis(text, drawn=kind != GRID) for text in options.over]
    design = Design(axes, kind, {RANDOM: options.random, LATIN: options.latin}.get(kind) or 0, options.seed)
    scenario = load_scenario(options.scenario, overrides)
    keep = [name for word in options.keep for name in word.split(",") if name]
    sweep = Sweep.of(scenario, design, keep, options.engine)
    out = Path(options.out) if options.out else Path("out") / scenario.name / "sweep.parquet"
    if options.scheduler is None:
        fixed = not any(key.startswith("robot.") for key in design.keys)
        announce_compiling(scenario, load_model(scenario).n if fixed else 0, options.engine, len(design))
    began = clock.monotonic()
    done: list[tuple[int, int]] = []
    with count("closedloop.sweep", len(design)) as show:

        def progress(runs: int, total: int) -> None:
            done.append((runs, total)) if not done else done.__setitem__(slice(1, None), [(runs, total)])
            show(runs, total)

        result = run_sweep(sweep, out, workers=options.workers, scheduler=options.scheduler, progress=progress)
    seconds = clock.monotonic() - began
    runs = done[-1][0] - done[0][0] if done else 0
    before = len(design) - runs
    statuses = ", ".join(f"{many} {status}" for status, many in sorted(result.counts.items()))
    columns = f" and {result.columns.name}" if result.columns else ""
    if runs:
        earlier = f" ({before} were there before)" if before else ""
        made = f"{runs} in {seconds:.1f} s, {runs / seconds:.3g} runs/s{earlier}; wrote {result.table}{columns}"
    else:
        made = f"all were there before, in {result.table}{columns}"
    bad = {verdict: many for verdict, many in result.verdicts.items() if verdict != GOOD}
    not_good = sum(bad.values())
    most = max(bad, key=lambda verdict: bad[verdict], default="")
    judged = f"; {not_good} with a bad verdict, most often: {most}" if not_good else ""
    print(f"{len(design)} runs: {statuses}{judged}; {made}")
    return NOT_GOOD if options.strict and not_good else DONE


def _sweep_parser() -> Parser:
    from closedloop.forms import COMPILED, ENGINES

    parser = Parser(
        prog="closedloop.sweep",
        description="Run a scenario many times with some keys changed, into a table of what came of each run.",
        epilog="Any other key of the scenario can be set for all runs, as --law.kp 900 (see python -m closedloop.run\n"
        "--help). A sweep that was killed goes on where it was with the same command.\n\n"
        "python -m closedloop.sweep plot FILE draws maps of the table.\n\n"
        "exit status: 0 done, and runs that failed are rows that say why; 2 the input is at fault; 3 a cluster was\n"
        "lost on the way, and 130 interrupted: the same command goes on from there; 4 done, but the verdict of some\n"
        "run is bad, with --strict",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("scenario", help="a shipped name (python -m closedloop.run --list) or a .toml file")
    add(
        "--over",
        metavar="KEY=VALUES",
        action="append",
        default=[],
        help="a key and its values, once for each key: law.force=5:15:101 (from, to, how many), "
        "stabiliser.time_constant=log:1e-4:1e-2:20, time.integrator=rk4,explicit_euler; several make a grid",
    )
    drawn = parser.add_mutually_exclusive_group()
    number = {"type": int, "metavar": "N"}
    drawn.add_argument("--random", **number, help="draw N runs from the ranges instead of a grid")  # type: ignore[arg-type]
    drawn.add_argument("--latin", **number, help="draw a Latin hypercube of N runs")  # type: ignore[arg-type]
    add("--seed", type=int, default=0, help="of the draws (default 0)")
    add("--out", metavar="FILE", help="the table, a .parquet file (default: out/SCENARIO/sweep.parquet)")
    add(
        "--keep",
        metavar="COLUMNS",
        action="append",
        default=[],
        help="keep whole columns of every run in a NetCDF file beside the table: f,e or contact_force,q ...",
    )
    add("--engine", choices=ENGINES, default=COMPILED, help="compiled (default), or pinocchio, on one core")
    add(
        "--workers", type=int, metavar="N", help="threads (default: one for each core); the table does not depend on it"
    )
    add("--strict", action="store_true", help="exit with status 4 if the verdict of any run is bad")
    add("--scheduler", metavar="ADDRESS", help="run on the Dask cluster of this scheduler, such as tcp://host:8786")
    return parser


def _plot(arguments: list[str]) -> int:
    parser = Parser(prog="closedloop.sweep plot", description="Draw maps of a sweep's table.")
    parser.add_argument("table", help="the .parquet file of a sweep")
    parser.add_argument(
        "--of",
        metavar="FIGURES",
        action="append",
        default=[],
        help="columns to draw: min_contact_force,rms_path_error ...",
    )
    parser.add_argument("--x", metavar="KEY", help="key along the horizontal axis (default: the first)")
    parser.add_argument("--y", metavar="KEY", help="key along the vertical axis (default: the second, if there is one)")
    parser.add_argument(
        "--out", metavar="FILE", help="the figure, .png, .svg or .pdf (default: the table's name with .png)"
    )
    options = parser.parse_args(arguments)
    from closedloop.sweep import sweep_plot

    of = [name for word in options.of for name in word.split(",") if name]
    path = sweep_plot(options.table, of or None, x=options.x, y=options.y, out=options.out)
    print(f"wrote {path}")
    return DONE


if __name__ == "__main__":
    sys.exit(main())
