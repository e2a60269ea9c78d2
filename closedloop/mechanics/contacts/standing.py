"""A disc that lies nearly flat: its edge rolls on the lowest point, or stands on one that is fixed to it.

With a the unit axis, t = a − (a·n) n its part along the plane, |t| the sine of the tilt, and ṫ its rate, the lowest
point is R t/|t| from the centre. Where t changes by about itself within a step it goes anywhere: it turns by |ṫ|/|t|,
without bound, and where t passes zero it jumps to the other side, with another velocity. Rows that go with it would do
work that nothing supplies. A disc with

    X |t| < h |ṫ| + X t0

stands: what was its lowest point is a point of the body, as its feet are (`closedloop.scenario.collision`). Where
another has come to be deeper it goes on, with an impact, to the next corner of a polygon in the edge: to a point as
high as the one it stood on, beyond the lowest. It rolls where the tilt is resolved and the lowest point is the one it
stands on. A foot is a point of the edge, and no contact while the edge rolls.
"""

from __future__ import annotations

import math

from closedloop.base.arrays import Array
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import FREE
from closedloop.mechanics.contacts.memory import ContactLinks, Contacts
from closedloop.mechanics.contacts.shapes import RADIUS, Shapes, shapes_at

# X: t may change by this share of itself in a step; a step is divided so that it changes by no more than the second.
RESOLVED, IN_A_PART = 0.8, 0.1
# t0: what is tilted less is flat, but for rounding. What stands rolls again from so many times the limit on, where the
# lowest point is no further than this share of R |t| below that which it stands on; from the third on, wherever it is.
LEAST_TILT, AGAIN, NEAR, SURELY = 1e-6, 2.0, 1e-4, 8.0
# Of an integrator that chooses its steps: as if they were so long, s.
OWN_STEP = 1e-3
# How deep another point of the edge may be, as a share of R |t|, and beside it, m: a polygon of some 31 corners. The
# next corner is beyond the lowest point by this share of the angle of the last; from further away, the lowest point.
SHARE_DEEPER, DEEPER, BEYOND, FAR = 0.005, 1e-10, 0.95, 0.9
# A foot that is no contact is so far, m.
APART = 1.0


@kernel
def see_tilt(shapes: Shapes, i: int) -> None:
    """Write tilt and tilt_rate of contact i, of a disc; its axes and its spin against the plane are written."""
    rim, axes, w = shapes.rim, shapes.axes, shapes.spin
    a0 = axes[0, 0] * rim.axis[i, 0] + axes[0, 1] * rim.axis[i, 1] + axes[0, 2] * rim.axis[i, 2]
    a1 = axes[1, 0] * rim.axis[i, 0] + axes[1, 1] * rim.axis[i, 1] + axes[1, 2] * rim.axis[i, 2]
    a2 = axes[2, 0] * rim.axis[i, 0] + axes[2, 1] * rim.axis[i, 1] + axes[2, 2] * rim.axis[i, 2]
    rim.tilt[i] = math.hypot(a1, a2)
    rim.tilt_rate[i] = math.hypot(w[2] * a0 - w[0] * a2, w[0] * a1 - w[1] * a0)


@kernel
def stand(shapes: Shapes, i: int, r: Array, wander: Array) -> None:
    """Write r and ṙ of the point that contact i stands on, in place of its lowest, and where that is."""
    rim, axes, w, radius = shapes.rim, shapes.axes, shapes.spin, shapes.shape[i, RADIUS]
    lowest = r[0] + radius
    for a in range(3):
        rim.lowest[i, a] = axes[0, a] * lowest + axes[1, a] * r[1] + axes[2, a] * r[2]
    for a in range(3):
        r[a] = axes[a, 0] * rim.seat[i, 0] + axes[a, 1] * rim.seat[i, 1] + axes[a, 2] * rim.seat[i, 2]
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        wander[a] = w[b] * r[d] - w[d] * r[b]
    rim.apart[i] = r[0] / lowest if lowest < 0.0 else 1.0
    r[0] -= radius


@kernel
def take_seat(shapes: Shapes, i: int, r: Array) -> None:
    """Let contact i stand on its lowest point r."""
    rim, axes = shapes.rim, shapes.axes
    for a in range(3):
        at = r[0] + shapes.shape[i, RADIUS]
        rim.seat[i, a] = axes[0, a] * at + axes[1, a] * r[1] + axes[2, a] * r[2]
    rim.stands[i] = 1.0


@kernel
def left_of_rolling(shapes: Shapes, i: int, h: float) -> float:
    """Return what is left of the tilt until contact i cannot roll in steps of h, s: negative where it cannot."""
    return float(RESOLVED * (shapes.rim.tilt[i] - LEAST_TILT) - h * shapes.rim.tilt_rate[i])


@kernel
def left_of_standing(shapes: Shapes, i: int, h: float) -> float:
    """Return what is left until contact i, which stands, rolls or stands on another point: negative once it does."""
    rim = shapes.rim
    size, deeper = rim.radius[i] * rim.tilt[i], rim.radius[i] * rim.tilt[i] * (1.0 - rim.apart[i])
    limit, tilt = h * rim.tilt_rate[i] + RESOLVED * LEAST_TILT, RESOLVED * rim.tilt[i]
    rolls = max(AGAIN * limit - tilt, deeper - NEAR * size - DEEPER)
    return float(min(rolls, SURELY * limit - tilt, DEEPER + SHARE_DEEPER * size - deeper))


@kernel
def is_idle(shapes: Shapes, c: Contacts, j: int, h: float) -> bool:
    """Whether contact j is a foot of a disc whose edge rolls; those of soft contacts are springs of their own."""
    i = int(shapes.rim.foot_of[j])
    rolls = i > 0 and c.mode[i] != FREE and shapes.rim.stands[i] == 0.0 and left_of_rolling(shapes, i, h) >= 0.0
    return bool(rolls and c.soft[i] == 0.0)


@kernel
def rim_margin(links: ContactLinks, c: Contacts, h: float) -> float:
    """Return the least of what is left to discs that are closed until they stand, or stand otherwise."""
    shapes, least = shapes_at(links.shapes), math.inf
    for i in range(1, links.points):
        if shapes.rim.radius[i] > 0.0 and c.mode[i] != FREE:
            stands = shapes.rim.stands[i] != 0.0
            least = min(least, left_of_standing(shapes, i, h) if stands else left_of_rolling(shapes, i, h))
    return float(least)


@kernel
def some_stand(links: ContactLinks, c: Contacts) -> bool:
    """Whether a disc stands on its edge or on its feet."""
    shapes, stands = shapes_at(links.shapes), False
    for i in range(1, links.points):
        on_foot = shapes.rim.foot_of[i] > 0.0 and c.mode[i] != FREE
        stands = stands or on_foot or (shapes.rim.stands[i] != 0.0 and c.mode[i] != FREE)
    return stands


@kernel
def longest_roll(links: ContactLinks, c: Contacts) -> float:
    """Return how long the next substep may be, s, for discs that roll."""
    shapes, longest = shapes_at(links.shapes), math.inf
    for i in range(1, links.points):
        turns = shapes.rim.radius[i] > 0.0 and c.mode[i] != FREE and shapes.rim.stands[i] == 0.0
        if turns and shapes.rim.tilt_rate[i] > 0.0:
            longest = min(longest, IN_A_PART * shapes.rim.tilt[i] / shapes.rim.tilt_rate[i])
    return float(longest)


@kernel
def leave_seats(links: ContactLinks, c: Contacts, h: float) -> bool:
    """Let discs stand on the next point, or roll, where they do no longer stand as they did; whether there are any.

    What rolls again has no feet.
    """
    shapes, left = shapes_at(links.shapes), False
    rim = shapes.rim
    for i in range(1, links.points):
        if rim.stands[i] == 0.0 or c.mode[i] == FREE or left_of_standing(shapes, i, h) >= 0.0:
            continue
        left = True
        size = rim.radius[i] * rim.tilt[i]
        if DEEPER + SHARE_DEEPER * size < (1.0 - rim.apart[i]) * size:
            seat_next(shapes, i)
            continue
        rim.stands[i] = 0.0
        for j in range(1, links.points):
            if rim.foot_of[j] == i and c.mode[j] != FREE and c.soft[i] == 0.0:
                c.mode[j], c.cleared[j], c.floor[j] = FREE, 0.0, min(c.located[3 * j], 0.0)
    return left


@kernel
def seat_next(shapes: Shapes, i: int) -> None:
    """Let contact i stand on the next point: in coordinates in which the edge is a circle, beyond the lowest."""
    rim, of_lowest, of_last = shapes.rim, 1.0, 0.0
    if FAR < rim.apart[i] < 1.0:
        angle = math.acos(rim.apart[i])
        of_lowest, of_last = math.sin((1.0 + BEYOND) * angle), math.sin(BEYOND * angle)
        of_lowest, of_last = of_lowest / math.sin(angle), of_last / math.sin(angle)
    for a in range(3):
        rim.seat[i, a] = of_lowest * rim.lowest[i, a] - of_last * rim.seat[i, a]


@kernel
def rest_on_feet(links: ContactLinks, c: Contacts) -> None:
    """Open the edge of a disc that stands on its feet: it is a fourth point of the same plane.

    Not of a soft one: what its springs carry does not go elsewhere at once.
    """
    shapes = shapes_at(links.shapes)
    for i in range(1, links.points):
        if shapes.rim.stands[i] == 0.0 or c.mode[i] == FREE or c.soft[i] != 0.0:
            continue
        feet = 0
        for j in range(1, links.points):
            feet += 1 if shapes.rim.foot_of[j] == i and c.mode[j] != FREE else 0
        if feet >= 3:
            c.mode[i], c.cleared[i], c.floor[i] = FREE, 0.0, min(c.located[3 * i], 0.0)
