"""Baumgarte's stabiliser: its gains, and its limit of stability from both sides."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import closedloop as cl
from closedloop.baumgarte import amplification, baumgarte_gains, largest_stable_ratio, spectral_radius
from closedloop.integrate import INTEGRATORS
from closedloop.simulation import run_loop
from closedloop.step import SCALARS, Row

ROOT_HALF = 1.0 / np.sqrt(2.0)
STEP = 0.001  # s

# (integrator, ζ) -> h/T, from the characteristic polynomial of the map of (e, hė), with z = h/T:
# semi-implicit Euler, λ² - (2 - 2ζz - z²)λ + (1 - 2ζz): λ = -1 at z = 2(√(ζ² + 1) - ζ);
# explicit Euler, λ = 1 + zs with s² + 2ζs + 1 = 0: |λ| = 1 at z = 2ζ for ζ <= 1, and at z = 2 for ζ = 1;
# rk4, |1 + w + w²/2 + w³/6 + w⁴/24| = 1 along w = zs: -2.7853 on the real axis, 2.7044 along 135 degrees.
LIMITS = {
    ("semi_implicit_euler", ROOT_HALF): 2 * (np.sqrt(1.5) - ROOT_HALF),
    ("explicit_euler", ROOT_HALF): 2 * ROOT_HALF,
    ("rk4", ROOT_HALF): 2.7044,
    ("semi_implicit_euler", 1.0): 2 * (np.sqrt(2.0) - 1.0),
    ("explicit_euler", 1.0): 2.0,
    ("rk4", 1.0): 2.7853,
}
CASES = pytest.mark.parametrize(("integrator", "damping"), LIMITS, ids=[f"{n} {z:.3g}" for n, z in LIMITS])
ERROR = 1e-6  # m, off the surface at the start: so small that e obeys the linear map to 1e-4


def pressed(integrator, damping, ratio, steps=300):
    """Return the scenario of an arm at rest, off the surface by ERROR, and h/T = ratio."""
    robot = cl.Robot(cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": STEP})).model)
    height = float(robot.position([0.6, -1.4])[2])
    return cl.load_scenario(
        "planar2_slide",
        {
            "surface.offset": height - ERROR,
            "reference.kind": "hold",
            "stabiliser.damping_ratio": damping,
            "stabiliser.time_constant": STEP / ratio,
            "time.step": STEP,
            "time.duration": steps * STEP,
            "time.integrator": integrator,
        },
    )


def test_gains_are_the_papers():
    """ζ = 0.707 and T = 1 ms are the paper's 1414 1/s and 10⁶ 1/s²."""
    s_v, s_p = baumgarte_gains(0.707, 1e-3)
    assert s_v == pytest.approx(1414.0, rel=1e-14)
    assert s_p == pytest.approx(1e6, rel=1e-14)


@CASES
def test_limit_is_the_closed_form(integrator, damping):
    """The largest stable h/T is the closed form's; of rk4's the four digits of the literature.

    At ζ = 1 the map has a double eigenvalue, which rounding splits by √1e-16.
    """
    tolerance = 5e-5 if integrator == "rk4" else 1e-7
    assert largest_stable_ratio(integrator, damping) == pytest.approx(LIMITS[integrator, damping], abs=tolerance)


@settings(deadline=None, max_examples=30)
@given(st.sampled_from(sorted(INTEGRATORS)), st.floats(0.05, 3.0))
def test_limit_divides_stable_from_unstable(integrator, damping):
    """Just inside the limit one step shrinks the error in the long run, just outside it grows it."""
    limit = largest_stable_ratio(integrator, damping)
    assert spectral_radius(integrator, damping, limit * (1 - 1e-6)) < 1.0
    assert spectral_radius(integrator, damping, limit * (1 + 1e-6)) > 1.0


@settings(deadline=None, max_examples=50)
@given(st.floats(0.05, 1e4))
def test_limit_of_the_eulers_is_known_at_any_damping(damping):
    """The limits of both Euler schemes are the closed forms at any damping ratio, weak or strong.

    Explicit Euler with ζ > 1 has two real modes; the faster one, of rate ζ + √(ζ² - 1), must stay above -2.
    """
    symplectic = 2.0 / (np.sqrt(damping**2 + 1.0) + damping)
    explicit = 2 * damping if damping <= 1.0 else 2.0 / (damping + np.sqrt(damping**2 - 1.0))
    assert largest_stable_ratio("semi_implicit_euler", damping) == pytest.approx(symplectic, rel=1e-6)
    assert largest_stable_ratio("explicit_euler", damping) == pytest.approx(explicit, rel=1e-6)


def test_limit_without_damping():
    """Without damping rk4 is stable up to h/T = 2√2, on the imaginary axis, and explicit Euler never."""
    assert largest_stable_ratio("rk4", 0.0) == pytest.approx(2 * np.sqrt(2.0), rel=1e-6)
    assert largest_stable_ratio("explicit_euler", 0.0) == 0.0


@CASES
def test_run_follows_the_map(integrator, damping):
    """In a real run (e, hė) is multiplied by the map at every step, so the limit is that of the simulator.

    1e-3: the tip moves by ERROR, which bends the linear closure by ERROR over the arm's 0.1 m and less.
    """
    ratio = 0.9 * LIMITS[integrator, damping]
    run = cl.simulate(pressed(integrator, damping, ratio, steps=12))
    state = np.array([ERROR, 0.0])
    step = amplification(integrator, damping, ratio)
    for e, rate in zip(run.closure_error, run.closure_rate, strict=True):
        assert np.allclose([e, STEP * rate], state, rtol=0, atol=1e-3 * ERROR * max(1.0, ratio**2))
        state = step @ state


@CASES
def test_just_inside_the_limit_a_run_keeps_the_closure(integrator, damping):
    """Two hundredths inside the limit the error grows no more than the powers of the map do, and dies away.

    At ζ = 1 the map is no normal matrix: its powers first grow some forty-fold, which is as it should be.
    """
    ratio = 0.98 * LIMITS[integrator, damping]
    step, powers = amplification(integrator, damping, ratio), [np.eye(2)]
    for _ in range(500):
        powers.append(step @ powers[-1])
    largest = max(abs(power[0, 0]) for power in powers)
    run = cl.simulate(pressed(integrator, damping, ratio, steps=2000))
    assert np.max(np.abs(run.closure_error)) < 1.1 * largest * ERROR
    assert np.max(np.abs(run.closure_error[-100:])) < 1e-3 * ERROR


@CASES
def test_just_outside_the_limit_a_run_would_shake_apart_and_is_refused(integrator, damping):
    """A hundredth outside the limit the error grows, and the scenario is refused with the limit in the message."""
    inside = cl.prepare(pressed(integrator, damping, 0.99 * LIMITS[integrator, damping], steps=2000))
    outside = 1.01 * LIMITS[integrator, damping]
    gains = np.array(baumgarte_gains(damping, STEP / outside))
    rows, _, failure, _ = run_loop(dataclasses.replace(inside, stabiliser=gains))
    e = np.abs(rows[:, Row.of(2).scalars + SCALARS.index("closure_error")])
    assert failure is not None or e[-100:].max() > 100 * ERROR
    with pytest.raises(cl.ScenarioError, match=r"stabiliser\.time_constant") as caught:
        cl.prepare(pressed(integrator, damping, outside))
    for word in ("unstable", integrator, f"{largest_stable_ratio(integrator, damping):.4f}"):
        assert word in str(caught.value)


def test_cures_in_the_refusal_are_cures():
    """The step and the time constant that the refusal of an unstable stabiliser names are accepted."""
    with pytest.raises(cl.ScenarioError, match="at most") as caught:
        cl.prepare(cl.load_scenario("wam_slide", {"stabiliser.time_constant": 2e-4}))
    words = str(caught.value).split()
    step = float(words[words.index("most") + 1])
    constant = float(words[words.index("least") + 1])
    assert step == pytest.approx(2e-4 * 1.0353, rel=1e-3)
    assert constant == pytest.approx(1e-3 / 1.0353, rel=1e-3)
    cl.prepare(cl.load_scenario("wam_slide", {"stabiliser.time_constant": constant, "time.duration": 0.01}))
    steps = {"time.step": step, "time.duration": 100 * step, "stabiliser.time_constant": 2e-4}
    cl.prepare(cl.load_scenario("wam_slide", steps))


def test_stabiliser_force_is_the_part_that_it_adds():
    """The recorded share of the stabiliser is the difference to the same state's force without it."""
    scenario = pressed("semi_implicit_euler", 0.707, 0.5, steps=1)
    with_it = cl.simulate(scenario)
    changes = {"surface.offset": scenario.surface.offset, "reference.kind": "hold", "time.duration": STEP}
    without = cl.simulate(cl.load_scenario("planar2_slide", changes | {"stabiliser.kind": "none"}))
    difference = with_it.contact_force[0] - without.contact_force[0]
    assert abs(difference) > 0.1
    assert with_it.stabiliser_force[0] == pytest.approx(difference, rel=1e-10)
