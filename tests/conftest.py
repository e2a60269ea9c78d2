"""What holds for all tests.

Property tests draw the same examples each time, so that a change is judged by what it changes. And nothing is compiled
in the background, where it would take a core from the tests: what a test needs is compiled first, and then kept.

python -m pytest --hypothesis-profile=explore      # other examples each time, to look for what was missed
"""

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from closedloop.jit.background import VARIABLE

settings.register_profile("same", derandomize=True)
settings.register_profile("explore")
settings.load_profile("same")
os.environ[VARIABLE] = "0"  # for the processes that tests start, too


@pytest.fixture(autouse=True)
def no_modules_left(tmp_path_factory, monkeypatch):
    """Forget the modules that a test has written and imported, and where it looked for them.

    The next test may write a module of the same name.
    """
    monkeypatch.setattr(sys, "path", list(sys.path))
    known = set(sys.modules)
    yield
    below = tmp_path_factory.getbasetemp()
    for name in sys.modules.keys() - known:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).is_relative_to(below):
            del sys.modules[name]
