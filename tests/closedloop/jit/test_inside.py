"""What is not public of numba stays in `closedloop.jit.inside`, and the kernels give the same numbers without it."""

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from budget import budget

import closedloop as cl

ROOT = Path(cl.__file__).parent.parent
PRIVATE = re.compile(r"^\s*(?:from|import) (?:numba\.(?:core|np|_\w+)|llvmlite)\b", re.MULTILINE)
# A path of joints that a tip follows, and an impact: of what ships the kernels that compile in the shortest time, and
# that have records, blocks, branches, loops and nested calls.
BRIEF = """
import hashlib
import numpy as np
import closedloop as cl
from closedloop.mechanics.impact import two_phase_impact
from closedloop.simulation.prepare import prepare
table = prepare(cl.load_scenario("planar2_slide", {"time.duration": 0.5})).table
struck = two_phase_impact([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]], [-1.0, 0.4, 0.1], 0.5, friction=0.3)
print(hashlib.sha256(table.tobytes() + struck.after.tobytes()).hexdigest(), struck.modes, len(table))
"""
SLIDE = """
import hashlib
import closedloop as cl
run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.5}), engine="compiled")
print(hashlib.sha256(run.contact_force.tobytes() + run.q.tobytes() + run.v.tobytes()).hexdigest(), len(run))
"""


def test_no_private_name_of_numba_is_imported_elsewhere():
    """Its submodules, which its documentation does not name, and LLVM's binding."""
    files = [file for package in ("closedloop", "robot_models") for file in (ROOT / package).rglob("*.py")]
    private = {file for file in files if PRIVATE.search(file.read_text(encoding="utf-8"))}
    assert {file.parent for file in private} == {ROOT / "closedloop" / "jit" / "inside"}


@pytest.mark.slow
def test_the_plain_form_gives_the_same_numbers():
    """With numba's public decorators alone, to the last bit; with the full budget a whole slide.

    Without LLVM's optimisation, of which no number depends and whose time is a third of that for compiling.
    """
    program = budget(BRIEF, SLIDE)
    plain = {"PYTHONPATH": str(ROOT), "CLOSEDLOOP_PLAIN_NUMBA": "1", "NUMBA_OPT": "0"}
    alone = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | plain, check=True, capture_output=True, text=True
    )
    with contextlib.redirect_stdout(io.StringIO()) as ours:
        exec(program, {})
    assert alone.stdout == ours.getvalue()
    assert alone.stdout.endswith(" 501\n")
