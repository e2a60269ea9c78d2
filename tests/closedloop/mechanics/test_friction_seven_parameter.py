"""The seven-parameter law: friction that rises with rest and lags the slip, by its closed forms and in a trial."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_friction_examples import contact

from closedloop.mechanics.friction.laws.seven_parameter import SurfaceSevenParameter

F_C, F_S, V_S, K_T, TAU, GAMMA, F_V = 0.1, 0.08, 2e-3, 2e4, 0.01, 0.4, 0.5
SECTION = SurfaceSevenParameter(
    kinetic=F_C, static_excess=F_S, stribeck_speed=V_S, stiffness=K_T, memory_delay=TAU, rise_time=GAMMA, viscous=F_V
)


def law_with(dwell=0.0, last=0.0, displacement=0.0, **changes):
    """Return a contact along a line with these states, the section changed so."""
    law = contact(SECTION.model_copy(update=changes), d=1)
    law.states[:] = dwell, last, displacement
    return law


patient = settings(deadline=None, max_examples=40)


def force(u, delayed_speed, dwell, last):
    """Return the friction per newton of normal force, and the viscous part, of slip u along a line."""
    c, w = law_with(dwell, last).slide(np.array([u]), delayed_speed, np.ones(1))
    return float(c[0]), float(w[0])


def test_static_friction_rises_with_rest():
    """No rest leaves F_Sa, a rest of γ brings it half way to F_S∞, a long one all the way; it rises throughout."""
    last = 0.02
    limits = [law_with(t, last).stick_limit for t in (0.0, GAMMA, 1e9 * GAMMA)]
    assert limits == pytest.approx([F_C + last, F_C + 0.5 * (last + F_S), F_C + F_S], rel=1e-8)
    times = np.linspace(0.0, 50.0, 500)
    assert np.all(np.diff([law_with(t, last).stick_limit for t in times]) > 0.0)


def test_dwell_time_is_counted_while_stuck():
    """Stuck for a while, in steps, a contact has that dwell time; sliding adds none."""
    law = law_with()
    for _ in range(40):
        law.advance(np.array([1e-6]), GAMMA / 40.0, stuck=True)
    assert law.z.dwell == pytest.approx(GAMMA, rel=1e-14)
    assert law.z.displacement[0] == pytest.approx(1e-6 * GAMMA, rel=1e-14)
    assert law.stick_limit == pytest.approx(F_C + 0.5 * F_S, rel=1e-14)
    before = law.states.copy()
    law.advance(np.array([1.0]), 1.0)
    assert np.array_equal(law.states, before)


def test_static_friction_without_a_rise_time_is_there_at_once():
    """With γ = 0 the excess is F_S∞ whatever went before."""
    assert [law_with(t, rise_time=0.0).stick_limit for t in (0.0, 1e-6, 1.0)] == [F_C + F_S] * 3


def test_stribeck_curve_is_half_way_at_its_speed():
    """At v_s half the excess is left, at 3 v_s a tenth: the curve is Lorentzian. The viscous part is beside it."""
    assert force(V_S, V_S, GAMMA, 0.0) == pytest.approx((F_C + 0.5 * 0.5 * F_S, F_V * V_S), rel=1e-14)
    assert force(3.0 * V_S, 3.0 * V_S, GAMMA, 0.0)[0] == pytest.approx(F_C + 0.1 * 0.5 * F_S, rel=1e-14)
    assert force(1e200, 1e200, 0.0, 0.0)[0] == F_C


def test_friction_lags_the_slip():
    """On a ramp v = a t the curve is that without memory, τ_L later; the viscous part does not lag."""
    a = 0.3
    assert law_with().lag == TAU
    for t in np.linspace(TAU, 0.1, 20):
        c, w = force(a * t, a * (t - TAU), GAMMA, 0.0)
        assert c == force(a * (t - TAU), a * (t - TAU), GAMMA, 0.0)[0]
        assert w == pytest.approx(F_V * a * t, rel=1e-15)


def test_memory_matters_to_changing_speed_alone():
    """At constant speed the slip of τ_L ago is that of now, and τ_L is in nothing else."""
    c, w = law_with(GAMMA, memory_delay=0.05).slide(np.array([3e-3]))
    assert (c[0], w[0]) == force(3e-3, 3e-3, GAMMA, 0.0)


@given(
    dwell=st.floats(0.0, 100.0), last=st.floats(0.0, F_S), lag=st.floats(0.0, 0.1), angle=st.floats(0.0, 6.3),
)  # fmt: skip
@patient
def test_sticking_starts_without_a_jump(dwell, last, lag, angle):
    """Where slip ends the spring takes over its force, stored energy does not rise, and the dwell time starts again."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    law = contact(SECTION)
    law.states[:] = dwell, last, 3e-6, -1e-6
    before, _ = law.slide(np.zeros(2), lag, direction)
    stored = law.stored_energy()
    law.stick(direction, lag)
    after = law.hold()
    assert after == pytest.approx(before, rel=1e-13, abs=1e-15)
    assert law.z.dwell == 0.0
    assert np.linalg.norm(after) <= law.stick_limit * (1.0 + 1e-13)
    assert law.stored_energy(stuck=True) <= stored * (1.0 + 1e-13)


@given(dwell=st.floats(0.0, 100.0), last=st.floats(0.0, F_S))
@patient
def test_sliding_starts_without_a_jump(dwell, last):
    """Where the spring reaches the limit, with no slip τ_L ago, slip has its force and what is stored stays."""
    law = law_with(dwell, last)
    law.z.displacement[0] = law.stick_limit / K_T
    slipping, _ = law.slide(np.zeros(1), 0.0, np.ones(1))
    assert slipping == pytest.approx(law.hold(), rel=1e-14)
    assert law.stored_energy() == pytest.approx(law.stored_energy(stuck=True), rel=1e-14)


def test_rest_is_fully_risen():
    """A contact at rest for long has all of F_S∞; one just made none."""
    law = contact(SECTION)
    assert law.stick_limit == F_C
    law.rested()
    assert law.stick_limit == pytest.approx(F_C + F_S, rel=1e-15)
