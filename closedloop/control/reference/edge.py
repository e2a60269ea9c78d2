"""Paths that leave a surface over its edge are refused before anything is simulated."""

from __future__ import annotations

import math

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.control.reference.tip_path import TipPath
from closedloop.mechanics.surface.contact import edge_distance
from closedloop.mechanics.surface.placed import PlacedSurface
from closedloop.mechanics.surface.surface import Surface

# Instants, beside the ends of its segments, at which a path is looked for beyond the edge of a surface; how far beyond
# is rounding, m.
PATH_CHECKS, ON_EDGE = 500, 1e-9


def edge_distances(surface: PlacedSurface, times: Array, r: Array) -> Array:
    """Return how far inside the edge points r (N, 3), m, base frame, are at times (N,), s: (N,), m, inf without one."""
    if not surface.ends:
        return np.full(times.size, math.inf)
    bounds, axes, found = np.array(surface.section.bounds()), surface.frame[[1, 2, 0]], np.empty(times.size)
    for k, t in enumerate(times):
        turn, shift = surface.displacement(float(t))
        found[k] = edge_distance(axes @ (turn.T @ (r[k] - shift) - surface.origin), bounds, np.zeros(5))
    return found


def refuse_beyond_edge(surface: PlacedSurface, tip: TipPath) -> None:
    """Refuse a path along a surface that leaves it over its edge; a tip that is to stay may be left by the surface."""
    if not surface.ends or not tip.length > 0.0:
        return
    times = tip.instants(PATH_CHECKS)
    inside = edge_distances(surface, times, tip.sample(times)[0])
    beyond = np.flatnonzero(inside < -ON_EDGE)
    if beyond.size:
        keys = " and ".join(tip.keys) or "reference"
        raise ScenarioError(
            f"{keys}: at t = {times[beyond[0]]:.4g} s the path leaves the surface over its edge, "
            f"by {-inside.min():.4g} m at most: make it shorter, or surface.{edge_key(surface.section)} larger"
        )


def edge_key(section: Surface) -> str:
    """Return the key that says where the edge of a surface is."""
    if section.edge_radius is not None:
        return "edge_radius"
    return "extent" if section.extent is not None or not hasattr(section, "spacing") else "spacing"
