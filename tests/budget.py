"""How much the tests that draw cases at random do.

The usual budget reaches every generator, every kind of case and every branch that a test asks for; the full one is many
more of the same, for a run by hand:

    CLOSEDLOOP_TESTS=full python -m pytest -m slow
"""

import os
from typing import TypeVar

T = TypeVar("T")

FULL = os.environ.get("CLOSEDLOOP_TESTS", "") == "full"


def budget(usual: T, full: T) -> T:
    """Return the first, or the second where the full budget is asked for."""
    return full if FULL else usual
