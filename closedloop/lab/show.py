"""Showing a run in the browser, or below a notebook's cell: the page of `closedloop.lab.share`, from a file."""

from __future__ import annotations

import html
import tempfile
from pathlib import Path
from typing import Any

from closedloop.lab.page import in_notebook
from closedloop.lab.share import page_of, share
from closedloop.record.run import Run

HEIGHT = 640  # px in a notebook


def show_run(run: Run, path: str | Path | None = None) -> Path | Any:
    """Show the replay of a run.

    Parameters
    ----------
    run : Run
    path : path, optional
        Write the page there instead of showing it.

    Returns
    -------
    Path or IPython.display.HTML
        The file; in a notebook, without `path`, what it displays.

    Raises
    ------
    ScenarioError
        If the run has no rows.
    OutputError
        If the file cannot be written.
    """
    if path is not None:
        return share(run, path)
    if in_notebook():
        from IPython.display import HTML

        inside = html.escape(page_of(run), quote=True)
        frame = f'<iframe srcdoc="{inside}" width="100%" height="{HEIGHT}" style="border:0"></iframe>'
        return HTML(frame)  # type: ignore[no-untyped-call]
    import webbrowser

    folder = Path(tempfile.mkdtemp(prefix="closedloop-"))
    page = share(run, folder / f"{run.scenario.name}.html")
    webbrowser.open(page.as_uri())
    return page
