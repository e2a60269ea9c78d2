"""The bar of the replay: play, step, loop, the next event, the instant and the speed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from closedloop.lab.playback import FASTEST, SLOWEST, Playback

PLAY, BACK, ON, EVENT = "play / pause", "step back", "step", "next event"


class PlaybackBar:
    """The bar, in the container of the page that is open while this is made.

    Parameters
    ----------
    gui : viser.GuiApi
    playback : Playback
        What it sets.
    moved : callable
        Called when the instant was set by hand.
    """

    def __init__(self, gui: Any, playback: Playback, moved: Callable[[], None]) -> None:
        self._playback, self._moved, self._step = playback, moved, 1e-3
        self.instants: list[float] = []
        self._end = 1.0
        self.buttons = gui.add_button_group("replay", (PLAY, BACK, ON, EVENT), hint="move the arm as in the run")
        self.time = gui.add_slider("time [s]", 0.0, self._end, 1e-3, 0.0, hint="instant of the run that is shown")
        self.buttons.on_click(self._clicked)
        self.time.on_update(self._sought)

    def add_settings(self, gui: Any) -> None:
        """Add speed and loop to the container of the page that is open."""
        low, high = math.log10(SLOWEST), math.log10(FASTEST)
        self.speed = gui.add_slider(
            "speed = 1x", low, high, 0.01, 0.0, hint="seconds of the run in a second",
            marks=((low, f"{SLOWEST:g}"), (-1.0, "0.1"), (0.0, "1"), (high, f"{FASTEST:g}")),
        )  # fmt: skip
        self.loop = gui.add_checkbox("loop", self._playback.loop, hint="begin anew at the end")
        self.speed.on_update(self._sped)
        self.loop.on_update(self._looped)

    def set_end(self, end: float, step: float) -> None:
        """Take over the last instant and the step of another run, s."""
        self._step = step
        if end > 0.0 and end != self._end:
            self._end = end
            self.time.max = end

    def show(self) -> None:
        """Show the instant of the replay."""
        at = min(self._playback.time, self._end)
        if self.time.value != at:
            self.time.value = at

    async def _clicked(self, event: Any) -> None:
        word = self.buttons.value
        if word == PLAY:
            (self._playback.pause if self._playback.playing else self._playback.play)()
        elif word == EVENT:
            self._playback.next_event(self.instants)
        else:
            self._playback.step(self._step if word == ON else -self._step)
        self.show()
        self._moved()

    async def _sought(self, event: Any) -> None:
        if event.client is not None:
            self._playback.pause()
            self._playback.seek(float(self.time.value))
            self._moved()

    async def _sped(self, event: Any) -> None:
        if event.client is not None:
            self._playback.set_speed(10.0 ** float(self.speed.value))
            self.speed.label = f"speed = {self._playback.speed:.2g}x"

    async def _looped(self, event: Any) -> None:
        self._playback.loop = bool(self.loop.value)
