"""Several laws, tunings or scenarios side by side under the same variations, and a log over a scenario.

The variations are the same for all, value by value and seed by seed, so that two laws meet the same friction, the same
surface and the same noise, and differences of a row are differences of the laws. A log is aligned in time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array, plain
from closedloop.base.errors import ScenarioError, needs
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.record.report.control_verdict import rms
from closedloop.record.run import Run
from closedloop.scenario.load import load_scenario
from closedloop.scenario.messages import with_unit
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import one_number, simulate_batch
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.simulate import simulate
from closedloop.studies.comparison import recording as logs
from closedloop.studies.comparison.recording import Audit, Reason, Recording
from closedloop.studies.identify.motion import LogError
from robot_models import RobotModel

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# So many values of a key that varies are named, the first and the last ones.
NAMED = 6
# Values of the summary that are compared, if none are named.
OF = ("rms_force_error", "peak_contact_force", "rms_path_error", "force_chatter", "max_joint_torque")


@dataclass(frozen=True, eq=False)
class Comparison:
    """The result of a comparison.

    `runs`: a row for each run: `scenario`, the keys that vary, status, both verdicts, and the values compared.
    `of`: the values compared.
    `units`: their units.
    """

    runs: pd.DataFrame
    of: tuple[str, ...]
    units: dict[str, str]

    @property
    def variations(self) -> str:
        """What varies and over which values, in words; "" if nothing does."""
        columns = list(self.runs.columns)
        keys = columns[columns.index("scenario") + 1 : columns.index("status")]
        said = []
        for key in keys:
            words = list(dict.fromkeys(f"{x:.6g}" if isinstance(x, float) else str(x) for x in self.runs[key]))
            if len(words) > NAMED:
                words = [", ".join(words[:2]) + f" ... {words[-1]} ({len(words)} values)"]
            said.append(f"{key} = {', '.join(words)}")
        return "; ".join(said)

    def table(self) -> pd.DataFrame:
        """Return a row for each scenario: how many runs it has, how many are good, the median and the worst values.

        Good is a run that is done with both verdicts good. The worst is the largest; a run without a value has none.
        The columns have the units of their values, such as ``"rms_force_error, worst [N]"``.
        """
        rows = {}
        for name, runs in self.runs.groupby("scenario", sort=False):
            good = (runs["status"] == "done") & (runs["verdict"] == "good") & (runs["control_verdict"] == "good")
            row: dict[str, Any] = {"runs": len(runs), "good": int(good.sum())}
            for each in self.of:
                values, unit = runs[each], self.units.get(each, "")
                row[with_unit(f"{each}, median", unit)] = values.median()
                row[with_unit(f"{each}, worst", unit)] = values.max()
            rows[name] = row
        import pandas as pd

        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("scenario")

    def figure(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Return a figure: for each value a point a run, the scenarios beside one another, and a bar at the median.

        With `ax` it is drawn on axes of the caller's, see `closedloop.figures`.
        """
        from closedloop.figures.style import MANY, panels, styled

        names = list(dict.fromkeys(self.runs["scenario"]))
        with styled():
            figure, on = panels(len(self.of), 1.0 + 1.3 * len(self.of), ax)
            for axes, each in zip(on, self.of, strict=True):
                for place, name in enumerate(names):
                    values = self.runs.loc[self.runs["scenario"] == name, each].to_numpy()
                    spread = place + np.linspace(-0.25, 0.25, values.size) if values.size > 1 else [place]
                    axes.plot(spread, values, "o", color=MANY[place % len(MANY)], markersize=3)
                    if np.any(np.isfinite(values)):
                        axes.plot([place - 0.3, place + 0.3], [np.nanmedian(values)] * 2, "k-", linewidth=1.6)
                unit = self.units.get(each, "")
                axes.set_ylabel(f"{each}\n[{unit}]" if unit else each, fontsize="small")
            words = [name.replace("_", "_\n").replace(":", ":\n") if len(names) > 3 else name for name in names]
            on[-1].set_xticks(range(len(names)), words)
            varied = wrap(self.variations, 70)
            on[0].set_title("\n".join(["each point a run; bars: medians", *varied]), fontsize="small")
        return figure


@arguments_checked()
def compare(
    scenarios: Mapping[str, Scenario] | Sequence[Scenario | str], over: Mapping[str, Sequence[Any]] | None = None, *,
    of: Sequence[str] = OF, engine: str = COMPILED, workers: int | None = None,
) -> Comparison:  # fmt: skip
    """Run several scenarios under the same variations and return their values side by side.

    Parameters
    ----------
    scenarios : mapping, or sequence
        Scenarios by the names that they are to have, or scenarios and names for `load_scenario`.
    over : mapping of str to sequence, optional
        Keys and their values, combined in all ways, such as ``{"friction.coefficient": [0.2, 0.4, 0.6], "sensor.seed":
        [0, 1, 2]}``; if left out, each scenario runs once, unchanged.
    of : sequence of str
        Values of `Run.summary`. If a value has a number for each joint, the largest magnitude is compared.
    engine, workers
        See `simulate_batch`.

    Raises
    ------
    ScenarioError
        If there are none, two have one name, a key is unknown to one of them, or there is no such value.
    """
    needs("pandas", "pyarrow")
    import pandas as pd

    named = _named(scenarios)
    tables = []
    units: dict[str, str] = {}
    for name, scenario in named.items():
        changes = dict(over) if over else {"time.duration": [scenario.time.duration]}
        try:
            table = simulate_batch(scenario, changes, grid=True, engine=engine, workers=workers)
        except ScenarioError as error:
            raise ScenarioError(f"compare: {error}") from None
        if lacking := [each for each in of if each not in table.column_names]:
            raise ScenarioError(
                f"compare: of = {', '.join(lacking)}: no value of a run's summary, such as rms_force_error"
            )
        units |= {each: ((table.schema.field(each).metadata or {}).get(b"units") or b"").decode() for each in of}
        frame = table.select([*(over or ()), "status", "verdict", "control_verdict", "reason", *of]).to_pandas()
        for each in of:
            frame[each] = [one_number(value) for value in table[each].to_pylist()]
        frame.insert(0, "scenario", name)
        tables.append(frame)
    return Comparison(pd.concat(tables, ignore_index=True), tuple(of), units)


def _named(scenarios: Mapping[str, Scenario] | Sequence[Scenario | str]) -> dict[str, Scenario]:
    if isinstance(scenarios, Mapping):
        found = dict(scenarios)
    else:
        loaded = [load_scenario(each) if isinstance(each, str) else each for each in scenarios]
        found = {each.name: each for each in loaded}
        if len(found) < len(loaded):
            raise ScenarioError(
                "compare: two of the scenarios have one name; give a mapping, such as {'paper': ..., 'hybrid': ...}"
            )
    if not found:
        raise ScenarioError("compare: there are no scenarios to compare")
    return found


# Shifts that are tried, the rows that they are tried on, and the share of the shorter one that must overlap.
SHIFTS, TRIED_ROWS, OVERLAP = 800, 400, 0.5
# A signal whose spread is below this tells no shift.
STILL = 1e-4


def shift_of(clock: Array, recording: Recording, run: Run) -> tuple[float, str]:
    """Return the shift at which log and run differ least, and what told it; that of two runs is 0."""
    if recording.is_run:
        return 0.0, "the clock of both runs"
    pairs = [("q", recording.q, run.q)] if recording.q is not None else []
    if recording.force is not None and run.scenario.has_surface:
        size = recording.force if recording.force.ndim == 1 else np.linalg.norm(recording.force, axis=1)
        pairs.append(("force", np.abs(size)[:, None], np.abs(run.contact_force)[:, None]))
    if recording.speed is not None:
        pairs.append(("speed", recording.speed[:, None], np.linalg.norm(run.velocity, axis=1)[:, None]))
    for name, logged, simulated in pairs:
        spread = simulated.std(axis=0)
        moves = (spread > STILL) & (logged.std(axis=0) > STILL)
        if moves.any():
            logged, simulated = (x[:, moves] / spread[moves] for x in (logged, simulated))
            return _best_shift(clock, logged, run.time, simulated), name
    return 0.0, ""


def _best_shift(clock: Array, logged: Array, time: Array, simulated: Array) -> float:
    """Return the shift of least mean square difference: of many, then between the best one's neighbours."""
    rows = np.unique(np.linspace(0, len(clock) - 1, TRIED_ROWS).astype(int))
    shorter = min(clock[-1], time[-1] - time[0])
    first, last = clock[0] - time[-1] + OVERLAP * shorter, clock[-1] - time[0] - OVERLAP * shorter

    def cost(shift: float, rows: NDArray[np.int64] = rows) -> float:
        at = clock[rows] - shift
        inside = (at >= time[0]) & (at <= time[-1])
        there = rows[inside]
        if len(there) < 10:
            return np.inf
        return sum(
            float(np.mean((logged[there, k] - np.interp(at[inside], time, simulated[:, k])) ** 2))
            for k in range(logged.shape[1])
        )

    shifts = np.union1d(np.linspace(first, last, SHIFTS), [0.0])
    best = int(np.argmin([cost(shift) for shift in shifts]))
    around = shifts[max(best - 1, 0)], shifts[min(best + 1, len(shifts) - 1)]
    every = np.arange(len(clock))
    found = minimize_scalar(lambda s: cost(s, every), bounds=around, method="bounded", options={"xatol": 1e-7})
    return float(found.x) if found.fun < cost(shifts[best], every) else float(shifts[best])


@dataclass(frozen=True, eq=False)
class Difference:
    """A quantity of a log beside the same of the run.

    `labels`: of its columns.
    `time` (N,): s, of the run.
    `logged`, `simulated` (N, k).
    `reasons`: what explains the difference.
    """

    name: str
    unit: str
    labels: tuple[str, ...]
    time: Array
    logged: Array
    simulated: Array
    reasons: list[Reason]

    @property
    def rms(self) -> Array:
        """RMS of the difference of each column."""
        return np.array([rms(x) for x in (self.logged - self.simulated).T])

    @property
    def size(self) -> Array:
        """RMS of each column as logged."""
        return np.array([rms(x) for x in self.logged.T])


@dataclass(frozen=True, eq=False)
class LogComparison:
    """The result of a comparison with a log.

    `run`: of the scenario.
    `shift`: the instant t of the run is t + `shift` of the log, counted from the log's first row, s.
    `shift_from`: from which quantity the shift was found: "q", "force", "speed", "the clock of both runs", or "" where
        nothing moves and the shift is 0.
    `overlap`: length of time that both cover, s.
    `differences`: "q", "torque", "force" and "speed", those that the log has.
    `audit`: audit of the log's force; None without torque, force or surface.
    `notes`: quantities that could not be compared, and why.
    """

    run: Run
    shift: float
    shift_from: str
    overlap: float
    differences: dict[str, Difference]
    audit: Audit | None
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Return the comparison in words."""
        by = f"by {self.shift_from}" if self.shift_from else "no motion in it determines the shift"
        told = [f"aligned: the log is {self.shift:+.6g} s from the run ({by}); {self.overlap:.4g} s in common"]
        for each in self.differences.values():
            told += ["", f"{each.name}: RMS of log minus run, {each.unit}"]
            for label, error, size in zip(each.labels, each.rms, each.size, strict=True):
                share = f", {100 * error / size:.3g} % of it" if size > 0.0 else ""
                told.append(f"  {label:20} {error:.4g}{share}")
            if np.all(each.rms <= logs.NOTHING * rms(each.logged)):
                told.append("  equal, to rounding and interpolation")
                continue
            told += [f"  {text}" for text in _explained(each.reasons)] or ["  nothing simple explains it"]
        if self.audit is not None:
            told += ["", "the log's own force", *(f"  {line}" for line in self.audit.lines())]
            told += [f"  {text}" for text in _explained(self.audit.reasons)]
        return told + [f"note: {note}" for note in self.notes]

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison for a program."""
        report: dict[str, Any] = {"shift": self.shift, "overlap": self.overlap, "notes": self.notes}
        for key, each in self.differences.items():
            report[key] = {
                "labels": each.labels, "unit": each.unit, "rms": each.rms, "size": each.size,
                "reasons": [_reason(reason) for reason in each.reasons],
            }  # fmt: skip
        if self.audit is not None:
            report["audit"] = {
                "reading": self.audit.what, "rms": self.audit.rms, "expected": self.audit.size,
                "rms_as_normal_force": self.audit.usual, "consistent": self.audit.consistent,
                "torque_explained": self.audit.explained, "reasons": [_reason(x) for x in self.audit.reasons],
            }  # fmt: skip
        return plain(report)

    def figure(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Return a figure: log and run one over the other, and their difference below, for each quantity.

        With `ax` it is drawn on axes of the caller's, see `closedloop.figures`.
        """
        from closedloop.figures.style import MANY, legend_beside_title, panels, styled

        with styled():
            figure, on = panels(2 * len(self.differences), 3.4 * len(self.differences) + 0.6, ax)
            on[0].set_title("Log: wide and pale; run: narrow")
            for at, each in enumerate(self.differences.values()):
                over, below = on[2 * at], on[2 * at + 1]
                for k, label in enumerate(each.labels):
                    colour = MANY[k % len(MANY)]
                    over.plot(each.time, each.logged[:, k], color=colour, alpha=0.45, linewidth=2.4)
                    over.plot(each.time, each.simulated[:, k], color=colour, linewidth=1.0, label=label)
                    below.plot(each.time, (each.logged - each.simulated)[:, k], color=colour)
                over.set_ylabel("\n".join([*wrap(each.name, 16), f"[{each.unit}]"]))
                below.set_ylabel(f"difference\n[{each.unit}]")
                legend_beside_title(over)
            on[-1].set_xlabel("time of the run, s")
        return figure


@arguments_checked()
def compare_log(
    log: Recording | Run | str | Path, scenario: Scenario, *, model: RobotModel | None = None,
    shift: float | None = None, cutoff: float | None = None,
) -> LogComparison:  # fmt: skip
    """Simulate a scenario and compare a log with it.

    Parameters
    ----------
    log : Recording, Run or path
        A file's columns are found by their usual names; `closedloop.studies.comparison.recording.read_recording` reads
        those with others.
    scenario : Scenario
        What the log is compared with.
    model : RobotModel, optional
        The robot to use instead of the one that the scenario names.
    shift : float, optional
        The instant of the log, s from its first row, at which the run begins; found if left out.
    cutoff : float, optional
        Cutoff of the filters in the audit of the log's force, Hz.

    Returns
    -------
    LogComparison

    Raises
    ------
    LogError
        If the log has other joints, or both have less than half of the shorter one in common.
    ScenarioError, SimulationError
        As `simulate` raises them.
    """
    run = simulate(scenario, model=model, progress=False)
    if isinstance(log, str | Path):
        recording = logs.read_recording(log, run.model)
    else:
        recording = logs.checked(logs.of_run(log) if isinstance(log, Run) else log, run.model)
    clock = recording.time - recording.time[0]
    normal_there = run.scenario.has_surface
    notes = []
    if recording.force is not None and not normal_there:
        notes.append("the scenario has no surface: the log's force is not compared")
    found, by = (shift, "the given shift") if shift is not None else shift_of(clock, recording, run)
    inside = (clock - found >= run.time[0]) & (clock - found <= run.time[-1])
    _need_overlap(int(inside.sum()), recording.step, clock, run, recording.source)
    time: Array = clock[inside] - found
    q, v, torque = (_at(time, run, run[name]) for name in ("q", "v", "torque"))
    robot = Robot(run.model, run.scenario.robot.tip) if run.model.tip or run.scenario.robot.tip else None
    names = run.model.joint_names
    differences = {}
    if recording.q is not None:
        differences["q"] = Difference(
            "joint positions", "rad (m)", names, time, recording.q[inside], q,
            logs.explain(*logs.of_joints(recording.q[inside] - q, names, v, torque), rms(q)),
        )  # fmt: skip
    else:
        notes.append("the log has no joint positions: joints are not compared")
    normal = _at(time, run, run.surface_normal) if normal_there else None
    told = None
    if recording.torque is not None:
        logged = recording.torque[inside]
        differences["torque"] = Difference(
            "torques", "N m (N)", names, time, logged, torque,
            logs.explain(
                *logs.of_torques(
                    logged - torque, time, names, (q, v, _at(time, run, run.acceleration)), torque, robot, normal
                ),
                rms(torque),
            ),
        )  # fmt: skip
    else:
        notes.append("the log has no torque: its force is not audited")
    if recording.force is not None and normal is not None:
        logged = recording.force[inside]
        along = np.einsum("ij,ij->i", logged, normal) if logged.ndim == 2 else logged
        force = _at(time, run, run.contact_force)
        differences["force"] = Difference(
            "contact force along the normal", "N", ("on the robot",), time, along[:, None], force[:, None],
            logs.explain(along - force, logs.force_hypotheses(force, np.gradient(force, time)), rms(force)),
        )  # fmt: skip
        if recording.torque is not None and recording.q is not None and robot is not None:
            acting = recording.torque[inside] + _beside(time, run, robot)
            struck = np.array([event.time for event in run.events if event.kind == "impact"])
            part = Recording(time, recording.q[inside], acting, logged, recording.source)
            try:
                told = logs.audit(part, robot, normal, cutoff, struck)
            except logs.NothingLeftError as error:
                notes.append(f"the log's force is not audited: {error}")
            if struck.size:
                notes.append("impulses are no part of a force: the audit leaves out what is near impacts of the run")
    elif recording.force is None:
        notes.append("the log has no force")
    if recording.speed is not None:
        speed = np.linalg.norm(_at(time, run, run.velocity), axis=1)
        differences["speed"] = Difference(
            "speed of the tip", "m/s", ("its size",), time, recording.speed[inside, None], speed[:, None], []
        )
    return LogComparison(run, float(found), by, float(time[-1] - time[0]), differences, told, notes)


def _at(time: Array, run: Run, column: Array) -> Array:
    """Return a column of the run at these instants, between its rows by a line."""
    if column.ndim == 1:
        return np.interp(time, run.time, column)
    return np.stack([np.interp(time, run.time, x) for x in column.T], axis=1)


def _beside(time: Array, run: Run, robot: Robot) -> Array:
    """Return the torques (N, n) beside those of the drives and the tip's force, N m: H q̈ + C − Q − JᵀF."""
    found = np.empty_like(run.torque)
    for k, (q, v, a, torque, force) in enumerate(
        zip(run.q, run.v, run.acceleration, run.torque, run.tip_force, strict=True)
    ):
        terms = robot.terms(q, v)
        found[k] = terms.mass_matrix @ a + terms.bias - torque - terms.jacobian.T @ force
    return _at(time, run, found)


def _need_overlap(rows: int, step: float, clock: Array, run: Run, source: str) -> None:
    common = rows * step
    shorter = min(float(clock[-1]), float(run.time[-1] - run.time[0]))
    if common < 0.9 * OVERLAP * shorter:
        raise LogError(
            f"{source}: log and run have {common:.4g} s in common, of {clock[-1]:.4g} s and {run.time[-1]:.4g} s: give "
            "another shift, or a longer scenario"
        )
    if rows < logs.FEWEST:
        raise LogError(
            f"{source}: {rows} rows in the {run.time[-1]:.4g} s of the run, {step:.4g} s apart: a comparison needs at "
            f"least {logs.FEWEST}; is its time in s?"
        )


def _explained(reasons: Sequence[Reason]) -> list[str]:
    told = []
    for reason in reasons:
        values = ", ".join(
            f"{label + ' ' if label else ''}{value:.4g} ± {half:.2g}"
            for label, value, half in zip(reason.labels or ("",), reason.value, reason.half, strict=True)
        )
        told.append(
            f"explained by {reason.name}: {values}{'' if reason.unit == '1' else ' ' + reason.unit} "
            f"(alone {100 * reason.alone:.0f} %; with it {100 * (1.0 - reason.left):.1f} %)"
        )
        if reason.as_well:
            told.append(f"  as well by {' or by '.join(reason.as_well)}: this log does not distinguish them")
    return told


def _reason(reason: Reason) -> dict[str, Any]:
    return {
        "name": reason.name, "unit": reason.unit, "labels": reason.labels, "value": reason.value,
        "half_interval": reason.half, "alone": reason.alone, "explained": 1.0 - reason.left, "as_well": reason.as_well,
    }  # fmt: skip
