"""Laps, interleaved, and what is made of them.

Contestants take turns, A B C C B A A B C ..., so that whatever else the machine does hits all alike, and a ratio is the
median of the ratios of neighbours in time. Beside the wall's time stands the processor's: on a machine that is shared
the share of a core that a contestant got is below one, and ratios are those of the processor's time.
"""

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from validation.oracle.spatial import Array
from validation.speed.contestants import Contestant


@dataclass(frozen=True)
class Timing:
    """What the laps of a contestant took.

    wall: (K,), seconds a step, by the wall's clock, of each lap
    share: (K,), processor time over wall time of each lap: cores that were busy for it
    end: what the last lap came to
    """

    contestant: Contestant
    wall: Array
    share: Array
    end: Array | None

    @property
    def median(self) -> float:
        """Seconds a step."""
        return float(np.median(self.wall))

    @property
    def busy(self) -> Array:
        """Processor seconds a step, of each lap (K,)."""
        return self.wall * self.share

    @property
    def processor(self) -> float:
        """Processor seconds a step."""
        return float(np.median(self.busy))

    @property
    def error(self) -> float | None:
        """How far it ended from the converged answer, rad or m; None where there is none."""
        if self.end is None or self.contestant.converged is None:
            return None
        return float(np.max(np.abs(self.end - self.contestant.converged)))

    @property
    def spread(self) -> float:
        """Half the distance of the quartiles, over the median."""
        low, high = np.percentile(self.wall, [25, 75])
        return float((high - low) / 2 / self.median)


def race(
    contestants: Sequence[Contestant], repeats: int, say: Callable[[str], None] = lambda text: None
) -> dict[tuple[str, str], Timing]:
    """Let every contestant run a lap to get warm and then `repeats` more, in turns.

    Returns (arm, name) -> `Timing`.
    Raises `RuntimeError` if one that does the whole work ends elsewhere than it should: it has not done the same.
    """
    keys = [(c.arm, c.name) for c in contestants]
    ends: dict[tuple[str, str], Array | None] = {}
    for key, contestant in zip(keys, contestants, strict=True):
        say(f"warming up {contestant.name} on {contestant.arm}")
        ends[key] = contestant.lap()[1]
    _check_ends(contestants, ends)
    wall: dict[tuple[str, str], list[float]] = {key: [] for key in keys}
    share: dict[tuple[str, str], list[float]] = {key: [] for key in keys}
    for k in range(repeats):
        say(f"lap {k + 1} of {repeats}")
        gc.collect()
        turn = list(zip(keys, contestants, strict=True))
        for key, contestant in turn if k % 2 == 0 else reversed(turn):
            busy, began = time.process_time(), time.perf_counter()
            seconds, ends[key] = contestant.lap()
            whole, used = time.perf_counter() - began, time.process_time() - busy
            wall[key].append((whole if seconds is None else seconds) / contestant.steps)
            share[key].append(used / whole)
    _check_ends(contestants, ends)
    return {
        key: Timing(contestant, np.array(wall[key]), np.array(share[key]), ends[key])
        for key, contestant in zip(keys, contestants, strict=True)
    }


def ratio(a: Timing, b: Timing, *, wall: bool = False) -> float:
    """Return how many times as long a step of `a` takes as one of `b`: the median over laps of the same turn.

    By the processor's time: where others want the core, long laps lose it for sure and short ones seldom, so that the
    wall would flatter who is quick. What several threads gain shows by the wall only.
    """
    return float(statistics.median(a.wall / b.wall if wall else a.busy / b.busy))


def _check_ends(contestants: Sequence[Contestant], ends: dict[tuple[str, str], Array | None]) -> None:
    for c in contestants:
        end = ends[c.arm, c.name]
        if end is None or c.wanted is None:
            continue
        apart = float(np.max(np.abs(end - c.wanted)))
        if not apart <= c.tolerance:
            raise RuntimeError(
                f"{c.name} on {c.arm} ended {apart:.1e} from where it should, over {c.tolerance:.0e}: "
                "it has not done the same work"
            )
