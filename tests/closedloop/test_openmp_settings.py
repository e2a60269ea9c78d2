"""Settings of OpenMP that cannot be read: left out before its library reads them, and no others."""

import ctypes.util
import os
import subprocess
import sys

import pytest

from closedloop.jit.openmp_settings import readable_openmp

READABLE = {
    "OMP_NUM_THREADS": ["1", " 2 ", "4,2", "+3"],
    "OMP_MAX_ACTIVE_LEVELS": ["0", "3"],
    "OMP_DYNAMIC": ["true", " FALSE"],
    "OMP_WAIT_POLICY": ["active"],
    "OMP_PROC_BIND": ["close, spread", "primary"],
    "OMP_SCHEDULE": ["static", "nonmonotonic : dynamic , 4"],
    "OMP_STACKSIZE": ["16", "10 M", "65536"],
    "GOMP_SPINCOUNT": ["infinite", "10k"],
    "GOMP_CPU_AFFINITY": ["0", "0-1 0", "0-2:2,0"],
    "OMP_PLACES": ["threads", "cores(2)", "{0}", "{0:2}:1"],
    "OMP_TARGET_OFFLOAD": ["disabled"],
    "OMP_ALLOCATOR": ["omp_default_mem_alloc"],
}
UNREADABLE = ["", "many", "1.5", "-1.", "1,", "{", "0 1,x", "true false", "0x", "\n", "ε"]
CASES = [
    *((name, value, True) for name, values in READABLE.items() for value in values),
    *((name, value, False) for name in READABLE for value in UNREADABLE),
    ("OMP_NUM_THREADS", "0", False), ("OMP_STACKSIZE", "15", False), ("OMP_PLACES", "0-1", False),
]  # fmt: skip
# What the library says of each setting, with the settings left out that are.
ASKED = """
import ctypes, os, sys
from closedloop.jit.openmp_settings import readable_openmp
for word in sys.stdin.read().split("\\0"):
    name, value = word.split("=", 1)
    os.environ[name] = value
    if os.fork() == 0:
        with readable_openmp():
            ctypes.CDLL(sys.argv[1])
        os._exit(0)
    assert os.wait()[1] == 0
    del os.environ[name]
"""


def test_what_cannot_be_read_is_left_out_and_said(monkeypatch):
    """Of each, one line with its name and what it must be; afterwards it is there again. Others stay."""
    for name, value, readable in CASES:
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            patch.setenv("OMP_OF_MY_OWN", "!")
            with readable_openmp() as said:
                assert (name in os.environ) == (not said) == readable, (name, value)
                assert "OMP_OF_MY_OWN" in os.environ
            assert os.environ[name] == value
            for line in said:
                assert line.startswith(f"{name} = {value!r} is left out: must be ")
                assert "\n" not in line


@pytest.mark.slow
@pytest.mark.skipif(ctypes.util.find_library("gomp") is None, reason="GNU's library of OpenMP is not here")
def test_the_library_has_nothing_to_say(monkeypatch):
    """Of what it can read, and of what it is not given: it is loaded once for each setting."""
    for name in {name for name, _, _ in CASES}:
        monkeypatch.delenv(name, raising=False)
    words = "\0".join(f"{name}={value}" for name, value, _ in CASES if name != "OMP_PLACES" or "2" not in value)
    done = subprocess.run(
        [sys.executable, "-c", ASKED, ctypes.util.find_library("gomp")], input=words, text=True, capture_output=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, timeout=100,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
