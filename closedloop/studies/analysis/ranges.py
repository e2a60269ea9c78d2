"""What is asked and answered about stability: a range of a key, a limit in it, and whole runs beside the limit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from closedloop.studies.analysis.poles import Pole
from closedloop.studies.shares import number_at, share_of

# A key's value: a number, or a list with a number for each joint.
Value = float | list[float]


@dataclass(frozen=True)
class Range:
    """A key of the scenario, and the range of numbers in which limits are sought."""

    key: str  # dotted key
    # low, high: ends, in either order: limits are found from `low` on
    low: float
    high: float
    log: bool = False  # whether it is looked at evenly in its logarithm
    held: tuple[float, ...] = ()  # where the key is a list, as it is in the scenario; else empty
    # the entry of that list which the numbers are of, the others as they are; if left out they are of the first that is
    # not zero, and the others change by the same factor
    index: int | None = None

    def value(self, number: float) -> float | list[float]:
        """Return the key's value for a number of the range."""
        if not self.held:
            return number
        if self.index is not None:
            return [*self.held[: self.index], number, *self.held[self.index + 1 :]]
        first = next(entry for entry in self.held if entry != 0.0)
        return [number / first * entry for entry in self.held]

    def at(self, share: float) -> float:
        """Return the value at `share`, 0 to 1, of the way."""
        return number_at(self.low, self.high, self.log, share)

    def share(self, value: float) -> float:
        """Return how far along the way a value is."""
        return share_of(self.low, self.high, self.log, value)


@dataclass(frozen=True)
class Limit:
    """A value at which the loop becomes unstable, or stable again."""

    # key, value: what is changed, and to what
    key: str
    value: float
    upwards: bool  # whether it is unstable above it, rather than below it
    pole: Pole  # the pole that lies on the unit circle there

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers."""
        return {
            "key": self.key, "value": self.value, "unstable": "above" if self.upwards else "below",
            "frequency": self.pole.frequency, "part": self.pole.part,
        }  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """Two runs of the whole nonlinear loop beside the boundary, from the instant on, that begin a little apart."""

    values: dict[str, Value]  # what is changed, from the instant on
    # expected, seen: the rate of the linear loop's slowest pole, and that with which the two runs grow apart, 1/s;
    # infinite if one of them stops
    expected: float
    seen: float

    @property
    def agrees(self) -> bool:
        """Whether both say the same of its stability."""
        return (self.expected > 0.0) == (self.seen > 0.0)
