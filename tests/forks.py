"""What pages and notebooks tell their reader to run, in forks of the tests' process, which has loaded it all."""

import os
import runpy
import shlex
import sys
import tempfile
import traceback
from functools import partial
from pathlib import Path

import matplotlib

import closedloop as cl
from closedloop.__main__ import main
from closedloop.run import main as run

PROGRAMS = {("closedloop",): main, ("python", "-m", "closedloop.run"): run}


def load_for_forks():
    """Import and load here what nearly every page and notebook needs; forks have it then."""
    for name in ("wam_slide", "cube_toss"):
        cl.simulate(cl.load_scenario(name, {"time.duration": 0.02}), progress=False)


def forked(folder, work):
    """Do some work in a fork of this process, in `folder`; return its exit status and all that it says."""
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="backslashreplace") as said:
        child = os.fork()
        if child == 0:
            _work(folder, work, said.fileno())
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said.seek(0)
        return status, said.read()


def _work(folder, work, said):
    status = 1
    try:
        for number in (1, 2):
            os.dup2(said, number)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        matplotlib.use("agg")
        os.chdir(folder)
        sys.path.insert(0, str(folder))
        status = work() or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def program(text, folder):
    """Run a program as `python session.py` does."""
    (Path(folder) / "session.py").write_text(text, encoding="utf-8")

    def work():
        sys.argv = ["session.py"]
        runpy.run_path("session.py", run_name="__main__")

    return forked(folder, work)


def command(line, folder):
    """Run a command as it stands on a page, `closedloop ...` or `python -m closedloop.run ...`."""
    words = shlex.split(line, comments=True)
    for head, found in PROGRAMS.items():
        if tuple(words[: len(head)]) == head:
            return forked(folder, partial(found, words[len(head) :]))
    raise ValueError(f"no command of this package: {line}")
