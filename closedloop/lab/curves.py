"""The curves of a run against time, as data: panels of traces, with as few points as a screen can show.

A panel's curves share their times. A reduced panel keeps, of each trace, the least and the greatest value in each part
of the time shown, so that an overshoot of one row stays visible.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from closedloop.base.arrays import Array
from closedloop.figures.dress import position_rounding
from closedloop.figures.errors import tip_errors
from closedloop.figures.friction import friction_levels
from closedloop.figures.link_contacts import contacts_drawn
from closedloop.figures.scene.ground import Ground
from closedloop.figures.scene.joined import errors_in
from closedloop.figures.style import length_unit
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.wrench import parts_of
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.record.report.measures import SETTLED
from closedloop.record.run import Run, units_by_kind
from closedloop.scenario.units import with_unit

# Okabe and Ito's palette: told apart by colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8A8A8A", "#B8A500")
# Parts of the time shown; each gives two points of every trace.
CELLS = 160
# Rows in which the errors of loops are evaluated.
MOST_LOOPS = 1000
# The error of a loop is the difference of two chains: its rounding is so many times that of the tip's position.
CHAINS = 8.0
# Numbers of a column of which curves are drawn at most.
MOST_WIDE = 16
# What the name of a column's panel begins with.
COLUMN = "column "
# Names of the panels, in their order, and their titles.
TITLES = {
    "force": "contact force", "links": "link forces",
    "torque": "torque", "torque without limit": "torque of joints without a limit",
    "tip": "tip error", "friction": "friction",
    "closure": "closure error", "penetration": "depth in the surface", "loops": "loop error", "error": "error",
}  # fmt: skip


@dataclass(frozen=True)
class Trace:
    """A curve: its label, its colour as #rrggbb, its values (N,), and whether it is a limit, drawn with dashes."""

    label: str
    colour: str
    values: Array
    limit: bool = False


@dataclass(frozen=True)
class Panel:
    """Curves over one time: a name of `TITLES`, the unit of the values, the times (N,), s, and the traces.

    `band` is how far from its dashed curve the first other may be, 0 where there is no such bound. `note` is what the
    title says besides.
    """

    name: str
    unit: str
    time: Array
    traces: tuple[Trace, ...]
    band: float = 0.0
    note: str = ""

    @property
    def main(self) -> Trace:
        """The trace that stands for the run where several runs are compared: f, or the first."""
        return next((trace for trace in self.traces if trace.label == "f"), self.traces[0])

    @property
    def title(self) -> str:
        """The panel's title with its unit."""
        return with_unit(f"{TITLES.get(self.name) or self.name.removeprefix(COLUMN)}{self.note}", self.unit)


def panels(run: Run) -> list[Panel]:
    """Return the panels of a run of at least one row, with every row: of what it has of loops, contacts and surface."""
    links = [_links(run)] if run.scenario.contact else []
    loops = [_loops(run)] if run.model.loops else []
    there = Ground(run).there
    closure = [_closure(run)] if there else []
    friction = [_friction(run)] if there and run.scenario.friction.kind != "none" else []
    tip = [_tip(run)] if run.scenario.has_surface or run.scenario.law.kind != "none" else []
    found = [*_torques(run), *tip, *friction, *closure, *loops]
    force = [_force(run)] if run.scenario.has_surface or not (links or found) else []
    return [*force, *links, *found]


def main_panel(run: Run) -> Panel:
    """Return the panel that shows most of a run: the forces between links where there are contacts of them, else f."""
    return _links(run) if run.scenario.contact else _force(run)


def _force(run: Run) -> Panel:
    """Return f beside f_des and its settling band, and what the sensor says where that differs from f."""
    measured = () if np.array_equal(run.measured_force, run.contact_force) else (
        Trace("measured", COLOURS[1], run.measured_force),
    )  # fmt: skip
    traces = (
        *measured,
        Trace("f", COLOURS[0], run.contact_force),
        Trace("commanded", COLOURS[2], run.reference_force, limit=True),
    )
    return Panel("force", "N", run.time, traces, SETTLED * _largest(run.reference_force))


def _links(run: Run) -> Panel:
    """Return the normal force of each contact of links, or patch, and the size of its friction, with dashes."""
    traces: list[Trace] = []
    each, summed = contacts_drawn(run)
    for k, drawn in enumerate(each):
        colour, friction = COLOURS[k % len(COLOURS)], f"{drawn.name}, friction"
        traces += [
            Trace(drawn.name, colour, drawn.force(run)),
            Trace(friction, colour, drawn.friction(run), limit=True),
        ]
    return Panel("links", "N", run.time, tuple(traces), note=summed)


def _largest(*values: Array) -> float:
    found = np.concatenate([np.abs(each).ravel() for each in values])
    found = found[np.isfinite(found)]
    return float(found.max()) if found.size else 0.0


def _closure(run: Run) -> Panel:
    """Return e; on a surface that gives way how deep the tip is in it."""
    soft = not isinstance(run.scenario.compliance, Rigid)
    values = np.maximum(-run.closure_error, 0.0) if soft else run.closure_error
    factor, name = length_unit(_largest(values))
    trace = Trace("depth" if soft else "e", COLOURS[0], factor * values)
    return Panel("penetration" if soft else "closure", name, run.time, (trace,), note=_note(run, values))


def _note(run: Run, errors: Array, times: float = 1.0) -> str:
    """Return what the title of errors, m, says if they are no larger than so many times the rounding of positions."""
    return ", rounding only" if 0.0 < _largest(errors) <= times * position_rounding(run) else ""


def _loops(run: Run) -> Panel:
    """Return how far each loop joint is from closed: the largest error of its rows, be it a length or an angle.

    In `MOST_LOOPS` rows at most: an error of positions has no jumps, and all rows take longer than the screen shows.
    """
    rows = np.unique(np.linspace(0, len(run) - 1, min(MOST_LOOPS, len(run))).round().astype(np.int64))
    errors = np.abs(errors_in(run, rows))
    parts = np.split(errors, np.cumsum([loop.rows for loop in run.model.loops])[:-1], axis=1)
    factor, name = length_unit(_largest(errors))
    traces = tuple(
        Trace(loop.name, COLOURS[k % len(COLOURS)], factor * part.max(axis=1))
        for k, (loop, part) in enumerate(zip(run.model.loops, parts, strict=True))
    )
    turning = any("N m" in (unit for _, unit in parts_of(run.model, loop)) for loop in run.model.loops)
    unit = f"{name}, {name[:-1]}rad" if turning else name
    return Panel("loops", unit, run.time[rows], traces, note=_note(run, errors, CHAINS))


def _tip(run: Run) -> Panel:
    """Return the tip's distance from where it is wanted: along the surface, and in free motion off it too."""
    names = ["along the path", "across it"] + (["off the surface"] if np.any(run.mode == FREE) else [])
    columns = tip_errors(run)[: len(names)]
    factor, unit_name = length_unit(_largest(*columns))
    traces = tuple(Trace(n, COLOURS[k], factor * columns[k]) for k, n in enumerate(names))
    return Panel("tip", unit_name, run.time, traces)


def _torques(run: Run) -> list[Panel]:
    """Return the torques of joints with a drive: as shares of their own limits, and as they are where there is none."""
    driven = np.flatnonzero(run.model.driven)
    limited = np.isfinite(run.model.effort_limit[driven]) & (run.model.effort_limit[driven] > 0.0)
    found = []
    for joints, share in ((driven[limited], True), (driven[~limited], False)):
        if not len(joints):
            continue
        values = run.torque[:, joints]
        values = 100.0 * values / run.model.effort_limit[joints] if share else values
        traces = [
            Trace(run.model.joint_names[j], COLOURS[j % len(COLOURS)], values[:, k]) for k, j in enumerate(joints)
        ]
        if share:
            level = np.full(len(run), 100.0)
            traces += [Trace("limit", COLOURS[6], level, limit=True), Trace("-limit", COLOURS[6], -level, limit=True)]
        kinds = [units_by_kind("N m", run.model.joint_types[j]) for j in joints]
        name, unit = ("torque", "% of limit") if share else ("torque without limit", " | ".join(dict.fromkeys(kinds)))
        found.append(Panel(name, unit, run.time, tuple(traces)))
    return found


def _friction(run: Run) -> Panel:
    """Return the size of friction at the tip beside its cone: the levels that the law has, times f."""
    traces = [Trace("|Ft|", COLOURS[0], np.linalg.norm(run.friction_force, axis=1))]
    for k, (level, name, _) in enumerate(friction_levels(run.scenario.friction)):
        cone = np.where(run.mode == FREE, 0.0, level * run.contact_force)
        traces.append(Trace(name, COLOURS[6 if k == 0 else 5], cone, limit=True))
    return Panel("friction", "N", run.time, tuple(traces))


def reduced(panel: Panel, begin: float, end: float, cells: int = CELLS) -> Panel:
    """Return a panel with the rows from `begin` to `end`, s, that show its shape; see the top of this file."""
    first, last = np.searchsorted(panel.time, [begin, end])
    first, last = max(int(first) - 1, 0), min(int(last) + 1, panel.time.size)
    count = last - first
    if count <= 2 * cells:
        keep = np.arange(first, last)
    else:
        width = -(-count // cells)
        parts = -(-count // width)
        values = np.array([trace.values[first:last] for trace in panel.traces])
        values = np.pad(values, ((0, 0), (0, width * parts - count)), mode="edge").reshape(-1, parts, width)
        gaps = np.isnan(values)
        low, high = (np.where(gaps, x, values) if gaps.any() else values for x in (np.inf, -np.inf))
        found = np.concatenate([low.argmin(axis=2), high.argmax(axis=2)]) + first + width * np.arange(parts)
        keep = np.unique(np.minimum(np.append(found, [first, last - 1]), last - 1))
    traces = tuple(Trace(t.label, t.colour, t.values[keep], t.limit) for t in panel.traces)
    return replace(panel, time=panel.time[keep], traces=traces)


def column_names(run: Run) -> list[str]:
    """Return the columns of a run that can be drawn against time beside its panels."""
    return [
        name for name, column in run.columns.items()
        if name != "time" and len(column) == len(run) and column.ndim <= 2 and column.size <= MOST_WIDE * len(run)
        and column.dtype.kind in "fiub"
    ]  # fmt: skip


def column_panel(run: Run, name: str) -> Panel:
    """Return a column of a run as a panel, with a trace for each of its numbers."""
    values = np.asarray(run.columns[name], dtype=float).reshape(len(run), -1)
    count = values.shape[1]
    of_joints = run.model.joint_names if count == run.model.n else run.model.coordinate_names
    labels = (
        of_joints if count in (run.model.n, len(of_joints)) and count > 1 else ("x", "y", "z") if count == 3 else ()
    )
    traces = tuple(
        Trace(labels[k] if labels else name if count == 1 else f"{name} {k}", COLOURS[k % len(COLOURS)], values[:, k])
        for k in range(count)
    )
    return Panel(COLUMN + name, run.units(name) or "1", run.time, traces)
