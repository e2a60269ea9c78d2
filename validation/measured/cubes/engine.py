"""What a comparison needs of an engine: parameters that may be fitted, and tosses simulated with them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import ClassVar

from closedloop.base.arrays import Array
from validation.measured.cubes.tosses import GRAVITY, SIDE, Toss

# Steps between two rows.
STEPS = 8


@dataclass(frozen=True)
class Parameter:
    """A parameter that is fitted: where the search starts, and between which values; all are positive."""

    name: str
    unit: str
    start: float
    low: float
    high: float


# Of the cube, the same for every engine; the last parameters of each. The lengths of the log are some 2 % short: it
# rests at 0.978 of half its side, and falls with 9.61 m/s². So the side scales gravity and inertia too. The published
# inertia, 8.1e-4 kg m², is between that of a solid cube and that of a thin box, 1.13e-3 kg m²; the tosses ask for the
# latter. A corner that strikes is 2 mm lower than a sharp one would be: corners are round.
CUBE = (
    Parameter("inertia", "kg m²", 1.1e-3, 6.7e-4, 2e-3),
    Parameter("corner_radius", "m", 0.002, 1e-4, 0.01),
    Parameter("side", "m", 0.1026, 0.098, 0.11),
)


class CubeEngine(ABC):
    """An engine that simulates tosses of a cube.

    `name` and `what` say which, `parameters` what is fitted.
    """

    name: ClassVar[str]
    what: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]

    @abstractmethod
    def simulate(self, values: Sequence[float], starts: Sequence[Array], tosses: Sequence[Toss]) -> list[Array]:
        """Return position and quaternion (rows, 7) of each toss at its instants; fewer rows if it was not completed.

        values: of the parameters, in their order
        starts: (13,), the state that each begins with
        tosses: which say how many rows there are
        """


def gravity(side: float) -> float:
    """Return g in the lengths of the log, m/s², if the cube's side in them is this, m."""
    return GRAVITY * side / SIDE


def moment(inertia: float, side: float) -> float:
    """Return a moment of inertia, kg m², in the lengths of the log."""
    return inertia * (side / SIDE) ** 2


def corners(side: float, radius: float) -> list[list[float]]:
    """Return the centres of the balls (8, 3) that round the corners, m, axes of the cube."""
    return [[x * (side / 2.0 - radius) for x in at] for at in product((-1.0, 1.0), repeat=3)]
