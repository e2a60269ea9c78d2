"""Opening the lab from Python, in a script or in a notebook; what a page may ask of it; and what follows the curves.

What follows the curves of a run when the slider rests is the strip of values, the run in space and the loop's analysis.
None of it may delay the next curves, so it waits for a rest, or for a while where the slider goes on moving.
"""

from __future__ import annotations

import atexit
import html
import logging
import math
import shutil
import tempfile
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import evenly
from closedloop.base.errors import ClosedLoopError, ScenarioError, missing_line, one_line
from closedloop.base.files import what_was_written, write_whole
from closedloop.control.law import ControlLaw
from closedloop.figures.scene.scene import Scene, mechanism_of, scene_of
from closedloop.figures.scene.solids import Ghost
from closedloop.lab.app import Answer, Lab
from closedloop.lab.controls import Changes
from closedloop.lab.curves import margin_tiles, reduced, tiles, values
from closedloop.lab.drawn import FRAMES, Message, pack, robot_message, space_message
from closedloop.lab.history import MOST_PINS, History, Pin, compared, in_words, new_folder, save, share
from closedloop.lab.mapping import MapWork
from closedloop.lab.server import Client, Newest, finite, in_notebook
from closedloop.record.run import Run, load_run
from closedloop.scenario.arm import is_of_model
from closedloop.scenario.load import load_scenario, parse_scenario, shipped_scenarios
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import beside_half
from closedloop.studies.analysis.assembly import instant_of, loop_at
from closedloop.studies.analysis.page import Overview, overview
from robot_models import RobotModel

# The strip follows when no other run has come for so long, s, and while a slider moves so often; then the rest.
REST, OFTEN = 0.2, 0.7
# Between two parts it waits until no run is being computed, but no longer than this, s.
GIVE_WAY = 0.3
LATER = 0.3
# Poles that are listed, and points of a curve over the frequency.
POLES, POINTS = 12, 400
LESS_IS_BETTER = ("rms_force_error", "force_settled_at", "rms_path_error", "max_abs_closure_error")
NO_LOOP = "a law that is a function is not linearised: make it a class of ControlLaw"


class Details:
    """What follows the curves."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._robot = 0
        self._cache = Cache()
        self.begin()
        self._work: Newest[Answer, None] = Newest(self._follow, rest=REST, most=OFTEN, held=lab.computes)
        self._loop: Newest[Answer, None] = Newest(self._analyse, rest=LATER, most=5.0, held=lab.computes)

    def begin(self) -> None:
        """Forget what was before: another scenario is shown."""
        self._shapes: Any = None
        self.at: float | None = None  # the instant of the analysis, s; half of the run if None
        self._margins: dict[str, Any] | None = None
        self._began: tuple[str, dict[str, float | None], dict[str, Any] | None] | None = None
        self._pinned: dict[str, dict[str, Any] | None] = {}

    def ask(self, answer: Answer) -> None:
        """Let what follows the curves of this answer follow."""
        self._work.ask(answer)
        self._loop.ask(answer)

    def wait(self, seconds: float) -> bool:
        """Wait until all has followed; return whether it has."""
        return self._work.wait(seconds) and self._loop.wait(seconds)

    def close(self) -> None:
        """Stop the threads."""
        self._work.close()
        self._loop.close()

    def robot_of(self, scene: Scene) -> int:
        """Return the number of the robot that the pages have, 0 if this scene has another."""
        return self._robot if scene.shapes is self._shapes else 0

    def pinned(self) -> None:
        """Send the runs that are kept, and what is compared with them."""
        lab = self._lab
        found: list[Message] = []
        for pin in lab.pins.held:  # of each panel the curve that stands for the run
            few = [reduced(panel, float(pin.run.time[0]), float(pin.run.time[-1])) for panel in pin.panels]
            mains = {p.name: {"time": p.time, "values": p.main.values, "factor": p.factor} for p in few}
            found.append({"name": pin.name, "colour": pin.colour, "panels": mains})
        lab.tell("pins", {"kind": "pins", "pins": found})
        names = {pin.name for pin in lab.pins.held}
        self._pinned = {name: margins for name, margins in self._pinned.items() if name in names}
        if lab.pins.held:
            self._pinned.setdefault(lab.pins.held[-1].name, self._margins)
        if lab.answer is not None:
            self.ask(lab.answer)

    def _follow(self, answer: Answer) -> None:
        run, lab = answer.run, self._lab
        if run is None or answer is not lab.answer:
            return
        summary = run.summary()
        self._send_strip(run, summary)
        lab.wait_for_plots(GIVE_WAY)
        lab.tell_controls()
        held = list(lab.pins.held)
        lab.tell("compare", compare_message(held, run, answer.changes))
        lab.wait_for_plots(GIVE_WAY)
        scene = scene_of(run, lab.ghosts)
        if scene.shapes is not self._shapes:
            self._shapes = scene.shapes
            self._robot += 1
            lab.tell("robot", robot_message(scene) | {"robot": self._robot})
        found = space_message(
            scene, evenly(len(run), FRAMES), summary["clearance"], lambda: lab.wait_for_plots(GIVE_WAY)
        )
        lab.tell("space", found | {"robot": self._robot})

    def _send_strip(self, run: Run, summary: Message) -> None:
        lab, held = self._lab, self._lab.pins.held
        margins = self._margins
        if self._began is None or self._began[0] != lab.history.base.name:
            self._began = (lab.history.base.name, values(run, summary), margins)  # the analysis may come before
        name, before, known = "the start", self._began[1], self._began[2]
        if held:
            name, before = held[-1].name, values(held[-1].run, held[-1].run.summary())
            known = self._pinned.get(name)
        found = tiles(run, summary, before, name)
        if margins is not None and run.scenario.has_law:  # without one nothing is a loop that could be unstable
            found[2:2] = margin_tiles(margins, margins["stable"], known, name)
        lab.tell("strip", {"kind": "strip", "tiles": found})

    def _analyse(self, answer: Answer) -> None:
        run, lab = answer.run, self._lab
        lab.wait_for_plots(GIVE_WAY)
        if run is None or answer is not lab.answer:
            return
        margins, message = None, {"kind": "analysis", "line": NO_LOOP}
        try:
            if lab.answers.law is None:
                end = run.scenario.time.duration
                at = 0.5 * end if self.at is None else min(self.at, end)
                model = lab.answers.model(run.scenario)
                problem = prepare(run.scenario, model, self._cache)
                lab.wait_for_plots(GIVE_WAY)
                instant = instant_of(problem, at, model)
                lab.wait_for_plots(GIVE_WAY)
                loop = loop_at(problem, instant)
                lab.wait_for_plots(GIVE_WAY)
                found = overview(loop)
                margins, message = found.margins.as_dict(), analysis_message(found)
        except ClosedLoopError as error:
            message["line"] = one_line(str(error))
        if run.scenario.name != lab.history.base.name:
            return  # of a scenario that was left meanwhile
        self._margins = margins
        lab.tell("analysis", message)
        if answer is lab.answer:
            if self._began is not None and self._began[2] is None and not answer.changes:
                self._began = (*self._began[:2], self._margins)
            lab.wait_for_plots(GIVE_WAY)
            with suppress(ClosedLoopError):  # the run itself stays where none at half its step can be simulated
                run = beside_half(run, law=lab.answers.law, model=run.model)
            self._send_strip(run, run.summary())
            if lab.clients and not lab.front:
                lab.map.begin_by_itself(answer)


def analysis_message(found: Overview) -> Message:
    """Return the message of a loop's analysis."""
    some = evenly(len(found.frequency), POINTS)
    return {
        "kind": "analysis", "line": "", "sentence": found.sentence, "margins": found.margins.as_dict(),
        "frequency": found.frequency[some], "gain": found.gain[some], "phase": found.phase[some],
        "poles": [_pole(pole) for pole in found.poles[:POLES]],
    }  # fmt: skip


def _pole(pole: Any) -> Message:
    s = pole.s
    over = not np.isfinite(s.real)
    number = "over at once" if over else f"{s.real:.4g}" + (f" ± {abs(s.imag):.4g}i" if s.imag else "")
    return {
        "s": number, "frequency": "-" if over else f"{pole.frequency:.4g}",
        "damping": "-" if over else f"{pole.damping:.3g}", "part": pole.part,
    }  # fmt: skip


def compare_message(pins: list[Pin], run: Run, changes: Changes) -> Message:
    """Return the table of the pinned runs and that of now: in each cell its text, and whether the pin is better."""

    def cell(name: str, text: str) -> list[Any]:
        lower = text.partition("(")[2][:1] == "-"
        told = "(" in text and name.partition(" ")[0] in LESS_IS_BETTER
        return [text, lower if told else None]

    table = compared(pins, run, changes) if pins else []
    rows = [[name, *(cell(name, text) for text in cells)] for name, cells in table]
    return {"kind": "compare", "columns": [{"name": p.name, "colour": p.colour} for p in pins], "rows": rows}


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
    given = {  # a class by its name
        key: value.member_name() if isinstance(value, type) and hasattr(value, "member_name") else value
        for key, value in changes.items()
    }
    history = History(base, name, given, words)
    lab = begun(history, law=law, model=model, host=host, port=port, dark=dark, front=front, ghosts=ghosts)
    if show and in_notebook():
        from IPython.display import IFrame, display

        display(IFrame(lab.framed_url, width="100%", height=HEIGHT))  # type: ignore[no-untyped-call]
    elif show:
        open_in_browser(lab.url)
    lab.wait_for_plots(LONGEST)
    return lab


def begun(history: History, **settings: Any) -> Lab:
    """Return a lab with all its parts; `settings` are those of `closedloop.lab.app.Lab`."""
    return Lab(history, act=act, details=Details, map_work=MapWork, **settings)


def _begin(
    scenario: Scenario | Run | str | Path, changes: Mapping[str, Any], model: RobotModel | None
) -> tuple[Scenario, str, RobotModel | None]:
    """Return the scenario, its name on the command line, and the robot if it came with a run."""
    if isinstance(scenario, str | Path) and str(scenario).endswith(".nc"):
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


def open_in_browser(url: str) -> None:
    """Open an address in the user's browser, without naming it where other users see it.

    The words of a command line are shown to all: the browser is given a file that only this user can read, and that
    sends it on.
    """
    folder = tempfile.mkdtemp(prefix="closedloop-lab-")  # of this user alone
    sent_on = f'<meta charset="utf-8"><meta http-equiv="refresh" content="0; url={html.escape(url)}">\n'
    page = write_whole(Path(folder) / "open.html", sent_on.encode())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    webbrowser.open(page.as_uri())


logger = logging.getLogger(__name__)

Said = dict[str, Any]


def act(lab: Lab, client: Client, said: Said) -> None:
    """Do what a page asks; what is at fault is a line on the page, also what is no request."""
    try:
        action = ACTIONS.get(str(said.get("do")))
        if action is None:
            client.put("status", pack(_status("what the page sent is no request of the lab's: nothing was done", True)))
            return
        client.time = finite(said.get("t"), client.time)
        lab.history.press = None if said.get("press") is None else (id(client), str(said["press"]))
        action(lab, client, said)
    except ClosedLoopError as error:
        _say(lab, one_line(str(error)), loud=True)
    except Exception:  # the page goes on: what comes from a browser may be anything
        client.put("status", pack(_status("what the page asked for failed: see the terminal", True)))
        logger.exception("a request of the page failed")


def _set(lab: Lab, client: Client, said: Said) -> None:
    """Set a key to what its control shows, or to what was typed beside it."""
    index = said.get("index")
    control = lab.controls.get((str(said.get("key")), index if isinstance(index, int) else None))
    if control is None:
        return
    try:
        value = control.typed(str(said.get("text"))) if said["do"] == "type" else control.read(said.get("shown"))
    except (ValueError, TypeError, OverflowError, ClosedLoopError) as error:
        lab.tell("fault", {"kind": "fault", "key": control.key, "line": one_line(str(error))}, keep=False)
        return
    if said.get("together") and control.index is not None:
        value = control.together(value)
    lab.changed(control.key, value)


def _reset(lab: Lab, client: Client, said: Said) -> None:
    """Set a key back to where it began; of a list one entry, or all."""
    key, index = str(said.get("key")), said.get("index")
    control = lab.controls.get((key, index if isinstance(index, int) else None)) or lab.controls.get((key, 0))
    if control is None:
        return
    if isinstance(index, int) and control.index == index:
        lab.changed(key, control.put(lab.first.get((key, index))))
        lab.refresh()
    else:
        lab.changed(key, None)


def _step(lab: Lab, client: Client, said: Said) -> None:
    """Undo, redo, or go back to where the scenario began."""
    history, word = lab.history, said["do"]
    moved = {"undo": history.undo, "redo": history.redo, "begin again": history.begin_again}[word]()
    if moved:
        lab.refresh()
        lab.ask()
    else:
        _say(lab, f"there is nothing to {word}" if word != "begin again" else "nothing was changed")


def _pin(lab: Lab, client: Client, said: Said) -> None:
    """Keep the run shown, or the latest pinned one no longer."""
    answer = lab.answer
    if said["do"] == "unpin":
        del lab.pins.held[-1:]
    elif answer is None or answer.run is None:
        return
    elif lab.pins.add(answer.run, answer.changes) is None:
        _say(lab, f"{MOST_PINS} runs are pinned already: unpin the last first", loud=True)
        return
    lab.details.pinned()


def _write(lab: Lab, client: Client, said: Said) -> None:
    """Write the run shown, as a scenario and a run file, or as a page."""
    answer = lab.answer
    if answer is None or answer.run is None:
        _say(lab, "there is no run yet")
        return
    command = lab.command(answer)
    if said["do"] == "save":
        written = save(answer.run, command, lab.folder)
    else:
        folder = new_folder(answer.run.scenario.name, lab.folder)
        written = [share(answer.run, folder / "page.html", command, lab.ghosts)]
    _say(lab, what_was_written(*written))


def _choose(lab: Lab, client: Client, said: Said) -> None:
    client.choose(said)
    lab.show_again(client)


def _map(lab: Lab, client: Client, said: Said) -> None:
    if said["do"] == "stop map":
        lab.map.stop()
    else:
        lab.map.start(str(said.get("x")), str(said.get("y")), str(said.get("quantity")))


# How long a pull acts, s; nearer to the tip than this share of the robot's size it is one at the tip.
PULL, AT_TIP = 0.2, 0.05


def _pull(lab: Lab, client: Client, said: Said) -> None:
    """Pull at a point of a link, from the instant that the page shows: a force from outside."""
    run = None if lab.answer is None else lab.answer.run
    if run is None:
        return
    at, force = (np.array([finite(x, math.nan) for x in said.get(key) or ()]) for key in ("at", "force"))
    frames = [each for each in mechanism_of(run.model).frames if each.parentJoint == said.get("joint")]
    if at.shape != (3,) or force.shape != (3,) or not np.all(np.isfinite([at, force])) or not frames:
        return
    scene, named = scene_of(run), [each for each in frames if each.name in run.model.frames]
    start = finite(said.get("start"), client.time)
    row = min(max(round(start / run.scenario.time.step), 0), len(run) - 1)
    axes, origins = (part[frames[0].parentJoint] for part in scene.joint_places(row))
    pulled: dict[str, Any] = {"force": _rounded(force), "duration": PULL}
    pulled["start"] = float(f"{max(min(start, run.scenario.time.duration - PULL), 0.0):.6g}")
    if np.linalg.norm(origins + axes @ at - scene.tip_place(row)) > AT_TIP * scene.size and named:
        pulled |= {"link": named[0].name, "at": _rounded(named[0].placement.actInv(at))}
    given = [force.model_dump(exclude_none=True) for force in lab.history.scenario().external_force or ()]
    if said.get("first"):  # what follows is the same pull, a moment later
        client.pulls = len(given)
    lab.changed("external_force", [*given[: client.pulls], pulled])
    if said.get("last"):
        lab.refresh()


def _rounded(vector: Any) -> list[float]:
    return [float(f"{x:.3g}") for x in vector]


def _analyse(lab: Lab, client: Client, said: Said) -> None:
    at = said.get("at")
    lab.details.at = None if at is None else finite(at, 0.0)
    if lab.answer is not None:
        lab.details.ask(lab.answer)


def _say(lab: Lab, line: str, loud: bool = False) -> None:
    lab.tell("status", _status(line, loud), keep=False)


def _status(line: str, loud: bool) -> Said:
    return {"kind": "status", "line": line, "loud": loud}


ACTIONS: dict[str, Callable[[Lab, Client, Said], None]] = {
    "set": _set, "type": _set, "reset": _reset, "undo": _step, "redo": _step, "begin again": _step,
    "pin": _pin, "unpin": _pin, "save": _write, "share": _write, "window": _choose, "columns": _choose,
    "map": _map, "stop map": _map, "analyse": _analyse, "pull": _pull,
    "open": lambda lab, client, said: lab.open(str(said["name"])) if said.get("name") in shipped_scenarios() else None,
    "shown": lambda lab, client, said: client.drawn(),
    "point": lambda lab, client, said: lab.map.go(
        finite(said.get("u"), 0.5), finite(said.get("v"), 0.5), bool(said.get("last"))
    ),
    "gallery": lambda lab, client, said: lab.show_gallery(client),
}  # fmt: skip
