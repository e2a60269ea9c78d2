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
from typing import Any  # noqa: E402

# Where each public name is: in the file that type checkers read.
with open(f"{__file__}i") as _stub:
    _lines = [line.split() for line in _stub if line.startswith("from closedloop.")]
_HOME = {"figures": "figures"} | {name: module.removeprefix("closedloop.") for _, module, _, name, *_ in _lines}

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
