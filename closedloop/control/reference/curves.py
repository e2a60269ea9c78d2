"""Curves of the tip, as displacements from its start.

A curve is any smooth function that begins at the origin. Its parameter s, in seconds, is that of
`closedloop.control.reference.timing`: the time of a motion at constant speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array

# s (N,), s, to the displacement, m, and its derivatives by s, m/s and m/s², each (N, 3), base frame.
Curve = Callable[[Array], Sequence[Array]]


@dataclass(frozen=True)
class Straight:
    """A straight line: x = ṙ s."""

    velocity: Array  # (3,): ṙ, the velocity at constant speed, m/s, base frame

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        x = s[:, None] * self.velocity
        return x, np.broadcast_to(self.velocity, x.shape), np.zeros_like(x)


@dataclass(frozen=True)
class Ellipse:
    """An ellipse, a circle if a and b are as long: x = a (1 − cos ωs) + b sin ωs."""

    # a, b (3,): from the start to the centre, and the half axis across it, in which the motion begins, m, base frame
    a: Array
    b: Array
    rate: float  # ω, rad/s

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        w = self.rate
        cos, sin = np.cos(w * s)[:, None], np.sin(w * s)[:, None]
        return (
            self.a * (1.0 - cos) + self.b * sin,
            w * (self.a * sin + self.b * cos),
            w * w * (self.a * cos - self.b * sin),
        )


@dataclass(frozen=True)
class Eight:
    """A figure of eight that begins at its crossing: x = a sin ωs + b sin 2ωs."""

    # a, b (3,): half the width along the eight and half the height across it, m, base frame
    a: Array
    b: Array
    rate: float  # ω, rad/s

    def __call__(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the displacement and its derivatives by s; see `Curve`."""
        w = self.rate
        one, two = (w * s)[:, None], (2.0 * w * s)[:, None]
        return (
            self.a * np.sin(one) + self.b * np.sin(two),
            w * (self.a * np.cos(one) + 2.0 * self.b * np.cos(two)),
            -w * w * (self.a * np.sin(one) + 4.0 * self.b * np.sin(two)),
        )
