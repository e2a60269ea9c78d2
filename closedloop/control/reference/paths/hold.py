"""[reference] kind = "hold": r(t) = r(0)."""

from closedloop.base.arrays import Array
from closedloop.control.reference.path import Path
from closedloop.control.reference.tip_path import TipPath


class Hold(Path):
    """The tip stays where it starts."""

    def tip_path(self, origin: Array, normal: Array) -> TipPath:
        """Return the path that stays; see `Path.tip_path`."""
        return TipPath(origin)
