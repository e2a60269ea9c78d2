"""What the lab draws of a run, as data: spans of sliders, tiles of the strip, and panels of curves over time.

A tile has a name, a value in words, and whether it is good where a verdict or a bound says so. Beside it stands how it
differs from the run that it is compared with, and whether that is better.

A panel's curves share their times. A reduced panel keeps, of each trace, the least and the greatest value in each part
of the time shown, so that an overshoot of one row stays visible.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, get_args

import annotated_types
import numpy as np
from pydantic.fields import FieldInfo

from closedloop.base.arrays import Array, evenly
from closedloop.base.sections import field_units, sizes
from closedloop.figures.force import contacts_drawn, friction_bounds
from closedloop.figures.motion import tip_errors
from closedloop.figures.scene.scene import Ground
from closedloop.figures.scene.solids import errors_in
from closedloop.figures.style import length_unit, position_rounding
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.loops.reactions import parts_of
from closedloop.mechanics.surface.compliances.none import Rigid
from closedloop.record.clearance import passing_note
from closedloop.record.report.control_verdict import told
from closedloop.record.report.measures import SETTLED
from closedloop.record.report.verdict import names_of
from closedloop.record.run import Run, units_by_kind
from closedloop.scenario.messages import with_unit
from closedloop.scenario.scenario import Scenario
from robot_models import RobotModel

# How far a slider reaches from zero where the scenario has zero, by unit.
USUAL = {
    "N": 10.0, "s": 0.02, "1/s": 200.0, "N/m": 2000.0, "N s/m": 200.0, "N m/rad": 1000.0, "N m s/rad": 100.0, "m": 0.05,
    "m/s": 0.05, "rad": 3.2, "rad/s": 1.0, "N m": 10.0, "kg": 10.0,
}  # fmt: skip
LOG_SPAN = 30.0  # a logarithmic slider reaches so many times up and down
POSITIONS = 400  # of a slider


def span(
    key: str, field: FieldInfo, value: float, unit: str, scenario: Scenario, index: int | None = None,
    model: RobotModel | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return form, low, high and step of a slider that starts at a value."""
    least, most = _bounds(field)
    if key.startswith("start.q") and unit == "1":  # of a quaternion
        return _linear(-1.0, 1.0)
    if key.startswith("start.q") and model is not None and not model.balls and index is not None and index < model.n:
        low, high = float(model.position_lower[index]), float(model.position_upper[index])
        least = low if math.isfinite(low) else value - math.pi
        most = high if math.isfinite(high) else value + math.pi
        return _linear(min(least, value), max(most, value))
    if least >= 0.0 and value > 0.0 and unit not in ("", "N") and not _is_instant(key, unit):
        there = sizes(Annotated[field.annotation, *field.metadata, None])
        smallest = max((size.least for size in there), default=0.0) or 1e-12
        low, high = math.log10(max(value / LOG_SPAN, smallest)), math.log10(min(value * LOG_SPAN, most))
        return {"form": "log", "low": low, "high": high, "step": (high - low) / POSITIONS}
    if math.isfinite(least) and most <= 1.0:
        return _linear(least, most)
    if unit == "" and -1.0 <= value <= 1.0 and isinstance(index, int):
        return _linear(-1.0, 1.0)  # a direction
    if _is_instant(key, unit):
        return _linear(0.0, max(2.0 * value, scenario.time.duration), 0.05)
    if key == "law.force" and scenario.surface.contact == "unilateral" and value >= 0.0:
        least = max(least, 0.0)  # with less the tip only leaves the surface
    reach = 3.0 * abs(value) or USUAL.get(unit, 1.0)
    return _linear(max(-reach, least), min(reach, most))


def _is_instant(key: str, unit: str) -> bool:
    """Whether a key is an instant or a duration of the run, not a time constant."""
    return unit == "s" and key.rpartition(".")[2] in ("start", "stop", "at", "pd_start", "duration", "times")


def _linear(low: float, high: float, step: float | None = None) -> dict[str, Any]:
    if high <= low:
        high = low + 1.0
    fine = 10.0 ** math.floor(math.log10((high - low) / POSITIONS)) if step is None else step
    fine = next((k * fine for k in (1, 2, 5, 10) if (high - low) / (k * fine) <= POSITIONS), 10 * fine)
    return {"form": "linear", "low": low, "high": high, "step": fine}


def _bounds(field: FieldInfo) -> tuple[float, float]:
    """Return the least and the greatest number that a field takes."""
    least, most = -math.inf, math.inf
    for part in (*field.metadata, *_inner(field.annotation)):
        if isinstance(part, annotated_types.Gt | annotated_types.Ge):
            least = max(least, float(getattr(part, "gt", getattr(part, "ge", -math.inf))))
        elif isinstance(part, annotated_types.Lt | annotated_types.Le):
            most = min(most, float(getattr(part, "lt", getattr(part, "le", math.inf))))
    found = list(sizes(Annotated[field.annotation, *field.metadata, None]))
    for size in found:
        least, most = max(least, -size.most), min(most, size.most)
    # Times, rates and gains have no bound below in their type where it takes a word or a list beside a number.
    if any(size.why == "no drive is so stiff" for size in found) or field_units(field) & {"s", "1/s", "1/s²"}:
        least = max(least, 0.0)
    return least, most


def _inner(annotation: Any) -> list[Any]:
    """Return the annotations of a key that may be left out, or of one that takes a number or a word."""
    found: list[Any] = []
    for part in get_args(annotation):
        found += [*getattr(part, "__metadata__", ()), *_inner(part)]
        found += [more for each in getattr(part, "__metadata__", ()) for more in getattr(each, "metadata", ())]
    return found


def nearest_round(x: float) -> float:
    """Return the 1, 2 or 5 times a power of ten that is nearest to x > 0 on a logarithmic scale."""
    power = math.floor(math.log10(x))
    steps = [step * 10.0**p for p in (power, power + 1) for step in (1.0, 2.0, 5.0)]
    return float(f"{min(steps, key=lambda step: abs(math.log(step / x))):.3g}")


Tile = dict[str, Any]

# Values that differ by no more than this share are equal: no digit that is shown differs.
ALIKE = 5e-4
# By name: the value of the summary, its unit, what it is, whether less is better, and the factor to its unit.
NUMBERS: dict[str, tuple[str, str, str, bool, float]] = {
    "force RMS": ("rms_force_error", "N", "RMS error of the contact force over the rows in contact", True, 1.0),
    "force peak": ("peak_force_error", "N", "largest error of the contact force in contact", True, 1.0),
    "settled": ("force_settled_at", "s", "instant from which f stays within 2 % of what is desired", True, 1.0),
    "path RMS": ("rms_path_error", "mm", "RMS distance of the tip from its path, along the surface", True, 1e3),
    "in contact": ("time_in_contact", "s", "time in contact", False, 1.0),
    "torque": ("torque_share", "%", "largest torque as a share of that joint's own limit", True, 100.0),
    "energy error": ("max_energy_residual", "J", "largest energy unaccounted for", True, 1.0),
    "friction loss": ("energy_lost_to_friction", "J", "energy lost to friction, of the tip and the joints", True, 1.0),
    "step error": ("step_error", "N", "by how much f differs in a run at half the step", True, 1.0),
}  # fmt: skip
MARGINS: dict[str, tuple[str, str, str]] = {
    "gain margin": ("gain", "x", "the factor by which the loop's gain may rise until it is unstable"),
    "phase margin": ("phase", "deg", "by which the phase may lag where the loop's gain is 1"),
    "delay margin": ("delay", "ms", "the delay that the loop may have in addition"),
}


def values(run: Run, summary: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers of the strip: of the summary, and the largest error of f and share of a torque's limit."""
    found = {key: summary.get(key) for key, *_ in NUMBERS.values()} | {"step_error": summary["step_error"]["force"]}
    touching = run.mode != FREE
    off = np.abs(run.contact_force - run.reference_force)[touching]
    found["peak_force_error"] = float(np.max(off)) if off.size and run.scenario.has_surface else None
    limits = run.model.effort_limit
    limited = np.flatnonzero(np.isfinite(limits) & (limits > 0.0) & run.model.driven)
    largest = [(summary["joints"][run.model.joint_names[j]]["max_joint_torque"], limits[j]) for j in limited]
    found["torque_share"] = max((torque / limit for torque, limit in largest if torque is not None), default=None)
    return found


def tiles(
    run: Run, summary: Mapping[str, Any], before: Mapping[str, float | None] | None = None, name: str = ""
) -> list[Tile]:
    """Return the tiles of a run; `before` are the `values` of another, which is called `name`."""
    numbers, control, problems = values(run, summary), summary["control_verdict"], summary["verdict"]["problems"]
    found = [_verdict("numbers", problems, names_of(problems), "whether the numbers of this run can be trusted")]
    if run.scenario.has_law or control["problems"]:  # without a law nothing is commanded
        why = "whether the arm did what was commanded"
        found.append(_verdict("control", control["problems"], told(summary), why))
    for label, (key, unit, hint, less, factor) in NUMBERS.items():
        number = numbers[key]
        needless = {"energy_lost_to_friction": 0.0, "time_in_contact": run.time[-1] - run.time[0]}.get(key)
        if number is None or (needless is not None and abs(number - needless) < run.scenario.time.step):
            continue
        tile = _tile(label, factor * number, unit, hint)
        if key == "torque_share" and number > 1.0:
            tile |= {"good": False, "why": f"a joint's torque is {number:.3g} times what the robot's file allows"}
        found.append(tile | _change(number, None if before is None else before.get(key), less, factor, name))
    if passing := passing_note(summary["clearance"]):
        near = summary["clearance"]
        tile = _tile("clearance", 1e3 * near["distance"], "mm", passing)
        found.append(tile | {"good": False, "at": near["time"], "why": passing})
    return found


def margin_tiles(margins: Mapping[str, Any], stable: bool, before: Mapping[str, Any] | None, name: str) -> list[Tile]:
    """Return the tiles of a loop's margins, as `Margins.as_dict` gives them, beside those of another."""
    if not stable:
        why = "a pole of the force loop grows: see the tab analysis"
        return [{"name": "loop", "text": "unstable", "unit": "", "hint": why, "good": False, "why": why}]
    found = []
    for label, (key, unit, hint) in MARGINS.items():
        factor = 1e3 if key == "delay" else 1.0
        number, other = margins.get(key), None if before is None else before.get(key)
        if number is None:
            found.append({"name": label, "text": "any", "unit": "", "hint": f"{hint}: at no value", "good": None})
        else:
            found.append(_tile(label, factor * number, unit, hint) | _change(number, other, False, factor, name))
    return found


def _tile(label: str, number: float, unit: str, hint: str) -> Tile:
    return {"name": label, "text": f"{number:.3g}", "unit": unit, "hint": hint, "good": None}


def _verdict(label: str, problems: Sequence[Mapping[str, Any]], text: str, hint: str) -> Tile:
    why = "; ".join(problem["text"] for problem in problems)
    at = next((problem["at"] for problem in problems if problem.get("at") is not None), None)
    return {
        "name": label, "text": text.replace("_", " "), "unit": "", "hint": f"{hint}: {why}" if why else hint,
        "good": not problems, "at": at, "why": why,
    }  # fmt: skip


def _change(number: float, before: float | None, less: bool, factor: float, name: str) -> Tile:
    """Return how a value differs from that of another run, and whether it is better."""
    if before is None or abs(number - before) <= ALIKE * max(abs(number), abs(before)):
        return {}
    change = number - before
    return {"change": f"{factor * change:+.2g}", "better": (change < 0.0) == less, "against": name}


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
    title says besides. `factor` is from metres to the unit, where that was chosen by the size of a length.
    """

    name: str
    unit: str
    time: Array
    traces: tuple[Trace, ...]
    band: float = 0.0
    note: str = ""
    factor: float = 1.0

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


def beside(there: Sequence[Panel], pinned: Sequence[Panel]) -> list[Panel]:
    """Return the panels of a run in units in which those of runs that are pinned can be read too: the larger one."""
    found = []
    for panel in there:
        largest = min((p for p in (panel, *pinned) if p.name == panel.name), key=lambda p: p.factor)
        ratio = largest.factor / panel.factor
        traces = tuple(replace(t, values=ratio * t.values) for t in panel.traces) if ratio != 1.0 else panel.traces
        found.append(replace(panel, traces=traces, unit=largest.unit, factor=largest.factor))
    return found


def main_panel(run: Run) -> Panel:
    """Return the panel that shows most of a run: the forces between links where there are contacts of them, else f."""
    return _links(run) if run.scenario.contact else _force(run)


def _force(run: Run) -> Panel:
    """Return f beside f_des and its settling band, and what the sensor says where that differs from f."""
    wanted = Trace("commanded", COLOURS[2], run.reference_force, limit=True)
    traces = [Trace("f", COLOURS[0], run.contact_force), wanted]
    if not np.array_equal(run.measured_force, run.contact_force):
        traces.insert(0, Trace("measured", COLOURS[1], run.measured_force))
    return Panel("force", "N", run.time, tuple(traces), SETTLED * _largest(run.reference_force))


def _links(run: Run) -> Panel:
    """Return the normal force of each contact of links, or patch, and the size of its friction, with dashes."""
    traces: list[Trace] = []
    each, summed = contacts_drawn(run)
    for k, drawn in enumerate(each):
        colour = COLOURS[k % len(COLOURS)]
        traces.append(Trace(drawn.name, colour, drawn.force(run)))
        traces.append(Trace(f"{drawn.name}, friction", colour, drawn.friction(run), limit=True))
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
    return Panel("penetration" if soft else "closure", name, run.time, (trace,), note=_note(run, values), factor=factor)


def _note(run: Run, errors: Array, times: float = 1.0) -> str:
    """Return what the title of errors, m, says if they are no larger than so many times the rounding of positions."""
    return ", rounding only" if 0.0 < _largest(errors) <= times * position_rounding(run) else ""


def _loops(run: Run) -> Panel:
    """Return how far each loop joint is from closed: the largest error of its rows, be it a length or an angle.

    In `MOST_LOOPS` rows at most: an error of positions has no jumps, and all rows take longer than the screen shows.
    """
    rows = evenly(len(run), MOST_LOOPS)
    errors = np.abs(errors_in(run, rows))
    parts = np.split(errors, np.cumsum([loop.rows for loop in run.model.loops])[:-1], axis=1)
    factor, name = length_unit(_largest(errors))
    traces = tuple(
        Trace(loop.name, COLOURS[k % len(COLOURS)], factor * part.max(axis=1))
        for k, (loop, part) in enumerate(zip(run.model.loops, parts, strict=True))
    )
    turning = any("N m" in (unit for _, unit in parts_of(run.model, loop)) for loop in run.model.loops)
    unit = f"{name}, {name[:-1]}rad" if turning else name
    return Panel("loops", unit, run.time[rows], traces, note=_note(run, errors, CHAINS), factor=factor)


def _tip(run: Run) -> Panel:
    """Return the tip's distance from where it is wanted: along the surface, and in free motion off it too."""
    names = ["along the path", "across it"] + (["off the surface"] if np.any(run.mode == FREE) else [])
    columns = tip_errors(run)[: len(names)]
    factor, unit_name = length_unit(_largest(*columns))
    traces = tuple(Trace(n, COLOURS[k], factor * columns[k]) for k, n in enumerate(names))
    return Panel("tip", unit_name, run.time, traces, factor=factor)


def _torques(run: Run) -> list[Panel]:
    """Return the torques of joints with a drive: as shares of their own limits, and as they are where there is none."""
    driven = np.flatnonzero(run.model.driven)
    limited = np.isfinite(run.model.effort_limit[driven]) & (run.model.effort_limit[driven] > 0.0)
    found = []
    for joints, share in ((driven[limited], True), (driven[~limited], False)):
        if not len(joints):
            continue
        values, names = run.torque[:, joints], run.model.joint_names
        values = 100.0 * values / run.model.effort_limit[joints] if share else values
        traces = [Trace(names[j], COLOURS[j % len(COLOURS)], values[:, k]) for k, j in enumerate(joints)]
        if share:
            level = np.full(len(run), 100.0)
            traces += [Trace("limit", COLOURS[6], level, limit=True), Trace("-limit", COLOURS[6], -level, limit=True)]
        kinds = [units_by_kind("N m", run.model.joint_types[j]) for j in joints]
        name, unit = ("torque", "% of limit") if share else ("torque without limit", " | ".join(dict.fromkeys(kinds)))
        found.append(Panel(name, unit, run.time, tuple(traces)))
    return found


def _friction(run: Run) -> Panel:
    """Return the size of friction at the tip beside its cone, see `closedloop.figures.force.friction_bounds`."""
    traces = [Trace("|Ft|", COLOURS[0], np.linalg.norm(run.friction_force, axis=1))]
    for k, (cone, name, _) in enumerate(friction_bounds(run)):
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
    named = count in (run.model.n, len(of_joints)) and count > 1
    labels = of_joints if named else ("x", "y", "z") if count == 3 else ()
    traces = tuple(
        Trace(labels[k] if labels else name if count == 1 else f"{name} {k}", COLOURS[k % len(COLOURS)], values[:, k])
        for k in range(count)
    )
    return Panel(COLUMN + name, run.units(name) or "1", run.time, traces)
