"""The tab "view" of the lab: speed and loop of the replay, what is drawn, how long the arrows are, light or dark."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from closedloop.figures.scene.scene import ARROWS, JOINTS, LOOP, TOUCH, Scene
from closedloop.lab.look import MEANINGS
from closedloop.lab.view_playback import PlaybackBar
from closedloop.lab.view_space import Space

EVENTS = "a dot where the tip touches down, lifts off, sticks ..."
DRAWN = (*ARROWS, JOINTS, "actual path", "desired path", "events")


class ViewTab:
    """The tab.

    Parameters
    ----------
    gui : viser.GuiApi
    tab : viser.GuiTabHandle
    bar : PlaybackBar
        Its speed and loop are here.
    dark : bool
        Whether the page begins dark.
    """

    def __init__(self, gui: Any, tab: Any, bar: PlaybackBar, dark: bool) -> None:
        self._gui = gui
        self._space: Space | None = None
        self._redraw: Callable[[], None] = lambda: None
        self._tell_scale: Callable[[], None] = lambda: None
        with tab:
            bar.add_settings(gui)
            self._scale = gui.add_slider(
                "arrows", -5.0, 1.0, 0.01, -2.0, hint="length of the arrows in space",
                marks=((-4.0, "0.1 mm/N"), (-2.0, "10 mm/N"), (0.0, "1 m/N")),
            )  # fmt: skip
            self._switches = {
                name: gui.add_checkbox(name, True, hint=f"whether it is drawn: {MEANINGS.get(name, EVENTS)}")
                for name in DRAWN
            }
            self._through = gui.add_checkbox(
                "see through", False, hint="draw the links that hide forces on them so that these are seen"
            )
            self._dark = gui.add_checkbox("dark", dark, hint="light on dark instead of dark on light")
        self._scale.on_update(self._scaled)
        self._dark.on_update(self._themed)
        self._through.on_update(self._made_clear)
        for name, switch in self._switches.items():
            switch.on_update(self._switched(name, switch))

    def connect(self, space: Space, redraw: Callable[[], None], scaled: Callable[[], None]) -> None:
        """Set what is drawn where; `redraw` draws the present instant again, `scaled` is told of another scale."""
        self._space, self._redraw, self._tell_scale = space, redraw, scaled

    def see_through(self, through: bool) -> None:
        """Draw the links that hide forces so that these are seen, or not, as the switch does."""
        if self._space is not None:
            self._through.value = through
            self._space.see_through(through)

    def show_scene(self, scene: Scene) -> None:
        """Show the length of the arrows, that of 10 N, and the switches of what this scene has."""
        for name, drawn in ((LOOP, scene.joined.loops), (JOINTS, scene.joined.loops), (TOUCH, scene.touching)):
            if self._switches[name].visible != bool(drawn):
                self._switches[name].visible = bool(drawn)
        if self._space is None or self._space.metres_per_newton is None:
            return
        self._scale.label = f"10 N = {10.0 * self._space.metres_per_newton:.2g} m"
        if abs(10.0**self._scale.value - self._space.metres_per_newton) > 1e-2 * self._space.metres_per_newton:
            self._scale.value = min(max(math.log10(self._space.metres_per_newton), -5.0), 1.0)

    async def _scaled(self, event: Any) -> None:
        if event.client is not None and self._space is not None:
            self._space.metres_per_newton = 10.0 ** float(self._scale.value)
            self._scale.label = f"10 N = {10.0 * self._space.metres_per_newton:.2g} m"
            self._redraw()
            self._tell_scale()

    async def _themed(self, event: Any) -> None:
        configure(self._gui, bool(self._dark.value))

    async def _made_clear(self, event: Any) -> None:
        if self._space is not None:
            self._space.see_through(bool(self._through.value))

    def _switched(self, name: str, switch: Any) -> Callable[[Any], Any]:
        async def switched(event: Any) -> None:
            if self._space is not None:
                self._space.hide(name, not switch.value)
                self._redraw()

        return switched


def configure(gui: Any, dark: bool) -> None:
    """Set the look of the page."""
    gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
