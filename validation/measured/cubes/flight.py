"""The state that a toss begins with, from all rows before the cube touches the board instead of from the first alone.

In the air the centre follows a parabola, and a body with three equal moments of inertia turns with a constant angular
velocity, so the rows of the flight give position, velocity, orientation and angular velocity by least squares.

What the log alone says of cube and board: where the centre of mass is, how level the board, how equal the sides.

In the air the centre of mass follows a parabola, and the middle of the cube turns about it. One linear least squares
over all flights gives the mass's place in the cube and the acceleration of gravity in the axes of the log. At the end
of a toss the cube lies on one of its six sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from closedloop.base.arrays import Array
from validation.measured.cubes.engine import corners
from validation.measured.cubes.tosses import FALL, RATE, Toss, first_row

# Half the side of the cube in the log and the height of its lowest corner above which it has touched nothing, m.
SIDE, CLEAR = 0.1026, 0.006
# Rows that a flight needs for a fit, and steps of the fit of the rotation: errors are a few degrees.
FEWEST_ROWS, STEPS = 5, 4


def heights(toss: Toss) -> Array:
    """Return the height of the lowest corner of a sharp cube at each row, m."""
    turned = rotations(toss.states).as_matrix()[:, 2, :]
    return toss.states[:, 6] + (turned @ np.array(corners(SIDE, 0.0)).T).min(axis=1)


def rotations(states: Array) -> Rotation:
    """Return the orientations of states (N, 13)."""
    return Rotation.from_quat(states[:, :4], scalar_first=True)


def flight(toss: Toss) -> int:
    """Return how many rows there are before the cube touches the board."""
    touched = np.flatnonzero(heights(toss) < CLEAR)
    return int(touched[0]) if len(touched) else len(toss.states)


def fitted_start(toss: Toss) -> Array:
    """Return the state (13,) that fits the flight best; the first row if the flight is too short to tell."""
    n = flight(toss)
    if n < FEWEST_ROWS:
        return first_row(toss)
    states, time = toss.states[:n], np.arange(n) / RATE
    basis = np.stack([np.ones(n), time], axis=1)
    fallen = states[:, 4:7] + np.outer(time * time, [0.0, 0.0, 0.5 * FALL])
    position, velocity = np.linalg.lstsq(basis, fallen, rcond=None)[0]
    measured = rotations(states)
    first, turning = measured[0], (measured[-1] * measured[0].inv()).as_rotvec() / time[-1]
    for _ in range(STEPS):
        error = (measured * (Rotation.from_rotvec(np.outer(time, turning)) * first).inv()).as_rotvec()
        by, faster = np.linalg.lstsq(basis, error, rcond=None)[0]
        first, turning = Rotation.from_rotvec(by) * first, turning + faster
    in_cube = first.inv().apply(turning)
    return np.concatenate([first.as_quat(scalar_first=True), position, in_cube, velocity])


# Rows at the end of a toss that are taken for rest.
LAST = 8


@dataclass(frozen=True)
class Geometry:
    """What the log says.

    centre: (3,), of mass, from the middle of the cube, m, axes of the cube
    gravity: (3,), acceleration of the centre of mass in the air, m/s², axes of the log
    slope: (2,), of the board along x and y, rad, from the heights of cubes at rest
    heights: (6,), mean height of the middle of a cube that lies on each of its sides, m: −x, +x, −y, +y, −z, +z up
    """

    centre: Array
    gravity: Array
    slope: Array
    heights: Array


def geometry(tosses: Sequence[Toss]) -> Geometry:
    """Return what the log of tosses says of cube and board."""
    square, side = np.zeros((6, 6)), np.zeros(6)
    for toss in tosses:
        n = flight(toss)
        if n < FEWEST_ROWS:
            continue
        time = np.arange(n) / RATE
        turned = rotations(toss.states[:n]).as_matrix()
        columns = np.concatenate([-turned, np.einsum("t,ij->tij", time * time / 2.0, np.eye(3))], axis=2)
        line = np.stack([np.ones(n), time], axis=1)  # a start and a velocity of each toss, taken out of everything
        out = np.eye(n) - line @ np.linalg.pinv(line)
        columns = np.einsum("ts,sij->tij", out, columns).reshape(3 * n, 6)
        place = (out @ toss.states[:n, 4:7]).reshape(3 * n)
        square, side = square + columns.T @ columns, side + columns.T @ place
    found = np.asarray(np.linalg.solve(square, side), dtype=np.float64)
    ends = np.array([toss.states[-LAST:, 4:7].mean(axis=0) for toss in tosses])
    plane: Array = np.linalg.lstsq(np.column_stack([np.ones(len(ends)), ends[:, :2]]), ends[:, 2], rcond=None)[0]
    upwards = np.array([rotations(toss.states[-1:]).as_matrix()[0, 2] for toss in tosses])
    axis = np.abs(upwards).argmax(axis=1)
    lies = 2 * axis + (upwards[np.arange(len(axis)), axis] > 0.0)
    heights = np.array([ends[lies == k, 2].mean() if (lies == k).any() else np.nan for k in range(6)])
    return Geometry(found[:3], found[3:], plane[1:], heights)


def geometry_lines(tosses: Sequence[Toss]) -> list[str]:
    """Return what the log says of cube and board, in words."""
    g = geometry(tosses)
    tilt = np.degrees(np.arctan(np.linalg.norm(g.gravity[:2]) / abs(g.gravity[2])))
    level = np.degrees(np.arctan(np.linalg.norm(g.slope)))
    x, y, z = 1e3 * g.centre
    low, high = 1e3 * np.nanmin(g.heights), 1e3 * np.nanmax(g.heights)
    return [
        f"centre of mass {x:.2f}, {y:.2f}, {z:.2f} mm from the middle of the cube",
        f"gravity {np.linalg.norm(g.gravity):.3f} m/s², {tilt:.2f}° from the vertical of the log",
        f"board {level:.2f}° from the horizontal of the log",
        f"the middle of a cube at rest is {low:.2f} to {high:.2f} mm high, by the side it lies on",
    ]
