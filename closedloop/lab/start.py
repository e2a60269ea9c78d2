"""Opening the lab from Python, in a script or in a notebook."""

from __future__ import annotations

import atexit
import html
import shutil
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from closedloop.base.arguments import arguments_checked
from closedloop.base.errors import ScenarioError, missing_line
from closedloop.base.files import write_whole
from closedloop.control.law import ControlLaw
from closedloop.figures.scene.solids import Ghost
from closedloop.lab.history import History, in_words
from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

if TYPE_CHECKING:
    from closedloop.lab.app import Lab

NEEDS = missing_line("the lab needs", "websockets", "lab")
HEIGHT = 800  # px of the lab in a notebook
BEGIN = "wam_slide"  # the scenario below those of which one is chosen
LONGEST = 600.0  # s that a first run may take, with what is compiled for it


@arguments_checked()
def lab(
    scenario: Scenario | Run | str | Path | None = None, overrides: Mapping[str, Any] | None = None, *,
    law: type[ControlLaw] | Callable[..., Any] | None = None, model: RobotModel | None = None, host: str = "127.0.0.1",
    port: int = 8080, dark: bool = False, show: bool = True, ghosts: Sequence[Ghost] = (),
) -> Lab:  # fmt: skip
    """Open the lab and return it when its first run is there; `close()` ends it.

    In a notebook it is shown below the cell; in a script a browser is opened.

    Parameters
    ----------
    scenario : Scenario, Run, str or path
        What it begins with: a shipped name or a file, as `load_scenario` takes them. If left out the page begins with
        the scenarios that ship, to choose one.
    overrides : mapping, optional
        As `load_scenario` takes them.
    law : callable or subclass of ControlLaw, optional
        A user's law: a function as `simulate` takes it, or a class, whose parameters then are sliders.
    model : RobotModel, optional
        The robot to use instead of loading the one that the scenario names.
    host, port : str and int
        Where it listens; the next free port is taken if this one is in use.
    dark : bool
        Whether the page is dark, whatever the system prefers.
    show : bool
        Whether to show the page at all.
    ghosts : sequence of Ghost
        Bodies with motions of their own, as measured ones, that are shown beside those of each run until another
        scenario is chosen; see `closedloop.figures.scene.solids`.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario is at fault, or websockets is not installed.
    OutputError
        If it cannot listen there.
    """
    if find_spec("websockets") is None:
        raise ScenarioError(NEEDS)
    front, scenario = scenario is None, BEGIN if scenario is None else scenario
    changes = dict(overrides or {})
    if isinstance(law, type) and issubclass(law, ControlLaw):
        changes, law = {"law.kind": law} | changes, None
    base, name, model = _begin(scenario, changes, model)
    if not isinstance(scenario, str | Path):
        name, changes = in_words(base)
    words = "" if law is None else f"--law {getattr(law, '__module__', '?')}:{getattr(law, '__qualname__', '?')}"
    history = History(base, name, _in_words(changes), words)
    lab = begun(history, law=law, model=model, host=host, port=port, dark=dark, front=front, ghosts=ghosts)
    if show:
        _show(lab)
    lab.wait_for_plots(LONGEST)
    return lab


def begun(history: History, **settings: Any) -> Lab:
    """Return a lab with all its parts; `settings` are those of `closedloop.lab.app.Lab`."""
    from closedloop.lab.actions import act
    from closedloop.lab.app import Lab
    from closedloop.lab.details import Details
    from closedloop.lab.mapping import MapWork

    return Lab(history, act=act, details=Details, map_work=MapWork, **settings)


def _begin(
    scenario: Scenario | Run | str | Path, changes: Mapping[str, Any], model: RobotModel | None
) -> tuple[Scenario, str, RobotModel | None]:
    """Return the scenario, its name on the command line, and the robot if it came with a run."""
    from closedloop.scenario.arm import is_of_model
    from closedloop.scenario.load import parse_scenario

    if isinstance(scenario, str | Path) and str(scenario).endswith(".nc"):
        from closedloop.record.run import load_run

        run = load_run(scenario)
        changed = any(map(is_of_model, changes))
        base = parse_scenario(run.scenario.to_toml(), where=str(scenario), overrides=changes)
        return base, str(scenario), model if model is not None or changed else run.model
    if isinstance(scenario, str | Path):
        return load_scenario(scenario, changes), str(scenario), model
    held = scenario.scenario if isinstance(scenario, Run) else scenario
    model = scenario.model if isinstance(scenario, Run) and model is None else model
    base = held.replace(changes) if changes else held
    return base, base.name, model


def _in_words(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return overrides as the command line has them: a class by its name."""
    return {
        key: value.member_name() if isinstance(value, type) and hasattr(value, "member_name") else value
        for key, value in changes.items()
    }


def _show(lab: Lab) -> None:
    from closedloop.lab.server import in_notebook

    if in_notebook():
        from IPython.display import IFrame, display

        display(IFrame(lab.framed_url, width="100%", height=HEIGHT))  # type: ignore[no-untyped-call]
    else:
        open_in_browser(lab.url)


def open_in_browser(url: str) -> None:
    """Open an address in the user's browser, without naming it where other users see it.

    The words of a command line are shown to all: the browser is given a file that only this user can read, and that
    sends it on.
    """
    import tempfile
    import webbrowser

    folder = tempfile.mkdtemp(prefix="closedloop-lab-")  # of this user alone
    page = Path(folder) / "open.html"
    write_whole(
        page, f'<meta charset="utf-8"><meta http-equiv="refresh" content="0; url={html.escape(url)}">\n'.encode()
    )
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    webbrowser.open(page.as_uri())
