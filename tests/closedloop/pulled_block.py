"""A block pulled over a surface by a spring whose end moves steadily: the classical trial of a friction law.

    m v̇ = k (y − x) + F_t(v, z),   y = speed·t,   v = ẋ

For the laws without a mode of sticking (dahl, lugre), with an adaptive implicit scheme. What sticks is for the
simulator.
"""

from dataclasses import dataclass

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.law import SurfaceFriction, surface_parameters


@dataclass(frozen=True)
class Pull:
    """What the block did.

    Attributes
    ----------
    time, position, velocity, deflection, spring, friction : (N,) arrays
        s; m; m/s; of the bristle, m; force of the spring and of the friction on the block, N.
    starts, stops : arrays
        Instants at which the velocity rose above and fell below `slip_speed`, s.
    """

    time: Array
    position: Array
    velocity: Array
    deflection: Array
    spring: Array
    friction: Array
    starts: Array
    stops: Array


def pull_block(
    section: SurfaceFriction,
    mass: float = 1.0,
    spring: float = 2.0,
    speed: float = 0.1,
    duration: float = 25.0,
    load: float = 1.0,
    slip_speed: float = 1e-3,
    tolerance: float = 1e-8,
) -> Pull:
    """Pull a block, at first at rest with the spring relaxed, and return its motion at the steps that the scheme took.

    Parameters
    ----------
    section : SurfaceFriction
        A law without a mode of sticking: dahl, lugre or none.
    mass, spring, speed, duration, load : float
        m, kg; k, N/m; of the spring's far end, m/s; s; normal force f, N.
    slip_speed : float
        Velocity that counts as slip in `starts` and `stops`, m/s.
    tolerance : float
        Relative tolerance of the integration; absolute ones follow from it.

    Raises
    ------
    ScenarioError
        If the law has a mode of sticking.
    """
    from scipy.integrate import solve_ivp

    if section.sticks != "elastic":
        raise ScenarioError(f"friction.kind = '{section.kind}': only dahl and lugre pull a block")
    contact = Contact(type(section), surface_parameters(section), 1)
    count = contact.states.size

    def friction(v: Array, z: Array) -> float:
        contact.states[:] = z
        c, w = contact.slide(v)
        return float(-load * c[0] - w[0])

    def motion(t: float, state: Array) -> Array:
        v = state[1:2]
        force = spring * (speed * t - state[0]) + friction(v, state[2:])
        return np.concatenate([v, [force / mass], contact.rates(v)])

    def starts(t: float, state: Array) -> float:
        return float(state[1] - slip_speed)

    def stops(t: float, state: Array) -> float:
        return float(state[1] - slip_speed)

    starts.direction, stops.direction = 1.0, -1.0  # type: ignore[attr-defined]
    scale = np.array([1.0, 1.0] + [1e-5] * count)  # bristles bend by microns
    done = solve_ivp(
        motion,
        (0.0, duration),
        np.zeros(2 + count),
        method="Radau",
        rtol=tolerance,
        atol=tolerance * scale,
        events=(starts, stops),
    )
    if not done.success:
        raise RuntimeError(f"the block could not be followed beyond t = {done.t[-1]:g} s: {done.message}")
    x, v, z = done.y[0], done.y[1], done.y[2:]
    return Pull(
        time=done.t,
        position=x,
        velocity=v,
        deflection=z[0] if count else np.zeros_like(x),
        spring=spring * (speed * done.t - x),
        friction=np.array([friction(v[i : i + 1], z[:, i]) for i in range(x.size)]),
        starts=done.t_events[0],
        stops=done.t_events[1],
    )
