"""The tosses of a cube, as measured, and how far a simulated one is from it.

A state is the quaternion w x y z, the position of the centre, m, the angular velocity in the cube's axes, rad/s, and
the velocity in the world's, m/s. The board is the plane z = 0. Source: S. Pfrommer, M. Halm, M. Posa, ContactNets,
Conference on Robot Learning, 2020; data of DAIRLab, dair_pll, BSD-3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from validation.measured.judged import columns

RATE = 148.0  # Hz
SIDE = 0.1048  # m, as published; so is what follows
MASS = 0.37  # kg
GRAVITY = 9.81  # m/s²
FALL = 9.61  # m/s², of the log: its lengths are 2 % short
FEWEST_ROWS = 3
# The norm of a measured quaternion, and a speed no toss by hand has, m/s: other values are of another unit or order.
NORM, FASTEST = 1e-3, 50.0


@dataclass(frozen=True)
class Toss:
    """One toss: its number, and its states (rows, 13)."""

    number: int
    states: Array


def read(given: Path | None = None) -> list[Toss]:
    """Return the tosses that come with the package, or those of a file in the same format.

    Raises `ModelError` if it cannot be read, or has something that is no toss.
    """
    name = "cube_tosses.npz" if given is None else str(given)
    states = columns("cube_tosses.npz", {"state": 13}, given)["state"]
    listed = columns("cube_tosses.npz", {"rows": 0, "toss": 0}, given)
    rows = listed["rows"]
    if not len(rows) or (rows != np.floor(rows)).any() or (rows < FEWEST_ROWS).any() or rows.sum() != len(states):
        raise ModelError(
            f"{name}: rows must have the number of rows of each toss, at least {FEWEST_ROWS}, and their sum must be "
            f"{len(states)}, as state has"
        )
    norms = np.linalg.norm(states[:, :4], axis=1)
    if not np.isfinite(states).all():
        raise ModelError(f"{name}: state has a value that is not finite")
    if (np.abs(norms - 1.0) > NORM).any():
        raise ModelError(f"{name}: the first four columns of state must be a unit quaternion w x y z")
    if (np.abs(states[:, 10:]) > FASTEST).any():
        raise ModelError(f"{name}: the last three columns of state, the velocity, are above {FASTEST:g} m/s")
    states[:, :4] /= norms[:, None]
    ends = np.cumsum(rows).astype(int)
    return [
        Toss(int(number), states[end - int(count) : end])
        for number, count, end in zip(listed["toss"], rows, ends, strict=True)
    ]


def first_row(toss: Toss) -> Array:
    """Return the state (13,) that a toss begins with, its velocity taken for what it is.

    The velocities of the log are differences of a row and the one before it, so that of the first row is half a row
    old: on average it is 0.031 m/s above the slope of the following rows, where gravity takes 0.033 m/s in this time.
    """
    start: Array = toss.states[0].copy()
    start[12] -= FALL * 0.5 / RATE
    return start


def errors(toss: Toss, simulated: Array) -> tuple[Array, Array]:
    """Return the position error, in % of the side, and the rotation error, degrees, of each row that was simulated.

    simulated: (rows or fewer, 7), position of the centre and quaternion, at the instants of the toss, from the first on
    """
    measured = toss.states[: len(simulated)]
    position: Array = np.linalg.norm(simulated[:, :3] - measured[:, 4:7], axis=1) * (100.0 / SIDE)
    cosine = np.abs(np.einsum("ij,ij->i", simulated[:, 3:7], measured[:, :4]))
    return position, np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0)))


def mean_errors(tosses: Sequence[Toss], simulated: Sequence[Array]) -> Array:
    """Return the mean errors of each toss after its first row, (tosses, 2); NaN of one that was not completed."""
    means = np.full((len(tosses), 2), np.nan)
    for mean, toss, path in zip(means, tosses, simulated, strict=True):
        if len(path) == len(toss.states) and np.isfinite(path).all():
            mean[:] = [each[1:].mean() for each in errors(toss, path)]
    return means
