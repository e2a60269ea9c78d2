"""The tabs of the lab: a control of viser for each control of the scenario, and a line beside the one at fault."""

from __future__ import annotations

import html
import math
from collections.abc import Callable
from typing import Any

from closedloop.lab.controls import TABS, Control, controls
from closedloop.scenario.scenario import Scenario, families
from robot_models import RobotModel


class Tabs:
    """The tabs with the controls of a scenario.

    Parameters
    ----------
    gui : viser.GuiApi
    group : viser.GuiTabGroupHandle
    changed : callable
        Takes a key and its new value, None: left out, when a control is moved.
    """

    def __init__(self, gui: Any, group: Any, changed: Callable[[str, Any], None]) -> None:
        self._gui, self._changed = gui, changed
        self._tabs = {name: group.add_tab(name) for name in TABS}
        self._folders: dict[str, Any] = {}
        self._held: dict[str, list[tuple[Control, Any]]] = {}
        self._notes: dict[str, Any] = {}

    def show(self, scenario: Scenario, model: RobotModel) -> None:
        """Show the values of a scenario; a section whose keys changed is made anew."""
        for tab, sections in TABS.items():
            for section in sections:
                wanted = controls(scenario, section, model)
                held = self._held.get(section)
                if held is None and not wanted:
                    continue  # a list without a table
                if held is None or not all(map(_can_show, (c for c, _ in held), wanted)) or len(held) != len(wanted):
                    self._make(tab, section, wanted)
                else:
                    for at, new in enumerate(wanted):
                        self._set(section, at, new.value)

    def note(self, key: str, line: str) -> None:
        """Show a line beside the control of a key; "": take all lines away."""
        for note in self._notes.values():
            if note.visible:
                note.visible = False
        section = key.partition(".")[0]
        if not line or section not in self._notes:
            return
        note = self._notes[section]
        last = next((handle for control, handle in reversed(self._held[section]) if control.key == key), None)
        if last is not None:
            note.order = last.order + 0.5
        note.content = f'<div style="color:#D55E00;font-size:0.8em;padding:0 0.6em">{html.escape(line)}</div>'
        note.visible = True

    def handle(self, key: str, index: int | None = None) -> Any:
        """Return the viser control of a key, for tests and the benchmark."""
        held = self._held[key.partition(".")[0]]
        return next(handle for control, handle in held if (control.key, control.index) == (key, index))

    def _make(self, tab: str, section: str, wanted: list[Control]) -> None:
        folder = self._folders.get(section)
        if folder is None:
            with self._tabs[tab]:
                folder = self._folders[section] = self._gui.add_folder(section if len(TABS[tab]) > 1 else None)
        else:
            for _, handle in self._held[section]:
                handle.remove()
            self._notes[section].remove()
        with folder:
            self._held[section] = [(control, self._add(section, at, control)) for at, control in enumerate(wanted)]
            self._notes[section] = self._gui.add_html("", visible=False)

    def _add(self, section: str, at: int, control: Control) -> Any:
        gui, hint = self._gui, control.hint or None
        if control.form == "choice":
            handle = gui.add_dropdown(control.caption, control.options, initial_value=control.shown, hint=hint)
        elif control.form == "flag":
            handle = gui.add_checkbox(control.caption, control.shown, hint=hint)
        elif control.form == "text":
            handle = gui.add_text(control.caption, control.shown, hint=hint)
        elif control.form == "whole":
            handle = gui.add_slider(control.caption, int(control.low), int(control.high), 1, control.shown, hint=hint)
        else:
            handle = gui.add_slider(
                control.caption,
                control.low,
                control.high,
                control.step,
                control.shown,
                hint=hint,
                marks=_marks(control),
            )

        # Asynchronous, so that the events of a drag are taken in their order.
        async def moved(event: Any) -> None:
            if event.client is not None:  # else it was set from here
                self._moved(section, at, handle)

        handle.on_update(moved)
        return handle

    def _moved(self, section: str, at: int, handle: Any) -> None:
        if at >= len(self._held[section]) or self._held[section][at][1] is not handle:
            return  # a control that has just been replaced
        control, _ = self._held[section][at]
        try:
            value = control.read(handle.value)
        except (ValueError, OverflowError) as error:
            self.note(control.key, str(error))
            return
        if control.form == "text" and control.key in families():
            return  # no browser names code to be imported
        for k, (other, _) in enumerate(self._held[section]):
            if other.key == control.key and value is not None:
                self._set(section, k, value, but=handle)
        self._changed(control.key, value)

    def _set(self, section: str, at: int, value: Any, but: Any = None) -> None:
        """Let a control show a value; that of `but` is being moved, and only its label is set."""
        control, handle = self._held[section][at]
        value = list(value) if isinstance(value, tuple) and control.index is not None else value
        if value == control.value:
            return
        changed = control.with_value(value)
        self._held[section][at] = (changed, handle)
        if changed.caption != control.caption:
            handle.label = changed.caption
        if handle is but:
            return
        if (changed.low, changed.high) != (control.low, control.high):
            handle.min, handle.max = changed.low, changed.high
        if handle.value != changed.shown:
            handle.value = changed.shown


def _marks(control: Control) -> tuple[tuple[float, str], ...] | None:
    """Return the marks below a logarithmic slider, three at least; None: viser's own two, its ends."""
    if control.form != "log":
        return None
    powers = range(math.ceil(control.low - 1e-9), math.floor(control.high + 1e-9) + 1)
    if len(powers) > 2:
        return tuple((float(k), f"{10.0**k:g}") for k in powers)
    return tuple((k, f"{10.0**k:.2g}") for k in (control.low, 0.5 * (control.low + control.high), control.high))


def _can_show(held: Control, wanted: Control) -> bool:
    """Whether a control can show the value of another without being made anew."""
    sliders = {"linear", "log"}
    same_form = held.form == wanted.form or {held.form, wanted.form} == sliders
    same = (held.key, held.index, held.options) == (wanted.key, wanted.index, wanted.options)
    if held.form == wanted.form == "linear":
        same = same and (held.low < 0.0) == (wanted.low < 0.0)
    return same and same_form and (held.form != "log" or wanted.own > 0.0)
