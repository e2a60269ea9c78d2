"""The state that a toss begins with, from all rows before the cube touches the board instead of from the first alone.

In the air the centre follows a parabola, and a body with three equal moments of inertia turns with a constant angular
velocity, so the rows of the flight give position, velocity, orientation and angular velocity by least squares.
"""

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
