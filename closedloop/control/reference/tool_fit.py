"""A tool whose round tip is too large for a hollow of the surface is refused before anything is simulated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.tip_path import TipPath
from closedloop.mechanics.surface.along import shape_at
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.plane import contact_frame

# Instants at which the path is looked at, and by which share the tool may be larger than the hollow: rounding.
PATH_CHECKS, ROUNDING = 200, 1e-9


def hollow_radii(surface: PlacedSurface, times: Array, r: Array) -> Array:
    """Return the smallest radius of curvature of the hollows at points of a surface, (N,), m; inf where there is none.

    Parameters
    ----------
    times : (N,) array
        s.
    r : (N, 3) array
        Points on it at these instants, m, base frame.
    """
    shape, found = shape_at(surface), np.full(times.size, math.inf)
    for k, t in enumerate(times):
        turn, shift = surface.displacement(float(t))
        point = turn.T @ (r[k] - shift)
        n = shape(point, np.zeros(3))[0]
        if not np.all(np.isfinite(n)):
            continue  # there is no normal: refused where the path is laid onto the surface
        tangents = contact_frame(n)[1:]
        rates = np.array([shape(point, e)[1] for e in tangents])  # of n, for a metre along either tangent
        bend = rates @ tangents.T
        least = float(np.linalg.eigvalsh(0.5 * (bend + bend.T))[0])
        if least < 0.0:
            found[k] = -1.0 / least
    return found


def refuse_tool_too_large(surface: PlacedSurface, tip: TipPath, radius: float) -> None:
    """Refuse a tool with a tip of this radius, m, where the path comes to a hollow that is narrower."""
    if radius == 0.0 or surface.fixed_plane:
        return
    times = tip.instants(PATH_CHECKS) if tip.segments else np.zeros(1)
    r, velocity = tip.sample(times)[:2]
    refuse_narrow(surface, times, r - radius * surface.normals(times, r, velocity)[0], radius)


def refuse_narrow(surface: PlacedSurface, times: Array, r: Array, radius: float) -> None:
    """Refuse a ball of this radius, m, that touches a surface at points r (N, 3), m, if it does not fit there."""
    hollow = hollow_radii(replace(surface, radius=0.0), times, r)
    k = int(np.argmin(hollow))
    if radius > hollow[k] * (1.0 + ROUNDING):
        raise ScenarioError(
            f"tool.radius = {radius:g}: at t = {times[k]:.4g} s the path is at {np.round(r[k], 4).tolist()} m, where "
            f"the surface is hollow with a radius of {hollow[k]:.4g} m: a tool so large touches it beside its tip; "
            "must be no larger than that"
        )
