"""The lab: a scenario, the run of it as it is now or the one line that says what is wrong, and the pages that show it.

Each kind of work has a thread of its own, and of what comes meanwhile takes the newest (`Newest`): runs, whose curves
are sent at once; what follows when the slider rests (`closedloop.lab.start`); and maps. A thread for each page takes
what it says (`closedloop.lab.start`). The scenarios that ship are shown as cards, with a picture of the robot at its
start.
"""

import contextlib
import logging
import sys
import threading
import time as clock
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, ScenarioError, SimulationError, one_line
from closedloop.base.interrupts import held_back
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import Ghost, compile_rows
from closedloop.jit.background import compiling_notice
from closedloop.jit.kernel import needs_compiling
from closedloop.lab.controls import Changes, Control, all_controls, begin_values, rows_in_groups
from closedloop.lab.curves import Panel, beside, panels
from closedloop.lab.drawn import Message, curves, frames, pack, robot_message, run_message, space_message
from closedloop.lab.history import IN_A_FILE, History, Pages, Pins, hello, page
from closedloop.lab.server import FIRST_PORT, RUN, Client, Newest, in_notebook, proxied
from closedloop.loop.events.table import EVENT_WIDTH
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario, shipped_scenarios
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import ALL
from closedloop.simulation.engines.law_source import fresh, law_digest
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO, kernels_of
from closedloop.simulation.parts import Cache
from closedloop.simulation.prepare import load_model, model_key, prepare
from closedloop.simulation.simulate import as_run, check_engine, law_name, run_loop, simulate
from robot_models import RobotModel

NO_EVENTS = np.zeros((0, EVENT_WIDTH))
# Steps of the run with which a loop is compiled.
FEW = 3
# A run that takes longer than this, s, shows what is done of it, this often: not just before its end.
SLOW = 0.1
# The first part is shown as soon as it is clear that the run takes that long, if so large a share of SLOW is left.
LEFT = 0.3


@dataclass(frozen=True)
class Answer:
    """What came of some changes."""

    changes: Changes
    key: str  # the key that was changed last, "" if none was
    run: Run | None  # the run, until where it stopped; None if nothing ran
    fault: str = ""  # what is wrong with the input, "" if nothing is
    stopped: str = ""  # why the run stopped before its end, "" if it did not
    seconds: float = 0.0  # time that it took, s, without compiling
    effort: float = 0.0  # time of a processor that it took, s: not longer while other programs are at work


class Answers:
    """Answers changes of one scenario.

    `law`: a user's law, see `closedloop.simulate`.
    `say`: takes a line while something is compiled or takes long, and "" when it is done.
    `part`: takes a `Run` until where it is, again and again, of one that takes long.
    """

    def __init__(
        self, history: History, law: Any = None, model: RobotModel | None = None,
        say: Callable[[str], None] = lambda line: None, part: Callable[[Run], None] = lambda run: None,
    ) -> None:  # fmt: skip
        self._part, self._cache = part, Cache()
        self._history, self.law, self._given, self._say = history, law, model, say
        self._models: dict[Hashable, RobotModel] = {}
        self._ready: set[tuple[Any, ...]] = set()

    def answer(self, changes: Changes, key: str = "") -> Answer:
        """Run the scenario with these changes; `key` is the one changed last."""
        began, worked = clock.perf_counter(), clock.thread_time()

        def took(run: Run | None, **more: str) -> Answer:
            seconds, effort = clock.perf_counter() - began, clock.thread_time() - worked
            return Answer(changes, key, run, seconds=seconds, effort=effort, **more)

        try:
            scenario = self._history.scenario(changes)
            model, engine = self.model(scenario), self.engine(scenario)
            if self._compile(scenario, model, engine):  # what is compiled once is no part of what a run takes
                began, worked = clock.perf_counter(), clock.thread_time()
            return took(self._run(scenario, model, engine))
        except SimulationError as error:
            run = error.run if error.run is not None and len(error.run) else None
            return took(run, stopped=one_line(str(error)))
        except ClosedLoopError as error:
            return took(None, fault=one_line(str(error)).removeprefix(f"{self._history.base.name}: "))
        except MemoryError:
            return took(None, fault="out of memory: ask for fewer steps")

    def _run(self, scenario: Scenario, model: RobotModel, engine: str) -> Run:
        law = fresh(self.law)
        with held_back():
            problem = prepare(scenario, model, self._cache)
        rows = np.empty((problem.steps + 1, problem.row_width))
        name, digest = ("scenario", "") if law is None else (law_name(law), law_digest(law))

        def made(some: Array, events: Array, seconds: float, stopped: str | None = None) -> Run:
            return as_run(
                problem, some, events, seconds, engine, law=(name, digest), with_states=law is None, stopped=stopped
            )  # fmt: skip

        began = shown = clock.perf_counter()

        def report(done: int, total: int) -> None:
            nonlocal shown
            now = clock.perf_counter()
            left = (now - began) * (total - done) / max(done, 1)
            first = shown == began and now - began + left > SLOW and left > LEFT * SLOW
            if (first or (now - shown > SLOW and left > SLOW)) and 1 < done < total:
                if now - began > SLOW:
                    self._say(f"computing ... {done / total:.0%}")
                if problem.tolerance is None:  # whose rows are elsewhere
                    self._part(made(rows[:done], NO_EVENTS, 0.0))
                shown = clock.perf_counter()

        try:
            found, events, failure, seconds = run_loop(problem, law, report, engine, rows=rows)
        finally:
            if shown > began:
                self._say("")
        run = made(found, events, seconds, None if failure is None else str(failure))
        if failure is not None:
            failure.run = run
            raise failure
        return run

    def model(self, scenario: Scenario) -> RobotModel:
        """Return the robot of a scenario, loaded once."""
        if self._given is not None:
            return self._given
        key = model_key(scenario)
        if key not in self._models:
            self._models, self._cache = {key: load_model(scenario)}, Cache()
        return self._models[key]

    def engine(self, scenario: Scenario) -> str:
        """Return the compiled engine where it covers the scenario and the law, else Pinocchio."""
        if scenario.time.integrator in ADAPTIVE:
            return PINOCCHIO
        with contextlib.suppress(ScenarioError):
            check_engine(scenario, COMPILED, self.law)
            return COMPILED
        return PINOCCHIO

    def _compile(self, scenario: Scenario, model: RobotModel, engine: str) -> bool:
        """Have compiled what a run of these kinds needs, here and now, and say so if it takes time.

        Return whether these kinds are new.
        """
        sections = (getattr(scenario, name) for name in type(scenario).model_fields)
        own = (str(getattr(section, "kind", "")) for section in sections)
        kinds = engine, scenario.surface.contact, *own, scenario.time.integrator
        if kinds in self._ready or scenario.time.integrator in ADAPTIVE:
            return False
        few = min(FEW, round(scenario.time.duration / scenario.time.step))
        short = scenario.time.model_copy(update={"duration": few * scenario.time.step})
        problem = prepare(scenario.model_copy(update={"time": short}), model)
        try:
            if any(map(needs_compiling, kernels_of(engine))):
                self._say(compiling_notice())
            rows, events, _, seconds = run_loop(problem, fresh(self.law), engine=engine)
            if len(rows):
                as_run(problem, rows, events, seconds, engine)  # what makes a run of the rows has kernels of its own
            if problem.robot.model.loops:
                compile_rows(problem.robot)
            self._ready.add(kinds)
        finally:
            self._say("")
        return True


# Steps of the run of which a picture is.
STEPS = 2
# The first card: an arm above its table that comes down on it. (The paper's slide has its elbow below the table.)
FIRST_CARD = "wam_touchdown"


@lru_cache(maxsize=1)
def cards() -> list[Message]:
    """Return name and description of each."""
    names = sorted(shipped_scenarios(), key=lambda name: name != FIRST_CARD)
    found = ((name, load_scenario(name).description) for name in names)
    return [{"name": name, "about": about[:1].upper() + about[1:]} for name, about in found]


@lru_cache(maxsize=64)
def picture(name: str) -> bytes:
    """Return the message of a scenario's picture, empty if it cannot be drawn."""
    scenario = load_scenario(name)
    try:
        few = scenario.time.model_copy(update={"duration": STEPS * scenario.time.step})
        scene = scene_of(simulate(scenario.model_copy(update={"time": few})))
        space = space_message(scene, [0])
    except (ClosedLoopError, ValueError):
        return b""
    return pack({"kind": "picture", "name": name, "robot": robot_message(scene), "space": space, "whole": True})


logger = logging.getLogger(__name__)

Asked = tuple[Answers, Changes, str]
Window = tuple[float, float] | None

# The order in which a page that opens is sent what there is.
FIRST = (
    "hello", "controls", "map_keys", "pins", "robot", RUN, "space", "strip", "compare", "analysis", "map", "boundary",
    "status",
)  # fmt: skip
SLIDERS = ("linear", "log", "whole")
UNSAVED = "This scenario was made in Python: press save, and run the command in the folder that it names."
# How soon a thread leaves the interpreter to the one that computes a run, s; Python's own is 5 ms.
SWITCH = 5e-4
STOPPED = "The lab was closed. What is shown stays; open the lab again to go on."


class Lab(Pages):
    """A lab of one scenario, served to a browser.

    `law`: a user's law, see `closedloop.simulate`.
    `port`: the next free one is taken if it is in use.
    `dark`: whether the page is dark, whatever the system prefers.
    `front`: whether the page begins with the scenarios that ship, to choose one.
    `ghosts`: bodies that are shown beside those of each run, until another scenario is chosen.
    `act`, `details`, `map_work`: the parts that know the whole: `closedloop.lab.start.act`,
        `closedloop.lab.start.Details`, `closedloop.lab.mapping.MapWork`; see `closedloop.lab.start.begun`.
    `after_show`, list of callable: called with each `Answer` whose curves were sent.
    `folder`, Path or None: where folders for files are made; "out" in the current folder if None.
    Raises ScenarioError or ModelError if the scenario that it begins with is at fault.
    Raises OutputError if it cannot listen there.
    """

    def __init__(
        self, history: History, *, law: Any = None, model: RobotModel | None = None, host: str = "127.0.0.1",
        port: int = FIRST_PORT, dark: bool = False, front: bool = False, ghosts: Sequence[Ghost] = (),
        act: "Callable[[Lab, Client, Any], None]", details: "Callable[[Lab], Any]", map_work: "Callable[[Lab], Any]",
    ) -> None:  # fmt: skip
        super().__init__()
        self.answer: Answer | None = None
        self.after_show: list[Callable[[Answer], None]] = []
        self.folder: Path | None = None
        self.pins, self.front = Pins(), front
        self._count = 0
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(min(SWITCH, self._switch))
        self._begin(history, law, model)
        self.ghosts: tuple[Ghost, ...] = tuple(ghosts)
        prepare(history.base, self.answers.model(history.base))  # what cannot be run is refused before there is a page
        self.details, self.map = details(self), map_work(self)
        self._newest: Newest[Asked, tuple[Answers, Answer]] = Newest(
            lambda asked: (asked[0], asked[0].answer(*asked[1:])), self._show
        )
        theme = "dark" if dark else ""
        self.listen(
            host, port, lambda nonce: page(f"closedloop: {self.history.base.name}", theme=theme, nonce=nonce),
            lambda client, message: act(self, client, message), in_notebook(),
        )  # fmt: skip
        self.refresh()
        self.ask("")

    def _begin(self, history: History, law: Any = None, model: RobotModel | None = None) -> None:
        self.history = history
        self.ghosts = ()
        self.answers = Answers(history, law, model, self.say, self._show_part)
        self.controls: dict[tuple[str, int | None], Control] = {}
        # the value with which each key, or each entry of its list, began
        self.first = {at: control.own for at, control in self._controls(history.base).items()}

    def _controls(self, scenario: Scenario) -> dict[tuple[str, int | None], Control]:
        law = self.answers.law
        return all_controls(scenario, self.answers.model(scenario), "" if law is None else law_name(law))

    @property
    def framed_url(self) -> str:
        """The address for a frame in a notebook: below that of Jupyter's server, where this passes the port on."""
        path = proxied(self.server.port)
        return f"{path}?token={self._token}" if path else self.url

    @property
    def run(self) -> Run | None:
        """The run shown."""
        return None if self.answer is None else self.answer.run

    def command(self, answer: Answer) -> str:
        """Return the command line that repeats the run of an answer."""
        return self.history.command(answer.changes, "compiled" if answer.run is None else answer.run.engine)

    def changed(self, key: str, value: Any) -> None:
        """Take a change of a key, None: back to where it began, and run the scenario with it."""
        more = {}
        section, _, name = key.partition(".")
        if name == "kind" and value in variants(section):
            with contextlib.suppress(ClosedLoopError):  # what is at fault is said by the run
                more = begin_values(self.history.scenario(), section, value)
        with self._lock:
            self.history.change(key, value, more)
            for at, control in self.controls.items():
                if at[0] == key and value is not None and control.form != "text":
                    with contextlib.suppress(ValueError, TypeError, IndexError):  # what is at fault is said by the run
                        self.controls[at] = control.with_value(value)
        self.ask(key)
        if more or value is None or ALL in key or name == "kind" or key == "surface.contact":  # others may show others
            self.refresh()

    def open(self, name: str) -> None:
        """Go over to another scenario that ships."""
        base = load_scenario(name)
        self.map.stop()
        with self._lock:
            self._begin(History(base, name))
            self.pins, self.front, self.answer = Pins(), False, None
            self._last = {}
            self.details.begin()
            self.map.begin()
        self.tell("pins", {"kind": "pins", "pins": []})
        self._hello(fresh=True)
        self.refresh()
        self.ask("")

    def refresh(self) -> None:
        """Let all controls show the scenario as it is now, if it can be read."""
        with contextlib.suppress(ClosedLoopError):
            scenario = self.history.scenario()
            found = self._controls(scenario)
            with self._lock:  # a span that a value has widened, or that a slider began with, stays
                for at, control in self.controls.items():
                    new = found.get(at)
                    if new is not None and (new.form, new.unit) == (control.form, control.unit) and new.form in SLIDERS:
                        span = replace(new, low=control.low, high=control.high, step=control.step)
                        found[at] = span.with_value(new.value)
                self.controls = found
            self.tell_controls(forced=True)
            self.map.show_keys()

    def tell_controls(self, forced: bool = False) -> None:
        """Send the controls as they are, and the command line that repeats the run."""
        history = self.history
        with self._lock:
            groups = rows_in_groups(self.controls.values(), self.first, history.changes)
        message = {
            "kind": "controls", "groups": groups, "undo": bool(history.past), "redo": bool(history.future),
            "forced": forced, "changed": len(history.changes), "note": UNSAVED if history.name == IN_A_FILE else "",
        }  # fmt: skip
        if self.answer is not None and self.run is not None:
            message |= {"command": self.command(self.answer), "scenario": self.run.scenario.to_toml()}
        self.tell("controls", message)

    def ask(self, key: str = "") -> None:
        """Run the scenario as it is now, `key` being what was changed last."""
        if key or self.answer is not None:
            self.map.changed()
        self._newest.ask((self.answers, self.history.changes, key))

    def wait(self, seconds: float = 60.0) -> bool:
        """Wait until the newest change has been sent, with all that follows its curves; return whether it has."""
        began = clock.monotonic()
        return self.wait_for_plots(seconds) and self.details.wait(max(0.0, seconds + began - clock.monotonic()))

    def wait_for_plots(self, seconds: float = 60.0) -> bool:
        """Wait until the curves of the newest change have been sent; return whether they have."""
        return self._newest.wait(seconds)

    def computes(self) -> bool:
        """Whether a run is being computed, or waits for it."""
        return not self._newest.idle

    def _show(self, found: tuple[Answers, Answer]) -> None:
        answers, answer = found
        if answers is not self.answers:
            return  # of a scenario that was left meanwhile
        run = answer.run if answer.run is not None and len(answer.run) else None
        if run is not None:
            self.answer = answer
            steps = max(0, len(run) - 1)
            line = answer.stopped or f"{steps} steps in {1e3 * answer.seconds:.0f} ms ({run.engine})"
            self._send_run(run, line=line, loud=bool(answer.stopped), **self._whole(run))
        self.tell("fault", {"kind": "fault", "key": answer.key, "line": answer.fault}, keep=False)
        if run is not None:
            self.details.ask(answer)
        else:
            self.tell_controls()
        for then in self.after_show:
            then(answer)

    def _show_part(self, run: Run) -> None:
        """Show what is done of a run that takes long."""
        if len(run) > 1 and run.scenario.name == self.history.base.name:
            self._send_run(run, partial=True, total=run.scenario.time.duration)

    def _send_run(self, run: Run, **more: Any) -> None:
        """Send the curves of a run to every page, then the robot at the instant that each page shows."""
        self._count += 1
        there, more = self._panels(run), more | {"n": self._count}
        made: dict[Any, bytes] = {}

        def message(window: Window = None, columns: tuple[str, ...] = ()) -> bytes:
            if (window, columns) not in made:
                made[window, columns] = pack(run_message(run, curves(run, window, columns, there=there), **more))
            return made[window, columns]

        with self._lock:
            self._last[RUN] = message
            open_now = list(self.clients)
        for client in open_now:
            client.put(RUN, message(client.window, client.columns))
        if more["partial"]:
            return
        scene = scene_of(run, self.ghosts)
        if robot := self.details.robot_of(scene):
            for client in open_now:
                row = min(round(client.time / run.scenario.time.step), len(run) - 1)
                client.put("frame", pack({"kind": "frame", "robot": robot, **frames(scene, [row])}))

    def _panels(self, run: Run) -> list[Panel]:
        """Return the panels of a run, in units that those of the pinned runs share."""
        return beside(panels(run), [panel for pin in self.pins.held for panel in pin.panels])

    def show_again(self, client: Client) -> None:
        """Send the run to one page again, whose window or columns are others now."""
        answer = self.answer
        if answer is not None and answer.run is not None:
            drawn = curves(answer.run, client.window, client.columns, there=self._panels(answer.run))
            client.put(RUN, pack(run_message(answer.run, drawn, n=self._count, **self._whole(answer.run))))

    def _whole(self, run: Run) -> Message:
        """Return what the message of a whole run says besides: where it is on the map."""
        return {"partial": False, "point": self.map.point(run.scenario), "stale": self.map.stale(run.scenario)}

    def say(self, line: str) -> None:
        """Say a line while something is compiled or takes long, also to pages that open meanwhile."""
        if line:
            self.tell("status", {"kind": "status", "line": line, "loud": False})
        else:
            self.forget("status")

    def forget(self, kind: str) -> None:
        """Do not send this to pages that open later."""
        self._last.pop(kind, None)

    def _hello(self, fresh: bool = False) -> None:
        base = self.history.base
        message = hello(base, self.answers.model(base), live=True, fresh=fresh)
        self.tell("hello", message)
        self._last["hello"] = pack(message | {"fresh": False})

    def _opened(self, client: Client) -> None:
        if "hello" not in self._last:
            self._hello()
        with self._lock:
            for slot in FIRST:
                if slot in self._last:
                    kept = self._last[slot]
                    client.put(slot, kept if isinstance(kept, bytes) else kept())
            if self.run is not None:  # the map may be newer than the run
                client.put("point", pack(self.map.where(self.run.scenario)))
            self.clients.append(client)
        if self.front:
            self.show_gallery(client, front=True)
        elif self.answer is not None:
            self.map.begin_by_itself(self.answer)

    def show_gallery(self, client: Client, front: bool = False) -> None:
        """Send one page the scenarios that ship, and then their pictures one by one."""
        client.put("gallery", pack({"kind": "gallery", "cards": cards(), "open": True, "front": front}))

        def draw() -> None:
            for name in [card["name"] for card in cards()]:
                data = picture(name)
                if client not in self.clients:
                    return
                if data:
                    client.put(f"picture {name}", data)

        threading.Thread(target=draw, name="closedloop-gallery", daemon=True).start()

    def close(self) -> None:
        """Stop all work and the server."""
        self.tell("goodbye", {"kind": "goodbye", "line": STOPPED}, keep=False)
        for work in (self.map, self.details, self._newest):
            work.close()
        clock.sleep(0.05)  # for the pages to be told
        for client in list(self.clients):
            client.close()
        self.server.close()
        sys.setswitchinterval(self._switch)
