"""Ctrl-C while numba compiles: answered as soon as the compiler is done, and the compiler can be used after it."""

import random
import signal
import subprocess
import sys
import threading
import time

import numba
import numpy as np
import pytest
from numba import types
from numba.core.compiler_lock import _CompilerLock, global_compiler_lock

from closedloop.base.interrupts import Terminated, terminable
from closedloop.control.law import LAWS
from closedloop.jit import calls
from closedloop.jit.calls import compiled_address
from closedloop.jit.kernel import direct, entry_kernel, jit_disabled, kernel
from closedloop.loop.step.entries import law_entry

pytestmark = pytest.mark.skipif(bool(jit_disabled()), reason="nothing is compiled")

SOURCE = """
def {name}(x, out):
    for i in range(x.shape[0]):
        out[i] = np.sin(x[i]) * np.cos(x[i]) + np.sqrt(np.abs(x[i])) + np.hypot(x[i], 1.0)
"""
NUMBERS = np.zeros(3)


def made(decorate, name="work"):
    """Return a function without a file, so that nothing is kept: it is compiled anew each time."""
    names = {"np": np}
    exec(SOURCE.format(name=name), names)
    return decorate(names[name])


def lock_is_free():
    """Whether another thread could compile now."""
    free = []

    def ask():
        if global_compiler_lock._lock.acquire(timeout=1.0):
            global_compiler_lock._lock.release()
            free.append(True)

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return bool(free)


@pytest.fixture
def signal_as_the_lock_is_taken(monkeypatch):
    """Send Ctrl-C at the instant at which numba has its lock, but is not yet ready to let it go."""
    acquire, sent = _CompilerLock.acquire, []

    def acquire_and_signal(self):
        acquire(self)
        if not sent:
            sent.append(True)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(_CompilerLock, "acquire", acquire_and_signal)
    return sent


@pytest.mark.parametrize("decorate", [entry_kernel, kernel], ids=["entry kernel", "kernel"])
@pytest.mark.parametrize("way", ["called", "direct"])
def test_ctrl_c_as_the_compiler_takes_its_lock(decorate, way, signal_as_the_lock_is_taken):
    """The function is compiled, then Ctrl-C is answered; the lock is free, and the usual handler is back."""
    function, out = made(decorate), np.zeros(3)
    before = signal.getsignal(signal.SIGINT)
    if way == "direct" and decorate is kernel:
        function = function.ordinary
    with pytest.raises(KeyboardInterrupt):
        (direct(function, NUMBERS, out) if way == "direct" else function)(NUMBERS, out)
    assert signal_as_the_lock_is_taken
    assert lock_is_free()
    assert signal.getsignal(signal.SIGINT) is before
    assert len(getattr(function, "ordinary", function).signatures) == 1
    function(NUMBERS, out)
    np.testing.assert_array_equal(out, 1.0)


@pytest.mark.usefixtures("signal_as_the_lock_is_taken")
def test_numba_alone_leaves_its_lock_taken():
    """The negative control: what is not ours leaves the lock taken, which is what the tests above would see."""
    function = made(numba.njit)
    try:
        with pytest.raises(KeyboardInterrupt):
            function(NUMBERS, np.zeros(3))
        assert not lock_is_free()
    finally:
        while global_compiler_lock.is_locked():
            global_compiler_lock._lock.release()


class SignalOnceTaken:
    """LLVM's lock, with Ctrl-C as it has been taken."""

    def __init__(self, lock):
        self.lock, self.sent = lock, False

    def acquire(self):
        """Take it, and send Ctrl-C the first time."""
        self.lock.acquire()
        if not self.sent:
            self.sent = True
            signal.raise_signal(signal.SIGINT)

    def release(self):
        """Let it go."""
        self.lock.release()

    def is_free(self):
        """Whether another thread could ask LLVM now; if not, it can afterwards."""
        taken = []

        def ask():
            taken.append(self.lock.acquire(timeout=1.0))
            if taken[0]:
                self.lock.release()

        thread = threading.Thread(target=ask)
        thread.start()
        thread.join()
        if not taken[0]:
            self.lock.release()
        return taken[0]


@pytest.mark.parametrize("ours", [True, False])
def test_ctrl_c_as_llvm_is_asked_for_an_address(monkeypatch, ours):
    """Each run asks for the addresses of what its loop calls: it left the lock taken, and the next batch hung."""
    from llvmlite.binding import ffi

    entry = law_entry(LAWS["paper"])
    compiled = entry.get_compile_result(types.int64(types.int64, types.int64))
    where = compiled_address(entry)
    monkeypatch.delitem(calls._addresses, entry)
    lock = SignalOnceTaken(ffi.lib._lock._lock)
    monkeypatch.setattr(ffi.lib._lock, "_lock", lock)
    ask, what = compiled_address, entry
    if not ours:  # the negative control
        ask, what = compiled.library.get_pointer_to_function, compiled.fndesc.llvm_cfunc_wrapper_name
    with pytest.raises(KeyboardInterrupt):
        ask(what)
    assert lock.sent
    assert lock.is_free() == ours
    assert compiled_address(entry) == where


# Runs of every kind, from Python that has nothing of numba's yet; prints what asked LLVM while Ctrl-C would not wait.
EVERY_WAY = """
import signal, threading, traceback
from llvmlite.binding import ffi

def taken():
    if threading.current_thread() is threading.main_thread():
        asked.append(True)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            stack = traceback.extract_stack()
            print(*(f"{call.filename}:{call.lineno}" for call in stack if "closedloop" in call.filename), sep=" > ")

asked = []
ffi.register_lock_callback(taken, lambda: None)
signal.signal(signal.SIGINT, signal.default_int_handler)
import closedloop as cl

short = cl.load_scenario("planar2_slide", {"time.duration": 0.02})
cl.simulate(short)
cl.simulate(short, engine="compiled")
cl.Simulator(short).run()
cl.simulate_batch(short, {"law.force": [1.0, 2.0]}, workers=1)
import numba

before = len(asked)
cl.simulate(short, law=numba.njit(lambda t, q, v, terms: terms.bias), engine="compiled")
assert 0 < before < len(asked)
print("asked by others")
import llvmlite.binding as llvm

llvm.get_host_cpu_name()
"""


def test_ctrl_c_waits_whenever_llvm_is_asked():
    """Whatever a run asks of LLVM, Ctrl-C waits: numba's start and its addresses too; but not what others ask."""
    done = subprocess.run([sys.executable, "-c", EVERY_WAY], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    by_runs, _, by_others = done.stdout.partition("asked by others\n")
    assert by_runs == ""
    assert by_others


def test_a_second_ctrl_c_does_not_wait(monkeypatch):
    """Who presses it twice does not want to wait for the compiler."""
    compiled = made(numba.njit)

    def compile_and_signal(signature):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("it went on")

    monkeypatch.setattr(compiled, "compile", compile_and_signal)
    monkeypatch.setattr("closedloop.jit.kernel._njit", lambda function, *_, **options: compiled)
    with pytest.raises(KeyboardInterrupt):
        made(entry_kernel)(NUMBERS, np.zeros(3))


CALLED_BACK = """
import ctypes, signal

@ctypes.CFUNCTYPE(None)
def call_back():
    signal.raise_signal(number)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_the_compiler_calls_back_is_not_lost(monkeypatch, capfd, number):
    """What is raised in a callback of LLVM is printed and forgotten: the signal is answered after it, and quietly."""
    compiled, names = made(numba.njit), {"__name__": "llvmlite.binding.executionengine", "number": number}
    exec(CALLED_BACK, names)

    def compile_and_call_back(signature):
        names["call_back"]()
        if number == signal.SIGINT:
            names["call_back"]()  # the first one waits until all is compiled
        time.sleep(5.0)
        raise AssertionError("it went on")

    monkeypatch.setattr(compiled, "compile", compile_and_call_back)
    monkeypatch.setattr("closedloop.jit.kernel._njit", lambda function, *_, **options: compiled)
    with terminable(), pytest.raises(KeyboardInterrupt) as stopped:
        made(entry_kernel)(NUMBERS, np.zeros(3))
    assert isinstance(stopped.value, Terminated) == (number == signal.SIGTERM)
    assert "ignored" not in capfd.readouterr().err


def test_other_threads_compile_as_ever():
    """Signals come in the main thread only: nothing is held back elsewhere."""
    out, function = np.zeros(3), made(entry_kernel)
    thread = threading.Thread(target=function, args=(NUMBERS, out))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(out, 1.0)


@pytest.mark.slow
def test_ctrl_c_at_random_moments_of_compiling():
    """Wherever in the compiler it comes: the function is compiled whole or not at all, and others can be after it."""
    rng, main = random.Random(5), threading.main_thread().ident
    began = time.perf_counter()
    made(entry_kernel)(NUMBERS, np.zeros(3))
    seconds, answered = time.perf_counter() - began, 0
    for k in range(6):
        function, out = made(entry_kernel, f"work{k}"), np.zeros(3)
        wait = rng.uniform(0.0, seconds)

        def interrupt(wait=wait):
            time.sleep(wait)
            signal.pthread_kill(main, signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        try:
            thread.start()
            function(NUMBERS, out)
            thread.join()
            time.sleep(0.01)
        except KeyboardInterrupt:
            answered += 1
            thread.join()
        assert lock_is_free()
        function(NUMBERS, out)
        np.testing.assert_array_equal(out, 1.0)
    assert answered == 6
