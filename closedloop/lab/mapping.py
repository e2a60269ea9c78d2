"""A map of the lab: a value of the run against two keys, its runs, the boundary of stability, and a click into it.

The runs are those of `closedloop.simulate_batch`, some of the map at a time, coarse first: every eighth row and
column, then every fourth, and so on, so that the shape shows early. The page draws it (`web/map.js`).
"""

import threading
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, ScenarioError, one_line
from closedloop.base.sections import Section
from closedloop.jit.background import refused, seconds_to_compile, start
from closedloop.jit.kernel import needs_compiling
from closedloop.lab.app import Answer, Lab
from closedloop.lab.controls import DAMPING, STIFFNESS, Control, group_of
from closedloop.lab.drawn import Message
from closedloop.lab.server import Newest
from closedloop.record.report.measures import MEASURES
from closedloop.record.report.verdict import GOOD
from closedloop.scenario.messages import typeset, with_unit
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import ALL
from closedloop.simulation.batch.simulate_batch import simulate_batch
from closedloop.simulation.engines.lanes import can_use_lanes, run_in_lanes
from closedloop.studies.analysis.stability import Range, Stability
from robot_models import RobotModel

CELLS = 40  # on either side
BATCH = 160  # runs that are computed in one go; the first few, which show the shape, go by themselves
FIRST = 25


@dataclass(frozen=True)
class Axis:
    """An axis of a map: a key's control, and the values (cells,) of its number in each cell, from low to high.

    Where the key is a list with a number for each joint, the number is that of the control's own entry; `together`: the
    other entries change by the same factor.
    """

    control: Control
    values: Array
    together: bool = False

    @classmethod
    def of(cls, control: Control, cells: int = CELLS, together: bool = False) -> "Axis":
        """Return the axis over the span of a slider: so many of its values, or all if they are fewer."""
        whole = np.round(np.linspace(0.0, control.high - control.low, cells) / control.step)
        shown = np.minimum(control.low + control.step * whole, control.high)
        own = (control.read(float(each)) for each in shown)
        values = [x if control.index is None else x[control.index] for x in own]
        return cls(control, np.unique(np.array(values, dtype=float)), together)

    @property
    def shown(self) -> Array:
        """What the slider shows in each cell."""
        return np.log10(self.values) if self.control.form == "log" else self.values

    @property
    def label(self) -> str:
        """The key, with its unit."""
        return with_unit(self.name, self.control.unit)

    @property
    def message(self) -> Message:
        """What the page is told of the axis."""
        return {"label": self.label, "values": self.values, "log": self.control.form == "log"}

    @property
    def name(self) -> str:
        """The key, with the entry's name where it is a list."""
        if self.together:
            return f"{self.control.key}, all"
        entry = "" if self.control.index is None else f" {self.control.label.rpartition(' ')[2]}"
        return f"{self.control.key}{entry}"

    def at(self, share: float) -> Any:
        """Return the key's value at a place on the axis, 0 to 1: one that its slider can show."""
        place = min(max(share, 0.0), 1.0) * self.values.size - 0.5
        scale = np.log10 if self.control.form == "log" else np.asarray
        value = self.control.read(float(np.interp(place, np.arange(self.values.size), scale(self.values))))
        return self.control.together(value) if self.together else value

    def value(self, cell: int) -> Any:
        """Return the key's value in a cell."""
        value = self.control.put(float(self.values[cell]))
        return self.control.together(value) if self.together else value


@dataclass
class Map:
    """A map of a scenario."""

    scenario: Scenario  # what all runs have in common
    # x, y: of two keys that differ, or of two entries of one list
    x: Axis
    y: Axis
    quantity: str  # a name of `closedloop.record.report.measures.MEASURES`
    model: RobotModel | None = None
    # (rows, columns): the quantity, row by row along y; NaN where it is not known yet, or does not exist
    grid: Array = field(init=False)
    # (rows, columns): 0 where numbers and control are good, 1 where not, 2 where the run was refused or stopped; NaN:
    # not known yet
    state: Array = field(init=False)
    # (row, column) of a cell whose run was refused or stopped, and why
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.grid = np.full((self.y.values.size, self.x.values.size), np.nan)
        self.state = np.full_like(self.grid, np.nan)

    def values(self, row: int, column: int) -> dict[str, Any]:
        """Return the values of both keys in a cell."""
        return self.both(self.x.value(column), self.y.value(row))

    def both(self, x: Any, y: Any) -> dict[str, Any]:
        """Return the values of both keys, given what either is on its own: two entries of one list are in one."""
        one, other = self.x.control, self.y.control
        if one.key == other.key and one.index is not None:
            y[one.index] = x[one.index]
        return {one.key: x} | {other.key: y}

    def fill(self, stop: Callable[[], bool] = lambda: False, batch: int = BATCH) -> Iterator[int]:
        """Compute the map, and yield how many cells are done, again and again, until all are or `stop` says so."""
        order, done = coarse_first(*self.grid.shape), 0
        while done < len(order):
            if stop():
                return
            cells = order[done : done + (batch if done else min(batch, FIRST))]
            points = [self.values(*cell) for cell in cells]
            columns = {key: [point[key] for point in points] for key in points[0]}
            try:
                table = simulate_batch(self.scenario, columns, model=self.model)
            except ScenarioError as error:  # none of these runs could be read
                for cell in cells:
                    self.state[cell], self.reasons[cell] = 2.0, one_line(str(error))
            else:
                read = (self.quantity, "status", "reason", "verdict", "control_verdict")
                rows = zip(cells, *(table[name].to_pylist() for name in read), strict=True)
                for cell, value, status, why, *verdicts in rows:
                    self.grid[cell] = np.nan if value is None or status != "done" else value
                    good = all(str(verdict).startswith(GOOD) for verdict in verdicts)
                    self.state[cell] = 2.0 if status != "done" else 0.0 if good else 1.0
                    if status != "done":
                        self.reasons[cell] = str(why)
            done += len(cells)
            yield done


def coarse_first(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return all cells of a grid, those of a coarse grid before those between them."""
    found: dict[tuple[int, int], None] = {}
    for step in (8, 4, 2, 1):
        found |= {(i, j): None for i in range(0, rows, step) for j in range(0, columns, step)}
    return list(found)


USUAL, WITHOUT_LAW = "rms_force_error", "energy_lost_to_friction"
# Keys that come last: they hold motions of the arm that leave the tip where it is, and change little of its force.
POSTURE = "law.posture_"
# The map is sent again after so long at the earliest while it fills in, s.
OFTEN = 0.25
# A page that opens begins with a map where a run takes no longer than this of a processor, s; it has so many runs at a
# time, and ends after so long, s, or when a slider is moved.
QUICK, FEW_RUNS, AT_MOST = 0.4, 24, 8.0
# While what a first map needs is compiled by another process, it is looked for this often, s.
LOOK = 1.0
# Values along the map at which the boundary of stability is solved for, and its tolerance: less than a pixel.
POINTS, FINE = 24, 2e-4


class MapWork:
    """The map."""

    def __init__(self, lab: Lab) -> None:
        self._lab, self._stop = lab, threading.Event()
        self.map: Map | None = None
        self._axes: dict[str, tuple[Control, bool]] = {}
        self._by_itself = False
        self._closed, self._waits = threading.Event(), False
        self._told: Message | None = None
        self._work: Newest[tuple[Map, bool], None] = Newest(self._fill)

    def begin(self) -> None:
        """Forget the map: another scenario is shown."""
        self._stop.set()
        self.map, self._told = None, None

    def show_keys(self) -> None:
        """Offer the keys of the scenario as it is now."""
        found = [c for c in self._lab.controls.values() if c.form in ("linear", "log")]
        self._axes = {}
        for control in (c for c in found if not c.key.startswith("start.")):
            entries = [] if control.index is None else [c for c in found if c.key == control.key]
            if len(entries) > 1 and control is entries[0] and control.own != 0.0:
                self._axes[Axis.of(control, 2, True).name] = control, True
            self._axes[Axis.of(control, 2).name] = control, False
        names = list(self._axes)
        # A gain, say, rather than an instant or a period, of which most values do not fit the step.
        logs = [n for n, (c, _) in self._axes.items() if c.form == "log" and c.unit != "s"] or names[-1:] or [""]
        logs.sort(key=lambda name: name.startswith(POSTURE))
        groups = [(n, group_of(self._axes[n][0].key)) for n in logs if n]
        of = {group: [n for n, its in groups if its == group] for group in (STIFFNESS, DAMPING)}
        first = next((name for name in names if name == "law.force"), names[0] if names else "")
        x, y = (of[STIFFNESS][0], of[DAMPING][0]) if all(of.values()) else (first, logs[0])
        quantity = USUAL
        touching = [n for n in names if n.startswith("contact.") and n.endswith((".friction", ".restitution"))]
        if len(touching) > 1 and not any(of.values()):  # bodies alone
            (x, y), quantity = touching[:2], WITHOUT_LAW
        message = {
            "kind": "map_keys", "names": names, "quantities": list(MEASURES), "quantity": quantity, "x": x, "y": y,
        }  # fmt: skip
        if message != self._told:
            self._told = message
            self._lab.tell("map_keys", message)

    @property
    def names(self) -> list[str]:
        """The keys that a map may have, by their names."""
        return list(self._axes)

    def start(self, x: str, y: str, quantity: str, by_itself: bool = False) -> None:
        """Compute the map of two keys, by their names; `by_itself`: nobody asked for it, and any change stops it."""
        self._stop.set()
        across, up, lab = self._axes.get(x), self._axes.get(y), self._lab
        try:
            if across is None or up is None or x == y or quantity not in MEASURES:
                raise ScenarioError("choose two different keys")
            if across[0].key == up[0].key and (across[1] or up[1]):
                raise ScenarioError("choose two keys of which one does not change the other")
            if lab.answers.law is not None:
                raise ScenarioError("a map needs a law that is a class: batches take no function")
            scenario = lab.history.scenario()
            model = lab.answers.model(scenario)
        except ClosedLoopError as error:
            self._say(one_line(str(error)), refused=True)
            return
        over, along = (Axis.of(control, CELLS, together) for control, together in (across, up))
        self._work.ask((Map(scenario, over, along, quantity, model), by_itself))

    def begin_by_itself(self, answer: Answer) -> None:
        """Compute a first map for a page that is open, of a run that is quick.

        What it needs is compiled first, by another process: here it would take the time of the runs.
        """
        run, told = answer.run, self._told
        if run is None or told is None or self.map is not None or answer.stopped:
            return
        if answer.effort > QUICK or not run.scenario.has_surface:  # another tab has something to show
            name = "analysis" if run.scenario.has_surface else "events"
            self._lab.tell("tab", {"kind": "tab", "name": name}, keep=False)
            return
        if can_use_lanes(run.scenario) and needs_compiling(run_in_lanes):
            self._wait_for_compiler()
            return
        self.start(told["x"], told["y"], told["quantity"], by_itself=True)

    def _wait_for_compiler(self) -> None:
        """Say what the first map waits for, and begin it when that is there."""
        seconds = seconds_to_compile([run_in_lanes])
        what = f"The code for eight runs at a time is not compiled yet (some {seconds:.0f} s)"
        if refused():
            self._say(f"{what}: press compute, then it is compiled first.")
        else:
            self._say(f"{what}. It is compiled in the background; then the first map begins.")
        if not self._waits:
            self._waits = True
            threading.Thread(target=self._look_for_compiled, name="closedloop-first-map", daemon=True).start()

    def _look_for_compiled(self) -> None:
        while needs_compiling(run_in_lanes):
            if not refused():
                start([run_in_lanes], quietly=True)
            if self._closed.wait(LOOK):
                return
        self._waits = False
        if self._lab.answer is not None and self.map is None:
            self._lab.details.ask(self._lab.answer)  # after which a first map begins, once the slider rests

    def changed(self) -> None:
        """A value of the scenario has changed: a map that nobody asked for leaves the processor to the run."""
        if self._by_itself:
            self._stop.set()

    def stop(self) -> None:
        """Stop computing."""
        self._stop.set()

    def wait(self, seconds: float) -> bool:
        """Wait until the map is complete or stopped; return whether it is."""
        return self._work.wait(seconds)

    def close(self) -> None:
        """Stop computing, and the threads."""
        self._stop.set()
        self._closed.set()
        self._work.close()

    def go(self, u: float, v: float, last: bool = True) -> None:
        """Load the run of a place of the map, as shares of its axes."""
        lab, found = self._lab, self.map
        if found is None:
            return
        values = found.both(found.x.at(u), found.y.at(v))
        lab.history.change("map", None, values)  # under one name: a drag is one step of undo
        lab.ask(found.x.control.key)
        if last:
            lab.refresh()
            cells = ((share, axis.values.size) for axis, share in ((found.y, v), (found.x, u)))
            row, column = (min(int(share * count), count - 1) for share, count in cells)
            if why := found.reasons.get((row, column)):
                self._say(why)

    def where(self, scenario: Scenario) -> Message:
        """Return the message of where a scenario is on the map."""
        return {"kind": "point", "at": self.point(scenario), "stale": self.stale(scenario)}

    def point(self, scenario: Scenario) -> list[float] | None:
        """Return where a scenario is on the map: its values of both keys; None if it has others, or there is no map."""
        if self.map is None:
            return None
        found = []
        for axis in (self.map.x, self.map.y):
            section, _, name = axis.control.key.partition(".")
            held = getattr(scenario, section, None)
            if isinstance(held, tuple):  # of tables: of one, or of all, which have it alike
                number, _, name = name.partition(".")
                held = held[0 if number == ALL else int(number)]
            value = getattr(held, name, None)
            if axis.control.index is not None and isinstance(value, tuple) and axis.control.index < len(value):
                value = value[axis.control.index]
            if not isinstance(value, int | float):
                return None
            found.append(float(value))
        return found

    def stale(self, scenario: Scenario) -> str:
        """Return the key by which a scenario differs from those of the map, beside its two; "" if none does."""
        if self.map is None:
            return ""
        axes = self.map.x, self.map.y
        for section in Scenario.model_fields:
            now, then = getattr(scenario, section), getattr(self.map.scenario, section)
            if now == then:
                continue
            if type(now) is not type(then) or not isinstance(now, Section):
                if not any(axis.control.key.startswith(f"{section}.") for axis in axes):
                    return section
                continue
            for name in type(now).model_fields:
                here = [axis for axis in axes if axis.control.key == f"{section}.{name}"]
                values = getattr(now, name), getattr(then, name)
                if values[0] == values[1] or any(axis.together or axis.control.index is None for axis in here):
                    continue
                moved = {axis.control.index for axis in here}
                lists = zip(*values, strict=True) if here and len(values[0]) == len(values[1]) else ()
                if not here or any(a != b for k, (a, b) in enumerate(lists) if k not in moved):
                    return f"{section}.{name}"
        return ""

    def _fill(self, request: tuple[Map, bool]) -> None:
        wanted, by_itself = request
        self._by_itself = by_itself
        self._stop.clear()
        self._lab.forget("boundary")
        self.map, sent, began = wanted, 0.0, clock.perf_counter()
        total = wanted.grid.size

        def stopped() -> bool:
            return (by_itself and clock.perf_counter() - began > AT_MOST) or self._stopped()

        try:
            for done in wanted.fill(stopped, FEW_RUNS if by_itself else BATCH):
                now = clock.perf_counter()
                if done == total or now - sent > OFTEN:
                    sent = now
                    failed = f", {len(wanted.reasons)} refused or stopped (grey)" if wanted.reasons else ""
                    self._send(wanted, f"{done} of {total} runs in {now - began:.1f} s{failed}", done == total)
            known = int(np.isfinite(wanted.state).sum())
            if known < total:
                self._send(wanted, f"{known} of {total} runs; press compute for all", True)
            self._boundary(wanted)
        except ClosedLoopError as error:
            self._send(wanted, one_line(str(error)), True)
        finally:
            self._by_itself = False

    def _stopped(self) -> bool:
        return self._stop.is_set() or self._work.overtaken

    def _send(self, found: Map, line: str, complete: bool) -> None:
        measure = MEASURES[found.quantity]
        unit = "" if measure.units == "1" else typeset(measure.units)
        message = {
            "kind": "map", "x": found.x.message, "y": found.y.message, "quantity": found.quantity, "unit": unit,
            "hint": measure.meaning, "grid": found.grid.copy(), "state": found.state.copy(), "complete": complete,
            "line": f"{line}. Dashed: where the verdicts turn from good." if complete else line,
        }  # fmt: skip
        self._lab.tell("map", message)
        self._lab.tell("point", self.where(self._lab.history.scenario()), keep=False)

    def _boundary(self, found: Map) -> None:
        """Send the boundary of stability, where the loop can be analysed and the keys are not entries of one list."""
        if found.x.control.key == found.y.control.key or self._stopped():
            return
        try:
            study = Stability(found.scenario, model=found.model)
            ranges = []
            for axis in (found.y, found.x):
                control, ends = axis.control, (float(axis.values[0]), float(axis.values[-1]))
                held = () if control.index is None else tuple(control.value)
                index = None if axis.together else control.index
                ranges.append(Range(control.key, *ends, control.form == "log", held, index))
            limits = study.boundary(ranges[0], ranges[1], POINTS, FINE, self._stopped)
        except (ClosedLoopError, ArithmeticError, ValueError):
            return
        if self._stopped():
            return
        if not limits:
            self._say(
                "The force loop is stable, or unstable, in the whole map. Dashed: where a verdict turns from good."
            )
        elif self.map is found:
            line = "Red: where the force loop becomes unstable. Dashed: where a verdict turns from good."
            xs, ys = zip(*sorted((value, limit.value) for value, limit in limits), strict=True)
            self._lab.tell("boundary", {"kind": "boundary", "x": np.array(xs), "y": np.array(ys), "line": line})

    def _say(self, line: str, refused: bool = False) -> None:
        self._lab.tell("map_said", {"kind": "map_said", "line": line, "refused": refused}, keep=False)
