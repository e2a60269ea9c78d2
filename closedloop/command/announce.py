"""What is said before something is compiled."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from closedloop.scenario.scenario import Scenario

if TYPE_CHECKING:
    pass


def announce_compiling(scenario: Scenario, n: int, engine: str, runs: int = 1) -> None:
    """Say why the first run of an installation takes longer, or the first of so many; n joints, 0: any number."""
    from closedloop.engines.lanes import loop_of
    from closedloop.jit.cache_folder import compiling_notice
    from closedloop.jit.kernel import needs_compiling

    if needs_compiling(loop_of(scenario, engine, n, runs)):
        print(compiling_notice(), file=sys.stderr, flush=True)
