"""Another order of the tests of each file, to see whether one leaves something behind for another.

SHUFFLE=1 python -m pytest -p tests.shuffle
"""

import os
import random

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Shuffle all tests; those of a file are then brought together again, in their new order."""
    random.Random(os.environ.get("SHUFFLE", "0")).shuffle(items)
