"""The lab measured in its own page: Chromium without a screen moves a slider, and the page's own clock is read."""

from __future__ import annotations

import shutil
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from closedloop.base.arrays import Array

if TYPE_CHECKING:
    from closedloop.lab.app import Lab

PROGRAMS = "chromium", "chromium-browser", "google-chrome"
# As where somebody works; without a graphics processor Chromium draws space in software only if it is allowed to.
OPTIONS = ["--enable-unsafe-swiftshader", "--no-sandbox", "--enable-precise-memory-info"]
SIZE = 1440, 900  # px
PICTURED = (900, 700), SIZE, (2560, 1440)  # px, sizes of which pictures are made
PATIENCE = 120_000  # ms
# Notes when the pointer is moved with its button down, by the event that the page's sliders follow; when the first
# curves are drawn after that, of a part of the run or of all of it; when those of a whole run are; and when a frame
# shows those.
WATCH = """() => {
const commanded = () => run.panels[0].traces.find(t => t.label === 'commanded');
const largest = () => commanded() ? Math.max(...commanded().values) : null;
window.lab = {first: [], drawn: [], shown: [], redrawn: 0, faults: 0, largest};
let began = null, last = run.n, first = null;
window.lab.forget = () => { began = first = null; Object.assign(window.lab, {first: [], drawn: [], shown: []}); };
addEventListener('error', () => { window.lab.faults += 1; });
addEventListener(AT_ONCE, e => { if (began === null && e.buttons) began = e.timeStamp; }, true);
document.addEventListener('drawn', e => {
  window.lab.redrawn += 1;
  if (began !== null && first === null && e.detail.n !== last) first = performance.now() - began;
  if (e.detail.partial || e.detail.n === last) return;
  last = e.detail.n;
  if (began === null) return;
  const from = began;
  window.lab.first.push(first);
  began = first = null;
  window.lab.drawn.push(performance.now() - from);
  requestAnimationFrame(() => window.lab.shown.push(performance.now() - from));
}); }"""


class Moved(NamedTuple):
    """What came of a slider that was dragged in the page all the time."""

    # moves, redrawn: movements of the pointer, and how often the curves were drawn
    moves: int
    redrawn: int
    seconds: float  # time that they took, s
    # plotted, wanted: value in the plot at the end, or of the run shown where the plot has no commanded force; value of
    # the slider
    plotted: float
    wanted: float
    faults: int  # errors in the page
    growth: float  # memory that the page gained between the first tenth and the end, MB


def why_not() -> str:
    """Return why the page cannot be measured here, "" if it can."""
    from importlib.util import find_spec

    if find_spec("playwright") is None:
        return "playwright is not installed: pip install playwright"
    return "" if program() else f"there is none of {', '.join(PROGRAMS)}"


@contextmanager
def page_of(lab: Lab, size: tuple[int, int] = SIZE, theme: Literal["light", "dark"] = "light") -> Iterator[Any]:
    """Open the page of a lab whose run is shown, and close it in the end."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program(), args=OPTIONS)
        try:
            page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=theme)
            page.set_default_timeout(PATIENCE)
            page.goto(lab.url)
            page.get_by_text("steps in").wait_for()
            page.wait_for_timeout(2000)
            page.evaluate(WATCH)
            yield page
        finally:
            browser.close()


def pictures(lab: Lab, folder: Path) -> list[Path]:
    """Write a picture of the page in each size and theme, half way through the run; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for size in PICTURED:
        for theme in ("light", "dark"):
            with page_of(lab, size, theme) as page:
                page.evaluate("seek(0.5 * (state.begin + state.end))")
                lab.map.wait(PATIENCE / 1e3)
                lab.wait(PATIENCE / 1e3)
                page.wait_for_timeout(1000)
                made.append(folder / f"{lab.history.base.name}-{size[0]}-{theme}.png")
                page.screenshot(path=made[-1])
    return made


def page_latencies(page: Any, key: str, changes: int) -> tuple[Array, Array, Array]:
    """Drag a slider, each movement after the plot of the one before.

    Returns the times (changes,), s, from the pointer's movement to the first curves, of a part of the run where that
    takes long; to those of the whole run; and to the frame with them.
    """
    box = slider_of(page, key)
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.wait_for_timeout(1000)
    page.evaluate("window.lab.forget()")
    for k in range(changes):
        # to and fro, never where it was, and not to an end: its handle may have been held beside its middle
        page.mouse.move(x + 2.0 * (6 - abs(k % 20 - 10)), y)
        wait_until(page, f"window.lab.shown.length > {k}")
    page.mouse.up()
    return tuple(np.array(page.evaluate(f"window.lab.{name}")) / 1e3 for name in ("first", "drawn", "shown"))  # type: ignore[return-value]


def page_drag(page: Any, lab: Lab, key: str, seconds: float, rate: float) -> Moved:
    """Drag a slider with the pointer `rate` times a second."""
    box = slider_of(page, key)
    middle, y = box["x"] + 0.7 * box["width"], box["y"] + 0.5 * box["height"]
    heap = "performance.memory ? performance.memory.usedJSHeapSize / 1e6 : 0"
    page.mouse.move(middle, y)
    page.mouse.down()
    before = int(page.evaluate("window.lab.redrawn"))
    began, moves, early = clock.perf_counter(), 0, 0.0
    while (now := clock.perf_counter() - began) < seconds:
        page.mouse.move(middle + 0.15 * box["width"] * float(np.sin(2.0 * np.pi * now / 3.0)), y)
        moves += 1
        if not early and now > 0.1 * seconds:
            early = float(page.evaluate(heap))
        clock.sleep(max(0.0, moves / rate - (clock.perf_counter() - began)))
    took, redrawn = clock.perf_counter() - began, int(page.evaluate("window.lab.redrawn")) - before
    page.mouse.up()
    page.wait_for_timeout(1000)
    lab.wait()
    page.wait_for_timeout(2000)
    plotted, faults = page.evaluate("window.lab.largest()"), int(page.evaluate("window.lab.faults"))
    if plotted is None:  # contacts of links alone
        plotted = reduce(getattr, key.split("."), lab.run.scenario) if lab.run is not None else np.nan
    wanted = float(slider_at(page, key).input_value())
    return Moved(moves, redrawn, took, float(plotted), wanted, faults, float(page.evaluate(heap)) - early)


def wait_until(page: Any, condition: str, seconds: float = 1e-3 * PATIENCE) -> None:
    """Wait until a condition is true in a page; Playwright's own way evaluates text, which the page's policy forbids.

    Raises `TimeoutError`.
    """
    end = clock.monotonic() + seconds
    while not page.evaluate(f"Boolean({condition})"):
        if clock.monotonic() > end:
            raise TimeoutError(f"after {seconds:g} s: {condition}")
        page.wait_for_timeout(20)


def program() -> str | None:
    """Return the program Chromium, None if there is none."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


def slider_at(page: Any, key: str) -> Any:
    """Return the slider of a key; of a list that of all its numbers."""
    return page.locator(f'.row[data-key="{key}"] input[type=range]').first


def slider_of(page: Any, key: str) -> dict[str, float]:
    """Return the box of the slider of a key, px: x, y, width and height."""
    return slider_at(page, key).bounding_box()
