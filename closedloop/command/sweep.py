"""The command line of sweeps: ``closedloop sweep wam_slide --over law.force=5:15:101 --out force.parquet``.

Exit status: 0 done, and runs that were stopped or refused are rows that say why; 2 the input is at fault (one line on
standard error); 3 an unforeseen error ended a run (its row says what and where), or a cluster was
lost on the way; 4 with --strict, a run that did not end, failed or has a bad verdict. 130 interrupted, 143 ended by
SIGTERM: the same command goes on from there, as after a cluster was lost.
"""

from __future__ import annotations

import os
import sys
import time as clock
from collections.abc import Sequence
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from closedloop.base.errors import printable
from closedloop.base.files import what_was_written
from closedloop.base.interrupts import word_for

# What takes time to import is imported below, once signals are answered.
if TYPE_CHECKING:
    from argparse import Namespace

    from closedloop.command.border import Parser
    from closedloop.scenario.scenario import Scenario
    from closedloop.studies.sweep.store import Joined
    from closedloop.studies.sweep.sweep import Axis, Sweep

# Different verdicts that the last line names.
MOST_VERDICTS = 4


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    from closedloop.command.border import run_command

    return run_command("closedloop sweep", _main, arguments)


def _main(words: list[str]) -> int:
    try:
        return _plot(words[1:]) if words[:1] == ["plot"] else _sweep(words)
    except KeyboardInterrupt as stop:
        then = "nothing was drawn" if words[:1] == ["plot"] else "the same command goes on from here"
        raise type(stop)(f"{word_for(stop)}; {then}") from None


@wraps(_main, assigned=())  # whose parser the completion of a shell asks for
def as_process(arguments: Sequence[str] | None = None) -> int:
    """Run the command line as all that this process does: a run that was abandoned keeps nobody waiting."""
    status = main(arguments)
    from closedloop.simulation.batch.threads import still_at_work

    if still_at_work():
        for output in (sys.stdout, sys.stderr):
            if output is not None:  # as it is where it was closed from the beginning
                with suppress(OSError):
                    output.flush()
        os._exit(status)
    return status


def _sweep(arguments: list[str]) -> int:
    from closedloop.base.errors import ScenarioError
    from closedloop.base.progress import count
    from closedloop.command.border import DONE, NOT_CONTROLLED, NOT_GOOD, STOPPED, parsed
    from closedloop.studies.sweep.store import why_no_place
    from closedloop.studies.sweep.sweep import run_sweep

    options, overrides = parsed(_sweep_parser(), arguments)
    if options.debug:
        import logging

        logging.basicConfig()
        logging.getLogger("closedloop").setLevel(logging.DEBUG)
    try:
        sweep = _asked_for(options, overrides)
    except ScenarioError as error:
        why = "" if options.out is None else why_no_place(Path(options.out))
        raise ScenarioError(*error.faults, *([why] if why else [])) from None
    scenario, design = sweep.scenario, sweep.design
    out = Path(options.out) if options.out else Path("out") / scenario.name / "sweep.parquet"
    began = clock.monotonic()
    done: list[int] = []  # at first, and now
    with count("closedloop sweep", len(design)) as show:

        def progress(runs: int, total: int) -> None:
            done[1:] = [runs]
            show(runs, total)

        result = run_sweep(
            sweep, out, workers=options.workers, scheduler=options.scheduler, progress=progress,
            overwrite=options.overwrite,
        )  # fmt: skip
    seconds = clock.monotonic() - began
    runs = done[-1] - done[0] if done else 0
    before = len(design) - runs
    columns = f" and {result.columns.name}" if result.columns else ""
    if runs:
        earlier = f" ({before} were there before)" if before else ""
        made = f"{runs} in {seconds:.1f} s, {runs / seconds:.3g} runs/s{earlier}; wrote {result.table}{columns}"
    else:
        made = f"all were there before, in {result.table}{columns}"
    print(printable(f"{len(design)} runs: {_counted(result)}; {made}"))
    from closedloop.simulation.batch.worker import FAILED
    from closedloop.simulation.batch.worker import STOPPED as HALTED

    if options.strict and (result.verdicts or {HALTED, FAILED} & result.counts.keys()):
        return NOT_GOOD
    if FAILED in result.counts:
        return STOPPED
    return NOT_CONTROLLED if options.strict and result.controls else DONE


def _asked_for(options: Namespace, overrides: dict[str, Any]) -> Sweep:
    """Return the sweep that the command line asks for."""
    from closedloop.scenario.load import refuse_lost
    from closedloop.scenario.user_module import name_members
    from closedloop.studies.sweep.sweep import GRID, LATIN, RANDOM, Design, Sweep, parse_axis

    kind = RANDOM if options.random is not None else LATIN if options.latin is not None else GRID
    axes = [parse_axis(text, drawn=kind != GRID) for text in options.over]
    name_members((axis.key, value) for axis in axes for value in axis.values)
    refuse_lost(overrides, ((axis.key, value) for axis in axes for value in axis.values))
    design = Design(axes, kind, {RANDOM: options.random, LATIN: options.latin}.get(kind) or 0, options.seed)
    scenario = _common(options.scenario, overrides, axes, drawn=kind != GRID)
    keep = [name for word in options.keep for name in word.split(",") if name]
    return Sweep.of(scenario, design, keep, options.engine, options.law or "")


def _common(name: str, overrides: dict[str, Any], axes: Sequence[Axis], drawn: bool) -> Scenario:
    """Return the scenario that the runs have in common; a key that must be given may be one that changes."""
    from closedloop.base.errors import ScenarioError
    from closedloop.scenario.load import load_scenario

    firsts = {axis.key: axis.drawn(0.0) if drawn else axis.at(0) for axis in axes}
    # Another kind drops what the file says of its own, so that one is taken only where nothing else will do.
    of_its_kind = {key: value for key, value in firsts.items() if not key.endswith(".kind")}
    for more in ({}, of_its_kind):
        with suppress(ScenarioError):
            return load_scenario(name, overrides | more)
    return load_scenario(name, overrides | firsts)


def _counted(result: Joined) -> str:
    """Return how many runs ended how, and how many with a bad verdict, the commonest first."""
    text = ", ".join(f"{many} {status}" for status, many in sorted(result.counts.items()))
    for what, found in (("a bad verdict", result.verdicts), ("bad control", result.controls)):
        if not found:
            continue
        worst = sorted(found.items(), key=lambda item: (-item[1], item[0]))
        text += f"; {sum(found.values())} with {what}: "
        text += "; ".join(f"{many} {said}" for said, many in worst[:MOST_VERDICTS])
        text += "; ..." if len(worst) > MOST_VERDICTS else ""
    return text


def _sweep_parser() -> Parser:
    from closedloop.command.border import list_of_sections, scenario_parser
    from closedloop.simulation.engines.loops import COMPILED, ENGINES

    parser = scenario_parser(
        "closedloop sweep",
        "SCENARIO",
        description="Run a scenario many times with some keys changed, into a table with a row for\n"
        "each run. The same command continues a sweep that was killed.\n"
        "closedloop sweep plot FILE draws maps of the table.",
        epilog=list_of_sections(names_only=True)
        + "\n\nexit status: 0 done, runs stopped or refused are rows that say why; 2 the input is\n"
        "at fault; 3 an unforeseen error ended a run, or a cluster was lost; 4 with --strict,\n"
        "a run did not end or has a bad verdict, 5 with --strict, all verdicts are good but\n"
        "one of a control; 130 Ctrl-C, 143 SIGTERM",
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="a shipped name, or a .toml file")
    over = (
        "a key and its values, once for each key; several make a grid: law.force=5:15:101 (from, to, how many), "
        "log:1e-4:1e-2:20, rk4,explicit_euler"
    )
    parser.options({"--over KEY=VALUES ...": over})
    drawn = parser.add_mutually_exclusive_group()
    number = {"type": int, "metavar": "N"}
    drawn.add_argument("--random", **number, help="draw N runs from the ranges instead of a grid")  # type: ignore[arg-type]
    drawn.add_argument("--latin", **number, help="draw a Latin hypercube of N runs")  # type: ignore[arg-type]
    parser.add_argument(
        "--engine", choices=ENGINES, default=COMPILED, help="default compiled; pinocchio runs on one core"
    )
    table = {
        "--seed N": "seed of the draws (default 0)",
        "--out FILE": "the .parquet file (default: out/SCENARIO/sweep.parquet)",
        "--overwrite": "replace another sweep in that file",
        "--keep COLUMNS ...": "keep columns of every run, such as f,e, in a .nc beside it",
        "--law MODULE:NAME": "law(x) or law(t, q, v, terms) of your own, in every run",
        "--workers N": "threads (default: one for each core)",
        "--strict": "status 4 if a run did not end well",
        "--debug": "print the traceback of an unforeseen error",
        "--scheduler ADDRESS": "a Dask cluster, such as tcp://host:8786",
    }
    parser.options(table, seed=0, workers=int)
    return parser


def _plot(arguments: list[str]) -> int:
    from closedloop.command.border import DONE, Parser, add_figure_options, drawn_as

    parser = Parser(prog="closedloop sweep plot", description="Draw maps of a sweep's table.")
    parser.add_argument("table", help="the .parquet file of a sweep")
    table = {
        "--of FIGURES ...": "columns to draw: min_contact_force,rms_path_error ...",
        "--x KEY": "key along the horizontal axis (default: the first)",
        "--y KEY": "key along the vertical axis (default: the second, if there is one)",
        "--out FILE": "the figure, .png, .svg or .pdf (default: the table's name with .png)",
    }
    parser.options(table)
    add_figure_options(parser, formats=False)
    options = parser.parse_args(arguments)
    from closedloop.studies.sweep.maps import sweep_plot

    of = [name for word in options.of for name in word.split(",") if name]
    with drawn_as(options):
        path = sweep_plot(options.table, of or None, x=options.x, y=options.y, out=options.out)
    print(what_was_written(path))
    return DONE


if __name__ == "__main__":
    sys.exit(as_process())
