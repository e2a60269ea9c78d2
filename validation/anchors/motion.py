"""Quantities that take time: an engine's own accelerations, integrated tightly."""

from collections.abc import Callable
from typing import Any

import numpy as np

from validation.anchors.asked import Asked
from validation.oracle.spatial import Array

RELATIVE, ABSOLUTE = 1e-12, 1e-13
"""Tolerances of DOP853 a step, close to the smallest that it takes."""

HORIZON = 60.0
"""No swing or flight of a reference problem takes longer [s]; one that does has gone wrong."""


def free_positions(engine: Asked, q: Array, v: Array, times: Array) -> Array:
    """Return the tip (k, 3) at `times` (k,) [s], moving freely from (q, v) at time 0."""
    states = _free(engine, q, v, float(times[-1]), t_eval=times).y
    return np.stack([engine.position(state[: engine.n]) for state in states.T])


def swing_period(engine: Asked, q: Array, v: Array) -> Array:
    """Return the time () [s] of a full swing of one joint about q = 0: twice that between two crossings of zero."""

    def crossing(_: float, state: Array) -> float:
        return float(state[0])

    crossing.terminal = 2  # type: ignore[attr-defined]
    (times,) = _free(engine, q, v, HORIZON, events=crossing).t_events
    if len(times) < 2:
        raise ArithmeticError(f"it does not swing through zero twice in {HORIZON:g} s")
    return np.asarray(2.0 * (times[1] - times[0]))


def impact_times(engine: Asked, q: Array, v: Array, normal: Array, restitution: Array, count: Array) -> Array:
    """Return when (count,) [s] the tip, falling freely, strikes the plane n·r = 0; between strikes q̇⁺ by `rebound`."""
    out: list[float] = []
    now = 0.0

    def height(_: float, state: Array) -> float:
        return float(normal @ engine.position(state[: engine.n]))

    height.terminal, height.direction = True, -1.0  # type: ignore[attr-defined]
    while len(out) < int(count):
        flight = _free(engine, q, v, HORIZON, events=height)
        if not len(flight.t_events[0]):
            raise ArithmeticError(f"it does not come down within {HORIZON:g} s")
        now += float(flight.t_events[0][0])
        out.append(now)
        q, v = np.split(flight.y_events[0][0], 2)
        v = engine.rebound(q, v, normal, float(restitution))
    return np.array(out)


def _free(engine: Asked, q: Array, v: Array, until: float, **options: Any) -> Any:
    """Integrate q̈ of the free arm, no torque, from time 0."""
    from scipy.integrate import solve_ivp

    n, nothing = engine.n, np.zeros(engine.n)

    def rates(_: float, state: Array) -> Array:
        return np.concatenate([state[n:], engine.forward_dynamics(state[:n], state[n:], nothing)])

    right_hand_side: Callable[[float, Array], Array] = rates
    start = np.concatenate([q, v])
    result = solve_ivp(
        right_hand_side, (0.0, until), start, method="DOP853", rtol=RELATIVE, atol=ABSOLUTE, max_step=0.1, **options
    )
    if result.status < 0:
        raise ArithmeticError(f"its accelerations cannot be integrated: {result.message}")
    return result
