"""The command ``closedloop analyse wam_hybrid_friction --at 3``: the force loop linear, its margins and its limits.

Exit status: 0 done; 2 the input is at fault; 3 the run stops before the instant, or there is no linear loop at it.
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
from closedloop.command.border import DONE, Parser, add_figure_options, as_command, drawn_as, formats_of, parsed

if TYPE_CHECKING:
    from closedloop.studies.analysis.stability import Range, Stability

# Values of a range that does not say how many, and where whole runs are tried beside a boundary.
POINTS, TRIED = 60, (0.25, 0.5, 0.75)


@as_command()
def main(words: list[str]) -> int:
    """Run the command line and return the exit status."""
    from closedloop.scenario.load import load_scenario

    parser = Parser(
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
    add_figure_options(parser)
    options, overrides = parsed(parser, words)
    formats_of(options)
    style = drawn_as(options)
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
    return DONE


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
        paths += draw_page(page, folder, formats_of(options))
        paths += [write_figure(figure, folder / name, formats_of(options)) for name, figure in drawn]
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
    from closedloop.studies.analysis.page import trial_line

    over, count = ranges[-1]
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
        drawn: list[tuple[str, Any]] = []
        if draw:
            from closedloop.studies.analysis.page import locus

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
        drawn = []
        if draw:
            from closedloop.studies.analysis.page import stability_map

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
