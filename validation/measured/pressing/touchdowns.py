"""The measured touchdowns: a file of arrays TEST/SIGNAL, each (2, N), time in s and value.

TEST is PLACE_F*_g*_v*: where it comes down, the commanded force in N, the gain scaling of the force mode, and the speed
that the program has, m/s. Time is 0 at the first contact.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ModelError
from closedloop.base.files import reason_of

# How long the tool rests after the first contact, s, before it slides or leaves; how fast it may come down, m/s, where
# that is not the speed of the name.
REST = {"direct": 5.0, "straight": 3.2, "ramp": 3.2}
DOWN = {"straight": 0.25}
NAME = re.compile(r"(?P<place>[a-z]+)_F(?P<force>[\d.]+)_g(?P<gain>[\d.]+)_v(?P<speed>[\d.]+)")
# The speed before the contact is the mean over this time, s.
BEFORE = (-0.03, -0.004)


@dataclass(frozen=True, eq=False)
class Touchdown:
    """A test: what was commanded, and what was measured.

    force: commanded, N
    gain, limit: gain scaling and speed limit, m/s, of the force mode
    speed: with which it comes to the surface, measured, m/s
    rest: time from the first contact to the end of what is compared, s
    time, measured: (N,), s, and the force at the sensor under the surface, N
    desired: (2, M), s, and the size of the speed that the force mode asks for, m/s, as its controller logs it
    """

    name: str
    place: str
    force: float
    gain: float
    limit: float
    speed: float
    rest: float
    time: Array
    measured: Array
    desired: Array | None = None


def read(path: Path) -> list[Touchdown]:
    """Return the tests of a file, by name.

    Raises `ModelError` if it cannot be read, or an array is missing or has another shape.
    """
    try:
        with np.load(path) as found:
            arrays = {key: np.asarray(found[key], dtype=np.float64) for key in found}
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ValueError, EOFError, BadZipFile, AttributeError):
        raise ModelError(f"{path}: is no .npz file of numbers, as numpy.savez writes it") from None
    names = sorted({key.rpartition("/")[0] for key in arrays})
    if not names:
        raise ModelError(f"{path}: has no test; arrays are called TEST/force_measured and TEST/speed_measured")
    return [_touchdown(path, name, arrays) for name in names]


def _touchdown(path: Path, name: str, arrays: dict[str, Array]) -> Touchdown:
    said = NAME.fullmatch(name)
    if said is None or said["place"] not in REST:
        raise ModelError(
            f"{path}: test {name!r}: must be PLACE_F*_g*_v*, such as direct_F100_g0.5_v0.10, with PLACE one of "
            f"{', '.join(REST)}"
        )
    series = []
    for signal in ("force_measured", "speed_measured", "speed_desired"):
        one = arrays.get(f"{name}/{signal}")
        if one is None and signal == "speed_desired":
            continue
        if one is None or one.ndim != 2 or len(one) != 2 or not np.all(np.isfinite(one)):
            raise ModelError(f"{path}: {name}/{signal}: must be (2, N), time in s and finite values")
        series.append(one)
    (time, force), (at, speed), *desired = series
    place, rest = said["place"], REST[said["place"]]
    if not (np.all(np.diff(time) > 0.0) and time[0] <= 0.0 and time[-1] >= rest):
        raise ModelError(f"{path}: {name}/force_measured: its time must rise, from 0 or before to {rest:g} s or later")
    before = speed[(at >= BEFORE[0]) & (at <= BEFORE[1])]
    if not (len(before) and before.mean() > 0.0):
        raise ModelError(f"{path}: {name}/speed_measured: has no speed above 0 in the {-BEFORE[0]:g} s before contact")
    limit = DOWN.get(place, float(said["speed"]))
    return Touchdown(
        name, place, float(said["force"]), float(said["gain"]), limit, float(before.mean()), rest, time, force, *desired
    )
