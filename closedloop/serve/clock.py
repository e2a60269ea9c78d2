"""Real time: instants at equal distances on the wall clock."""

from __future__ import annotations

import time

# A server that is later than this does not catch up: the simulation stands still meanwhile, s.
LATEST = 0.02


class Clock:
    """Instants that are one period apart.

    Attributes
    ----------
    late : int
        Instants that were skipped because the server came more than `LATEST` late.
    """

    def __init__(self, period: float) -> None:
        self.period, self.late = period, 0
        self._next = 0.0

    def begin(self) -> None:
        """Let the next instant be one period from now."""
        self._next = time.perf_counter() + self.period

    def left(self) -> float:
        """Return how long it is until the next instant, s; 0 if it has passed."""
        return max(0.0, self._next - time.perf_counter())

    def tick(self) -> None:
        """Go on to the instant after this one."""
        self._next += self.period
        behind = time.perf_counter() - self._next
        if behind > LATEST:
            skipped = int(behind / self.period)
            self.late += skipped
            self._next += skipped * self.period
