"""A run that a law or a signal ends early: everything until then is there, to the bit, and the reason in one line."""

import importlib
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pytest

import closedloop as cl
from closedloop.base.errors import ClosedLoopError
from closedloop.base.interrupts import Terminated, held_back, terminable
from closedloop.loop.events.locate import TERMS
from closedloop.loop.step import entries
from closedloop.record.columns.record import COLUMNS
from closedloop.simulation import loop_calls, simulate
from closedloop.simulation.engines import loops
from closedloop.simulation.engines.user_law import UserLaw
from closedloop.simulation.prepare import prepare

INTEGRATORS = ("semi_implicit_euler", "rk4", "dop853")
LATE = 0.021


def scenario(integrator="semi_implicit_euler", **changes):
    """Return a slide of 0.03 s."""
    return cl.load_scenario("wam_slide", {"time.duration": 0.03, "time.integrator": integrator} | changes)


def soft(t, q, v, terms):
    """Press gently, and follow nothing."""
    return terms.bias - 5.0 * terms.jacobian[2] - 5.0 * v


def soft_until(late):
    """Return the same law with another end."""
    return lambda t, q, v, terms: soft(t, q, v, terms) if t < LATE - 1e-9 else late()


def begins_as(run, whole):
    """Whether a run is the beginning of another, to the last bit."""
    for name, column in COLUMNS.items():
        if column.dims[0] == "time":
            assert np.array_equal(getattr(run, name), getattr(whole, name)[: len(run)]), name
    return True


def fail():
    """Raise what a slip in a law raises."""
    raise IndexError("tuple index out of range")


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_exception_in_a_law_keeps_what_ran(integrator):
    """The error has the law's file, line, type and message, the exception as its cause, and all rows before it."""
    with pytest.raises(cl.LawError) as caught:
        cl.simulate(scenario(integrator), law=soft_until(fail))
    line = fail.__code__.co_firstlineno + 2
    message = str(caught.value)
    assert f"test_interrupted.py:{line}: IndexError: tuple index out of range" in message
    assert "\n" not in message
    assert isinstance(caught.value.__cause__, IndexError)
    run = caught.value.run
    assert run.stopped == message
    assert len(run) == 21
    # dop853 cuts its steps at the rows, so that it is the same to the bit too.
    assert begins_as(run, cl.simulate(scenario(integrator), law=soft))


NO_TORQUE = {
    "short": lambda: [1.0],
    "ragged": lambda: [[1.0], [1.0, 2.0]],
    "none": lambda: None,
    "text": lambda: ["1", "2", "3", "4"],
    "bool": lambda: np.ones(4, dtype=bool),
    "dates": lambda: np.ones(4, dtype="M8[s]"),
    "spans": lambda: np.ones(4, dtype="m8[s]"),
    "complex": lambda: np.ones(4, dtype=complex),
    "objects": lambda: np.ones(4, dtype=object),
}


@pytest.mark.parametrize("answer", NO_TORQUE)
@pytest.mark.parametrize("integrator", ["rk4", "dop853"])
def test_what_is_no_torque_ends_the_run_and_keeps_it(answer, integrator):
    """Text, truth values, dates, complex numbers and other shapes are refused wherever in the run they come."""
    with pytest.raises(cl.LawError, match="4 real numbers") as caught:
        cl.simulate(scenario(integrator), law=soft_until(NO_TORQUE[answer]))
    assert len(caught.value.run) == 21


@pytest.mark.parametrize("answer", NO_TORQUE)
def test_what_is_no_torque_at_the_start_is_an_input_at_fault(answer):
    """Before anything ran, the law is refused as an input."""
    with pytest.raises(cl.ScenarioError, match="4 real numbers"):
        cl.simulate(scenario(), law=lambda t, q, v, terms: NO_TORQUE[answer]())


@pytest.mark.parametrize("kind", [int, np.float32, np.uint8, np.longdouble])
def test_real_numbers_of_every_kind_are_torques(kind):
    """Whole numbers and floats of any width are taken."""
    run = cl.simulate(scenario(**{"time.duration": 0.002}), law=lambda t, q, v, terms: np.full(4, kind(3)))
    assert np.all(run.torque == 3.0)


def test_a_law_that_leaves_python_is_a_law_that_failed():
    """`sys.exit` in a law loses no rows."""

    def leave():
        raise SystemExit(0)

    with pytest.raises(cl.LawError, match="SystemExit") as caught:
        cl.simulate(scenario(), law=soft_until(leave))
    assert len(caught.value.run) == 21


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_ctrl_c_keeps_what_ran(integrator):
    """Ctrl-C in the middle ends the run with an error that is a KeyboardInterrupt too, and has all rows before it."""
    with pytest.raises(KeyboardInterrupt) as caught:
        cl.simulate(scenario(integrator), law=soft_until(interrupt))
    assert isinstance(caught.value, cl.InterruptedRunError)
    assert isinstance(caught.value, ClosedLoopError)
    assert "interrupted" in str(caught.value)
    assert len(caught.value.run) == 21
    assert begins_as(caught.value.run, cl.simulate(scenario(integrator), law=soft))


def test_a_run_that_crawls_returns_to_python_soon(monkeypatch):
    """Evaluations that take ten thousand times as long as those before are not done by the thousand."""
    time_of_one, clock, calls = 1e-6, [0.0], []

    def evaluate(evaluations):
        clock[0] += evaluations * time_of_one
        calls.append((evaluations, evaluations * time_of_one))
        return TERMS

    monkeypatch.setattr(loops.clock, "perf_counter", lambda: clock[0])
    taken = loops.Pace()
    for _ in range(20):
        assert taken.take(evaluate) == TERMS
    assert calls[-1][0] == loops.MOST, "it returns more often than need be"
    time_of_one = 1e-2
    for _ in range(20):
        taken.take(evaluate)
    assert [seconds for _, seconds in calls[21:] if seconds > 2.0 * loops.MOMENT] == []
    assert min(evaluations for evaluations, _ in calls) > 0


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
def test_how_often_a_run_returns_to_python_changes_no_bit(engine, monkeypatch):
    """Every evaluation, every seventh, or as many as there are."""
    whole = cl.simulate(scenario(), engine=engine)
    for count in (1, 7):
        monkeypatch.setattr(loops, "FEW", count)
        monkeypatch.setattr(loops, "MOST", count)
        assert begins_as(cl.simulate(scenario(), engine=engine), whole)


@pytest.fixture
def alarm():
    """Return a function that sends Ctrl-C after so many seconds, wherever Python is then."""

    def ring(number, frame):
        interrupt()

    before = signal.signal(signal.SIGALRM, ring)
    yield lambda seconds: signal.setitimer(signal.ITIMER_REAL, seconds)
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize(
    ("integrator", "law", "duration", "times"),
    [
        ("rk4", None, 8.0, 6),
        ("rk4", soft, 0.1, 6),
        pytest.param("dop853", None, 0.3, 6, marks=pytest.mark.slow),
        pytest.param("dop853", soft, 0.1, 6, marks=pytest.mark.slow),
    ],
    ids=["rk4", "rk4, a law", "dop853", "dop853, a law"],
)
def test_ctrl_c_at_any_moment(integrator, law, duration, times, alarm):
    """Wherever an interruption strikes, what is left is a beginning of the whole run, condition numbers included."""
    asked = scenario(integrator, **{"time.duration": duration})
    whole = cl.simulate(asked, law=law)
    seconds, rng, left = whole.wall_seconds, np.random.default_rng(5), []
    for _ in range(20 * times):
        # It may strike before the first step, where nothing is lost, or once the run has ended.
        with suppress(KeyboardInterrupt):
            try:
                alarm(rng.uniform(0.0, 1.0) * seconds + 0.001)
                # The first run may have compiled, and may have shared the processor: how long one takes is learnt.
                seconds = cl.simulate(asked, law=law).wall_seconds
            except cl.InterruptedRunError as error:
                left.append(error.run)
            finally:
                alarm(0.0)
        alarm(0.0)
        if len(left) == times:
            break
    assert left
    assert all(begins_as(run, whole) for run in left)


@pytest.mark.parametrize("what", ["TORQUE", "RATES"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_ctrl_c_as_the_law_is_entered(integrator, what):
    """Where nothing can catch it, and whatever the law is entered for: no row is half written."""
    whole = cl.simulate(scenario(integrator), law=soft)
    entered = 0

    def trace(frame, event, arg):
        nonlocal entered
        if frame.f_code is not UserLaw._entry.__code__:
            return None
        if event == "line" and frame.f_locals["what"] == getattr(entries, what):
            entered += 1
            if entered == 20:
                raise KeyboardInterrupt
        # Only the first line: what is raised at a later one is caught.
        return trace if event == "call" else None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        with pytest.raises(cl.InterruptedRunError) as caught:
            cl.simulate(scenario(integrator), law=soft)
    finally:
        sys.settrace(before)
    assert entered == 20
    run = caught.value.run
    assert 0 < len(run) < len(whole)
    assert begins_as(run, whole)


def interrupt():
    """Do what Ctrl-C does."""
    signal.raise_signal(signal.SIGINT)


def test_a_signal_waits_for_what_must_be_finished():
    """Inside `held_back` the first Ctrl-C waits for the end of the block; a second one does not."""
    done = []

    def finish():
        with held_back():
            interrupt()
            done.append("whole")

    def insist():
        with held_back():
            interrupt()
            interrupt()
            done.append("never")

    with pytest.raises(KeyboardInterrupt):
        finish()
    assert done == ["whole"]
    with pytest.raises(KeyboardInterrupt):
        insist()
    assert done == ["whole"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_sigterm_is_an_interruption_with_a_name():
    """SIGTERM ends a run as Ctrl-C does, within `terminable` alone."""

    def end():
        signal.raise_signal(signal.SIGTERM)

    with terminable(), pytest.raises(cl.InterruptedRunError, match="terminated") as caught:
        cl.simulate(scenario(), law=soft_until(end))
    assert isinstance(caught.value.__cause__, Terminated)
    assert len(caught.value.run) == 21
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_signal_that_an_import_swallows_comes_again(tmp_path, monkeypatch):
    """A library that is being imported may drop what a handler raises; a moment later it is raised for all that."""
    (tmp_path / "swallows_signals.py").write_text(
        "import signal\ntry:\n    signal.raise_signal(signal.SIGTERM)\nexcept BaseException:\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)

    def use():
        importlib.import_module("swallows_signals")
        time.sleep(5.0)

    with terminable(), pytest.raises(Terminated):
        use()


@pytest.mark.parametrize(
    ("module", "where"), [(simulate, "problem_of"), (loop_calls, "begun"), (loops, "addresses_of")]
)
def test_ctrl_c_before_the_first_step_carries_the_run(module, where, monkeypatch):
    """Whenever it comes, what is raised is the interrupted run; before there is a row it has none."""
    begins = partial(cl.simulate, scenario()) if module is simulate else prepare(scenario()).run
    plain = getattr(module, where)

    def interrupted_there(*arguments, **options):
        interrupt()
        return plain(*arguments, **options)

    monkeypatch.setattr(module, where, interrupted_there)
    with pytest.raises(cl.InterruptedRunError) as caught:
        begins()
    assert len(caught.value.run) == 0
    assert caught.value.run.scenario.name == "wam_slide"


STARTS = """
import os, signal, sys, _thread
count, at = 0, int(sys.argv.pop(1))
def see(event, arguments):
    global count
    if event == "import" and not at < 0:
        count += 1
        if count == at:
            signal.raise_signal(signal.SIGINT)
sys.argv[0] = "closedloop"
import closedloop
sys.addaudithook(see)
from closedloop.__main__ import main
sys.exit(main())
"""


def test_ctrl_c_while_a_command_is_imported_prints_no_traceback():
    """At whichever import it comes, the status is 130, and there is one line or none."""
    for at in (1, 40, 150):
        done = subprocess.run(
            [sys.executable, "-c", STARTS, str(at), "run", "--list"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 130, done.stderr
        assert len(done.stderr.splitlines()) <= 1, done.stderr
        assert "Traceback" not in done.stderr
