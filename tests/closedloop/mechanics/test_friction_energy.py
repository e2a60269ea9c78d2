"""Friction never adds energy; lugre where it says so."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_friction_examples import (
    EXAMPLES,
    PUBLISHED,
    ROUNDING,
    angles,
    contact,
    factor,
    level,
    patient,
    pointing,
    some_states,
    speeds,
)

from closedloop.mechanics.friction.law import surface_parameters
from closedloop.mechanics.friction.laws.lugre import SurfaceLuGre, is_passive, passive_damping_speed, passive_viscous


def gained(law, u, stuck, f, delayed_speed=None):
    """Return F_t·u + f d(stored)/dt, W, and the size of what was added."""
    d, z, sticks = u.size, law.states, law.member.sticks
    step = law.rates(u, stuck)
    c, w = (law.hold(), np.zeros(d)) if stuck and sticks == "spring" else law.slide(u, delayed_speed)
    work = -f * c @ u - w @ u
    # stored = ½σ_0|x|² of a bristle, or of a spring while it is stuck; constant otherwise
    stores = (sticks == "spring" and stuck) or (sticks == "elastic" and z.size > 0)
    storing = f * law.par.stiffness * z[-d:] @ step[-d:] if stores else 0.0
    return work + storing, abs(f * c @ u) + abs(w @ u) + abs(storing)


@pytest.mark.parametrize("name", EXAMPLES)
@given(
    speed=st.one_of(speeds, st.just(0.0)), angle=angles, share=st.floats(0.0, 1.0), along=angles,
    f=st.floats(0.0, 50.0), lag=speeds, stuck=st.booleans(),
)  # fmt: skip
@patient
def test_friction_never_adds_energy(name, speed, angle, share, along, f, lag, stuck):
    """Friction takes at least what it stores, in any state, at any slip and any constant normal force."""
    law = contact(EXAMPLES[name])
    assert name != "lugre" or is_passive(law.par, 50.0)
    some_states(law, share, along)
    gain, size = gained(law, pointing(speed, angle), stuck, f, lag)
    assert gain <= ROUNDING * size + 1e-300  # below it numbers have no relative rounding


@given(
    kinetic=level, ratio=factor, stiffness=st.floats(1e2, 1e6), damping=st.floats(0.0, 1e3), by_speed=st.booleans(),
    speed=st.floats(-7.0, 3.0).map(lambda e: 10.0**e), angle=angles, share=st.floats(0.0, 1.0), f=st.floats(0.1, 50.0),
)  # fmt: skip
@settings(deadline=None, max_examples=300)
def test_lugre_is_passive_where_it_says_so(kinetic, ratio, stiffness, damping, by_speed, speed, angle, share, f):
    """Parameters that just meet one of the two conditions give no state from which energy is gained."""
    section = SurfaceLuGre(
        kinetic=kinetic, static=kinetic * ratio, stribeck_speed=1e-3, stiffness=stiffness, damping=damping
    )
    par = surface_parameters(section)
    edge = passive_damping_speed(par)
    by_speed = by_speed and math.isfinite(edge)
    cure = {"damping_speed": edge} if by_speed else {"viscous": passive_viscous(par, f)}
    law = contact(section.model_copy(update=cure))
    assert is_passive(law.par, f)
    some_states(law, share, angle)
    gain, size = gained(law, pointing(speed, 0.0), False, f)
    assert gain <= 1e-12 * size + 1e-300


@pytest.mark.parametrize(("share", "adds"), [(0.98, True), (1.02, False)])
def test_viscous_condition_of_lugre_is_sharp(share, adds):
    """With constant damping, a little less viscous friction than the condition asks for adds energy at high speed."""
    b = passive_viscous(surface_parameters(PUBLISHED), load=2.0)
    law = contact(PUBLISHED.model_copy(update={"viscous": share * b}), d=1)
    assert is_passive(law.par, 2.0) is not adds
    law.states[:] = 1.5e-5
    gains = [gained(law, np.array([v]), False, 2.0)[0] for v in np.logspace(-3, 3, 60)]
    assert bool(max(gains) > 0.0) is adds


def test_published_lugre_can_add_energy():
    """The published figures (σ_2 = 0.4 N s/m, constant damping) meet no condition, and at 10 m/s do add energy."""
    law = contact(PUBLISHED, d=1)
    assert not is_passive(law.par)
    law.states[:] = 1.5e-5
    assert gained(law, np.array([10.0]), False, 1.0)[0] > 0.0


@pytest.mark.parametrize("name", EXAMPLES)
def test_stored_energy_is_half_stiffness_times_deflection_squared(name):
    """Elastic laws store ½σ_0|z|², the spring ½k_t|x|²; the others nothing."""
    law = contact(EXAMPLES[name])
    z = some_states(law, 0.7, 1.0)
    wanted = 0.5 * law.par.stiffness * float(z[-2:] @ z[-2:]) if z.size else 0.0
    assert law.stored_energy(stuck=True) == pytest.approx(wanted, rel=1e-14)
