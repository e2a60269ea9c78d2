"""The choice of the loop: each of the two engines has one for the paper's law on a smooth surface and a general one.

All four take any number of joints, and each is compiled once for an installation. In a batch, runs of the paper's law
on a smooth surface go eight at a time in SIMD lanes instead (`closedloop.engines.lanes`).
"""

from __future__ import annotations

from collections.abc import Callable

from closedloop.engines.pinocchio import proceed_general_on_pinocchio, proceed_on_pinocchio

PINOCCHIO, COMPILED = ENGINES = ("pinocchio", "compiled")
# Time that it takes to compile the small loop and the general one, about, s.
SECONDS, SECONDS_GENERAL = 12.0, 40.0


def loop_for(engine: str, general: bool) -> Callable[..., int]:
    """Return the loop of an engine, see `closedloop.simulate`; `general` as in `closedloop.step.evaluate`."""
    if engine == COMPILED:
        from closedloop.engines.compiled import run_compiled, run_compiled_general

        return run_compiled_general if general else run_compiled
    return proceed_general_on_pinocchio if general else proceed_on_pinocchio
