"""Which loop a problem runs in: of the two engines, each has a small one and one with everything that may come on top.

All four take any number of joints, and each is compiled once for an installation. A batch's runs of the paper's law on
a smooth surface go eight at a time instead (`closedloop.engines.lanes`).
"""

from __future__ import annotations

from collections.abc import Callable

from closedloop.engines.pinocchio import proceed_on_pinocchio, proceed_with_more_on_pinocchio

PINOCCHIO, COMPILED = ENGINES = ("pinocchio", "compiled")
# How long compiling the small loop and the large one takes, about, s.
SECONDS, SECONDS_WITH_MORE = 12.0, 40.0


def loop_for(engine: str, more: bool) -> Callable[..., int]:
    """Return the loop of an engine, see `closedloop.simulate`; `more` as in `closedloop.step.evaluate`."""
    if engine == COMPILED:
        from closedloop.engines.compiled import run_compiled, run_compiled_with_more

        return run_compiled_with_more if more else run_compiled
    return proceed_with_more_on_pinocchio if more else proceed_on_pinocchio
