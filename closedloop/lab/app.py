"""The lab: a scenario, the run of it as it is now, and the pages that show it.

Each kind of work has a thread of its own, and of what comes meanwhile takes the newest (`Newest`): runs, whose curves
are sent at once; what follows when the slider rests (`closedloop.lab.details`); and maps. A thread for each page takes
what it says (`closedloop.lab.actions`). The scenarios that ship are shown as cards, with a picture of the robot at its
start.
"""

import contextlib
import logging
import sys
import threading
import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from closedloop.base.errors import ClosedLoopError
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import Ghost
from closedloop.lab.answers import Answer, Answers
from closedloop.lab.controls import Changes, Control, all_controls, begin_values, rows_in_groups
from closedloop.lab.curves import Panel, beside, panels
from closedloop.lab.drawn import Message, curves, frames, pack, robot_message, run_message, space_message
from closedloop.lab.history import IN_A_FILE, History, Pins, hello, page
from closedloop.lab.server import FIRST_PORT, RUN, Client, Newest, Server, in_notebook, new_token, proxied
from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario, shipped_scenarios
from closedloop.scenario.messages import variants
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import ALL
from closedloop.simulation.prepare import prepare
from closedloop.simulation.simulate import law_name, simulate
from robot_models import RobotModel

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


def pictures() -> Iterator[tuple[str, bytes]]:
    """Yield each scenario's name and the message of its picture, of those that can be drawn."""
    for card in cards():
        data = picture(card["name"])
        if data:
            yield card["name"], data


@lru_cache(maxsize=64)
def picture(name: str) -> bytes:
    """Return the message of a scenario's picture, empty if it cannot be drawn."""
    scenario = load_scenario(name)
    step = scenario.time.step
    try:
        few = scenario.time.model_copy(update={"duration": STEPS * step})
        run = simulate(scenario.model_copy(update={"time": few}))
        scene = scene_of(run)
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


class Lab:
    """A lab of one scenario, served to a browser.

    `law`: a user's law, see `closedloop.simulate`.
    `port`: the next free one is taken if it is in use.
    `dark`: whether the page is dark, whatever the system prefers.
    `front`: whether the page begins with the scenarios that ship, to choose one.
    `ghosts`: bodies that are shown beside those of each run, until another scenario is chosen.
    `act`, `details`, `map_work`: the parts that know the whole: `closedloop.lab.actions.act`,
        `closedloop.lab.details.Details`, `closedloop.lab.mapping.MapWork`; see `closedloop.lab.start.begun`.
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
        self.answer: Answer | None = None
        self.after_show: list[Callable[[Answer], None]] = []
        self.folder: Path | None = None
        self.pins, self.front = Pins(), front
        self.clients: list[Client] = []
        self._last: dict[str, bytes | Callable[[], bytes]] = {}
        self._lock, self._count, self._dark = threading.RLock(), 0, dark
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(min(SWITCH, self._switch))
        self._begin(history, law, model)
        self.ghosts: tuple[Ghost, ...] = tuple(ghosts)
        prepare(history.base, self.answers.model(history.base))  # what cannot be run is refused before there is a page
        self.details, self.map = details(self), map_work(self)
        self._newest: Newest[Asked, tuple[Answers, Answer]] = Newest(self._compute, self._show)
        self._token = new_token()
        theme = "dark" if dark else ""
        self.server = Server(
            host, port, self._token,
            lambda nonce: page(f"closedloop: {self.history.base.name}", theme=theme, nonce=nonce), self._opened,
            lambda client, message: act(self, client, message), self._closed, framed=in_notebook(),
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
    def url(self) -> str:
        """The address of the page, with the token that lets in."""
        host = self.server.host
        host = "127.0.0.1" if host == "0.0.0.0" else f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.server.port}/?token={self._token}"

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
        answer = self.answer
        message = {
            "kind": "controls", "groups": groups, "undo": bool(history.past), "redo": bool(history.future),
            "forced": forced, "changed": len(history.changes), "note": UNSAVED if history.name == IN_A_FILE else "",
        }  # fmt: skip
        if answer is not None and answer.run is not None:
            message |= {"command": self.command(answer), "scenario": answer.run.scenario.to_toml()}
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

    def _compute(self, request: Asked) -> tuple[Answers, Answer]:
        answers, changes, key = request
        return answers, answers.answer(changes, key)

    def _show(self, found: tuple[Answers, Answer]) -> None:
        answers, answer = found
        if answers is not self.answers:
            return  # of a scenario that was left meanwhile
        run = answer.run if answer.run is not None and len(answer.run) else None
        if run is not None:
            self.answer = answer
            steps = max(0, len(run) - 1)
            line = answer.stopped or f"{steps} steps in {1e3 * answer.seconds:.0f} ms ({run.engine})"
            self._send_run(run, line=line, loud=bool(answer.stopped), partial=False,
                           point=self.map.point(run.scenario), stale=self.map.stale(run.scenario))  # fmt: skip
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
            found = run_message(
                answer.run, curves(answer.run, client.window, client.columns, there=self._panels(answer.run)),
                n=self._count, partial=False,
                point=self.map.point(answer.run.scenario), stale=self.map.stale(answer.run.scenario),
            )  # fmt: skip
            client.put(RUN, pack(found))

    def say(self, line: str) -> None:
        """Say a line while something is compiled or takes long, also to pages that open meanwhile."""
        if line:
            self.tell("status", {"kind": "status", "line": line, "loud": False})
        else:
            self.forget("status")

    def tell(self, slot: str, message: Message, keep: bool = True) -> None:
        """Send a message to every page, and to those that open later if it is to be kept."""
        data = pack(message)
        with self._lock:  # a page that opens now has it among what is kept, or is sent it
            if keep:
                self._last[slot] = data
            for client in list(self.clients):
                client.put(slot, data)

    def forget(self, *slots: str) -> None:
        """Do not send these to pages that open later."""
        for slot in slots:
            self._last.pop(slot, None)

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
            if self.answer is not None and self.answer.run is not None:  # the map may be newer than the run
                client.put("point", pack(self.map.where(self.answer.run.scenario)))
            self.clients.append(client)
        if self.front:
            self.show_gallery(client, front=True)
        elif self.answer is not None:
            self.map.begin_by_itself(self.answer)

    def _closed(self, client: Client) -> None:
        if client in self.clients:
            self.clients.remove(client)

    def show_gallery(self, client: Client, front: bool = False) -> None:
        """Send one page the scenarios that ship, and then their pictures one by one."""
        client.put("gallery", pack({"kind": "gallery", "cards": cards(), "open": True, "front": front}))

        def draw() -> None:
            for name, data in pictures():
                if client not in self.clients:
                    return
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
