"""The map of the lab at work: the keys it may have, its runs, the boundary of stability, and a click into it."""

from __future__ import annotations

import threading
import time as clock
from typing import Any

import numpy as np

from closedloop.base.errors import ClosedLoopError, one_line
from closedloop.lab.controls import Control
from closedloop.lab.drawn import Message
from closedloop.lab.history import Changes
from closedloop.lab.mapping import Axis, Map
from closedloop.lab.newest import Newest
from closedloop.lab.protocol import Lab
from closedloop.record.report.measures import MEASURES
from closedloop.scenario.scenario import Scenario
from closedloop.studies.analysis.stability import Range, Stability

USUAL = "rms_force_error"
# The map is sent again after so long at the earliest while it fills in, s.
OFTEN = 0.25
# Values along the map at which the boundary of stability is solved for.
POINTS = 24


class MapWork:
    """The map.

    Parameters
    ----------
    lab : Lab
    """

    def __init__(self, lab: Lab) -> None:
        self._lab, self._stop = lab, threading.Event()
        self.map: Map | None = None
        self._before: Changes = {}
        self._controls: dict[str, Control] = {}
        self._told: Message | None = None
        self._work: Newest[tuple[Map, Changes], None] = Newest(self._fill, lambda nothing: None)

    def begin(self) -> None:
        """Forget the map: another scenario is shown."""
        self._stop.set()
        self.map, self._told = None, None

    def show_keys(self) -> None:
        """Offer the keys of the scenario as it is now."""
        found = (c for c in self._lab.controls.values() if c.form in ("linear", "log"))
        self._controls = {Axis.of(c, 2).name: c for c in found if not c.key.startswith("start.")}
        names = list(self._controls)
        # A gain, say, rather than an instant or a period, of which most values do not fit the step.
        log = next(
            (n for n, c in self._controls.items() if c.form == "log" and c.unit != "s"), names[-1] if names else ""
        )
        message = {
            "kind": "map_keys", "names": names, "quantities": list(MEASURES), "quantity": USUAL, "y": log,
            "x": next((name for name in names if name == "law.force"), names[0] if names else ""),
        }  # fmt: skip
        if message != self._told:
            self._told = message
            self._lab.tell("map_keys", message)

    @property
    def names(self) -> list[str]:
        """The keys that a map may have, by their names."""
        return list(self._controls)

    def start(self, x: str, y: str, quantity: str) -> None:
        """Compute the map of two keys, by their names."""
        self._stop.set()
        across, up, lab = self._controls.get(x), self._controls.get(y), self._lab
        if across is None or up is None or x == y or quantity not in MEASURES:
            self._say("choose two different keys")
            return
        if lab.answers.law is not None:
            self._say("a map needs a law that is a class: batches take no function")
            return
        try:
            scenario = lab.history.scenario()
            model = lab.answers.model(scenario)
        except ClosedLoopError as error:
            self._say(one_line(str(error)))
            return
        self._work.ask((Map(scenario, Axis.of(across), Axis.of(up), quantity, model), dict(lab.history.changes)))

    def stop(self) -> None:
        """Stop computing."""
        self._stop.set()

    def wait(self, seconds: float) -> bool:
        """Wait until the map is complete or stopped; return whether it is."""
        return self._work.wait(seconds)

    def close(self) -> None:
        """Stop computing, and the thread."""
        self._stop.set()
        self._work.close()

    def go(self, u: float, v: float, last: bool = True) -> None:
        """Load the run of a place of the map, as shares of its axes."""
        lab, found = self._lab, self.map
        if found is None:
            return
        value: dict[str, Any] = {}
        for axis, share in ((found.x, u), (found.y, v)):
            key, own = axis.control.key, axis.at(share)
            if axis.control.index is not None and key in value:  # two entries of one list
                value[key][axis.control.index] = own[axis.control.index]
            else:
                value[key] = own
        lab.history.change("map", None, value)  # under one name: a drag is one step of undo
        lab.ask(found.x.control.key)
        if last:
            lab.refresh()
            row, column = (
                min(int(share * axis.values.size), axis.values.size - 1) for axis, share in ((found.y, v), (found.x, u))
            )
            if why := found.reasons.get((row, column)):
                self._say(why)

    def point(self, scenario: Scenario) -> list[float] | None:
        """Return where a scenario is on the map: its values of both keys; None if it has others, or there is no map."""
        if self.map is None:
            return None
        found = []
        for axis in (self.map.x, self.map.y):
            section, _, name = axis.control.key.partition(".")
            value = getattr(getattr(scenario, section, None), name, None)
            if axis.control.index is not None and isinstance(value, tuple) and axis.control.index < len(value):
                value = value[axis.control.index]
            if not isinstance(value, int | float):
                return None
            found.append(float(value))
        return found

    def _fill(self, request: tuple[Map, Changes]) -> None:
        wanted, self._before = request
        self._stop.clear()
        self._lab.forget("boundary")
        self.map, sent, began = wanted, 0.0, clock.perf_counter()
        total = wanted.grid.size
        try:
            for done in wanted.fill(lambda: self._stop.is_set() or self._work.overtaken):
                now = clock.perf_counter()
                if done == total or now - sent > OFTEN:
                    sent = now
                    failed = f", {len(wanted.reasons)} refused or stopped (grey)" if wanted.reasons else ""
                    self._send(wanted, f"{done} of {total} runs in {now - began:.1f} s{failed}", done == total)
            if not self._stop.is_set():
                self._boundary(wanted)
            else:
                self._send(wanted, "stopped", True)
        except ClosedLoopError as error:
            self._send(wanted, one_line(str(error)), True)

    def _send(self, found: Map, line: str, complete: bool) -> None:
        measure = MEASURES[found.quantity]
        message = {
            "kind": "map", "x": _axis(found.x), "y": _axis(found.y), "quantity": found.quantity, "unit": measure.units,
            "hint": measure.meaning, "grid": found.grid.copy(), "state": found.state.copy(), "complete": complete,
            "line": f"{line}. Dashed: where the verdicts turn from good." if complete else line,
        }  # fmt: skip
        self._lab.tell("map", message)
        self._lab.tell("point", {"kind": "point", "at": self.point(self._lab.history.scenario())}, keep=False)

    def _boundary(self, found: Map) -> None:
        """Send the boundary of stability, where the loop can be analysed and both keys are numbers."""
        if found.x.control.index is not None or found.y.control.index is not None:
            return
        try:
            study = Stability(found.scenario, model=found.model)
            over, along = (_range(axis) for axis in (found.y, found.x))
            limits = study.boundary(over, along, POINTS)
        except (ClosedLoopError, ArithmeticError, ValueError):
            return
        if limits and self.map is found:
            line = "Red: where the force loop becomes unstable. Dashed: where a verdict turns from good."
            xs, ys = zip(*sorted((value, limit.value) for value, limit in limits), strict=True)
            self._lab.tell("boundary", {"kind": "boundary", "x": np.array(xs), "y": np.array(ys), "line": line})

    def _say(self, line: str) -> None:
        self._lab.tell("map_said", {"kind": "map_said", "line": line}, keep=False)


def _axis(axis: Axis) -> Message:
    return {"label": axis.label, "values": axis.values, "log": axis.control.form == "log"}


def _range(axis: Axis) -> Range:
    return Range(axis.control.key, float(axis.values[0]), float(axis.values[-1]), axis.control.form == "log")
