"""Settings of numba in the environment; some values would end a command with a traceback.

A number of threads that is none is left out: nothing here depends on it. Of other variables that it does not
understand numba warns with a traceback, and takes its defaults. A file of settings that cannot be read is refused.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

THREADS = "NUMBA_NUM_THREADS"
_HOW_MANY = re.compile(r"\s*0*[1-9]\d{0,4}\s*", re.ASCII)
FILE = ".numba_config.yaml"  # in the current folder


@contextmanager
def sound_settings() -> Iterator[None]:
    """Leave out a number of threads that is none, and what numba says of variables, meanwhile."""
    threads = os.environ.get(THREADS, "1")
    sound = bool(_HOW_MANY.fullmatch(threads))
    if not sound:
        del os.environ[THREADS]
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Environment variable 'NUMBA_")
            yield
    finally:
        if not sound:
            os.environ[THREADS] = threads


def why_no_settings() -> str:
    """Return why numba's file of settings cannot be read; "" if it can, or is not there."""
    if not os.path.lexists(FILE):
        return ""
    try:
        import yaml
    except ImportError:  # numba then reads no such file
        return ""
    try:
        with open(FILE) as file:
            yaml.safe_load(file)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        return f"{FILE}, numba's settings in this folder: cannot be read ({type(error).__name__}); remove or mend it"
    return ""
