"""The seven-parameter law: friction that rises with rest and lags the slip, by its closed forms and in a trial."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from closedloop.friction import pack
from closedloop.friction.laws import (
    advance_states,
    contact_states,
    holding,
    memory_delay,
    rest_states,
    sliding,
    stick_limit,
    stick_states,
    stored_energy,
)
from closedloop.friction.layout import DISPLACEMENT, DWELL, LAST, STIFFNESS
from closedloop.friction.sections import SurfaceSevenParameter

F_C, F_S, V_S, K_T, TAU, GAMMA, F_V = 0.1, 0.08, 2e-3, 2e4, 0.01, 0.4, 0.5
SECTION = SurfaceSevenParameter(
    kinetic=F_C, static_excess=F_S, stribeck_speed=V_S, stiffness=K_T, memory_delay=TAU, rise_time=GAMMA, viscous=F_V
)
KIND, PAR = pack(SECTION)

patient = settings(deadline=None, max_examples=40)


def force(u, delayed_speed, dwell, last):
    """Return the friction per newton of normal force, and the viscous part, of slip u along a line."""
    c, w = np.empty(1), np.empty(1)
    sliding(KIND, PAR, np.array([u]), delayed_speed, np.array([dwell, last, 0.0]), np.ones(1), c, w)
    return float(c[0]), float(w[0])


def test_static_friction_rises_with_rest():
    """No rest leaves F_Sa, a rest of γ brings it half way to F_S∞, a long one all the way; it rises throughout."""
    last = 0.02
    limits = [stick_limit(KIND, PAR, np.array([t, last, 0.0])) for t in (0.0, GAMMA, 1e9 * GAMMA)]
    assert limits == pytest.approx([F_C + last, F_C + 0.5 * (last + F_S), F_C + F_S], rel=1e-8)
    times = np.linspace(0.0, 50.0, 500)
    assert np.all(np.diff([stick_limit(KIND, PAR, np.array([t, last, 0.0])) for t in times]) > 0.0)


def test_dwell_time_is_counted_while_stuck():
    """Stuck for a while, in steps, a contact has that dwell time; sliding adds none."""
    z = np.zeros(3)
    contact_states(z)
    for _ in range(40):
        advance_states(KIND, PAR, np.array([1e-6]), True, GAMMA / 40.0, z)
    assert z[DWELL] == pytest.approx(GAMMA, rel=1e-14)
    assert z[DISPLACEMENT] == pytest.approx(1e-6 * GAMMA, rel=1e-14)
    assert stick_limit(KIND, PAR, z) == pytest.approx(F_C + 0.5 * F_S, rel=1e-14)
    before = z.copy()
    advance_states(KIND, PAR, np.array([1.0]), False, 1.0, z)
    assert np.array_equal(z, before)


def test_static_friction_without_a_rise_time_is_there_at_once():
    """With γ = 0 the excess is F_S∞ whatever went before."""
    kind, par = pack(SECTION.model_copy(update={"rise_time": 0.0}))
    assert [stick_limit(kind, par, np.array([t, 0.0, 0.0])) for t in (0.0, 1e-6, 1.0)] == [F_C + F_S] * 3


def test_stribeck_curve_is_half_way_at_its_speed():
    """At v_s half the excess is left, at 3 v_s a tenth: the curve is Lorentzian. The viscous part is beside it."""
    assert force(V_S, V_S, GAMMA, 0.0) == pytest.approx((F_C + 0.5 * 0.5 * F_S, F_V * V_S), rel=1e-14)
    assert force(3.0 * V_S, 3.0 * V_S, GAMMA, 0.0)[0] == pytest.approx(F_C + 0.1 * 0.5 * F_S, rel=1e-14)
    assert force(1e200, 1e200, 0.0, 0.0)[0] == F_C


def test_friction_lags_the_slip():
    """On a ramp v = a t the curve is that without memory, τ_L later; the viscous part does not lag."""
    a = 0.3
    assert memory_delay(KIND, PAR) == TAU
    for t in np.linspace(TAU, 0.1, 20):
        c, w = force(a * t, a * (t - TAU), GAMMA, 0.0)
        assert c == force(a * (t - TAU), a * (t - TAU), GAMMA, 0.0)[0]
        assert w == pytest.approx(F_V * a * t, rel=1e-15)


def test_memory_matters_to_changing_speed_alone():
    """At constant speed the slip of τ_L ago is that of now, and τ_L is in nothing else."""
    kind, par = pack(SECTION.model_copy(update={"memory_delay": 0.05}))
    z, c, w = np.array([GAMMA, 0.0, 0.0]), np.empty(1), np.empty(1)
    sliding(kind, par, np.array([3e-3]), 3e-3, z, np.zeros(1), c, w)
    assert (c[0], w[0]) == force(3e-3, 3e-3, GAMMA, 0.0)


@given(
    dwell=st.floats(0.0, 100.0), last=st.floats(0.0, F_S), lag=st.floats(0.0, 0.1), angle=st.floats(0.0, 6.3),
)  # fmt: skip
@patient
def test_sticking_starts_without_a_jump(dwell, last, lag, angle):
    """Where slip ends the spring takes over its force, stored energy does not rise, and the dwell time starts again."""
    direction = np.array([np.cos(angle), np.sin(angle)])
    z = np.array([dwell, last, 3e-6, -1e-6])
    before, after, w = np.empty(2), np.empty(2), np.empty(2)
    sliding(KIND, PAR, np.zeros(2), lag, z, direction, before, w)
    stored = stored_energy(KIND, PAR, False, z, 2)
    stick_states(KIND, PAR, lag, direction, z)
    holding(KIND, PAR, z, after, w)
    assert after == pytest.approx(before, rel=1e-13, abs=1e-15)
    assert not np.any(w)
    assert z[DWELL] == 0.0
    assert np.linalg.norm(after) <= stick_limit(KIND, PAR, z) * (1.0 + 1e-13)
    assert stored_energy(KIND, PAR, True, z, 2) <= stored * (1.0 + 1e-13)


@given(dwell=st.floats(0.0, 100.0), last=st.floats(0.0, F_S))
@patient
def test_sliding_starts_without_a_jump(dwell, last):
    """Where the spring reaches the limit, with no slip τ_L ago, slip has its force and what is stored stays."""
    z = np.array([dwell, last, 0.0])
    z[DISPLACEMENT] = stick_limit(KIND, PAR, z) / K_T
    held, slipping, w = np.empty(1), np.empty(1), np.empty(1)
    holding(KIND, PAR, z, held, w)
    sliding(KIND, PAR, np.zeros(1), 0.0, z, np.ones(1), slipping, w)
    assert slipping == pytest.approx(held, rel=1e-14)
    assert stored_energy(KIND, PAR, False, z, 1) == pytest.approx(stored_energy(KIND, PAR, True, z, 1), rel=1e-14)


def test_rest_is_fully_risen():
    """A contact at rest for long has all of F_S∞; one just made none."""
    z = np.full(4, np.nan)
    rest_states(KIND, PAR, z)
    assert stick_limit(KIND, PAR, z) == pytest.approx(F_C + F_S, rel=1e-15)
    contact_states(z)
    assert stick_limit(KIND, PAR, z) == F_C


def stick_slip(section, speed, slips, spring=2.0, mass=1.0, h=2e-4):
    """Pull a block at f = 1 N as a simulator would; return force at break-away, dwell times, F_Sa and energies.

    Semi-implicit Euler with the mode switched at the end of a step, and a history of speeds for the memory.
    """
    kind, par = pack(section)
    lag = round(memory_delay(kind, par) / h)
    u, z, c, w = np.zeros(1), np.zeros(3), np.empty(1), np.empty(1)
    rest_states(kind, par, z)
    history = np.zeros(lag + 1)
    x, stuck, direction = 0.0, True, np.ones(1)
    away, dwells, lasts, energies, work = [], [], [], [], 0.0
    for i in range(400_000):
        delayed = history[i % (lag + 1)] if lag else abs(u[0])
        history[i % (lag + 1)] = abs(u[0])
        if stuck:
            holding(kind, par, z, c, w)
        else:
            sliding(kind, par, u, delayed, z, direction, c, w)
        pull = spring * (speed * i * h - x)
        before = u[0]
        u[0] += h / mass * (pull - c[0] - w[0])
        if not stuck and before > 0.0 >= u[0]:
            u[0] = 0.0
            stick_states(kind, par, delayed, direction, z)
            stuck = True
            lasts.append(float(z[LAST]))
            if len(away) == slips:
                break
        x += h * u[0]
        advance_states(kind, par, u, stuck, h, z)
        work += h * speed * pull
        held = par[STIFFNESS] * abs(z[DISPLACEMENT])
        if stuck and held >= stick_limit(kind, par, z):
            stuck = False
            away.append(held)
            dwells.append(float(z[DWELL]))
        bound = 0.5 * mass * u[0] ** 2 + 0.5 * spring * (speed * (i + 1) * h - x) ** 2
        energies.append(work - bound - stored_energy(kind, par, stuck, z, 1))
    else:
        raise AssertionError("the block did not stop as often as asked for")
    return np.array(away), np.array(dwells), np.array(lasts), np.array(energies)


def test_stick_slip_of_a_block():
    """Pulled slowly a block sticks and slips; break-away obeys the rise with rest, and friction only takes energy."""
    section = SECTION.model_copy(update={"stiffness": 2e3, "static_excess": 0.1, "viscous": 0.05})
    away, dwells, lasts, taken = stick_slip(section, 0.01, 4)
    assert len(away) == 4
    assert np.all(lasts < 0.1)
    assert np.all(lasts > 0.0)
    wanted = F_C + lasts[:3] + (0.1 - lasts[:3]) * dwells[1:] / (dwells[1:] + GAMMA)
    assert away[1:] == pytest.approx(wanted, rel=5e-3)  # seen at the end of a step
    assert taken[-1] > 0.0
    assert np.min(np.diff(taken)) > -1e-6 * taken[-1]
