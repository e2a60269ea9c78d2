"""Gains: ``closedloop analyse wam_hybrid_friction --at 3`` has the margins of the force loop and its limits,
``closedloop tune wam_slide --vary law.kd=5:200 --minimise rms_force_error`` finds the best by an optimiser.

Exit status: 0 done; 2 the input is at fault; 3 the run stops before the instant, there is no linear loop at it, or no
point that was tried meets the constraints.
"""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from closedloop.base.arrays import plain
from closedloop.base.errors import ClosedLoopError, ScenarioError
from closedloop.base.files import made_folder, what_was_written, write_whole
from closedloop.command import border

if TYPE_CHECKING:
    from closedloop.studies.analysis.stability import Range, Stability

# Values of a range that does not say how many, and where whole runs are tried beside a boundary.
POINTS, TRIED = 60, (0.25, 0.5, 0.75)


@border.as_command()
def analyse(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.scenario.load import load_scenario

    parser = border.Parser(
        prog="closedloop analyse",
        description="Linearise the force loop about its motion: margins, poles, and where it becomes unstable.",
        cure="such as: closedloop analyse wam_hybrid_friction --at 3",
    )
    parser.add_argument("scenario", help="a scenario that ships, or a .toml; --SECTION.KEY VALUE changes it")
    table = {
        "--at T": "the instant, s (default: half of the duration)",
        "--out DIR": "where figures and analysis.json go (default: none are written)",
        "--json": "print analysis.json instead",
        "--vary KEY=RANGE ...": "a key and its range, such as compliance.stiffness=log:1e2:1e7 or "
        "law.force_integral=0:80:40: the limits in it are solved for; given twice, the boundary over both",
        "--no-runs": "do not try whole runs beside the limits",
    }
    parser.options(table, at=float)
    border.add_figure_options(parser)
    options, overrides = border.parsed(parser, words)
    border.formats_of(options)
    style = border.drawn_as(options)
    if len(options.vary) > 2:
        raise ScenarioError("command line: --vary: at most two keys, one that is solved for and one along it")
    ranges = [_range(text) for text in options.vary]
    folder = made_folder(options.out) if options.out else None

    from closedloop.studies.analysis.here import refuse_outside
    from closedloop.studies.analysis.stability import Stability

    scenario = load_scenario(options.scenario, overrides)
    if options.at is not None:
        refuse_outside(scenario, options.at, "command line: --at")
    study = Stability(scenario, options.at)
    with style:
        _analyse(study, ranges, folder, options)
    return border.DONE


def _analyse(study: Stability, ranges: list[tuple[Range, int]], folder: Path | None, options: Namespace) -> None:
    """Print what is asked of a force loop, and write it into a folder, if there is one."""
    from closedloop.studies.analysis.page import page_of

    page = page_of(study, limits=not ranges)
    lines, found, drawn = (
        _varied(study, ranges, not options.no_runs, draw=folder is not None) if ranges else ([], {}, [])
    )
    report = page.as_dict() | found
    if options.json:
        print(json.dumps(report, indent=2, allow_nan=False))
    else:
        print("\n".join([*page.lines(), *lines]))
    if folder is not None:
        from closedloop.figures.files import write_figure
        from closedloop.studies.analysis.page import draw_page

        paths = [write_whole(folder / "analysis.json", (json.dumps(report, indent=2) + "\n").encode())]
        paths += draw_page(page, folder, border.formats_of(options))
        paths += [write_figure(figure, folder / name, border.formats_of(options)) for name, figure in drawn]
        if not options.json:
            print(what_was_written(*paths))


def _range(text: str) -> tuple[Range, int]:
    """Read KEY=RANGE, and how many values it has."""
    from closedloop.studies.analysis.stability import Range
    from closedloop.studies.sweep.sweep import parse_range

    axis = parse_range(text, "log:1e2:1e7 or 0:80")
    return Range(axis.key, axis.low, axis.high, axis.log), axis.count or POINTS


def _varied(
    study: Stability, ranges: list[tuple[Range, int]], runs: bool, draw: bool
) -> tuple[list[str], dict[str, Any], list[tuple[str, Any]]]:
    """Return lines, values for JSON and figures of the limits over one key, or the boundary over two."""
    from closedloop.studies.analysis.page import locus, stability_map, trial_line

    over, count = ranges[-1]
    drawn: list[tuple[str, Any]] = []
    if len(ranges) == 1:
        limits, refused = study.limits(over)
        lines = ["", f"{over.key} from {over.low:g} to {over.high:g}:"]
        for limit in limits:
            side = "above" if limit.upwards else "below"
            lines.append(f"  unstable {side} {limit.value:.5g}, at {limit.pole.frequency:.4g} Hz ({limit.pole.part})")
        if not limits:
            lines.append(f"  no limit: the loop is {'stable' if study.base.stable else 'unstable'} there")
        if refused:
            lines.append(f"  beyond that refused: {refused}")
        trials = [trial for limit in limits for trial in study.try_beside(limit)] if runs else []
        if draw:
            drawn = [("analysis_locus", locus(_loops(study, over, count), over, limits, study.scenario))]
        found: dict[str, Any] = {"vary": [over.key], "limits": {over.key: [limit.as_dict() for limit in limits]}}
    else:
        along, points = ranges[0]
        boundary = study.boundary(over, along, points)
        lines = ["", f"{along.key:>24}  {over.key}: limit"]
        shown = boundary[:: max(1, len(boundary) // 12)]
        for value, limit in shown:
            side = "above" if limit.upwards else "below"
            lines.append(f"{value:>24.6g}  unstable {side} {limit.value:.6g} ({limit.pole.frequency:.3g} Hz)")
        if not boundary:
            lines.append("  no limit in these ranges")
        chosen = [boundary[int(share * (len(boundary) - 1))] for share in TRIED] if boundary and runs else []
        trials = [trial for value, limit in chosen for trial in study.try_beside(limit, {along.key: value})]
        if draw:
            here = _here(study, along, over)
            drawn = [("analysis_map", stability_map(boundary, over, along, here, trials, study.scenario))]
        found = {
            "vary": [along.key, over.key],
            "boundary": [{along.key: value} | limit.as_dict() for value, limit in boundary],
        }  # fmt: skip
    found["trials"] = plain([asdict(trial) for trial in trials])
    if trials:
        lines += ["", f"beside it, from t = {study.base.time:g} s on:", *map(trial_line, trials)]
    return lines, found, drawn


def _loops(study: Stability, over: Range, count: int) -> list[tuple[float, Any]]:
    """Return loops along a range; values that are refused are left out."""
    found = []
    for k in range(count):
        value = over.at(k / (count - 1))
        try:
            found.append((value, study.loop({over.key: value})))
        except ClosedLoopError:
            continue
    return found


def _here(study: Stability, *ranges: Range) -> tuple[float, float] | None:
    """Return the scenario's own values of two keys, if they are numbers."""
    values = []
    for each in ranges:
        section, _, name = each.key.partition(".")
        value = getattr(getattr(study.scenario, section, None), name, None)
        if not isinstance(value, int | float):
            return None
        values.append(float(value))
    return values[0], values[1]


@border.as_command()
def tune(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.scenario.load import load_scenario
    from closedloop.studies.sweep.sweep import parse_axis, parse_range

    options, overrides = border.parsed(_parser(), words)
    if not options.vary:
        raise ScenarioError("command line: name what varies, such as --vary law.kd=5:200")
    scenario = load_scenario(options.scenario, overrides)
    ranges = [parse_range(text, "5:200 or log:1:1000") for text in options.vary]
    folder = made_folder(options.out) if options.out else None
    from closedloop.studies.tune import tune as study

    found = {}
    for text in options.minimise or ["rms_force_error"]:
        weight, times, name = text.rpartition("*")
        try:
            found[name.strip()] = float(weight) if times else 1.0
        except ValueError:
            raise ScenarioError(
                f"--minimise {text}: must be a value, or WEIGHT*VALUE, such as 0.1*max_tip_speed"
            ) from None
    over = {axis.key: [axis.at(i) for i in range(len(axis))] for axis in map(parse_axis, options.over)}
    tuning = study.tune(
        scenario, {axis.key: (axis.low, axis.high) for axis in ranges}, found, options.subject_to,
        over=over, robust=options.robust, log=[axis.key for axis in ranges if axis.log],
        starts=options.starts, seed=options.seed, kept=folder / "runs.jsonl" if folder else None, progress=True,
    )  # fmt: skip
    report = border.print_outcome(tuning, options.json)
    if folder is not None:
        from closedloop.figures.files import write_figure

        head = "# " + "\n# ".join(tuning.lines()[:1]) + "\n"
        paths = [
            write_whole(folder / "tuned.toml", (head + tuning.scenario.to_toml()).encode()),
            write_whole(folder / "tune.json", (report + "\n").encode()),
            write_figure(tuning.figure(), folder / "tune"),
        ]
        if not options.json:
            print(what_was_written(*paths))
    return border.DONE if tuning.feasible else border.STOPPED


def _parser() -> border.Parser:
    parser = border.Parser(
        prog="closedloop tune",
        description="Find the gains, or other numbers of a scenario, that minimise a value of its runs.",
        cure="such as: closedloop tune wam_slide --vary law.kd=5:200 --minimise rms_force_error",
    )
    parser.add_argument("scenario", help="a scenario that ships, or a .toml; --SECTION.KEY VALUE changes it")
    vary = "what varies and its range, such as law.kd=5:200, law.kp[1]=log:100:3000; of a list each entry by itself"
    parser.options({"--vary KEY=LOW:HIGH ...": vary})
    parser.add_argument(
        "--minimise", "--minimize", action="append", default=[], metavar="[WEIGHT*]NAME",
        help="a value of the summary (default: rms_force_error); given several times, the weighted sum",
    )  # fmt: skip
    many = "minimise the worst or the mean of all variations"
    parser.add_argument("--robust", choices=("worst", "mean"), default="worst", help=many)
    table = {
        "--subject-to NAME<=NUMBER ...": "a constraint, such as 'peak_contact_force<=12' or 'modulus_margin@3>=0.5'",
        "--over KEY=VALUES ...": "variations under which constraints hold, such as friction.coefficient=0.2,0.4,0.6",
        "--starts N": "searches from different points (4)",
        "--seed N": "seed of these points (0)",
        "--out DIR": "where tuned.toml, tune.json and a figure go; an interrupted tuning continues from its runs.jsonl",
        "--json": "print the report as JSON",
    }
    parser.options(table, starts=4, seed=0)
    return parser
