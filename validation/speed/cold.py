"""A fresh interpreter, from its start to its first result."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import closedloop

PROGRAM = "import closedloop as cl; cl.simulate(cl.load_scenario('wam_slide'), engine='{engine}')"


def first_result(engine: str, repeats: int) -> float:
    """Return the median seconds of a process that simulates `wam_slide` once, everything compiled before."""
    _timed(engine, {})
    return statistics.median(_timed(engine, {}) for _ in range(repeats))


def first_result_ever(engine: str) -> float:
    """Return the seconds of the first such process of an installation, which compiles."""
    with tempfile.TemporaryDirectory() as folder:
        return _timed(engine, {"NUMBA_CACHE_DIR": folder})


def _timed(engine: str, settings: dict[str, str]) -> float:
    root = str(Path(closedloop.__file__).parent.parent)
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", PROGRAM.format(engine=engine)],
        check=True,
        env={**os.environ, "PYTHONPATH": path, **settings},
    )
    return time.perf_counter() - began
