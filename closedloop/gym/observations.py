"""The parts of an observation: what a controller can know at a control instant, and what a critic may besides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.gym.now import Now


class Part(NamedTuple):
    """A part of an observation: its numbers (N, k), how many for n joints, a actions, c contacts, and their bounds."""

    read: Callable[[Now], Array]
    numbers: Callable[[int, int, int], int]
    low: float
    high: float
    unit: str


def _one(now_part: Array) -> Array:
    return now_part[:, None]


# Beyond any run that does not end: a joint's speed ends one at 1e6 rad/s (m/s).
FAR, FAST, STRONG = 1e3, 1e6, 1e6
PARTS: dict[str, Part] = {
    "q": Part(lambda now: now.q, lambda n, a, c: n, -FAR, FAR, "rad"),
    "v": Part(lambda now: now.v, lambda n, a, c: n, -FAST, FAST, "rad/s"),
    "torque": Part(lambda now: now.torque, lambda n, a, c: n, -STRONG, STRONG, "N m"),
    "joint_error": Part(lambda now: now.q - now.wanted_q, lambda n, a, c: n, -FAR, FAR, "rad"),
    "tip_error": Part(lambda now: now.tip - now.wanted_tip, lambda n, a, c: 3, -FAR, FAR, "m"),
    "tip_velocity": Part(lambda now: now.tip_velocity, lambda n, a, c: 3, -FAST, FAST, "m/s"),
    "force": Part(lambda now: _one(now.measured), lambda n, a, c: 1, -STRONG, STRONG, "N"),
    "force_error": Part(lambda now: _one(now.wanted_force - now.measured), lambda n, a, c: 1, -STRONG, STRONG, "N"),
    "force_sum": Part(lambda now: _one(now.force_sum), lambda n, a, c: 1, -STRONG, STRONG, "N s"),
    "contact": Part(lambda now: _one(now.contact.astype(np.float64)), lambda n, a, c: 1, 0.0, 1.0, "1"),
    "sticks": Part(lambda now: _one(now.sticks.astype(np.float64)), lambda n, a, c: 1, 0.0, 1.0, "1"),
    "phase": Part(lambda now: _one(now.phase), lambda n, a, c: 1, 0.0, 1.0, "1"),
    "action": Part(lambda now: now.action, lambda n, a, c: a, -1.0, 1.0, "1"),
}
# The truth, for critics; what an episode draws stands behind it.
TRUTH: dict[str, Part] = {
    "true_force": Part(lambda now: _one(now.force), lambda n, a, c: 1, -STRONG, STRONG, "N"),
    "friction_force": Part(lambda now: now.friction_force, lambda n, a, c: 3, -STRONG, STRONG, "N"),
    "slip_velocity": Part(lambda now: now.slip_velocity, lambda n, a, c: 3, -FAST, FAST, "m/s"),
    "gap": Part(lambda now: _one(now.gap), lambda n, a, c: 1, -FAR, FAR, "m"),
    "link_forces": Part(lambda now: now.link_forces, lambda n, a, c: c, -STRONG, STRONG, "N"),
    "link_gaps": Part(lambda now: now.link_gaps, lambda n, a, c: c, -FAR, FAR, "m"),
    "normal": Part(lambda now: now.normal, lambda n, a, c: 3, -1.0, 1.0, "1"),
}


class Observations:
    """An observation of some parts, in order.

    Attributes
    ----------
    names : tuple of str
        Of each number: "q.0", "q.1", ..., "force".
    low, high : (k,) arrays
        Bounds, to which what is observed is cut.
    """

    def __init__(self, parts: Sequence[str], known: dict[str, Part], n: int, numbers: int, contacts: int = 0) -> None:
        for name in parts:
            if name not in known:
                raise ScenarioError(f"observations: no part {name!r}; there are {', '.join(known)}")
        self._parts = [known[name] for name in parts]
        counts = [part.numbers(n, numbers, contacts) for part in self._parts]
        self.names = tuple(
            name if count == 1 else f"{name}.{i}"
            for name, count in zip(parts, counts, strict=True)
            for i in range(count)
        )
        self.low = np.repeat([part.low for part in self._parts], counts)
        self.high = np.repeat([part.high for part in self._parts], counts)

    def read(self, now: Now) -> Array:
        """Return the observations (N, k), a new array."""
        values: Array = np.concatenate([part.read(now) for part in self._parts], axis=1)
        np.maximum(values, self.low, out=values)
        np.minimum(values, self.high, out=values)
        return values
