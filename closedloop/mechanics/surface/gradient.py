"""The gradient of φ at points of a motion: where it vanishes or jumps the surface has no normal."""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.jit.calls import call_at
from closedloop.jit.kernel import entry_kernel
from closedloop.mechanics.surface.contact import LEVEL, ask_at
from closedloop.mechanics.surface.geometry import Touch
from closedloop.mechanics.surface.placed import PlacedSurface


@entry_kernel
def gradients_on_surface(entry: int, address: int, times: Array, r: Array, gradients: Array) -> int:
    """Write ∇φ (N, 3), surface's axes, at points r (N, 3), m, base frame, at times (N,), s; return N.

    `entry` and `address` are of the surface and of its memory.
    """
    _, ask = ask_at(address)
    touch = Touch(ask.touch)
    for k in range(times.size):
        ask.time = times[k]
        for i in range(3):
            ask.r[i] = r[k, i]
        call_at(entry, address, LEVEL)
        for i in range(3):
            gradients[k, i] = touch.gradient[i]
    return int(times.size)


def gradients(surface: PlacedSurface, times: Array, r: Array) -> Array:
    """Return ∇φ (N, 3), surface's axes, 0 for no number, at points r (N, 3), m, base frame, at times (N,), s."""
    found, _ = surface.at_each(gradients_on_surface, (), times, (r, np.zeros((times.size, 3))))
    return np.where(np.isfinite(found[1]), found[1], 0.0)
