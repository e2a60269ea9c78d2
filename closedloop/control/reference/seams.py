"""The instants at which a path crosses the seams of a surface, where third derivatives of φ jump.

A tool that is held against the surface has an acceleration that jumps there, and no polynomial goes over the jump. So
the joint path has a knot at each of these instants.
"""

from __future__ import annotations

import numpy as np

from closedloop.control.reference.tip_path import Segment
from closedloop.mechanics.surface.placed import PlacedSurface

# Instants of a segment between which crossings are looked for.
INSTANTS = 257
# Newton steps to a crossing: a secant over 1/256 of a segment begins them.
STEPS = 4
# The path goes so far at least from one of the instants to the next, m: along a seam it is on either side by rounding.
ACROSS = 1e-9
# Nearer to the last, as a share of a segment, is no other crossing: a path through a corner of four patches has two.
APART = 1e-9


def seams(surface: PlacedSurface | None, segment: Segment) -> list[float]:
    """Return the instants within a segment, s, in order; none of a surface that moves."""
    if surface is None or surface.moves or not any(map(np.size, surface.section.seams())):
        return []
    begin, end = segment.start, segment.stop
    times = np.linspace(begin, end, INSTANTS)
    places = (segment.sample(times)[0] - surface.origin) @ surface.frame[1:].T
    found: list[float] = []
    for tangent, place, lines in zip(surface.frame[1:], places.T, surface.section.seams(), strict=True):
        apart = place[:, None] - lines
        k, line = np.nonzero((apart[:-1] * apart[1:] <= 0.0) & (np.abs(np.diff(place))[:, None] > ACROSS))
        t = times[k] + np.diff(times)[k] * apart[k, line] / (apart[k, line] - apart[k + 1, line])
        for _ in range(STEPS if t.size else 0):
            r, velocity, _ = segment.sample(t)
            with np.errstate(divide="ignore", invalid="ignore"):  # at rest where it begins on a line
                step = ((r - surface.origin) @ tangent - lines[line]) / (velocity @ tangent)
            t = np.clip(t - np.nan_to_num(step), times[k], times[k + 1])
        found += t.tolist()
    kept = [begin]
    for instant in sorted(found):
        if kept[-1] + APART * (end - begin) < instant < end - APART * (end - begin):
            kept.append(instant)
    return kept[1:]
