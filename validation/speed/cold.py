"""A fresh interpreter, from its start to its first result."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import closedloop

PROGRAM = "import closedloop as cl; cl.simulate(cl.load_scenario('wam_slide'), engine='{engine}')"
AFTERWARDS = "from closedloop.jit.background import wait_until_done; wait_until_done()"


def first_result(engine: str, repeats: int) -> float:
    """Return the median seconds of a process that simulates `wam_slide` once, everything compiled before."""
    _timed(engine, {})
    return statistics.median(_timed(engine, {}) for _ in range(repeats))


def first_result_ever(engine: str) -> float:
    """Return the seconds of the first such process of an installation, with nothing compiled."""
    with tempfile.TemporaryDirectory() as folder:
        settings = {"NUMBA_CACHE_DIR": folder}
        seconds = _timed(engine, settings)
        _timed(engine, settings, AFTERWARDS)  # no process in the background disturbs what is measured next
        return seconds


def _timed(engine: str, settings: dict[str, str], program: str = PROGRAM) -> float:
    root = str(Path(closedloop.__file__).parent.parent)
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", program.format(engine=engine)],
        check=True,
        env={**os.environ, "PYTHONPATH": path, **settings},
    )
    return time.perf_counter() - began
