"""Writing what the lab shows into a folder of its own: scenario.toml, run.nc and page.html."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from closedloop.base.errors import OutputError, printable
from closedloop.base.files import reason_of, write_whole
from closedloop.figures.scene.ghost import Ghost
from closedloop.lab.share import share
from closedloop.record.run import Run

MOST_FOLDERS = 10_000


def new_folder(name: str, parent: Path | None = None) -> Path:
    """Make and return the first folder out/NAME-lab/1, 2, 3 ... that is not there yet."""
    parent = (Path("out") if parent is None else parent) / f"{name}-lab"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, MOST_FOLDERS):
            folder = parent / str(number)
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        raise OutputError(f"{parent}: cannot be made: {reason_of(error)}") from None
    raise OutputError(f"{parent}: holds {MOST_FOLDERS} folders already; move some of them away")


def save(run: Run, command: str, parent: Path | None = None) -> list[Path]:
    """Write a run and its scenario into a new folder, and return the files.

    `command`, which repeats the run, stands in the scenario's first line.
    """
    folder = new_folder(run.scenario.name, parent)
    text = f"# {printable(command)}\n{run.scenario.to_toml()}"
    return [write_whole(folder / "scenario.toml", text.encode()), run.save(folder / "run.nc")]


def save_page(run: Run, command: str, parent: Path | None = None, ghosts: Sequence[Ghost] = ()) -> Path:
    """Write the page of a run into a new folder, and return it; see `closedloop.lab.share`."""
    return share(run, new_folder(run.scenario.name, parent) / "page.html", command, ghosts)
