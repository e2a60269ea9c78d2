"""The cells of a comparison: one quantity of one engine over all states, and all of one robot."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Cell:
    """One quantity of one engine over all states.

    robot, quantity, engine: what was compared
    status: "agrees", "disagrees", "not covered", "not installed" or "not usable"
    reason: why, where there is no number
    absolute, relative: worst errors; inf if a number is missing or not finite
    tolerance: the bound at the state that comes closest to it
    margin: worst error over its bound; at most 1 for "agrees"
    state: the state that gave it
    states: how many were compared
    """

    robot: str
    quantity: str
    engine: str
    status: str
    reason: str = ""
    absolute: float = np.nan
    relative: float = np.nan
    tolerance: float = np.nan
    margin: float = np.nan
    state: int | None = None
    states: int = 0


@dataclass
class Comparison:
    """All cells of one robot.

    robot, tip, reference: robot, tip and the engine that the others are compared with
    seed, states: what was drawn
    cells: by engine, then quantity
    probes: engine -> what its probe found
    """

    robot: str
    tip: str
    reference: str
    seed: int
    states: int
    cells: list[Cell] = field(default_factory=list)
    probes: dict[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether something was compared and nothing is out of tolerance."""
        compared = [cell for cell in self.cells if cell.status in ("agrees", "disagrees")]
        return bool(compared) and all(cell.status == "agrees" for cell in compared)

    @property
    def worst(self) -> Cell | None:
        """The cell that uses the largest part of its tolerance; None if nothing was compared."""
        compared = [cell for cell in self.cells if cell.status in ("agrees", "disagrees")]
        return max(compared, key=lambda cell: cell.margin, default=None)
