"""A run as one page of HTML: the page of the lab without its server, in a file that needs no network; and shown."""

import html
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from closedloop.base.errors import ScenarioError
from closedloop.base.files import write_whole
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import Ghost
from closedloop.lab.curves import tiles
from closedloop.lab.drawn import curves, in_text, robot_message, run_message, space_message, spread
from closedloop.lab.server import in_notebook
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

# Frames of the replay at most, parts of the time of which a curve shows the extremes, and columns besides the panels.
MOST_FRAMES, CELLS = 500, 400
COLUMNS = ("q", "v", "torque", "position", "kinetic_energy")
SCRIPTS = (
    "numbers.js", "space.js", "draw_space.js", "plots.js", "controls.js", "map.js", "tabs.js", "gallery.js", "page.js",
)  # fmt: skip


def page_of(run: Run, command: str = "", ghosts: Sequence[Ghost] = ()) -> str:
    """Return the page of a run; `command` is the command line that repeats it, `ghosts` are shown beside its bodies."""
    if not len(run):
        raise ScenarioError(f"{run.scenario.name}: the run has no rows: there is nothing to show")
    scene, summary = scene_of(run, ghosts), run.summary()
    drawn = curves(run, None, COLUMNS, CELLS)
    messages = [
        hello(run.scenario, run.model, live=False) | {"scenario": run.scenario.to_toml(), "command": command},
        run_message(run, drawn, line="", n=1, partial=False) | {"columns": list(COLUMNS)},
        {"kind": "strip", "tiles": tiles(run, summary)},
        robot_message(scene),
        space_message(scene, spread(run, MOST_FRAMES), summary["clearance"]) | {"n": 1},
    ]
    return page(f"{run.scenario.name}, {run.model.name}", messages)


def hello(scenario: Scenario, model: RobotModel, **more: Any) -> dict[str, Any]:
    """Return the message with what a page is about: its title, the scenario in words, and more."""
    name, about = scenario.name, scenario.description
    title = name if name == model.name else f"{name} ({model.name})"
    return {"kind": "hello", "name": name, "title": title, "about": about[:1].upper() + about[1:], **more}


def page(title: str, messages: Sequence[Any] = (), theme: str = "", nonce: str = "") -> str:
    """Return the page with messages inside; without any it opens a socket below its own address.

    `theme` is "dark", "light", or "" for what the system prefers; `nonce` is the word by which the policy of a server
    knows the page's own script and style. No text of a run can end the script it stands in.
    """
    web = files("closedloop.lab") / "web"
    parts = {
        "TITLE": html.escape(title),
        "THEME": theme,
        "NONCE": nonce,
        "STYLE": (web / "style.css").read_text(encoding="utf-8"),
        "SCRIPT": "\n".join((web / name).read_text(encoding="utf-8") for name in SCRIPTS),
        "DATA": in_text(list(messages)),
    }
    found, *rest = (web / "page.html").read_text(encoding="utf-8").split("@")
    for name, text in zip(rest[::2], rest[1::2], strict=True):
        found += parts[name] + text
    return found


def share(run: Run, path: str | Path, command: str = "", ghosts: Sequence[Ghost] = ()) -> Path:
    """Write the page of a run, see `page_of`, and return its path."""
    return write_whole(path, page_of(run, command, ghosts).encode())


HEIGHT = 640  # px in a notebook


def show_run(run: Run, path: str | Path | None = None) -> Path | Any:
    """Show the replay of a run, see `closedloop.record.run.Run.show`."""
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
