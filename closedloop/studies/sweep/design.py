"""The values of the runs of a sweep: a grid, random draws, or a Latin hypercube. Run i depends on i alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import ScenarioError
from closedloop.studies.sweep.axes import Axis
from robot_models.cached import cached_property

GRID, RANDOM, LATIN = "grid", "random", "latin"

# Random numbers are drawn in blocks, each with a generator of its own: run i needs its block, and no other.
BLOCK = 1024
MOST_RUNS = 100_000_000
# A Latin hypercube is a permutation of all runs on each axis, and is held whole.
MOST_LATIN = 1_000_000


class Design(Sequence[tuple[Any, ...]]):
    """The values of the axes' keys for every run.

    Parameters
    ----------
    axes : sequence of Axis
    kind : "grid", "random" or "latin"
        Every value with every other, the last axis fastest; independent draws, even along each axis; or draws of which
        each axis has exactly one in each of `count` equal intervals (McKay, Beckman and Conover 1979).
    count : int, optional
        Number of draws.
    seed : int
        Of the draws.
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
