"""Robot closed-loop dynamics for force control study.

    import closedloop as cl
    run = cl.simulate(cl.load_scenario("wam_slide", {"law.force": 15.0}))
    run.time, run.contact_force, run.summary(), run.plot()

Simulate
    load_scenario, shipped_scenarios, Scenario    scenarios: read one, list those of the package
    simulate                                      simulate a scenario to its end; returns a Run
    halve                                         the same, with the difference from a run at half the step
    Simulator, StepState                          simulate step by step, from your own program
    simulate_batch, sweep_plot                    many runs at once; maps of a sweep
    Run, Event, load_run                          the record, a change of the contact, read a run file
    compare                                       several laws or scenarios under the same variations
    linearise, linearize                          the force loop as a linear system: poles, margins, the port
    gradient, gradients, sensitivities            derivatives of runs with respect to numbers of their scenarios
    tune                                          gains, or other numbers, that minimise a value of the runs
    serve                                         let another program drive a scenario
    figures, lab                                  figures of a run; a page with sliders that simulates again
Build
    ControlLaw, Law, LawInput                     control laws of your own, and their input
    Surface, SurfaceMotion, Compliance            surfaces of your own, their motion and their compliance
    Robot, Terms, Plane, solve_closure            the arm, its terms at a state, the surface, Eq. 24
    prepare, Problem                              a scenario as arrays
Identify
    identify, Log                                 parameters of a robot, with intervals, from a log of its motion
    identify_contact                              friction, stiffness, damping, restitution, force sensor, from a log
    excite                                        a motion within limits that makes given parameters known best
    compare_log, Recording                        compare a log or a run with a scenario, and explain the difference
Errors, all of them ClosedLoopError
    ScenarioError, ModelError, RunFileError, OutputError, ClusterError
    SimulationError (its run has the rows until then): SingularClosureError, DivergenceError, ChatterError,
    PainleveError, NoNormalError, LawError, InterruptedRunError

help(cl.simulate), and so on, says more. Names are loaded when they are first used, so that ``import closedloop`` is
quick.
"""

from closedloop.command.current_folder import leave_out_current_folder, runs_a_command

leave_out_current_folder(__file__)  # before anything else is imported
if runs_a_command():
    import os

    # The matrices are those of one arm. Two threads would wait for each other where another process has a core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import _signal  # type: ignore[import-not-found]  # what `signal` is made of, there without a file to read

    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, _signal.SIG_DFL)  # ends the process without a word while the next is imported
    from closedloop.base.interrupts import leave_quietly

    if _signal.getsignal(_signal.SIGINT) == _signal.SIG_DFL:
        _signal.signal(_signal.SIGINT, _signal.default_int_handler)
    leave_quietly()  # until the command catches what is raised

import sys  # noqa: E402
from importlib import import_module  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

if TYPE_CHECKING:
    from closedloop import figures as figures
    from closedloop.base.errors import ChatterError as ChatterError
    from closedloop.base.errors import ClosedLoopError as ClosedLoopError
    from closedloop.base.errors import ClusterError as ClusterError
    from closedloop.base.errors import DivergenceError as DivergenceError
    from closedloop.base.errors import InterruptedRunError as InterruptedRunError
    from closedloop.base.errors import LawError as LawError
    from closedloop.base.errors import ModelError as ModelError
    from closedloop.base.errors import NoNormalError as NoNormalError
    from closedloop.base.errors import OutputError as OutputError
    from closedloop.base.errors import PainleveError as PainleveError
    from closedloop.base.errors import RunFileError as RunFileError
    from closedloop.base.errors import ScenarioError as ScenarioError
    from closedloop.base.errors import SimulationError as SimulationError
    from closedloop.base.errors import SingularClosureError as SingularClosureError
    from closedloop.control.law import ControlLaw as ControlLaw
    from closedloop.control.law import LawInput as LawInput
    from closedloop.lab.start import lab as lab
    from closedloop.mechanics.closure.solve import solve_closure as solve_closure
    from closedloop.mechanics.robot.pinocchio import Robot as Robot
    from closedloop.mechanics.robot.pinocchio import Terms as Terms
    from closedloop.mechanics.surface.motion import SurfaceMotion as SurfaceMotion
    from closedloop.mechanics.surface.placed import Plane as Plane
    from closedloop.mechanics.surface.surface import Compliance as Compliance
    from closedloop.mechanics.surface.surface import Surface as Surface
    from closedloop.record.columns.record import Event as Event
    from closedloop.record.run import Run as Run
    from closedloop.record.run import load_run as load_run
    from closedloop.scenario.load import load_scenario as load_scenario
    from closedloop.scenario.load import shipped_scenarios as shipped_scenarios
    from closedloop.scenario.scenario import Scenario as Scenario
    from closedloop.serve.serve import serve as serve
    from closedloop.simulation.batch.simulate_batch import simulate_batch as simulate_batch
    from closedloop.simulation.engines.problem import Problem as Problem
    from closedloop.simulation.engines.user_law import Law as Law
    from closedloop.simulation.prepare import prepare as prepare
    from closedloop.simulation.simulate import halve as halve
    from closedloop.simulation.simulate import simulate as simulate
    from closedloop.simulation.simulator import Simulator as Simulator
    from closedloop.simulation.state import StepState as StepState
    from closedloop.studies.analysis.assembly import linearise as linearise
    from closedloop.studies.comparison.compare import compare as compare
    from closedloop.studies.comparison.recording import Recording as Recording
    from closedloop.studies.comparison.with_log import compare_log as compare_log
    from closedloop.studies.gradient.gradient import gradient as gradient
    from closedloop.studies.gradient.gradient import gradients as gradients
    from closedloop.studies.gradient.gradient import sensitivities as sensitivities
    from closedloop.studies.identify.contact.identify_contact import identify_contact as identify_contact
    from closedloop.studies.identify.excite import excite as excite
    from closedloop.studies.identify.identify import identify as identify
    from closedloop.studies.identify.log import Log as Log
    from closedloop.studies.sweep.maps import sweep_plot as sweep_plot
    from closedloop.studies.tune.tune import tune as tune

    linearize = linearise

_HOME = {
    name: module
    for module, names in {
        "base.errors": "ChatterError ClosedLoopError ClusterError DivergenceError InterruptedRunError LawError "
        "ModelError NoNormalError OutputError PainleveError RunFileError ScenarioError SimulationError "
        "SingularClosureError",
        "control.law": "ControlLaw LawInput",
        "figures": "figures",
        "lab.start": "lab",
        "mechanics.closure.solve": "solve_closure",
        "mechanics.robot.pinocchio": "Robot Terms",
        "mechanics.surface.motion": "SurfaceMotion",
        "mechanics.surface.placed": "Plane",
        "mechanics.surface.surface": "Compliance Surface",
        "record.columns.record": "Event",
        "record.run": "Run load_run",
        "scenario.load": "load_scenario shipped_scenarios",
        "scenario.scenario": "Scenario",
        "serve.serve": "serve",
        "simulation.batch.simulate_batch": "simulate_batch",
        "simulation.engines.problem": "Problem",
        "simulation.engines.user_law": "Law",
        "simulation.prepare": "prepare",
        "simulation.simulate": "halve simulate",
        "simulation.simulator": "Simulator",
        "simulation.state": "StepState",
        "studies.analysis.assembly": "linearise",
        "studies.comparison.compare": "compare",
        "studies.comparison.recording": "Recording",
        "studies.comparison.with_log": "compare_log",
        "studies.gradient.gradient": "gradient gradients sensitivities",
        "studies.identify.contact.identify_contact": "identify_contact",
        "studies.identify.excite": "excite",
        "studies.identify.identify": "identify",
        "studies.identify.log": "Log",
        "studies.sweep.maps": "sweep_plot",
        "studies.tune.tune": "tune",
    }.items()
    for name in names.split()
}

_SPELLED = {"linearize": "linearise"}  # works, and is not listed
_NAMES = sorted(_HOME)
# What is looked for by another name.
_CALLED = {
    "run": "simulate(scenario) simulates, and load_run(path) reads a run", "sim": "simulate(scenario)",
    "plot": "simulate(scenario).plot(), or figures", "load": "load_scenario(name), or load_run(path)",
    "scenario": "load_scenario(name)", "analyse": "linearise(scenario)", "analyze": "linearize(scenario)",
}  # fmt: skip


def _meant(name: str) -> str:
    if name.startswith("_"):
        return ""
    from difflib import get_close_matches

    meant = _CALLED.get(name) or next(iter(get_close_matches(name, _NAMES, n=1, cutoff=0.7)), "")
    return f"; call closedloop.{meant}" if name in _CALLED else f"; did you mean '{meant}'?" if meant else ""


def __getattr__(name: str) -> Any:
    if name == "__all__" and sys._getframe(1).f_globals.get("__name__") != "pydoc":
        # Without it help() shows the text above, and not the three thousand lines of all that is named there.
        return _NAMES
    if name == "__version__":
        from importlib.metadata import version

        return version("closedloop")
    if name in _SPELLED:
        return __getattr__(_SPELLED[name])
    if name not in _HOME:
        raise AttributeError(f"module 'closedloop' has no attribute '{name}'{_meant(name)}")
    module = import_module(f"closedloop.{_HOME[name]}")
    value = module if _HOME[name] == name else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return _NAMES
