"""Which form of the loop a problem runs in.

There are two engines; each has a small form for the paper's law on a smooth surface, and one with everything that may
come on top. All four take any number of joints. A batch's runs of the paper's law on a smooth surface may go eight at a
time in SIMD lanes (`closedloop.engines.lanes`), in a third of the time.
"""

from __future__ import annotations

from collections.abc import Callable

from closedloop.engines.pinocchio import proceed_on_pinocchio, proceed_with_more_on_pinocchio

PINOCCHIO, COMPILED = ENGINES = ("pinocchio", "compiled")


def machine(more: bool, engine: str) -> Callable[..., int]:
    """Return the form of the loop that a problem needs.

    Parameters
    ----------
    more : bool
        See `closedloop.step.evaluate`.
    engine : "pinocchio" or "compiled"
        See `closedloop.simulate`.
    """
    if engine == COMPILED:
        from closedloop.engines.compiled import run_compiled, run_compiled_with_more

        return run_compiled_with_more if more else run_compiled
    return proceed_with_more_on_pinocchio if more else proceed_on_pinocchio
