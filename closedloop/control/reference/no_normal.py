"""Paths that come to where the surface has no normal are refused before anything is simulated.

There the gradient of φ vanishes, or jumps: at the tip of a cone, where a surface meets itself or has an edge, or where
a formula has a factor that is zero. That may be a point, and a path is known at instants. So ∇φ is followed along it:
from the instants at which it is small the least of it is found, and where it turns much from one to the next it is
seen whether it does so at once.
"""

from __future__ import annotations

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.tip_path import TipPath
from closedloop.mechanics.surface.gradient import gradients
from closedloop.mechanics.surface.placed import PlacedSurface

# Instants, beside the ends of its segments, at which ∇φ is looked at.
PATH_CHECKS = 300
# Shares of the largest |∇φ| below which the least near an instant is searched for, and below which it vanishes.
SMALL, VANISHED = 0.25, 1e-8
# Cosine of the angle by which ∇φ turns between two instants at which a jump is searched for, and of one that is none.
TURNS, JUMPS = 0.95, 0.98
# An instant is searched for until it is known to this share of the time between two of them.
NEAREST = 1e-12


def refuse_without_normal(surface: PlacedSurface, tip: TipPath) -> None:
    """Refuse a path along a surface to where the gradient of its φ vanishes or jumps."""
    if surface.fixed_plane or not tip.segments:
        return
    times = tip.instants(PATH_CHECKS)
    found = _below(surface, tip, times)[0]
    sizes = np.linalg.norm(found, axis=1)
    largest = float(np.max(sizes))
    for k in map(int, np.flatnonzero(sizes <= SMALL * largest)):
        before, after = max(k - 1, 0), min(k + 1, times.size - 1)
        if sizes[k] <= min(sizes[before], sizes[after]):
            t = _least(surface, tip, times[before], times[k], times[after]) if sizes[k] > 0.0 else float(times[k])
            if not np.linalg.norm(_below(surface, tip, np.array([t]))[0]) > VANISHED * largest:
                raise _refused(surface, tip, t, "vanishes")
    for k in map(int, np.flatnonzero(_cosines(found) < TURNS)):
        jump = _jump(surface, tip, times[k], times[k + 1])
        if jump is not None:
            raise _refused(surface, tip, jump, "jumps")


def _refused(surface: PlacedSurface, tip: TipPath, t: float, does: str) -> ScenarioError:
    place = _below(surface, tip, np.array([t]))[1][0].round(4) + 0.0
    return ScenarioError(
        f"reference: at t = {t:.4g} s the path comes to {place.tolist()} m, where the surface has no normal, "
        f"as the gradient of its φ {does} there; make the path shorter, or lead it past that place"
    )


def _below(surface: PlacedSurface, tip: TipPath, times: Array) -> tuple[Array, Array]:
    """Return ∇φ on the surface below a path at times (N,), s, and where that is, m; each (N, 3)."""
    motion = tip.sample(times)
    try:
        r = surface.follow(0.0, times, motion)[0]
    except ScenarioError:  # nothing lies below: then along the path itself
        r = motion[0]
    return gradients(surface, times, r), r


def _cosines(found: Array) -> Array:
    """Return the cosines between neighbours of gradients (N, 3): (N − 1,), 1 where one of them is zero."""
    sizes = np.linalg.norm(found, axis=1)
    both = sizes[1:] * sizes[:-1]
    return np.divide(np.sum(found[1:] * found[:-1], axis=1), both, out=np.ones(both.size), where=both > 0.0)


def _least(surface: PlacedSurface, tip: TipPath, before: float, at: float, after: float) -> float:
    """Return the instant between two others, s, at which |∇φ| is least; `at` is one in between, from where it counts.

    Counted from there, an instant close to it is told apart to its own rounding, not to that of the whole run.
    """
    from scipy.optimize import minimize_scalar

    def size(shift: float) -> float:
        return float(np.linalg.norm(_below(surface, tip, np.array([at + shift]))[0]))

    exact = {"xatol": NEAREST * (after - before)}
    return at + float(minimize_scalar(size, bounds=(before - at, after - at), method="bounded", options=exact).x)


def _jump(surface: PlacedSurface, tip: TipPath, low: float, high: float) -> float | None:
    """Return the instant between two others, s, at which the direction of ∇φ jumps, or None if it turns smoothly."""
    span = high - low
    while high - low > max(NEAREST * span, 4e-16 * high):
        middle = 0.5 * (low + high)
        turned = _cosines(_below(surface, tip, np.array([low, middle, high]))[0])
        if np.min(turned) > JUMPS:
            return None
        low, high = (low, middle) if turned[0] < turned[1] else (middle, high)
    return high
