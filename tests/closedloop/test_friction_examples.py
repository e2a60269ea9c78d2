"""An example of every law of friction, and what the tests of the laws share."""

import math

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from closedloop.friction import KINDS, STICKS, state_count
from closedloop.friction.laws import (
    rest_states,
    sliding,
    stick_limit,
)
from closedloop.friction.layout import STIFFNESS
from closedloop.friction.sections import (
    NoFriction,
    SurfaceCoulomb,
    SurfaceCoulombViscous,
    SurfaceDahl,
    SurfaceKarnopp,
    SurfaceLuGre,
    SurfaceSevenParameter,
    SurfaceStribeck,
)

patient = settings(deadline=None, max_examples=40)  # the first example of all compiles


# Sums of a few products: their rounding, relative to the largest of them.
ROUNDING = 1e-13

EXAMPLES = {
    "none": NoFriction(),
    "coulomb": SurfaceCoulomb(coefficient=0.3),
    "coulomb_viscous": SurfaceCoulombViscous(coefficient=0.3, viscous=4.0),
    "stribeck": SurfaceStribeck(kinetic=0.2, static=0.35, stribeck_speed=2e-3, exponent=1.3, viscous=0.5),
    "karnopp": SurfaceKarnopp(kinetic=0.2, static=0.35, dead_band=1e-4, viscous=0.5),
    "dahl": SurfaceDahl(coefficient=0.3, stiffness=3e4, viscous=0.2),
    "lugre": SurfaceLuGre(
        kinetic=0.2, static=0.35, stribeck_speed=2e-3, stiffness=3e4, damping=40.0, damping_speed=0.02, viscous=0.5
    ),
    "seven_parameter": SurfaceSevenParameter(
        kinetic=0.1,
        static_excess=0.08,
        stribeck_speed=2e-3,
        stiffness=2e4,
        memory_delay=0.01,
        rise_time=0.4,
        viscous=0.5,
    ),
}

# Table 1 of Canudas de Wit, Olsson, Åström, Lischinsky 1995.
PUBLISHED = SurfaceLuGre(
    kinetic=1.0, static=1.5, stribeck_speed=1e-3, stiffness=1e5, damping=math.sqrt(1e5), viscous=0.4
)

level = st.floats(0.01, 2.0)
factor = st.floats(1.0, 4.0)
speeds = st.floats(-6.0, 1.0).map(lambda e: 10.0**e)
angles = st.floats(0.0, 2.0 * math.pi)


def pointing(size: float, angle: float) -> np.ndarray:
    """Return the (2,) vector of this length and direction."""
    return size * np.array([math.cos(angle), math.sin(angle)])


def friction(kind, par, u, z, delayed_speed=None, direction=None):
    """Return c and w of a contact that slides."""
    c, w = np.empty_like(u), np.empty_like(u)
    lag = float(np.linalg.norm(u)) if delayed_speed is None else delayed_speed
    sliding(kind, par, u, lag, z, np.zeros_like(u) if direction is None else direction, c, w)
    return c, w


def some_states(name, par, share, angle, d=2):
    """Return states of a law that are `share` of the largest deflection there is, along `angle`."""
    z = np.zeros(state_count(KINDS[name], d))
    rest_states(KINDS[name], par, z)
    if z.size:
        largest = stick_limit(KINDS[name], par, z) / par[STIFFNESS]
        z[-d:] = pointing(share * largest, angle)[:d]
    return z


def turned(z, rotation):
    """Return the states seen in axes that are turned."""
    return np.concatenate([z[:-2], rotation @ z[-2:]]) if z.size else z


def test_every_law_has_an_example():
    """The table of laws, that of sticking and the examples of these tests name the same laws."""
    assert set(KINDS) == set(EXAMPLES)
    assert set(STICKS) == set(KINDS.values())
    assert all(section.kind == name for name, section in EXAMPLES.items())
