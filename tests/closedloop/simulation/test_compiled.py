"""One source, two ways to run it: compiled, and in plain Python."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
from closedloop.jit.cache_folder import cache_folder
from closedloop.jit.kernel import needs_compiling
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO, kernels_of, loop_for

ROOT = Path(cl.__file__).parent.parent

# All in one process: to start one takes longer than the runs.
PROGRAM = """
import json, sys, numba, closedloop as cl
assert numba.config.DISABLE_JIT
for name, changes in json.load(sys.stdin).items():
    cl.simulate(cl.load_scenario(name, changes)).save(name + ".nc")
"""
INTERPRETED = {
    name: {"time.duration": 0.03, "law.pd_start": 0.0} | changes
    for name, changes in {
        "wam_slide": {"reference.start": 0.02},
        "planar2_slide": {"reference.start": 0.02, "time.integrator": "rk4", "law.sample_period": 0.002},
        "planar2_drop": {"surface.gap": 1e-5},
    }.items()
}


@pytest.fixture(scope="module")
def interpreted(tmp_path_factory):
    """Return a folder with the runs that the interpreter made."""
    folder = tmp_path_factory.mktemp("interpreted")
    subprocess.run(
        [sys.executable, "-c", PROGRAM], input=json.dumps(INTERPRETED), text=True, cwd=folder, check=True, timeout=120,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    return folder


@pytest.mark.parametrize("name", INTERPRETED)
def test_interpreted_run_is_the_compiled_one(name, interpreted):
    """The same source run by the interpreter gives the same columns.

    Both do strict IEEE arithmetic in the same order, so they agree to the last bit; 1e-12 is room for a compiler that
    fuses a product and a sum.
    """
    theirs = cl.load_run(interpreted / f"{name}.nc").columns
    run = cl.simulate(cl.load_scenario(name, INTERPRETED[name]))
    assert np.ptp(run.contact_force) > 0.1
    for column, ours in run.columns.items():
        assert theirs[column].shape == ours.shape
        if ours.size:
            assert np.max(np.abs(ours - theirs[column])) <= 1e-12 * max(1.0, np.max(np.abs(ours))), column


def test_compiled_code_is_kept_by_the_text_of_its_source():
    """After a run nothing of it is left to compile, and the cache's folder is named after a digest."""
    cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}))
    assert not needs_compiling(loop_for(PINOCCHIO))
    assert len(cache_folder().name.removeprefix("closedloop-")) == 16


def test_one_step_for_both_engines():
    """What takes long to compile is compiled once: the engines differ in what they call it with."""
    (own,), (_, called) = kernels_of(PINOCCHIO), kernels_of(COMPILED)
    assert own is called
    assert loop_for(COMPILED) is not loop_for(PINOCCHIO)
