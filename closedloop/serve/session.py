"""The simulation that is served, and its record."""

from __future__ import annotations

from closedloop.base.arrays import Array
from closedloop.record.run import Run
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.simulator import Simulator
from closedloop.simulation.state import StepState


class Session:
    """A simulation that clients drive one after the other, and how many of its cycles had a command.

    Attributes
    ----------
    simulator : Simulator
        The simulation; `simulator.problem` is the scenario, prepared.
    cycles, lost : int
        Steps since the last reset during which a client drove, and those of them for which no command came in time.
    late : int
        Instants of real time that this computer was too late for; see `closedloop.serve.clock`.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.simulator = Simulator(scenario)
        self.period = self.simulator.problem.h
        self.cycles = self.lost = self.late = 0
        self.simulator.reset()

    @property
    def state(self) -> StepState:
        """The present state."""
        return self.simulator.state

    @property
    def done(self) -> bool:
        """Whether the end of the scenario is reached."""
        return self.simulator.done

    def reset(self) -> StepState:
        """Begin anew; the record of what was before is dropped."""
        self.cycles = self.lost = self.late = 0
        return self.simulator.reset()

    def step(self, torque: Array | None) -> StepState:
        """Advance by one step with a torque (n,), N m, or with None by the scenario's own law."""
        return self.simulator.step(torque)

    def run(self) -> Run:
        """Return the record so far."""
        return self.simulator.run()
