"""A run does without scipy.linalg, whose import takes 0.3 s; a compiled law that needs BLAS still gets it."""

import subprocess
import sys
from pathlib import Path

import pytest

import closedloop as cl

PROGRAM = """
import sys
import numba
import numpy as np
import closedloop as cl

cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.01}))
print("scipy.linalg" in sys.modules)

@numba.njit
def product(a, b):
    return a @ b, np.linalg.cholesky(a)  # numba compiles `solve` for five times as long

a = np.array([[2.0, 1.0], [1.0, 3.0]])
print(np.allclose(product(a, a)[0], a.dot(a)), np.allclose(product(a, a)[1], np.linalg.cholesky(a)))
print("scipy.linalg" in sys.modules)
"""


@pytest.mark.slow
def test_a_run_does_not_import_scipy_linalg_and_blas_is_there_on_request():
    """In a fresh process: first a run, then a compiled matrix product (BLAS) and a factorisation (LAPACK)."""
    root = Path(cl.__file__).parent.parent
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=root, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.split() == ["False", "True", "True", "True"]
