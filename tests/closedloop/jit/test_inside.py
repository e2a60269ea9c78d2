"""What is not public of numba stays in `closedloop.jit.inside`, and the kernels give the same numbers without it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import closedloop as cl

ROOT = Path(cl.__file__).parent.parent
PRIVATE = re.compile(r"^\s*(?:from|import) (?:numba\.(?:core|np|_\w+)|llvmlite)\b", re.MULTILINE)
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
    """A whole slide of the compiled engine, with numba's public decorators alone, to the last bit.

    Without LLVM's optimisation, of which no number depends and whose time is a third of that for compiling.
    """
    said = [
        subprocess.run(
            [sys.executable, "-c", SLIDE], env=os.environ | {"PYTHONPATH": str(ROOT)} | more, check=True,
            capture_output=True, text=True,
        ).stdout
        for more in ({"CLOSEDLOOP_BACKGROUND_COMPILE": "0"}, {"CLOSEDLOOP_PLAIN_NUMBA": "1", "NUMBA_OPT": "0"})
    ]  # fmt: skip
    assert said[0] == said[1]
    assert said[0].endswith(" 501\n")
