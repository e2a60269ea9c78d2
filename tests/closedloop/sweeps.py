"""What the tests of sweeps share: a small sweep, the command line in this process, and as a process to be killed."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from closedloop.sweep.__main__ import main

# 12 runs, of which one axis is refused at its short end.
SMALL = (
    "wam_slide", "--time.duration", "0.02",
    "--over", "law.force=5:15:4", "--over", "stabiliser.time_constant=5e-4,0.001,0.01",
)  # fmt: skip


def sweep(capsys, *arguments):
    """Run the command line here; return exit status, standard output and standard error."""
    capsys.readouterr()
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    # Where nothing is compiled yet, that is said, and takes so long that how far it is is said too.
    said = [
        line for line in captured.err.splitlines(True) if not re.match(r"compiling |closedloop.sweep: \d+ of", line)
    ]
    return status, captured.out, "".join(said)


def refusal(capsys, *arguments):
    """Return the one line on standard error, having checked that it is one, and that the exit status is 2."""
    status, out, err = sweep(capsys, *arguments)
    assert status == 2, err
    assert not out
    assert len(err.splitlines()) == 1, err
    return err.removeprefix("closedloop.sweep: ")


def _heed_interrupts():
    """Undo what a shell does to the tests if it runs them in the background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def process(folder: Path, *arguments):
    """Start the command line as a process of its own in `folder`."""
    return subprocess.Popen(
        [sys.executable, "-m", "closedloop.sweep", *map(str, arguments)],
        cwd=folder, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=_heed_interrupts,
    )  # fmt: skip
