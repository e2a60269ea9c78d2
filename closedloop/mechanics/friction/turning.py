"""Where the friction of a slow slip points: to where the slip goes within the step.

Friction turns a slip u with the rate μ|f| s/|u|, s the mobility along the surface. Where that is above 1/h, a step that
takes friction against the present u throws the contact from side to side, and at last no step is short enough. There
the direction d is that of the slip u⁺ at the end of the step,

    u⁺ + h μ|f| S_t d = u + h (a_t + S_tn f − S_t w),    d = u⁺/|u⁺|

as in time stepping (J. J. Moreau, 1988): one equation for |u⁺|, by bisection. If friction is enough to stop the contact
within the step, d is such that it goes straight to rest. A slip that has only just broken away is u = 0: what rounding
has left of it has no direction, and must decide nothing.
"""

import math

from closedloop.base.arrays import Array
from closedloop.jit.dual8 import along, has_derivatives, settled, slope_of, sought
from closedloop.jit.kernel import kernel, kernel_inlined
from closedloop.mechanics.closure.contact_force import IMMOBILE
from closedloop.mechanics.friction.law import STILL


@kernel
def turn_friction(S: Array, a1: float, a2: float, u: Array, direction: Array, f: float, h: float, c: Array) -> bool:
    """Turn the friction −c f of a slow contact to where its slip points at the end of the step; return if it was slow.

    `S` (3, 3): mobility of the contact along n, t1, t2, 1/kg.
    `a1`, `a2`: its acceleration along t1 and t2 with all forces but this friction, m/s².
    `u` (3,): its velocity, m/s.
    `direction` (2,): of its slip as the substep began.
    `f`, `h`: normal force, N, and step, s.
    `c` (2,): ±μ u/|u| (minus where f pulls); written.
    """
    level, speed = math.hypot(c[0], c[1]), math.hypot(u[1], u[2])
    reach = h * level * abs(f)
    if not reach * (S[1, 1] + S[2, 2]) > speed:
        return False
    u1, u2, before1, before2 = u[1], u[2], u[1], u[2]
    if speed <= STILL:
        u1, u2, before1, before2 = 0.0, 0.0, direction[0], direction[1]
    elif not u1 * direction[0] + u2 * direction[1] > 0.0:
        return False  # past the end of slip
    det = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    trace, largest = S[1, 1] + S[2, 2], level * f
    if not det > IMMOBILE * trace * trace:
        return False  # what moves along a line does not turn
    p1, p2 = (S[2, 2] * u1 - S[1, 2] * u2) / det, (S[1, 1] * u2 - S[1, 2] * u1) / det
    q1, q2 = (S[2, 2] * a1 - S[1, 2] * a2) / det, (S[1, 1] * a2 - S[1, 2] * a1) / det
    if math.hypot(p1 / h + q1, p2 / h + q2) < level * abs(f):
        if speed <= STILL:
            return False  # it does not leave: friction is against the direction in which it is pulled
        pull, square = p1 * q1 + p2 * q2, p1 * p1 + p2 * p2
        rate = (math.sqrt(pull * pull + square * (largest * largest - q1 * q1 - q2 * q2)) - pull) / square
        d1, d2 = rate * p1 + q1, rate * p2 + q2
    else:
        g11, g12, g22 = reach * S[1, 1], reach * S[1, 2], reach * S[2, 2]
        x1, x2 = u1 + h * a1, u2 + h * a2
        s, low, high, d1, d2 = 0.0, 0.0, math.hypot(x1, x2), x1, x2
        for _ in range(60):
            s = 0.5 * (low + high)
            d1, d2 = slowed(s, (g11, g12, g22), x1, x2)
            low, high = (s, high) if math.hypot(d1, d2) > 1.0 else (low, s)
            if high - low <= 1e-14 * high:
                break
        if has_derivatives(x1):
            d1, d2 = slowed(along(s), (g11, g12, g22), x1, x2)
            slope, s = slope_of(math.hypot(d1, d2)), sought(s)
            d1, d2 = slowed(s, (g11, g12, g22), x1, x2)
            d1, d2 = slowed(settled(s, math.hypot(d1, d2), slope), (g11, g12, g22), x1, x2)
    size = math.hypot(d1, d2)
    if not size > 0.0 or d1 * before1 + d2 * before2 < 0.0:
        return False  # slip ends within the step; until then friction is against it
    turned = math.copysign(level / size, f)
    c[0], c[1] = turned * d1, turned * d2
    return True


@kernel_inlined
def slowed(s: float, g: tuple[float, float, float], x1: float, x2: float) -> tuple[float, float]:
    """Return d = (s I + G)⁻¹ x of the symmetric G (g11, g12, g22): u⁺/s, if |u⁺| is s."""
    g11, g12, g22 = g
    det = (s + g11) * (s + g22) - g12 * g12
    return ((s + g22) * x1 - g12 * x2) / det, ((s + g11) * x2 - g12 * x1) / det
