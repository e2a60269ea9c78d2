"""`cl.sensitivities`: derivatives of whole columns of a run, over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from closedloop.base.arguments import arguments_checked
from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.scenario.scenario import Scenario
from closedloop.studies.gradient.gradient import Gradient, differentiated
from closedloop.studies.gradient.keys import Keys
from closedloop.studies.gradient.outputs import output
from closedloop.studies.gradient.variants import simulated
from robot_models import RobotModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Sensitivities(Gradient):
    """Columns of a run and their derivatives; the first index of every array is the row.

    Attributes
    ----------
    time : (N,) array
        Instants of the rows, s.
    """

    time: Array

    def figure(self) -> Figure:
        """Return a figure: for each column and key a panel, in it a line for each entry of both."""
        from closedloop.figures.style import MANY, new_figure, styled

        pairs = [(of, key) for of, by_key in self.derivative.items() for key in by_key]
        with styled():
            figure = new_figure(1.0 + 1.6 * len(pairs))
            panels = np.atleast_1d(figure.subplots(len(pairs), 1, sharex=True))
            for axes, (of, key) in zip(panels, pairs, strict=True):
                lines = np.asarray(self.derivative[of][key]).reshape(len(self.time), -1)
                for i, line in enumerate(lines.T):
                    label = f"[{i}]" if lines.shape[1] > 1 else None
                    axes.plot(self.time, line, color=MANY[i % len(MANY)], linewidth=1.2, label=label)
                if lines.shape[1] > 1:
                    axes.legend(loc="upper right", fontsize=7, ncols=4)
                axes.set_ylabel(f"∂ {of} [{self.units[of]}]\n/ ∂ {key}", fontsize=8)
            panels[-1].set_xlabel("time [s]")
            panels[0].set_title("by how much a column changes with a number of the scenario")
        return figure


@arguments_checked(keys="a list of keys", of="a list of columns")
def sensitivities(
    scenario: Scenario,
    keys: Sequence[str],
    of: Sequence[str] = ("contact_force",),
    *,
    model: RobotModel | None = None,
    progress: bool | Callable[[int, int], None] = False,
    workers: int | None = None,
) -> Sensitivities:
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
    run = simulated(scenario, model)
    outputs = [output(name, run, whole=True) for name in dict.fromkeys(of)]
    found = differentiated(varied, run, outputs, model, progress, workers)
    return Sensitivities(**{each.name: getattr(found, each.name) for each in fields(Gradient)}, time=run.time)
