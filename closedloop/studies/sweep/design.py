"""The values of the runs of a sweep: its axes, a grid, draws."""

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from closedloop.base.arrays import number_at, number_of
from closedloop.base.errors import ScenarioError
from closedloop.scenario.load import toml_value
from closedloop.scenario.messages import takes_whole_numbers
from closedloop.simulation.batch.simulate_batch import key_type
from robot_models.cached import cached_property

FORMS = "5:15:11 (from, to, how many), log:1e-4:1e-2:20, or 5,10,15"
# Values of one axis.
MOST_VALUES = 1_000_000_000
LARGEST_WHOLE = 2**53
_KEY = re.compile(r"[A-Za-z_][\w-]*(\.[^.=]+)+")


@dataclass(frozen=True)
class Axis:
    """A key and its values: those of a list, or a range."""

    key: str  # dotted key of the scenario
    spec: str  # how it was given
    values: tuple[Any, ...] = ()  # the values of a list; of a range none
    # low, high: ends of a range
    low: float = 0.0
    high: float = 0.0
    count: int = 0  # how many values a range has in a grid; 0 if that was not said
    log: bool = False  # whether a range is even in its logarithm
    whole: bool = False  # whether the key takes whole numbers only

    def __len__(self) -> int:
        """Return how many values it has in a grid."""
        return len(self.values) or self.count

    @property
    def kind(self) -> str:
        """Type of the key's column in the table, in Arrow's words."""
        return str(key_type(self.values)) if self.values else "int64" if self.whole else "double"

    def at(self, index: int) -> Any:
        """Return value `index` of a grid."""
        if self.values:
            return self.values[index]
        return self._between(index / (self.count - 1), exact_end=index == self.count - 1)

    def drawn(self, share: float) -> Any:
        """Return the value at `share`, from 0 to below 1, of the way along the axis."""
        if self.values:
            return self.values[int(share * len(self.values))]
        if self.whole:
            low, high = sorted((self.low, self.high))
            return int(low + math.floor(share * (high - low + 1)))
        return self._between(share)

    def _between(self, share: float, exact_end: bool = False) -> float | int:
        if share == 0.0 or exact_end:
            value = self.high if exact_end else self.low
        else:
            value = number_at(self.low, self.high, self.log, share)
        return round(value) if self.whole else value


def parse_axis(text: str, drawn: bool = False) -> Axis:
    """Read an axis from KEY=VALUES.

    `text`: ``law.force=5:15:11``, ``stabiliser.time_constant=log:1e-4:1e-2:20``,
        ``time.integrator=rk4,explicit_euler``.
    `drawn`: whether values are drawn from the range, so that how many there are need not be said.
    """
    if not text.isprintable():
        raise ScenarioError(f"--over {text}: has characters that cannot be printed")
    key, equals, spec = text.partition("=")
    key, spec = key.strip(), spec.strip()
    if not (equals and _KEY.fullmatch(key)):
        raise ScenarioError(f"--over {text}: must be KEY=VALUES with a key such as law.force; VALUES are {FORMS}")
    if not spec.strip(", "):
        raise ScenarioError(f"--over {text}: has no values; they are {FORMS}")
    parts = spec.split(":")
    log = parts[0] == "log"
    numbers = [number_of(part) for part in parts[log:]]
    if len(parts) > 1 and None not in numbers:
        return _range(text, key, spec, [x for x in numbers if x is not None], log, drawn)
    if log or (len(parts) in (3, 4) and not spec.startswith(("[", '"', "'"))):
        raise ScenarioError(f"--over {text}: not a range of numbers; it must look like {FORMS}")
    values, whole = _listed(spec, text), takes_whole_numbers(key)
    if not whole and all(type(value) in (int, float) for value in values):
        values = tuple(float(value) for value in values)
    if len({repr(value) for value in values}) < len(values):
        raise ScenarioError(f"--over {text}: the same value twice")
    return Axis(key, spec, values, whole=whole)


def parse_range(text: str, such: str) -> Axis:
    """Read what varies within a range of real numbers, KEY=LOW:HIGH or KEY=log:LOW:HIGH; its ends in order."""
    try:
        axis = parse_axis(text, drawn=True)
    except ScenarioError as error:
        raise ScenarioError(str(error).replace("--over", "--vary", 1)) from None
    if axis.values or axis.whole:
        raise ScenarioError(f"--vary {text}: must be a range of real numbers, such as {axis.key}={such}")
    low, high = sorted((axis.low, axis.high))
    return replace(axis, low=low, high=high)


def _range(text: str, key: str, spec: str, numbers: list[float], log: bool, drawn: bool) -> Axis:
    if len(numbers) == 2 and not drawn:
        raise ScenarioError(
            f"--over {text}: how many values? such as {spec}:11; or draw from the range with --random or --latin"
        )
    if len(numbers) not in (2, 3):
        raise ScenarioError(f"--over {text}: a range has two ends and how many values it has, such as 5:15:11")
    low, high = numbers[:2]
    count = numbers[2] if len(numbers) == 3 else 0.0
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ScenarioError(f"--over {text}: both ends must be finite")
    if not math.isfinite(high - low):
        raise ScenarioError(f"--over {text}: is wider than a double can hold, 1.8e308")
    if low == high:
        raise ScenarioError(
            f"--over {text}: is empty: it ends where it begins; a single value is written {key}={low:g}"
        )
    if len(numbers) == 3 and not (2 <= count <= MOST_VALUES and count == math.floor(count)):
        raise ScenarioError(
            f"--over {text}: {spec.rpartition(':')[2]} values: must be a whole number from 2 on, up to {MOST_VALUES}"
        )
    if log and not (low > 0.0 and high > 0.0):
        raise ScenarioError(f"--over {text}: both ends of a logarithmic range must be above 0")
    if log and not 0.0 < high / low < math.inf:
        raise ScenarioError(f"--over {text}: is wider than a double can hold: the ratio of its ends is beyond 1e308")
    whole = takes_whole_numbers(key)
    axis = Axis(key, spec, (), low, high, int(count), log, whole)
    if whole and max(abs(low), abs(high)) > LARGEST_WHOLE:
        raise ScenarioError(f"--over {text}: whole numbers of a range may go to 2^53, which a double holds exactly")
    if whole and (log or low % 1 or high % 1 or (not drawn and (high - low) / (count - 1) % 1)):
        raise ScenarioError(f"--over {text}: {key} takes whole numbers only; name them, such as {key}=0,1,2")
    return axis


def _listed(spec: str, text: str) -> tuple[Any, ...]:
    """Read a list: as TOML where it is that, else word by word, so that names need no quotes."""
    try:
        found = tomllib.loads(f"values = [{spec}]")
        if len(found) == 1:
            return tuple(found["values"])
    except (ValueError, RecursionError):
        pass
    words = [word.strip() for word in spec.split(",")]
    if any(words) and not all(words[:-1]):  # one comma more at the end is none
        raise ScenarioError(f"--over {text}: has a comma too many: a value is missing")
    return tuple(toml_value(word) for word in words if word)


GRID, RANDOM, LATIN = "grid", "random", "latin"

# Random numbers are drawn in blocks, each with a generator of its own: run i needs its block, and no other.
BLOCK = 1024
MOST_RUNS = 100_000_000
# A Latin hypercube is a permutation of all runs on each axis, and is held whole.
MOST_LATIN = 1_000_000


class Design(Sequence[tuple[Any, ...]]):
    """The values of the axes' keys for every run.

    `kind`: every value with every other, the last axis fastest; independent draws, even along each axis; or draws of
        which each axis has exactly one in each of `count` equal intervals (McKay, Beckman and Conover 1979).
    `count`: number of draws.
    `seed`: of the draws.
    """

    def __init__(self, axes: Sequence[Axis], kind: str = GRID, count: int = 0, seed: int = 0) -> None:
        if not axes:
            raise ScenarioError("--over: name at least one key and its values, such as --over law.force=5:15:11")
        keys = [axis.key for axis in axes]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise ScenarioError(f"--over {twice[0]}: comes twice")
        if kind == GRID:
            count = math.prod(len(axis) for axis in axes)
        elif count < 1:
            raise ScenarioError(f"--{kind} {count}: must be at least 1")
        if seed < 0:
            raise ScenarioError(f"--seed {seed}: must be 0 or above")
        most = MOST_LATIN if kind == LATIN else MOST_RUNS
        if count > most:
            raise ScenarioError(f"{count} runs: a {kind} sweep may have {most}; take fewer values")
        self.axes, self.kind, self.runs, self.seed = tuple(axes), kind, count, seed
        self._block = lru_cache(maxsize=4)(self._draw)

    @property
    def keys(self) -> tuple[str, ...]:
        """The changed keys."""
        return tuple(axis.key for axis in self.axes)

    def __len__(self) -> int:
        return self.runs

    @overload
    def __getitem__(self, at: int) -> tuple[Any, ...]: ...
    @overload
    def __getitem__(self, at: slice) -> list[tuple[Any, ...]]: ...
    def __getitem__(self, at: int | slice) -> tuple[Any, ...] | list[tuple[Any, ...]]:
        if isinstance(at, slice):
            return [self[i] for i in range(*at.indices(self.runs))]
        if not 0 <= at < self.runs:
            raise IndexError(at)
        if self.kind == GRID:
            places = []
            for axis in reversed(self.axes):
                at, place = divmod(at, len(axis))
                places.append(place)
            return tuple(axis.at(place) for axis, place in zip(self.axes, reversed(places), strict=True))
        shares = self._latin[at] if self.kind == LATIN else self._block(at // BLOCK)[at % BLOCK]
        return tuple(axis.drawn(share) for axis, share in zip(self.axes, shares.tolist(), strict=True))

    def _draw(self, block: int) -> NDArray[np.float64]:
        return np.random.default_rng([self.seed, block]).random((BLOCK, len(self.axes)))

    @cached_property
    def _latin(self) -> NDArray[np.float64]:
        from scipy.stats import qmc

        # Its numbers are from (0, 1]: the end belongs to the last value.
        drawn: NDArray[np.float64] = qmc.LatinHypercube(len(self.axes), rng=np.random.default_rng(self.seed)).random(
            self.runs
        )
        return np.asarray(np.minimum(drawn, math.nextafter(1.0, 0.0)))
