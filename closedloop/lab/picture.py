"""The picture in space beside the plots: when it shows another run, and where it is seen from at first.

The plots go to the page first and alone: viser's page draws them at once then, while whatever is in space waits for a
frame, and all that comes after it too. Where a frame takes long, as without a graphics processor, a picture for each
movement of a slider would make the plots wait. So it follows when the slider rests, and while it moves now and then, if
the page is not late with what the slider does next.
"""

from __future__ import annotations

import threading
import time as clock
from typing import Any

import numpy as np

from closedloop.figures.scene.scene import ARROWS, scene_of
from closedloop.lab.look import caption
from closedloop.lab.playback import Playback
from closedloop.lab.view_settings import ViewTab
from closedloop.lab.view_space import Space
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario

# Where the scene is seen from at first, in radii of what is drawn from its middle, and how wide, rad.
VIEW_FROM, FIELD_OF_VIEW = np.array([2.4, -1.25, 1.15]), float(np.deg2rad(40.0))
# A run is drawn when no other has come for so long, s, or the last was drawn so long ago. While a slider moves, the
# page is late if the second run after the picture comes only so long after it (the first may have been asked for
# before), and for so long it is not tried again.
REST, EVERY, LATE, AGAIN = 0.4, 1.0, 0.2, 15.0


class Picture:
    """The picture in space.

    Parameters
    ----------
    server : viser.ViserServer
    base : Scenario
        What is described until there is a run.
    playback : Playback
        Its instant is shown.
    view : ViewTab
        The tab that sets how it is drawn.
    below : viser.GuiHtmlHandle
        Takes what stands below the picture.
    panel : int
        Width of the panel beside it, px.
    """

    def __init__(self, server: Any, base: Scenario, playback: Playback, view: ViewTab, below: Any, panel: int) -> None:
        self._server, self._base, self._playback, self._view = server, base, playback, view
        self._below, self._panel, self._seen = below, panel, False
        self._changed = threading.Condition()
        self._waiting: Run | None = None
        self._asked = self._shown = 0.0
        self._late, self._since_picture = -AGAIN, 0
        self.space = Space(server.scene)
        view.connect(self.space, self.move, self.tell)
        server.on_client_connect(_fit)

    def ask(self, run: Run) -> None:
        """Show another run as soon as `follow` finds that it may be shown."""
        with self._changed:
            self._waiting, self._asked = run, clock.perf_counter()
            self._since_picture += 1
            if self._since_picture == 2 and self._asked - self._shown > LATE:
                self._late = self._asked

    def follow(self, now: float) -> None:
        """Show the run that waits, if it is time for it at an instant of `time.perf_counter`, s."""
        run, rests = self._waiting, now - self._asked >= REST
        again = self._playback.playing or (now - self._shown >= EVERY and now - self._late >= AGAIN)
        if run is None or not (rests or again):
            return
        self._shown, self._since_picture = now, 2 if rests else 0  # after a rest anything may come late
        try:
            with self._server.atomic():
                self._show(run)
        finally:
            with self._changed:
                if self._waiting is run:
                    self._waiting = None
                self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        """Wait until the newest run is shown; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._waiting is None, seconds)

    def move(self) -> None:
        """Show the instant of the replay."""
        if self.space.scene is not None:
            with self._server.atomic():
                self.space.move(self._row(self.space.scene.run))

    def tell(self) -> None:
        """Say below the picture what it shows."""
        scene = self.space.scene
        scenario, kinds = (self._base, tuple(ARROWS)) if scene is None else (scene.run.scenario, scene.kinds)
        changed = scenario != self._base
        text = caption(scenario, changed, kinds, self.space.metres_per_newton, self._panel)
        if self._below.content != text:
            self._below.content = text

    def _show(self, run: Run) -> None:
        scene = scene_of(run)
        self.space.show_scene(scene, self._row(run))
        self._view.show_scene(scene)
        self.tell()
        if not self._seen:
            self._seen = True
            self._view.see_through(scene.arm_hides_force)
            middle, radius = scene.ball
            camera = self._server.initial_camera
            camera.fov, camera.look_at = FIELD_OF_VIEW, middle
            camera.position = middle + radius * VIEW_FROM

    def _row(self, run: Run) -> int:
        """Return the row of a run at the instant of the replay."""
        return int(min(round(self._playback.time / run.scenario.time.step), len(run) - 1))


async def _fit(client: Any) -> None:
    """Let a browser in which the panel leaves a narrow view see the arm from further off, once."""
    fitted = False

    async def look(camera: Any) -> None:
        nonlocal fitted
        if not fitted and camera.aspect < 1.0:
            fitted = True
            camera.position = camera.look_at + (camera.position - camera.look_at) / max(camera.aspect, 0.3)

    client.camera.on_update(look)
