"""Robot closed-loop dynamics for force control study.

    import closedloop as cl
    run = cl.simulate(cl.load_scenario("wam_slide", {"law.force": 15.0}))
    run.time, run.contact_force, run.summary(), run.plot()

Simulate
    load_scenario, shipped_scenarios, Scenario    what is simulated
    simulate                                      a scenario to its end, as a Run
    halve                                         the same, and by how much it differs at half the step
    Simulator, StepState                          the same step by step, driven from outside
    simulate_batch, sweep_plot                    many runs at once; maps of a sweep
    Run, Event, load_run                          the record, what happened to the contact, a run file
    figures, lab                                  what of a run can be drawn; a page with sliders on which it answers
Build
    ControlLaw, Law, LawInput                     laws of one's own, and what they see
    Surface, SurfaceMotion, Compliance            surfaces of one's own, how they move, how they give way
    Robot, Terms, Plane, solve_closure            the arm, its terms at a state, the surface, Eq. 24
    prepare, Problem                              a scenario as numbers
Errors, all of them ClosedLoopError
    ScenarioError, ModelError, RunFileError, OutputError, ClusterError
    SimulationError (its run has the rows until then): SingularClosureError, DivergenceError, ChatterError,
    PainleveError, NoNormalError, LawError, InterruptedRunError

help(cl.simulate), and so on, says more. Names are loaded when they are first used, so that ``import closedloop`` is
quick.
"""

from __future__ import annotations

from closedloop.command.current_folder import leave_out_current_folder, runs_a_command

leave_out_current_folder(__file__)  # before anything else is imported
if runs_a_command():
    from closedloop.interrupts import leave_quietly

    leave_quietly()  # until the command catches what is raised

import sys  # noqa: E402
from importlib import import_module  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

if TYPE_CHECKING:
    from closedloop import figures as figures
    from closedloop.batch.simulate_batch import simulate_batch as simulate_batch
    from closedloop.closure.solve import solve_closure as solve_closure
    from closedloop.columns.events import Event as Event
    from closedloop.control.law import ControlLaw as ControlLaw
    from closedloop.control.law_input import LawInput as LawInput
    from closedloop.engines.problem import Problem as Problem
    from closedloop.engines.user_law import Law as Law
    from closedloop.errors import ChatterError as ChatterError
    from closedloop.errors import ClosedLoopError as ClosedLoopError
    from closedloop.errors import ClusterError as ClusterError
    from closedloop.errors import DivergenceError as DivergenceError
    from closedloop.errors import InterruptedRunError as InterruptedRunError
    from closedloop.errors import LawError as LawError
    from closedloop.errors import ModelError as ModelError
    from closedloop.errors import NoNormalError as NoNormalError
    from closedloop.errors import OutputError as OutputError
    from closedloop.errors import PainleveError as PainleveError
    from closedloop.errors import RunFileError as RunFileError
    from closedloop.errors import ScenarioError as ScenarioError
    from closedloop.errors import SimulationError as SimulationError
    from closedloop.errors import SingularClosureError as SingularClosureError
    from closedloop.lab.start import lab as lab
    from closedloop.record.load import load_run as load_run
    from closedloop.record.run import Run as Run
    from closedloop.robot.pinocchio import Robot as Robot
    from closedloop.robot.pinocchio import Terms as Terms
    from closedloop.scenario.file import shipped_scenarios as shipped_scenarios
    from closedloop.scenario.load import load_scenario as load_scenario
    from closedloop.scenario.scenario import Scenario as Scenario
    from closedloop.simulation.halve import halve as halve
    from closedloop.simulation.prepare import prepare as prepare
    from closedloop.simulation.simulate import simulate as simulate
    from closedloop.simulation.simulator import Simulator as Simulator
    from closedloop.simulation.state import StepState as StepState
    from closedloop.surface.compliance import Compliance as Compliance
    from closedloop.surface.motion import SurfaceMotion as SurfaceMotion
    from closedloop.surface.plane import Plane as Plane
    from closedloop.surface.surface import Surface as Surface
    from closedloop.sweep import sweep_plot as sweep_plot

_HOME = {
    "ChatterError": "errors",
    "ClosedLoopError": "errors",
    "ClusterError": "errors",
    "Compliance": "surface.compliance",
    "ControlLaw": "control.law",
    "DivergenceError": "errors",
    "Event": "columns.events",
    "InterruptedRunError": "errors",
    "Law": "engines.user_law",
    "LawError": "errors",
    "LawInput": "control.law_input",
    "ModelError": "errors",
    "NoNormalError": "errors",
    "OutputError": "errors",
    "PainleveError": "errors",
    "Plane": "surface.plane",
    "Problem": "engines.problem",
    "Robot": "robot.pinocchio",
    "Run": "record.run",
    "RunFileError": "errors",
    "Scenario": "scenario.scenario",
    "ScenarioError": "errors",
    "SimulationError": "errors",
    "Simulator": "simulation.simulator",
    "SingularClosureError": "errors",
    "Surface": "surface.surface",
    "SurfaceMotion": "surface.motion",
    "StepState": "simulation.state",
    "Terms": "robot.pinocchio",
    "figures": "figures",
    "halve": "simulation.halve",
    "lab": "lab.start",
    "load_run": "record.load",
    "load_scenario": "scenario.load",
    "prepare": "simulation.prepare",
    "shipped_scenarios": "scenario.file",
    "simulate": "simulation.simulate",
    "simulate_batch": "batch.simulate_batch",
    "solve_closure": "closure.solve",
    "sweep_plot": "sweep",
}

_NAMES = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name == "__all__" and sys._getframe(1).f_globals.get("__name__") != "pydoc":
        # Without it help() shows the text above, and not the three thousand lines of all that is named there.
        return _NAMES
    if name not in _HOME:
        raise AttributeError(f"module 'closedloop' has no attribute '{name}'")
    module = import_module(f"closedloop.{_HOME[name]}")
    value = module if _HOME[name] == name else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return _NAMES
