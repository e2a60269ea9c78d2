"""Settings of OpenMP from outside that its library cannot read.

Pinocchio brings GNU's library, which reads them when it is loaded, and says of one that it cannot read a line
of its own in the middle of a command. Nothing here depends on them: such a setting is left out, and that is said.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

_MORE, _ONE, _ANY = r"\s*,\s*", r"\+?0*[1-9]\d{0,8}", r"\+?\d{1,9}"
_SWITCH = "true|false"
# A stack has 16 kB at least; without a unit a size is in kB.
_STACK = rf"(1[6-9]|[2-9]\d|[1-9]\d{{2,8}})\s*k?|{_ONE}\s*[mg]|[1-9]\d{{5,9}}\s*b"
_EVERY = rf"(:{_ANY}(:-?{_ANY})?)?"
_PLACE = rf"!?({_ANY}|\{{!?{_ANY}{_EVERY}({_MORE}!?{_ANY}{_EVERY})*\}}){_EVERY}"
_PROCESSORS = rf"{_ANY}(-{_ANY}(:{_ANY})?)?"
_WHERE = "master|primary|close|spread"
_HOW = r"((non)?monotonic\s*:\s*)?(static|dynamic|guided|auto)"
# What each may be, in words, and as a pattern.
_READABLE = {
    "OMP_NUM_THREADS": ("a positive number, or several with commas between", rf"{_ONE}({_MORE}{_ONE})*"),
    **dict.fromkeys(("OMP_THREAD_LIMIT", "OMP_NUM_TEAMS", "OMP_TEAMS_THREAD_LIMIT"), ("a positive number", _ONE)),
    **dict.fromkeys(
        ("OMP_MAX_ACTIVE_LEVELS", "OMP_DEFAULT_DEVICE", "OMP_MAX_TASK_PRIORITY", "GOMP_DEBUG"),
        ("a whole number, zero or more", _ANY),
    ),
    **dict.fromkeys(
        ("OMP_NESTED", "OMP_DYNAMIC", "OMP_CANCELLATION", "OMP_DISPLAY_AFFINITY"), ("true or false", _SWITCH)
    ),
    "OMP_DISPLAY_ENV": ("true, false or verbose", rf"{_SWITCH}|verbose"),
    "OMP_WAIT_POLICY": ("active or passive", "active|passive"),
    "OMP_PROC_BIND": (
        "true, false, or a list of primary, close and spread", rf"{_SWITCH}|({_WHERE})({_MORE}({_WHERE}))*"
    ),
    "OMP_SCHEDULE": (
        "static, dynamic, guided or auto, and after a comma a number if need be", rf"{_HOW}({_MORE}{_ANY})?"
    ),
    **dict.fromkeys(("OMP_STACKSIZE", "GOMP_STACKSIZE"), ("a size of 16k or more, such as 4M", _STACK)),
    "GOMP_SPINCOUNT": ("a whole number or infinite", rf"-?{_ANY}\s*[bkmg]?|infinit[ey]"),
    "GOMP_CPU_AFFINITY": ("numbers of processors such as 0-3", rf"{_PROCESSORS}([\s,]+{_PROCESSORS})*"),
    "OMP_PLACES": (
        "threads, cores, sockets, or places such as {0:4}",
        rf"(threads|cores|sockets|ll_caches|numa_domains)(\s*\({_ONE}\))?|{_PLACE}({_MORE}{_PLACE})*",
    ),
    "OMP_TARGET_OFFLOAD": ("default, mandatory or disabled", "default|mandatory|disabled"),
    "OMP_ALLOCATOR": ("an allocator such as omp_default_mem_alloc", r"omp_\w+_mem_alloc"),
}  # fmt: skip


@contextmanager
def readable_openmp() -> Iterator[list[str]]:
    """Leave out settings of OpenMP that cannot be read, meanwhile; give a line for each."""
    left_out = {
        name: value
        for name, value in os.environ.items()
        if name in _READABLE and not re.fullmatch(rf"\s*({_READABLE[name][1]})\s*", value, re.ASCII | re.IGNORECASE)
    }
    for name in left_out:
        del os.environ[name]
    try:
        yield [f"{name} = {value[:40]!r} is left out: must be {_READABLE[name][0]}" for name, value in left_out.items()]
    finally:
        os.environ.update(left_out)
