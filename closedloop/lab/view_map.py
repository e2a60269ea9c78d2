"""The tab "map" of the lab: a value of the run against two keys; a click on a cell loads its run."""

from __future__ import annotations

import base64
import html
import io
import re
import threading
import time as clock
from typing import Any

from closedloop.base.errors import ClosedLoopError, one_line
from closedloop.lab.controls import TABS, Control, controls
from closedloop.lab.for_tabs import LabForTabs
from closedloop.lab.history import Changes
from closedloop.lab.look import MAP, paragraph
from closedloop.lab.map_picture import MapPicture, Picture
from closedloop.lab.mapping import Axis, Map
from closedloop.lab.newest import Newest
from closedloop.record.report.measures import MEASURES

USUAL = "peak_contact_force"
# The map is drawn again after so long at the earliest while it fills in, s: to draw it takes time from the runs.
REDRAWN = 0.4
# viser has no picture that can be clicked: this writes the cell into the text field "cell", as if it were typed.
CLICK = """(function(e){
var b=e.target.getBoundingClientRect(),x=(e.clientX-b.left)/b.width,y=(e.clientY-b.top)/b.height,a=%s;
var c=Math.floor((x-a[0])/(a[1]-a[0])*%d),r=Math.floor((a[3]-y)/(a[3]-a[2])*%d);
if(c<0||r<0||c>=%d||r>=%d)return;
var i=Array.from(document.querySelectorAll('input')).find(function(i){return i.value.indexOf('cell')===0});
if(!i)return;
Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(i,'cell '+r+', '+c);
i.dispatchEvent(new Event('input',{bubbles:true}));})(event)"""


class MapTab:
    """The tab, in a lab that is laid out.

    Parameters
    ----------
    lab : LabForTabs
        The lab.
    tab : viser.GuiTabHandle
    """

    def __init__(self, lab: LabForTabs, tab: Any) -> None:
        self._lab, gui = lab, lab.server.gui
        self._stop = threading.Event()
        self._drawing = threading.Lock()
        self.map: Map | None = None
        self._picture: MapPicture | None = None
        self._before: Changes = {}
        self._controls: dict[str, Control] = {}
        self._work: Newest[Map, None] = Newest(self._fill, lambda nothing: None)
        with tab:
            gui.add_html(paragraph(MAP))
            self.x = gui.add_dropdown("across", ("-",), hint="the key along the map")
            self.y = gui.add_dropdown("up", ("-",), hint="the key up the map")
            self.quantity = gui.add_dropdown("value", tuple(MEASURES), initial_value=USUAL, hint="what the map shows")
            self.buttons = gui.add_button_group("map", ("compute", "stop"))
            self.said = gui.add_html("")
            self.image = gui.add_html("")
            self.cell = gui.add_text("cell", "cell -", hint="row, column of the run to load: click on the map")
        self.buttons.on_click(lambda event: self.press(self.buttons.value))
        self.cell.on_update(lambda event: self.open_cell(str(self.cell.value)) if event.client is not None else None)

    def show_keys(self) -> None:
        """Offer the keys of the scenario as it is now."""
        scenario = self._lab.history.scenario()
        model = self._lab.answers.model(scenario)
        found = [c for tab in TABS.values() for section in tab for c in controls(scenario, section, model)]
        self._controls = {_name(c): c for c in found if c.form in ("linear", "log") and not c.key.startswith("start.")}
        names = tuple(self._controls)
        # A gain, say, rather than an instant or a period, of which most values do not fit the step.
        over_decades = next((n for n, c in self._controls.items() if c.form == "log" and c.unit != "s"), names[-1])
        for handle, usual in ((self.x, names[0]), (self.y, over_decades)):
            chosen = handle.value if handle.value in names else usual
            if handle.options != names:
                handle.options = names
            if handle.value != chosen:
                handle.value = chosen

    def press(self, word: str) -> None:
        """Compute the map of the two keys chosen, or stop."""
        self._stop.set()
        if word == "stop":
            return
        x, y = self._controls.get(str(self.x.value)), self._controls.get(str(self.y.value))
        if x is None or y is None or x is y or self.quantity.value not in MEASURES:
            self._say("choose two different keys")
            return
        try:
            self._before = dict(self._lab.history.changes)
            scenario = self._lab.history.scenario()
            model = self._lab.answers.model(scenario)
        except ClosedLoopError as error:
            self._say(one_line(str(error)))
            return
        if self._lab.answers.law is not None:
            self._say("a map needs a law that is a class: batches take no function")
            return
        self._work.ask(Map(scenario, Axis.of(x), Axis.of(y), str(self.quantity.value), model))

    def wait(self, seconds: float) -> bool:
        """Wait until the map is complete or stopped; return whether it is."""
        return self._work.wait(seconds)

    def open_cell(self, text: str) -> None:
        """Load the run of a cell, given as row and column."""
        numbers = [int(word) for word in re.findall(r"\d{1,4}", text)]
        if self.map is None or len(numbers) != 2:
            return
        row, column = numbers
        if not (row < self.map.grid.shape[0] and column < self.map.grid.shape[1]):
            return
        self._lab.history.set_all(self.map.changes(row, column, self._before))
        self._lab.refresh()
        self._lab.ask()
        self._show(True, (row, column))
        if why := self.map.reasons.get((row, column)):
            self._say(why)

    def _fill(self, wanted: Map) -> None:
        self._stop.clear()
        self.map, self._picture, total, drawn = wanted, MapPicture(wanted), wanted.grid.size, 0.0
        began = clock.perf_counter()
        try:
            for done in wanted.fill(lambda: self._stop.is_set() or self._work.overtaken):
                failed = f", {len(wanted.reasons)} were refused or stopped (grey)" if wanted.reasons else ""
                if done == total or clock.perf_counter() - drawn > REDRAWN:
                    self._say(f"{done} of {total} runs in {clock.perf_counter() - began:.1f} s{failed}")
                    self._show(done == total)
                    drawn = clock.perf_counter()
        except ClosedLoopError as error:
            self._say(one_line(str(error)))

    def _show(self, complete: bool, chosen: tuple[int, int] | None = None) -> None:
        if self.map is None or self._picture is None:
            return
        with self._drawing:  # a cell may be clicked while the map fills in
            drawn = self._picture.draw(complete, chosen)
        rows, columns = self.map.grid.shape
        click = html.escape(CLICK % (list(drawn.area), columns, rows, columns, rows), quote=True)
        style = "width:100%;cursor:crosshair;image-rendering:auto"
        self.image.content = f'<img alt="map" style="{style}" onclick="{click}" src="{_png(drawn)}">'

    def _say(self, line: str) -> None:
        self.said.content = f'<div style="font-size:0.8em;padding:0.3em 0.8em">{html.escape(line)}</div>'

    def close(self) -> None:
        """Stop computing."""
        self._stop.set()
        self._work.close()


def _name(control: Control) -> str:
    entry = "" if control.index is None else f" {control.label.rpartition(' ')[2]}"
    return f"{control.key}{entry}"


def _png(drawn: Picture) -> str:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(drawn.pixels).save(file, format="PNG")
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
