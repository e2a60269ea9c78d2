"""The two engines, and the loop of each.

A loop takes any number of joints and any laws, and is compiled once for an installation. In a batch, runs of the
paper's law on a smooth surface go eight at a time in SIMD lanes instead (`closedloop.simulation.engines.lanes`).
"""

from __future__ import annotations

from collections.abc import Callable

from closedloop.simulation.engines.proceed import proceed_at

PINOCCHIO, COMPILED = ENGINES = ("pinocchio", "compiled")


def loop_for(engine: str) -> Callable[..., int]:
    """Return the loop of an engine, see `closedloop.simulate`: what Python calls."""
    return kernels_of(engine)[0]


def kernels_of(engine: str) -> tuple[Callable[..., int], ...]:
    """Return the loop of an engine, and what it calls."""
    if engine == COMPILED:
        from closedloop.simulation.engines.compiled import run_compiled

        return run_compiled, proceed_at
    return (proceed_at,)
