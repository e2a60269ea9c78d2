"""A fork while another thread works something out: what the copy asks for is worked out there, and nothing waits."""

import ast
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.record.run import Run
from robot_models.cached import cached_property

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")

# A copy that hangs is ended by the system, s: no answer takes as long.
LONGEST = 60


def answered_in_a_fork(ask):
    """Whether a copy of this process, forked now, comes to an end of `ask`."""
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LONGEST)
        try:
            ask()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.fixture
def being_worked_out(monkeypatch):
    """Keep another thread inside a property of a class while a test runs."""
    entered, go, threads = threading.Event(), threading.Event(), []

    def hold(prop, instance, name):
        plain = prop._function
        here = threading.get_ident()

        def slow(each):
            if threading.get_ident() != here and each is instance:
                entered.set()
                go.wait(LONGEST)
            return plain(each)

        monkeypatch.setattr(prop, "_function", slow)
        thread = threading.Thread(target=lambda: getattr(instance, name))
        thread.start()
        threads.append(thread)
        assert entered.wait(LONGEST)

    yield hold
    go.set()
    for thread in threads:
        thread.join()


def test_a_summary_is_made_in_a_fork_while_another_thread_is_in_one(being_worked_out):
    """Python 3.11's own property left its lock taken in the copy, which waited for ever."""
    one, other = (cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.01})) for _ in range(2))
    being_worked_out(vars(Run)["_summary"], one, "_summary")
    assert answered_in_a_fork(other.summary)


def test_all_threads_get_the_value_that_was_first():
    """Two that work it out at once agree on it."""
    meet, seen = threading.Barrier(2), []

    class Thing:
        @cached_property
        def value(self):
            meet.wait(LONGEST)
            return object()

    thing = Thing()
    threads = [threading.Thread(target=lambda: seen.append(thing.value)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen[0] is seen[1] is thing.value


def test_environments_are_stepped_and_closed_in_a_fork():
    """The threads that step them are not in the copy, which has its own; both give the same."""
    pytest.importorskip("gymnasium", reason="gymnasium is not installed: the extra 'gym'")
    from closedloop.gym.env import ContactVectorEnv

    envs = ContactVectorEnv(4, "press", threads=2)
    envs.reset(seed=0)
    actions = np.zeros(envs.action_space.shape)
    envs.step(actions)
    receive, send = os.pipe()

    def ask():
        os.write(send, envs.step(actions)[0].tobytes())
        envs.close()

    assert answered_in_a_fork(ask)
    assert os.read(receive, 1 << 16) == envs.step(actions)[0].tobytes()
    envs.close()
    os.close(receive)
    os.close(send)


def test_no_property_has_a_lock():
    """None in the packages is that of functools."""
    for package in (cl, robot_models):
        for file in Path(package.__file__).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module == "functools":
                    assert "cached_property" not in [alias.name for alias in node.names], file
