"""An example of every law of friction, and what the tests of the laws share."""

import math

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from closedloop.mechanics.friction.contact import Contact
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS, surface_parameters
from closedloop.mechanics.friction.laws.coulomb import SurfaceCoulomb
from closedloop.mechanics.friction.laws.coulomb_viscous import SurfaceCoulombViscous
from closedloop.mechanics.friction.laws.dahl import SurfaceDahl
from closedloop.mechanics.friction.laws.karnopp import SurfaceKarnopp
from closedloop.mechanics.friction.laws.lugre import SurfaceLuGre
from closedloop.mechanics.friction.laws.none import NoFriction
from closedloop.mechanics.friction.laws.seven_parameter import SurfaceSevenParameter
from closedloop.mechanics.friction.laws.stribeck import SurfaceStribeck

patient = settings(deadline=None, max_examples=40)


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


def contact(section, d=2):
    """Return a contact of a section in so many dimensions."""
    return Contact(type(section), surface_parameters(section), d)


def some_states(law, share, angle):
    """Give a contact states that are `share` of the largest deflection there is, along `angle`; return them."""
    z = law.rested()
    if z.size:
        z[-law.d :] = pointing(share * law.stick_limit / law.par.stiffness, angle)[: law.d]
    return z


def turned(z, rotation):
    """Return the states seen in axes that are turned."""
    return np.concatenate([z[:-2], rotation @ z[-2:]]) if z.size else z


def test_every_law_has_an_example():
    """Both families have the same laws, each with an example here; and each law sticks in one of the three ways."""
    names = {name for name in SURFACE_LAWS if ":" not in name}
    assert names == {name for name in JOINT_LAWS if ":" not in name} == set(EXAMPLES)
    for name, section in EXAMPLES.items():
        assert section.kind == name
        assert SURFACE_LAWS[name].sticks == JOINT_LAWS[name].sticks
        assert section.sticks in ("rigid", "elastic", "spring")
