"""Integrators: their order measured, their formulas as they stand in the rows, their energy accounted for."""

from types import SimpleNamespace

import numpy as np
import pytest
from rounding import within

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.advance import advance
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.record.report import energy_balance

DURATION = 0.2  # s
# Steps in DURATION: as few as is smooth, doubled until rk4's error is still a hundred times rounding (1e-14 × steps).
# Those that move a tip on a surface: time stepping is for contacts of links.
OF_THE_TIP = [name for name, scheme in INTEGRATORS.items() if not scheme.time_stepping]
STEPS = {"semi_implicit_euler": (40, 80, 160, 320), "explicit_euler": (40, 80, 160, 320), "rk4": (5, 10, 20, 40)}
EULERS = ["semi_implicit_euler", "explicit_euler"]


def smooth_law(t, q, v, terms):
    """Return a torque that is smooth in time and state."""
    push = terms.jacobian.T @ np.array([0.0, 0.0, 10.0 + 3.0 * np.sin(9.0 * t)])
    return terms.bias - push + np.array([2.0 * np.cos(7.0 * t), -np.sin(5.0 * t)]) - 0.4 * v


def slide(integrator, steps, stabiliser):
    """Return a smooth run of planar2 along the ground, whose tip starts at about 0.4 m/s along it.

    T = 50 ms where there is a stabiliser, whatever the step: gains that grew with the step would change the problem.
    """
    q = np.array([0.6, -1.4])
    A = np.array([0.4 * np.cos(0.6) + 0.3 * np.cos(-0.8), 0.3 * np.cos(-0.8)])
    v = 1.5 * np.array([-A[1], A[0]]) / np.linalg.norm(A)
    changes = {
        "start.q": q.tolist(),
        "start.v": v.tolist(),
        "reference.kind": "hold",
        "stabiliser.kind": stabiliser,
        "time.duration": DURATION,
        "time.step": DURATION / steps,
        "time.integrator": integrator,
    }
    if stabiliser == "baumgarte":
        changes |= {"stabiliser.time_constant": 0.05, "stabiliser.damping_ratio": 1.0}
    return cl.simulate(cl.load_scenario("planar2_slide", changes), law=smooth_law)


def slope(steps, errors):
    """Return the order: the slope of log error against log step."""
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


@pytest.fixture(scope="module")
def truth():
    """Return, for each stabiliser, the end of a run with rk4 in a step 25 times finer than the finest compared."""
    return {kind: slide("rk4", 1000, kind) for kind in ("none", "baumgarte")}


@pytest.mark.parametrize("stabiliser", ["none", "baumgarte"])
@pytest.mark.parametrize("name", OF_THE_TIP)
def test_order_of_convergence_is_the_stated_one(name, stabiliser, truth):
    """Joint positions, velocities and the contact force at the end converge with the order that the name states.

    0.15 of the order is what higher-order terms take from the slope at these steps.
    """
    runs = [slide(name, n, stabiliser) for n in STEPS[name]]
    exact = truth[stabiliser]
    assert np.max(np.abs(runs[-1].v[-1] - runs[-1].v[0])) > 0.3  # it is no trivial motion
    for column in ("q", "v", "contact_force"):
        errors = [np.max(np.abs(getattr(r, column)[-1] - getattr(exact, column)[-1])) for r in runs]
        assert errors[-1] > 1e-12
        assert slope(STEPS[name], errors) == pytest.approx(INTEGRATORS[name].order, abs=0.15), column


@pytest.mark.parametrize("name", OF_THE_TIP)
def test_energy_left_over_falls_with_the_order(name):
    """What the energy balance leaves over falls with the integrator's order."""
    residuals = [np.max(np.abs(energy_balance(slide(name, n, "none"))[0])) for n in STEPS[name]]
    assert slope(STEPS[name], residuals) == pytest.approx(INTEGRATORS[name].order, abs=0.15)


@pytest.mark.parametrize("name", OF_THE_TIP)
def test_drift_of_the_closure_falls_with_the_order(name):
    """Without a stabiliser the closure error is truncation: it falls with the integrator's order."""
    drift = [abs(slide(name, n, "none").closure_error[-1]) for n in STEPS[name]]
    assert slope(STEPS[name], drift) == pytest.approx(INTEGRATORS[name].order, abs=0.2)


@pytest.mark.parametrize("name", EULERS)
def test_euler_rows_follow_their_formula(name):
    """Each row comes from the one before by the scheme's formula, to the last bit."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.integrator": name, "time.duration": 0.6}))
    h = run.scenario.time.step
    assert np.array_equal(run.v[1:], run.v[:-1] + h * run.acceleration[:-1])
    velocity = run.v[1:] if name == "semi_implicit_euler" else run.v[:-1]
    assert np.array_equal(run.q[1:], run.q[:-1] + h * velocity)


def test_rk4_evaluates_the_law_at_its_nodes():
    """Four evaluations a step, at its beginning, twice in its middle and at its end; one for the last row."""
    instants = []

    def law(t, q, v, terms):
        instants.append(t)
        return terms.bias

    cl.simulate(cl.load_scenario("wam_slide", {"time.integrator": "rk4", "time.duration": 0.002}), law=law)
    h = 0.001
    expected = [0, h / 2, h / 2, h, h, 1.5 * h, 1.5 * h, 2 * h, 2 * h]
    assert within(16, instants, expected)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_tableau_meets_the_order_conditions(name):
    """The weights sum to one, every stage's row to its node, and the conditions up to the stated order hold."""
    scheme = INTEGRATORS[name]
    table = scheme.tableau()
    a, b, c = table[:-1], table[-1], np.array(scheme.nodes)
    assert table.shape == (scheme.stages + 1, scheme.stages)
    assert np.sum(b) == pytest.approx(1.0)
    assert np.allclose(a.sum(axis=1), c)
    if scheme.order == 4:
        conditions = {b @ c: 1 / 2, b @ c**2: 1 / 3, b @ a @ c: 1 / 6, b @ c**3: 1 / 4}
        conditions |= {(b * c) @ a @ c: 1 / 8, b @ a @ c**2: 1 / 12, b @ a @ a @ c: 1 / 24}
        assert all(value == pytest.approx(right) for value, right in conditions.items())
        assert len(conditions) == 7


def linear(y, M, n):
    """Return q̈ and ż of a linear system, of y = (q, q̇, z)."""
    rates = M @ y
    return rates[:n], rates[n:]


@pytest.mark.parametrize("name", [name for name, scheme in INTEGRATORS.items() if not scheme.semi_implicit])
def test_a_step_is_that_of_its_tableau(name):
    """Positions, velocities and the states of a law advance alike: y + h Σ b_i k_i with k_i = f(y + h Σ a_ij k_j)."""
    n, k, h, scheme, rng = 3, 2, 0.1, INTEGRATORS[name], np.random.default_rng(2)
    M, begin = rng.normal(size=(n + k, 2 * n + k)), rng.normal(size=2 * n + k)
    q, v, z = begin[:n].copy(), begin[n : 2 * n].copy(), begin[2 * n :].copy()
    stages = np.full((scheme.stages, 2 * n + k), np.nan)
    slopes = []
    for stage, row in enumerate(scheme.a):
        y = begin + h * sum((a * slope for a, slope in zip(row, slopes, strict=True)), np.zeros(2 * n + k))
        np.testing.assert_allclose(np.concatenate([q, v, z]), y, rtol=1e-14, atol=1e-14)
        qdd, dz = linear(y, M, n)
        slopes.append(np.concatenate([y[n : 2 * n], qdd, dz]))
        w = SimpleNamespace(start=SimpleNamespace(state=begin), stages=stages, qdd=qdd, dz=dz, q=q, v=v, z=z)
        interpreted(advance)(stage, h, False, False, scheme.tableau(), w)
    y = begin + h * sum(b * slope for b, slope in zip(scheme.b, slopes, strict=True))
    np.testing.assert_allclose(np.concatenate([q, v, z]), y, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("piece", [False, True])
def test_a_semi_implicit_step_takes_the_new_velocity_and_a_piece_of_one_the_mean(piece):
    """q̇ and z by their rates; q by the new q̇, after an event by the mean of the old and the new."""
    n, k, h, rng = 3, 2, 0.1, np.random.default_rng(3)
    q, v, z, qdd, dz = (rng.normal(size=size) for size in (n, n, k, n, k))
    new = v + h * qdd
    expected = q + h * (0.5 * (v + new) if piece else new), new, z + h * dz
    w = SimpleNamespace(start=SimpleNamespace(state=None), stages=None, qdd=qdd, dz=dz, q=q, v=v, z=z)
    interpreted(advance)(0, h, True, piece, np.zeros((2, 1)), w)
    for ours, right in zip((q, v, z), expected, strict=True):
        np.testing.assert_allclose(ours, right, rtol=1e-15)
