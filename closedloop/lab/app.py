"""The lab: everything on the page, and what happens when something on it is moved.

Three threads share the work: viser's takes what the browser sends, one computes runs (`Newest`) and shows their curves,
one moves the replay and draws in space.
"""

from __future__ import annotations

import contextlib
import html
import io
import logging
import threading
import time as clock
from collections.abc import Callable
from typing import Any

from closedloop.base.errors import ClosedLoopError
from closedloop.lab.answers import Answer, Answers
from closedloop.lab.history import Changes, History
from closedloop.lab.kinds import begin_values
from closedloop.lab.look import GREYED, KEYS, PLOTS, paragraph
from closedloop.lab.newest import Newest
from closedloop.lab.picture import Picture
from closedloop.lab.playback import Playback
from closedloop.lab.server import FIRST_PORT, new_token, serve
from closedloop.lab.view_controls import Tabs
from closedloop.lab.view_keep import STEPS, KeepTab
from closedloop.lab.view_map import MapTab
from closedloop.lab.view_playback import PlaybackBar
from closedloop.lab.view_plots import Plots
from closedloop.lab.view_settings import ViewTab, configure
from closedloop.lab.view_space import Space
from closedloop.record.run import Run
from closedloop.scenario.messages import variants
from closedloop.simulation.prepare import prepare
from robot_models import RobotModel

logger = logging.getLogger(__name__)

# Frames of the replay, and movements of the plots' cursor, in a second.
FRAMES, CURSORS = 30.0, 12.0
WIDTH = 510  # px of the panel on the right
# A result that has been overtaken for so long, s, is greyed until the new one is there: sooner it would flicker.
GREYED_AFTER = 0.25
LONGEST = 100  # characters of a fault at the top; it stands in full beside its control


class Lab:
    """A lab of one scenario, served to a browser.

    Parameters
    ----------
    history : History
        The scenario and its changes.
    law : callable, optional
        A user's law, see `closedloop.simulate`.
    model : RobotModel, optional
        The robot to use instead of loading the scenario's.
    host : str
        Address to listen on.
    port : int
        The next free one is taken if it is in use.
    dark : bool
        Whether the page begins dark.

    Raises
    ------
    ScenarioError, ModelError
        If the scenario that it begins with is at fault.
    OutputError
        If it cannot listen there.
    """

    def __init__(
        self, history: History, *, law: Any = None, model: RobotModel | None = None, host: str = "127.0.0.1",
        port: int = FIRST_PORT, dark: bool = False,
    ) -> None:  # fmt: skip
        self.history, self.playback = history, Playback()
        self.answer: Answer | None = None
        self._closed, self._shown_at = threading.Event(), 0.0
        self._waits_since: float | None = None  # the instant of the first change that is not shown yet
        self._greyed, self._said, self._waiting = False, "", threading.Lock()
        self.after_show: list[Callable[[Answer], None]] = []
        self.answers = Answers(history, law, model, self._say, lambda: self._newest.overtaken)
        prepare(history.base, self.answers.model(history.base))  # what cannot be run is refused before there is a page
        self._token = new_token()
        self.server = serve(host, port, self._token)
        self._lay_out(dark)
        self._newest: Newest[tuple[Changes, str], Answer] = Newest(self._compute, self._show)
        self.refresh()
        self.ask("")
        self._player = threading.Thread(target=self._play, name="closedloop-replay", daemon=True)
        self._player.start()

    @property
    def url(self) -> str:
        """The address of the page, with the token that lets in."""
        host = self.server.get_host()
        host = "127.0.0.1" if host == "0.0.0.0" else f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.server.get_port()}/?token={self._token}"

    @property
    def space(self) -> Space:
        """What is drawn in space."""
        return self.picture.space

    @property
    def run(self) -> Run | None:
        """The run shown."""
        return None if self.answer is None else self.answer.run

    def command(self, answer: Answer) -> str:
        """Return the command line that repeats the run of an answer."""
        engine = "compiled" if answer.run is None else answer.run.engine
        return self.history.command(answer.changes, engine)

    def _lay_out(self, dark: bool) -> None:
        gui = self.server.gui
        configure(gui, dark)
        gui.set_panel_label(f"closedloop: {self.history.base.name}")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self.caption = gui.add_html("")
        self.status = gui.add_html("")
        gui.add_html(KEYS)
        self.bar = PlaybackBar(gui, self.playback, self._moved)
        self.steps = gui.add_button_group("changes", STEPS, hint="take back the last change, or all of them")
        self.group = gui.add_tab_group()
        self.tabs = Tabs(gui, self.group, self.changed)
        self.view = ViewTab(gui, self.group.add_tab("view"), self.bar, dark)
        kept, mapped = self.group.add_tab("keep"), self.group.add_tab("map")
        panel = gui.add_panel()
        with panel.add_tab("plots"):
            gui.add_html(paragraph(PLOTS))
            self.plots = Plots(gui)
        panel.dock_below(gui.main_panel)
        self.picture = Picture(self.server, self.history.base, self.playback, self.view, self.caption, WIDTH)
        self.keep, self.map = KeepTab(self, kept), MapTab(self, mapped)

    def changed(self, key: str, value: Any) -> None:
        """Take a change of a control, and run the scenario with it."""
        more = {}
        section, _, name = key.partition(".")
        if name == "kind" and value in variants(section):
            with contextlib.suppress(ClosedLoopError):  # what is at fault is said by the run
                more = begin_values(self.history.scenario(), section, value)
        self.history.change(key, value, more)
        self.ask(key)
        if more or name == "kind" or key == "surface.contact":  # which changes what other controls may show
            self.refresh()

    def refresh(self) -> None:
        """Let all controls show the scenario as it is now, if it can be read."""
        with contextlib.suppress(ClosedLoopError):
            scenario = self.history.scenario()
            self.tabs.show(scenario, self.answers.model(scenario))
            self.map.show_keys()

    def ask(self, key: str = "") -> None:
        """Run the scenario as it is now, `key` being what was changed last."""
        with self._waiting:
            if self._waits_since is None:
                self._waits_since = clock.perf_counter()
            self._newest.ask((self.history.changes, key))

    def wait(self, seconds: float = 60.0) -> bool:
        """Wait until the newest change is shown, in the plots and in space; return whether it is."""
        return self.wait_for_plots(seconds) and self.picture.wait(seconds)

    def wait_for_plots(self, seconds: float = 60.0) -> bool:
        """Wait until the plots of the newest change are on their way; return whether they are."""
        return self._newest.wait(seconds)

    def _compute(self, request: tuple[Changes, str]) -> Answer:
        return self.answers.answer(*request)

    def _show(self, answer: Answer) -> None:
        with self._waiting:
            self._waits_since = clock.perf_counter() if self._newest.overtaken else None
            self._greyed, self._said = False, ""
        with self.server.atomic():
            self._show_line(answer)
            if answer.run is not None and len(answer.run):
                self.answer = answer
                self._show_run(answer.run)
        self.server.flush()
        if answer.run is not None and len(answer.run):
            self.picture.ask(answer.run)
        for then in self.after_show:
            then(answer)

    def _show_run(self, run: Run) -> None:
        self.playback.set_end(float(run.time[-1]))
        self.bar.set_end(self.playback.end, run.scenario.time.step)
        self.bar.instants = [event.time for event in run.events]
        self.plots.show_run(run, self.playback.time)
        self.bar.show()

    def _show_line(self, answer: Answer) -> None:
        self.tabs.note(answer.key, answer.fault)
        if answer.fault:
            short = answer.fault if len(answer.fault) <= LONGEST else f"{answer.fault[:LONGEST]} ..."
            self._set_status(f"not run: {short}", "#D55E00")
        elif answer.stopped:
            self._set_status(answer.stopped, "#D55E00")
        elif answer.run is not None:
            steps = max(0, len(answer.run) - 1)
            self._set_status(f"{steps} steps in {1e3 * answer.seconds:.0f} ms ({answer.run.engine})", "inherit")

    def _say(self, line: str) -> None:
        """Say a line while something is compiled or takes long."""
        if line:
            self._said = line
            self._set_status(line, "#D55E00")

    def _set_status(self, line: str, colour: str) -> None:
        style = f"padding:0.3em 0.8em;font-size:0.85em;color:{colour}"
        said = f'<div id="closedloop-status" style="{style}">{html.escape(line)}</div>'
        self.status.content = said + (GREYED if self._greyed else "")

    def _grey_if_late(self, now: float) -> None:
        """Grey what is shown if the run that is to replace it takes long."""
        with self._waiting:
            if self._greyed or self._waits_since is None or now - self._waits_since < GREYED_AFTER:
                return
            self._greyed = True
            line = self._said or ("computing ...; what is shown is the run before" if self.run else "computing ...")
            self._set_status(line, "#D55E00" if self._said else "grey")

    def _moved(self) -> None:
        """Show the instant that the replay was moved to."""
        with self.server.atomic():
            self.plots.move_cursor(self.playback.time)
        self.picture.move()

    def _play(self) -> None:
        last = cursor = clock.perf_counter()
        while not self._closed.wait(1.0 / FRAMES):
            now = clock.perf_counter()
            moved = self.playback.advance(now - last)
            last = now
            self._grey_if_late(now)
            try:
                self.picture.follow(now)
                if not moved or self.run is None:
                    continue
                self.picture.move()
            except Exception:  # the thread goes on: it moves the replay as well
                logger.exception("a run could not be drawn in space")
            if now - cursor > 1.0 / CURSORS or not self.playback.playing:
                cursor = now
                with self.server.atomic():
                    self.plots.move_cursor(self.playback.time)
                    self.bar.show()

    def close(self) -> None:
        """Stop all work and the server."""
        self._closed.set()
        for work in (self.map, self.keep, self._newest):
            work.close()
        self._player.join(2.0)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
