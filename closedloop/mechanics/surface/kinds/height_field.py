"""[surface] kind = "height_field": heights on a grid, joined by a bicubic B-spline with continuous second derivatives.

The spline goes through the heights, and is mirrored at the edge of the grid, which is the edge of the surface too.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.sections import LENGTH, PLACE, Number, Positive
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import kernel
from closedloop.mechanics.surface.surface import Placed

# Fewest heights along a side of the grid.
FEWEST = 4


class HeightField(Placed):
    """A measured or computed shape: heights on a grid of equal spacing, with the surface's origin above its middle."""

    heights: tuple[tuple[Annotated[Number, PLACE], ...], ...] = Field(
        description="heights along the normal, m: a list along the second tangent of lists along the first"
    )
    spacing: Annotated[Positive, LENGTH] = Field(0.01, description="distance between neighbours, m")

    @field_validator("heights")
    @classmethod
    def _is_a_grid(cls, value: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        lengths = {len(row) for row in value}
        if len(lengths) != 1 or min(len(value), *lengths) < FEWEST:
            raise ValueError(f"must be at least {FEWEST} lists of at least {FEWEST} numbers, all of one length")
        return value

    def bounds(self) -> tuple[float, float]:
        """Return those of the grid, or of a smaller patch of it.

        Raises ScenarioError if a round edge is not on the grid.
        """
        rows, columns = len(self.heights), len(self.heights[0])
        a, b = super().bounds()
        x, y = 0.5 * self.spacing * (columns - 1), 0.5 * self.spacing * (rows - 1)
        if b > 0.0:
            return min(a, x), min(b, y)
        if a > min(x, y):
            raise ScenarioError(f"surface.edge_radius = {a:g}: the grid ends {min(x, y):g} m from its middle")
        return a, b

    def seams(self) -> tuple[Array, Array]:
        """Return the lines of the grid, where one patch of the spline ends and the next begins."""
        return self._lines(len(self.heights[0])), self._lines(len(self.heights))

    def _lines(self, count: int) -> Array:
        return np.asarray(self.spacing * (np.arange(count) - 0.5 * (count - 1)), dtype=np.float64)

    def list_length(self) -> int:
        """Return the length of what `resolved` gives."""
        return 2 + (len(self.heights) + 2) * (len(self.heights[0]) + 2)

    def resolved(self) -> dict[str, Any]:
        """Return, in place of the heights, rows and columns of the grid and the coefficients of the spline.

        There is one coefficient beyond each edge; the height in the middle of the grid is 0.
        """
        from scipy.ndimage import spline_filter

        heights = np.array(self.heights)
        rows, columns = heights.shape
        coefficients = np.pad(spline_filter(heights, order=3, mode="mirror"), 1, mode="reflect").ravel()
        grid = np.concatenate([[float(rows), float(columns)], coefficients])
        middle = interpreted(bicubic)(grid, 0.5 * (columns - 1), 0.5 * (rows - 1))[0]
        return {"heights": (float(rows), float(columns), *(coefficients - middle))}

    @staticmethod
    def level(p: Array, par: Any, gradient: Array, hessian: Array) -> float:
        """Return z less the height below p; beyond the edge, where there is no surface, that of the edge."""
        rows, columns, a = par.heights[0], par.heights[1], par.spacing
        x, y = p[0] / a + 0.5 * (columns - 1.0), p[1] / a + 0.5 * (rows - 1.0)
        x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
        h, hx, hy, hxx, hxy, hyy = bicubic(par.heights, x, y)
        gradient[0], gradient[1], gradient[2] = -hx / a, -hy / a, 1.0
        hessian[0, 0], hessian[1, 1] = -hxx / (a * a), -hyy / (a * a)
        hessian[0, 1] = hessian[1, 0] = -hxy / (a * a)
        return float(p[2] - h)


@kernel
def weight(t: float, k: int, order: int) -> float:
    """Return the k-th of the four cubic B-splines that are not zero on an interval, or its first or second derivative.

    `t`: place in the interval, 0 to 1.
    `k`: 0 to 3.
    `order`: 0, 1 or 2.
    """
    if k > 1:  # they mirror each other
        mirrored = weight_of_first_two(1.0 - t, 3 - k, order)
        return -mirrored if order == 1 else mirrored
    return weight_of_first_two(t, k, order)


@kernel
def weight_of_first_two(t: float, k: int, order: int) -> float:
    """Return what `weight` does, of k = 0 or 1."""
    s = 1.0 - t
    if k == 0:
        return s * s * s / 6.0 if order == 0 else (-0.5 * s * s if order == 1 else s)
    if order == 0:
        return (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0
    return 1.5 * t * t - 2.0 * t if order == 1 else 3.0 * t - 2.0


@kernel
def bicubic(grid: Array, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Return the spline h at column x and row y of its grid, and its derivatives h_x, h_y, h_xx, h_xy and h_yy.

    `grid` has the numbers of rows and of columns, and the coefficients, of which there is one beyond each edge.
    """
    rows, columns = int(grid[0]), int(grid[1])
    j, i = min(int(x), columns - 2), min(int(y), rows - 2)
    t, s = x - j, y - i
    h, hx, hy, hxx, hxy, hyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(4):
        b, db, ddb = weight(s, m, 0), weight(s, m, 1), weight(s, m, 2)
        for k in range(4):
            c = grid[2 + (i + m) * (columns + 2) + j + k]
            a, da, dda = weight(t, k, 0), weight(t, k, 1), weight(t, k, 2)
            h += c * a * b
            hx += c * da * b
            hy += c * a * db
            hxx += c * dda * b
            hxy += c * da * db
            hyy += c * a * ddb
    return h, hx, hy, hxx, hxy, hyy
