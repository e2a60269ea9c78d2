"""Signals at any moment of a command: what is on the disk afterwards opens, and nothing else is there."""

import json
import os
import signal
import sys
import time
import traceback

import numpy as np
import pytest
from budget import budget

import closedloop as cl
from closedloop.base.files import remove_unfinished
from closedloop.record.columns.record import COLUMNS
from closedloop.run import main

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")

LAW = """
import time

def slow(t, q, v, terms):
    time.sleep(1e-3)
    return terms.bias - 5.0 * terms.jacobian[2]
"""
COMMAND = ["wam_slide", "--law=slow_law:slow", "--time.duration=0.1", "--no-figures", "--no-halve", "--json", "--out"]
# How long a command may take to end after a signal, s.
PATIENCE = 60.0


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a slow law in it, in which the command has run twice, the second time to `whole`."""
    folder = tmp_path_factory.mktemp("killed")
    (folder / "slow_law.py").write_text(LAW)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [*sys.path])
        assert main([*COMMAND, "first"]) == 0  # which imports and compiles what the next only runs
        began = time.perf_counter()
        assert main([*COMMAND, "whole"]) == 0
        (folder / "seconds").write_text(str(time.perf_counter() - began))
        yield folder
    sys.modules.pop("slow_law", None)


def run_and_signal(place, out, number, after):
    """Run the command in a fork of this process, send it a signal after so many seconds; return status and words."""
    said = place / f"{out}.txt"
    child = os.fork()
    if child == 0:
        status = 99
        try:
            with said.open("w") as stream:
                sys.stdout = sys.stderr = stream
                try:
                    status = main([*COMMAND, out])
                except KeyboardInterrupt:  # it came before or after the command
                    status = 130
                except BaseException:
                    traceback.print_exc(file=stream)
                    status = 98
        finally:
            os._exit(status)
    time.sleep(after)
    os.kill(child, number)
    waited = time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), said.read_text() if said.exists() else ""
        if time.monotonic() - waited > PATIENCE:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None, "did not end"
        time.sleep(0.01)


def judge(place, number, times, seed):
    """Send the signal at a random moment in each of so many parts of the time that a run takes, and a little longer.

    Look at what is left; return the statuses.
    """
    whole = cl.load_run(place / "whole" / "run.nc")
    seconds = float((place / "seconds").read_text())
    rng, statuses = np.random.default_rng(seed), set()
    for i in range(times):
        out = f"{number}_{seed}_{i}"
        status, words = run_and_signal(place, out, number, 1.3 * (i + rng.uniform()) / times * seconds)
        statuses.add(status)
        assert "Traceback" not in words, words
        folder = place / out
        if not folder.exists():
            continue
        removed = remove_unfinished(folder)
        assert not removed or number == signal.SIGKILL
        left = {path.name for path in folder.iterdir()}
        assert left <= {"run.nc", "summary.json"}
        if "summary.json" in left:
            assert "run.nc" in left
            json.loads((folder / "summary.json").read_text())
        if "run.nc" in left:
            run = cl.load_run(folder / "run.nc")
            assert run.stopped is not None or len(run) == len(whole)
            changed = [n for n in COLUMNS if not np.array_equal(run.columns[n], whole.columns[n][: len(run)])]
            assert changed == []
        elif status in (130, 143):
            assert words.startswith(("", "closedloop: ")[bool(words)])
    return statuses


ALLOWED = {
    signal.SIGINT: {0, 99, 130},  # 99 where nothing catches it yet, or any more
    signal.SIGTERM: {0, 143, -signal.SIGTERM},  # the last before the command listens
    signal.SIGKILL: {0, -signal.SIGKILL},
}


@pytest.mark.parametrize("number", ALLOWED)
def test_signal_at_a_few_moments(number, place):
    """Two moments each; with the full budget forty."""
    assert judge(place, number, budget(2, 40), 0) <= ALLOWED[number]
