"""What the studies share: a posture, what is measured of a run, and the results as files and as a table."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array, plain
from closedloop.base.errors import ClosedLoopError, InterruptedRunError, faults_on_one_line
from closedloop.base.files import what_was_written, write_whole
from closedloop.base.progress import reporting
from closedloop.record.report.control_verdict import told
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.simulate import simulate

# Joint positions of the WAM, rad: with the elbow up the workspace along y allows longer and faster paths.
ELBOW_UP = (math.pi / 2, 1.0, 0.0, 2.0)


def force_and_path(error: Array, off: Array, normal: Array) -> dict[str, float]:
    """Return RMS and peak of a force error (N,), N, and the RMS of what the tip is off (N, 3) along the surface, mm."""
    off = off - np.sum(off * normal, axis=1)[:, None] * normal
    return {
        "force_rms": float(np.sqrt(np.mean(error**2))),
        "force_peak": float(np.max(np.abs(error))),
        "path_rms": float(1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    }


def measured(
    row: dict[str, Any], scenario: Scenario, measures: Callable[[Run], dict[str, float]], names: Sequence[str]
) -> dict[str, Any]:
    """Run a scenario and return the row with its measures of these names; a run that cannot go on is its reason."""
    try:
        run = simulate(scenario, engine="compiled")
        return row | {"reason": ""} | measures(run) | {"control_verdict": told(run.summary())}
    except InterruptedRunError:
        raise
    except ClosedLoopError as error:
        none = dict.fromkeys(names, math.nan)
        return row | {"reason": faults_on_one_line(error)} | none | {"control_verdict": ""}


def each(name: str, cells: Sequence[tuple[Any, ...]], run: Callable[..., dict[str, Any]]) -> list[dict[str, Any]]:
    """Return what `run` gives of the arguments in each cell; a bar on standard error says how far it is."""
    results: list[dict[str, Any]] = []
    with reporting(True, name, len(cells)) as report:
        for cell in cells:
            results.append(run(*cell))
            report(len(results), len(cells))
    return results


def conclude(
    folder: Path, name: str, results: Any, columns: Sequence[str], figures: Sequence[Path],
    tables: Callable[[Any], None] | None, rows: Iterable[Sequence[Any]] | None = None,
) -> None:  # fmt: skip
    """Write the results as `name`.json and rows of them as `name`.csv, and print their tables, or the JSON if None.

    If no rows are given they are those columns of each result. A number that is not finite is null, and an empty cell.
    """
    rows = [[row[column] for column in columns] for row in results] if rows is None else rows
    said = json.dumps(plain(results), indent=2)
    write_whole(folder / f"{name}.json", (said + "\n").encode())
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *plain(list(rows))])
    write_whole(folder / f"{name}.csv", text.getvalue().encode())
    if tables is None:
        print(said)
    else:
        tables(results)
        print(what_was_written(f"{name}.json", f"{name}.csv", *figures, folder=folder))


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], width: int | None = None) -> None:
    """Print a table whose first column is words, and all others numbers."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left", no_wrap=not k)
    for row in rows:
        table.add_row(*row)
    Console(highlight=False, width=width).print(table)
