"""A run by scipy's DOP853 to its end, or to where it fails."""

from __future__ import annotations

import time as clock
from collections.abc import Callable

from closedloop.base.arrays import Array
from closedloop.base.errors import DivergenceError, InterruptedRunError, LawError, SimulationError
from closedloop.loop.step.record_row import complete_record, rows_there
from closedloop.simulation.engines.adaptive.drive import AdaptiveRun
from closedloop.simulation.engines.adaptive.memory import Stopped
from closedloop.simulation.engines.failures import failure_of, interrupted, when
from closedloop.simulation.engines.problem import Problem
from closedloop.simulation.engines.user_law import Law


def run_adaptive(
    problem: Problem, law: Law | None, report: Callable[[int, int], None], keep_interrupted: bool = False
) -> tuple[Array, Array, SimulationError | None, float]:
    """Run the problem to its end, or to where it fails; see `closedloop.simulation.simulate.run_loop`."""
    run = AdaptiveRun(problem, law, report)
    memory, steps = run.memory, problem.steps
    failure: SimulationError | None = None
    began = clock.perf_counter()
    try:
        report(0, steps)
        began = run.start()
        run.run_to_end()
        report(steps, steps)
        complete_record(memory.loop.address, memory.rows, run.row)
    except Stopped as stop:
        t = run.time
        if stop.fault:
            failure = DivergenceError(f"{when(t)}: {stop.fault}", t)
        else:
            failure = failure_of(stop.status, t, problem.robot, problem, law, memory.w.q, memory.w.v)
    except LawError as error:
        failure = error
    except KeyboardInterrupt as stop:
        if not keep_interrupted:
            raise
        failure = interrupted(stop, run.time)
    finally:
        memory.close()
    seconds = clock.perf_counter() - began
    done = run.row
    if isinstance(failure, InterruptedRunError):
        done = rows_there(memory.state, done, problem.robot.n)
    complete_record(memory.loop.address, memory.rows, done)
    return memory.rows[:done], memory.events[: int(memory.state.event.rows)], failure, seconds
