"""A served simulation in the browser: the lab's page shows its latest seconds as they come, and at the end all of it.

The page only shows: it moves nothing, and what it asks for is another part of the time or another column.
"""

import sys
import threading
import time
from typing import Any

from closedloop.figures.scene.scene import scene_of
from closedloop.lab.curves import tiles
from closedloop.lab.drawn import Rows, curves, robot_message, run_message, space_message, spread
from closedloop.lab.history import hello
from closedloop.lab.server import FIRST_PORT, Client
from closedloop.lab.shown import Shown
from closedloop.record.run import Run
from closedloop.serve.session import Session

# The part of the run that is shown while it goes on, s of its own time, and how often, s.
LATEST, OFTEN = 5.0, 0.1
# It takes no larger part of the processor's time than one over this: the simulation is served by the same process.
SHARE = 10.0
# How soon the thread that draws leaves the interpreter to the one that serves, s; Python's own is 5 ms.
SWITCH = 5e-4
GOES_ON = "it is served, and goes on: its last {:g} s, without what is known only at its end"


class Watch:
    """The lab's page of a session, from now until `finish`.

    `url`, str: its address, with the token that lets in.
    Raises OutputError if it cannot listen there.
    """

    def __init__(self, session: Session, *, port: int = FIRST_PORT) -> None:
        self._session, problem = session, session.problem
        self._rows = max(2, round(LATEST / problem.h))
        self._run: Run | None = None
        self._count, self._done = 0, False
        self._switch = sys.getswitchinterval()
        self._page = Shown(f"closedloop: {problem.scenario.name}", port=port, run=self._message)
        self.url = self._page.url
        sys.setswitchinterval(min(SWITCH, self._switch))
        about = {"scenario": problem.scenario.to_toml(), "command": ""}
        self._page.tell("hello", hello(problem.scenario, problem.robot.model, live=False) | about)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="closedloop-watch", daemon=True)
        self._thread.start()

    def finish(self, run: Run, line: str) -> None:
        """Show the whole run, with the line that says where it is, and close the page."""
        self._ended.set()
        self._thread.join()
        sys.setswitchinterval(self._switch)
        if len(run):
            self._done, summary = True, run.summary()
            self._page.tell("strip", {"tiles": tiles(run, summary)})
            self._show(run, spread(run), summary["clearance"])
        self._page.tell("goodbye", {"line": line})
        self._page.close()

    def _follow(self) -> None:
        """Show the latest rows again and again, where somebody looks and there are others than before."""
        took, last = 0.0, (-1.0, -1)
        while not self._ended.wait(max(OFTEN, (SHARE - 1.0) * took)):
            run = self._session.latest(self._rows) if self._page.watched else None
            if run is None or (float(run.time[-1]), len(run)) == last:
                continue
            began, last, loaded = time.thread_time(), (float(run.time[-1]), len(run)), self._run is not None
            self._show(run, [len(run) - 1])
            took = time.thread_time() - began if loaded else 0.0  # at first the shapes of the arm are read

    def _show(self, run: Run, rows: Rows, passing: dict[str, Any] | None = None) -> None:
        self._count += 1
        scene, first = scene_of(run), self._run is None
        self._run = run
        if first:
            self._page.tell("robot", robot_message(scene) | {"robot": 1})
        self._page.tell("space", space_message(scene, rows, passing) | {"robot": 1})
        self._page.tell_run()

    def _message(self, client: Client) -> dict[str, Any] | None:
        run = self._run
        if run is None:
            return None
        drawn = curves(run, client.window if self._done else None, client.columns)
        line = f"{len(run) - 1} steps, served" if self._done else GOES_ON.format(LATEST)
        return run_message(run, drawn, n=self._count, partial=not self._done, follow=not self._done, line=line) | (
            {} if self._done else {"stopped": ""}
        )
