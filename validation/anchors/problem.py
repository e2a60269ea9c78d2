"""What a reference problem is, and what a grade is."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from validation.anchors.quantities import QUANTITIES
from validation.oracle.spatial import Array
from validation.oracle.urdf import RobotModel


@dataclass(frozen=True, eq=False)
class Case:
    """One value, or array of values, that an engine must give.

    name: what the value is, in words
    quantity: key of `QUANTITIES`, which says how an engine is asked for it
    inputs: arguments of that quantity; SI units and radians, arrays read-only
    expected: what the source gives
    tolerance: largest accepted |error| of each entry, in the unit of `expected`; broadcast to its shape
    argument: why the tolerance is this large and not larger
    """

    name: str
    quantity: str
    inputs: Mapping[str, Array]
    expected: Array
    tolerance: Array
    argument: str

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise ValueError(f"case {self.name!r}: {self.quantity!r} is not one of {', '.join(sorted(QUANTITIES))}")
        expected = _frozen(self.expected)
        tolerance = _frozen(np.broadcast_to(np.asarray(self.tolerance, dtype=float), expected.shape))
        if expected.size == 0 or not np.all(np.isfinite(expected)):
            raise ValueError(f"case {self.name!r}: expected has no entries, or entries that are not finite")
        if not (np.all(np.isfinite(tolerance)) and np.all(tolerance > 0.0)):
            raise ValueError(f"case {self.name!r}: every tolerance must be finite and positive")
        if not self.argument.strip():
            raise ValueError(f"case {self.name!r}: a tolerance needs its argument")
        object.__setattr__(self, "expected", expected)
        object.__setattr__(self, "tolerance", tolerance)
        inputs = {name: _frozen(value) for name, value in self.inputs.items()}
        object.__setattr__(self, "inputs", MappingProxyType(inputs))


@dataclass(frozen=True, eq=False)
class ReferenceProblem:
    """A robot and what is known about it from elsewhere.

    name: short and unique
    source: citation of the values, or of the closed form
    model: the robot, in URDF, with the fields that an engine reads
    tip: link whose origin is the tip
    cases: at least one
    """

    name: str
    source: str
    model: RobotModel
    tip: str
    cases: tuple[Case, ...]

    def __post_init__(self) -> None:
        names = [case.name for case in self.cases]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"problem {self.name!r}: it needs cases, each with a name of its own")
        if not self.source.strip():
            raise ValueError(f"problem {self.name!r}: a reference needs its source")


@dataclass(frozen=True)
class Grade:
    """How an engine did in one case.

    problem, case, quantity: which case
    error: |error| of the entry with the largest ratio to its tolerance; inf if there is no answer
    tolerance: of that entry
    passed: answered, and every entry within its tolerance
    covered: the engine has the methods that the quantity needs
    reason: why it was not covered, or gave no usable answer; else empty
    """

    problem: str
    case: str
    quantity: str
    error: float
    tolerance: float
    passed: bool
    covered: bool
    reason: str = field(default="")

    @property
    def ratio(self) -> float:
        """Error over tolerance, at most 1 for a pass."""
        return self.error / self.tolerance


def _frozen(value: ArrayLike) -> Array:
    out = np.array(value, dtype=float)
    out.setflags(write=False)
    return out
