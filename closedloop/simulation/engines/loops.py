"""The two engines, the loop of each, and how many evaluations it does before Ctrl-C can have its effect in Python.

A loop takes any number of joints and any laws, and is compiled once for an installation. In a batch, runs of the
paper's law on a smooth surface go eight at a time in SIMD lanes instead (`closedloop.simulation.engines.lanes`).
"""

import time as clock
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


# Evaluations at first and at most, and the time that they are to take, s.
FEW, MOST, MOMENT = 100, 4000, 0.02


class Pace:
    """The number of evaluations that take a `MOMENT`, by how long the last ones have taken.

    Evaluations of a run that crawls may take a thousand times as long as those before.
    """

    def __init__(self) -> None:
        self._count = FEW

    def take(self, evaluate: Callable[[int], int]) -> int:
        """Do so many evaluations by a function of their number, and return what it does."""
        began = clock.perf_counter()
        request = evaluate(self._count)
        share = MOMENT / max(clock.perf_counter() - began, 0.5 * MOMENT)
        self._count = min(max(int(share * self._count), 1), MOST)
        return request
