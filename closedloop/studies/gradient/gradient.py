"""`cl.gradient` and `cl.sensitivities`: derivatives of runs with respect to numbers of the scenario.

`cl.sensitivities`: derivatives of whole columns of a run, over time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError, needs
from closedloop.base.progress import reporting
from closedloop.base.second_process import Beside
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import threads_for
from closedloop.simulation.engines.loops import COMPILED
from closedloop.studies.gradient import differences
from closedloop.studies.gradient.differences import Along, Direction, Estimate, Keys, Output, indexed, output, values_of
from closedloop.studies.gradient.exact import exact, grazes
from robot_models import RobotModel

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Entry = float | Array

# A derivative whose error may be more than this share of it is named.
ROUGH = 1e-4
# The columns of the table, and how their entries are written.
SHOWN = {"of": "{}", "key": "{}", "value": "{:.6g}", "derivative": "{:.6g}", "error": "{:.1e}", "method": "{}"}


@dataclass(frozen=True, eq=False, repr=False)
class Gradient:
    """Values of a run and their derivatives.

    An entry is a number if both the quantity and the key are numbers; else an array, whose first indices are those of
    the quantity, and whose last are those of the key.

    `value`: the quantities.
    `units`: their units.
    `derivative`: ``derivative[of][key]``, in the quantity's unit over the key's; NaN where there is no derivative;
        `problems` gives the reason.
    `error`: estimates of their errors.
    `method`: how each was found.
    `one_sided`: where there is no derivative, the one-sided derivatives below and above; NaN on a side without one.
        Empty elsewhere.
    `problems`: the quantities that have no derivative, or an uncertain one, and the reason.
    """

    value: dict[str, Entry]
    units: dict[str, str]
    derivative: dict[str, dict[str, Entry]]
    error: dict[str, dict[str, Entry]]
    method: dict[str, dict[str, str]]
    one_sided: dict[str, dict[str, tuple[Entry, Entry]]]
    problems: tuple[str, ...]

    def table(self) -> pd.DataFrame:
        """Return a row for each number: `of`, `key` with its entries, `value`, `derivative`, `error`, `method`."""
        needs("pandas")
        import pandas as pd

        return pd.DataFrame(self._rows(), columns=list(SHOWN))

    def _rows(self) -> list[dict[str, Any]]:
        rows = []
        for of, by_key in self.derivative.items():
            value = np.asarray(self.value[of])
            for key, derivative in by_key.items():
                error = np.asarray(self.error[of][key])
                for at, one in np.ndenumerate(np.asarray(derivative)):
                    mine, its = at[: value.ndim], at[value.ndim :]
                    rows.append(
                        {
                            "of": indexed(of, mine), "key": indexed(key, its), "value": value[mine],
                            "derivative": one, "error": error[at], "method": self.method[of][key],
                        }
                    )  # fmt: skip
        return rows

    def __str__(self) -> str:
        """Return the whole table and the problems."""
        cells = [list(SHOWN), *([form.format(row[name]) for name, form in SHOWN.items()] for row in self._rows())]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = ["  ".join(map(str.rjust, row, widths)) for row in cells]
        return "\n".join([*lines, *self.problems])

    __repr__ = __str__


@arguments_checked(keys="a list of keys", of="a list of quantities")
def gradient(
    scenario: Scenario, keys: Sequence[str], of: Sequence[str], *, model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False, workers: int | None = None,
) -> Gradient:  # fmt: skip
    """Return derivatives of quantities of a run with respect to numbers of its scenario.

    Parameters
    ----------
    scenario : Scenario
        From `load_scenario`.
    keys : sequence of str
        Dotted keys of numbers or of lists of numbers, such as ``["law.force", "law.kp"]``.
    of : sequence of str
        Values of `Run.summary`, ``rms_force_error``; a column at the row nearest to an instant, ``contact_force@3.5``,
        ``q@end``; columns of the events, ``event_time``.
    model : RobotModel, optional
        The robot to use instead of loading `scenario.robot.model`.
    progress : bool or callable
        True draws a bar on standard error; a callable gets (runs done, runs in all).
    workers : int, optional
        Threads; as many as there are cores if left out. The result is the same for any number.

    Returns
    -------
    Gradient

    Raises
    ------
    ScenarioError
        If a key or a quantity is unknown, or no real number.
    SimulationError
        If the run stops early.
    """
    if isinstance(of, str) or not of:
        raise ScenarioError("of: must be a list of quantities, such as ['rms_force_error', 'contact_force@end']")
    varied = Keys(scenario, keys)
    run = differences.simulated(scenario, model)
    outputs = [output(name, run) for name in dict.fromkeys(of)]
    return differentiated(varied, run, outputs, model, progress, workers)


def differentiated(
    varied: Keys, run: Run, outputs: Sequence[Output], model: RobotModel | None,
    progress: bool | Callable[[int, int], None], workers: int | None,
) -> Gradient:  # fmt: skip
    """Return the derivatives of outputs of a run; see `gradient`."""
    directions = varied.directions
    with reporting(progress, f"derivatives of {varied.scenario.name}", 6 * len(directions)) as report:
        base = _sampled(run, outputs)
        by_duals = exact(varied, run, base, outputs, model, report, workers)
        parts = [by_duals.outputs, [each for each in outputs if each not in by_duals.outputs]]
        made, problems = Gradient({}, {}, {}, {}, {}, {}, ()), [*grazes(run), *by_duals.problems]
        for some, found in zip(parts, (by_duals.found, {}), strict=True):
            if some:
                base = _sampled(run, some)
                rest = [d for d in directions if d not in found]
                found = found | differences.along(varied, rest, base, partial(values_of, some), model, report, workers)
                problems += _gathered(made, varied, run, some, base.values, {d: found[d] for d in directions})
    ordered: dict[str, Any] = {
        part.name: {each.name: getattr(made, part.name)[each.name] for each in outputs}
        for part in fields(Gradient)
        if part.name != "problems"
    }
    return Gradient(**ordered, problems=tuple(dict.fromkeys(problems)))


def _sampled(run: Run, outputs: Sequence[Output]) -> differences.Sample:
    """Return what is kept of the run itself."""
    scale = [np.full(value.size, np.max(np.abs(value), initial=0.0)) for value in (each.of(run) for each in outputs)]
    return replace(differences.sample(run, partial(values_of, outputs)), scale=np.concatenate(scale))


def _gathered(
    made: Gradient, varied: Keys, run: Run, outputs: Sequence[Output], values: Array, found: dict[Direction, Along]
) -> list[str]:
    """Put the derivatives of some quantities along all directions into `made` by name; return what is wrong."""
    problems = [f"no derivative with respect to {d}: {known.why}" for d, known in found.items() if known.best is None]
    for each, part in zip(outputs, differences.slices_of(outputs, run), strict=True):
        value = each.of(run)
        made.value[each.name], made.units[each.name] = _entry(value), each.units
        name = each.name
        made.derivative[name], made.error[name], made.method[name], made.one_sided[name] = {}, {}, {}, {}
        for key, at in varied.values.items():
            its = [found[d] for d in varied.directions if d.key == key]
            parts = [each.part(part) for each in its]
            shape = value.shape + at.shape
            four: list[Any] = [np.stack([one[i] for one in parts], axis=-1).reshape(shape) for i in range(4)]
            made.derivative[name][key], made.error[name][key] = _entry(four[0]), _entry(four[1])
            made.method[name][key] = its[0].method_of(part)
            if np.any(np.isnan(four[0])):
                made.one_sided[name][key] = _entry(four[2]), _entry(four[3])
        for d, known in found.items():
            if known.best is not None:
                problems += _named(each.name, d, known.part(part), values[part])
    return problems


def _named(of: str, direction: Direction, part: Estimate, values: Array) -> list[str]:
    """Return what has no derivative, or an uncertain one, in words."""
    lines, many = [], f" at {{}} of {values.size} places" if values.size > 1 else ""
    kinks = np.flatnonzero(part.kink)
    if kinks.size:
        i = kinks[0]
        lines.append(
            f"{of} has no derivative with respect to {direction}{many.format(kinks.size)}: "
            f"{part.below[i]:.6g} below and {part.above[i]:.6g} above"
        )
    least = 1e-2 * float(np.max(np.abs(values), initial=0.0)) / (direction.step / differences.SHARE)
    rough = np.flatnonzero(~part.kink & (part.error > ROUGH * np.maximum(np.abs(part.value), least)))
    if rough.size:
        i = rough[np.argmax(part.error[rough])]
        lines.append(
            f"{of} with respect to {direction}{many.format(rough.size)}: {part.value[i]:.6g} may be off by "
            f"{part.error[i]:.2g}; it is not smooth"
        )
    return lines


def _entry(array: Array) -> Entry:
    return float(array) if array.ndim == 0 else array


@arguments_checked(keys="a list of keys", of="a list of quantities")
def gradients(
    scenarios: Sequence[Scenario], keys: Sequence[str], of: Sequence[str], *, model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False, workers: int | None = None,
) -> list[Gradient]:  # fmt: skip
    """Return what `gradient` returns of each of several scenarios, on two cores.

    Half of the time is that of Python, and threads would wait for each other: a second process takes every other one.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Such as one with several values of a gain.
    keys, of, model
        See `gradient`.
    progress : bool or callable
        True draws a bar on standard error; a callable gets (scenarios done, scenarios in all).
    workers : int, optional
        1 leaves all scenarios to this process. The result is the same.

    Raises
    ------
    ScenarioError, SimulationError
        As `gradient`, of a scenario that it is raised of.
    """
    if not scenarios:
        raise ScenarioError("scenarios: must be a list of scenarios, such as [load_scenario('wam_slide')]")
    shared = threads_for(COMPILED, workers) > 1
    found: dict[int, Gradient] = {}
    with ExitStack() as open_until_done:
        report = open_until_done.enter_context(reporting(progress, "derivatives", len(scenarios)))

        def take(some: range) -> dict[int, Gradient]:
            for i in some:
                report(len(found), len(scenarios))
                found[i] = gradient(scenarios[i], keys, of, model=model, workers=1)
            return found

        take(range(1))  # the kernels are compiled now
        if shared:
            beside = Beside(lambda: take(range(2, len(scenarios), 2)))
            open_until_done.callback(beside.stop)
            take(range(1, len(scenarios), 2))
            found |= beside.result()
        else:
            take(range(1, len(scenarios)))
        report(len(scenarios), len(scenarios))
    return [found[i] for i in range(len(scenarios))]


@dataclass(frozen=True, eq=False)
class Sensitivities(Gradient):
    """Columns of a run and their derivatives; the first index of every array is the row.

    `time` (N,): instants of the rows, s.
    """

    time: Array

    def figure(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Return a figure: for each column and key a panel, in it a line for each entry of both.

        With `ax` it is drawn on axes of the caller's, see `closedloop.figures`.
        """
        from closedloop.figures.style import MANY, legend_beside_title, panels, styled

        pairs = [(of, key) for of, by_key in self.derivative.items() for key in by_key]
        with styled():
            figure, on = panels(len(pairs), 1.0 + 1.6 * len(pairs), ax)
            on[0].set_title("By how much a column changes with a number of the scenario")
            for axes, (of, key) in zip(on, pairs, strict=True):
                lines = np.asarray(self.derivative[of][key]).reshape(len(self.time), -1)
                for i, line in enumerate(lines.T):
                    label = f"[{i}]" if lines.shape[1] > 1 else None
                    axes.plot(self.time, line, color=MANY[i % len(MANY)], linewidth=1.2, label=label)
                if lines.shape[1] > 1:
                    legend_beside_title(axes)
                axes.set_ylabel(f"∂ {of} [{self.units[of]}]\n/ ∂ {key}", fontsize="small")
            on[-1].set_xlabel("time [s]")
        return figure


@arguments_checked(keys="a list of keys", of="a list of columns")
def sensitivities(
    scenario: Scenario, keys: Sequence[str], of: Sequence[str] = ("contact_force",), *,
    model: RobotModel | None = None, progress: bool | Callable[[int, int], None] = False, workers: int | None = None,
) -> Sensitivities:  # fmt: skip
    """Return derivatives of whole columns of a run with respect to numbers of its scenario.

    Parameters
    ----------
    scenario, keys, model, progress, workers
        See `closedloop.gradient`.
    of : sequence of str
        Columns of the run, such as ``["contact_force", "torque"]``.

    Returns
    -------
    Sensitivities

    Raises
    ------
    ScenarioError, SimulationError
        As `closedloop.gradient`.
    """
    if isinstance(of, str) or not of:
        raise ScenarioError("of: must be a list of columns, such as ['contact_force']")
    varied = Keys(scenario, keys)
    run = differences.simulated(scenario, model)
    outputs = [output(name, run, whole=True) for name in dict.fromkeys(of)]
    found = differentiated(varied, run, outputs, model, progress, workers)
    return Sensitivities(**{each.name: getattr(found, each.name) for each in fields(Gradient)}, time=run.time)
