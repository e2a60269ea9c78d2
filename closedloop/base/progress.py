"""Progress on standard error: a bar where that is a terminal."""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from closedloop.base.errors import printable

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

# Where there is no terminal, seconds between two lines.
BETWEEN_LINES = 10.0


def _shown(*columns: str | ProgressColumn) -> Progress:
    """Return progress with these columns on standard error, disabled where that is no terminal.

    With FORCE_COLOR rich takes a file for a terminal, which is to have colours.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    drawn = console.is_terminal and sys.stderr.isatty()
    console.quiet = not drawn  # rich before 15 ends a line that it did not begin
    return Progress(*columns, console=console, transient=True, disable=not drawn)


@contextmanager
def reporting(
    progress: bool | Callable[[int, int], None] | None, name: str, total: int
) -> Iterator[Callable[[int, int], None]]:
    """Yield a function of (done, in all): `progress` itself; if it is True a bar on a terminal; else a silent one."""
    if progress is not True:
        yield progress or (lambda done, total: None)
        return
    from rich.progress import BarColumn, TimeRemainingColumn

    with _shown("{task.description}", BarColumn(), "{task.percentage:3.0f} %", TimeRemainingColumn()) as shown:
        task = shown.add_task(name, total=total)
        yield lambda done, total: shown.update(task, completed=done)


@contextmanager
def count(name: str, total: int) -> Iterator[Callable[[int, int], None]]:
    """Yield a function of (runs done, runs in all) that shows them with their rate and the time left.

    Runs that were done before the first call have no part in the rate. On a terminal it is a bar, else a line every
    `BETWEEN_LINES` seconds.
    """
    from rich.progress import BarColumn

    began: list[tuple[float, int]] = []
    said = [clock.monotonic()]
    with _shown("{task.description}", BarColumn(), "{task.fields[state]}") as progress:
        task = progress.add_task(name, total=total, state="")

        def show(done: int, total: int) -> None:
            now = clock.monotonic()
            if not began:
                began.append((now, done))
            since, first = now - began[0][0], began[0][1]
            state = progress_text(done, total, done - first, since)
            progress.update(task, completed=done, state=state)
            if progress.disable and done < total and now - said[0] >= BETWEEN_LINES:
                said[0] = now
                print(printable(f"{name}: {state}"), file=sys.stderr, flush=True)

        yield show


@contextmanager
def counter(name: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that shows how many runs are done, if standard error is a terminal."""
    from rich.progress import SpinnerColumn

    with _shown(SpinnerColumn(), "{task.description}: {task.completed} runs") as progress:
        task = progress.add_task(name, total=None)
        yield lambda done: progress.update(task, completed=done)


def progress_text(done: int, total: int, lately: int, seconds: float) -> str:
    """Return how far it is in words, of which `lately` runs were done in so many `seconds`."""
    text = f"{done} of {total} runs"
    if lately > 0 and seconds > 0.0:
        rate = lately / seconds
        left = round((total - done) / rate)
        hours, minutes = left // 3600, left // 60 % 60
        time = f"{hours} h {minutes:02} min" if hours else f"{minutes} min {left % 60:02} s" if minutes else f"{left} s"
        text += f", {rate:.3g} runs/s, {time} left"
    return text
