"""Baumgarte's stabiliser: its gains, and its limit of stability from both sides."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stabiliser_errors import rounding_gain, sliding_error

import closedloop as cl
from closedloop.loop.step.record_row import recorded
from closedloop.mechanics.closure.baumgarte import (
    amplification,
    baumgarte_gains,
    largest_stable_ratio,
    recommended_ratio,
    spectral_radius,
)
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.scenario.load import parse_scenario
from closedloop.simulation.simulate import run_loop

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
    e = np.abs(recorded(rows, 2, "closure_error"))
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


# --- which T goes with a step --------------------------------------------------------------------------------------

# Time stepping has no closure of the tip that is stabilised.
SCHEMES = sorted(name for name, scheme in INTEGRATORS.items() if not scheme.time_stepping)


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(SCHEMES), st.floats(0.02, 50.0))
def test_auto_is_stable_with_twice_the_step(integrator, damping):
    """At any damping the error dies out, would with twice the step, and T is no less than two steps."""
    ratio = recommended_ratio(integrator, damping)
    assert 0.0 < ratio <= 0.5
    assert spectral_radius(integrator, damping, ratio) < 1.0
    assert spectral_radius(integrator, damping, 1.999 * ratio) < 1.0


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(SCHEMES), st.floats(0.3, 3.0))
def test_auto_is_quiet_and_leaves_the_force_alone(integrator, damping):
    """Rounding is never amplified beyond 0.4 h²-units, and in steady sliding f is moved by about 1 % of a at most."""
    ratio = recommended_ratio(integrator, damping)
    assert rounding_gain(integrator, damping, ratio) < 0.4
    assert abs(sliding_error(integrator, damping, ratio)[2]) < 0.012


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(SCHEMES), st.floats(0.05, 10.0), st.floats(0.0, 0.01))
def test_auto_changes_little_when_damping_does(integrator, damping, change):
    """T is a continuous function of ζ: a hundredth more damping changes it by no more than some hundredths."""
    before, after = (recommended_ratio(integrator, damping * factor) for factor in (1.0, 1.0 + change))
    assert after == pytest.approx(before, rel=3.0 * change + 1e-9)


def test_least_spectral_radius_would_not_do():
    """Why the rule is not the T of least spectral radius: it is near the limit, jumps, and is wrong in f."""

    def least(integrator, damping):
        ratios = largest_stable_ratio(integrator, damping) * np.linspace(0.002, 1.0, 1500)
        return min(ratios.tolist(), key=lambda ratio: spectral_radius(integrator, damping, ratio))

    assert least("semi_implicit_euler", 0.1) > 0.99 * largest_stable_ratio("semi_implicit_euler", 0.1)
    assert least("semi_implicit_euler", 0.77) == pytest.approx(0.46, abs=0.01)
    assert least("semi_implicit_euler", 0.80) == pytest.approx(0.825, abs=0.01)
    assert sliding_error("rk4", 1.0, least("rk4", 1.0))[2] == pytest.approx(0.59, abs=0.02)
    assert sliding_error("rk4", 0.707, least("rk4", 0.707))[2] == pytest.approx(0.07, abs=0.01)


@pytest.mark.parametrize(("integrator", "sign"), [("semi_implicit_euler", -1.0), ("explicit_euler", 1.0)])
@pytest.mark.parametrize("damping", [0.3, 0.707, 1.0])
@pytest.mark.parametrize("ratio", [0.1, 0.5])
def test_sliding_error_of_the_eulers_is_the_closed_form(integrator, sign, damping, ratio):
    """e = ∓ζ h T a, ė = ±h a/2, and no share of the force: the spring and the damper balance."""
    error, rate, share = sliding_error(integrator, damping, ratio)
    assert error == pytest.approx(sign * damping / ratio, rel=1e-12)
    assert rate == pytest.approx(-0.5 * sign, rel=1e-12)
    assert share == pytest.approx(0.0, abs=1e-15)


def test_sliding_error_of_rk4_has_its_order():
    """With T fixed, e falls like h⁴ and so does the share of the force."""
    ratios = np.array([0.02, 0.04, 0.08])
    values = np.array([sliding_error("rk4", 0.707, float(ratio)) for ratio in ratios])
    e_slope = np.diff(np.log(np.abs(values[:, 0]) * ratios**2)) / np.log(2.0)
    share_slope = np.diff(np.log(np.abs(values[:, 2]))) / np.log(2.0)
    assert e_slope == pytest.approx([4.0, 4.0], abs=0.15)
    assert share_slope == pytest.approx([4.0, 4.0], abs=0.1)


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("ratio", [0.2, 0.5])
def test_run_slides_with_that_error(integrator, ratio):
    """A sliding arm has the e and the share of f of `sliding_error`, with a the n·J̇ᵣq̇ of its state.

    1 %: a changes along the path, and e follows by a few steps; the share of the Eulers is this change alone.
    """
    constant = STEP / ratio
    changes = {"reference.start": 0.1, "reference.stop": 1.5, "time.duration": 1.5, "time.integrator": integrator}
    run = cl.simulate(cl.load_scenario("wam_slide", changes | {"stabiliser.time_constant": constant}))
    terms = cl.Robot(run.model).terms(run.q[-1], run.v[-1])
    normal = np.array([0.0, 0.0, 1.0])
    row = normal @ terms.jacobian
    mobility = row @ np.linalg.solve(terms.mass_matrix, row)
    a = float(normal @ terms.drift)
    error, _, share = sliding_error(integrator, run.scenario.stabiliser.damping_ratio, ratio)
    assert run.closure_error[-1] == pytest.approx(error * STEP**2 * a, rel=1e-2)
    assert run.stabiliser_force[-1] == pytest.approx(share * a / mobility, rel=2e-2, abs=1e-4 * abs(a) / mobility)


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("ratio", [0.3, 0.6, 0.9])
def test_rounding_gain_is_that_of_noise_put_into_the_map(integrator, ratio):
    """The gain is the scatter of −s_v ė − s_p e over steps of the scheme with a random error in e at each stage.

    A hundred sequences of 400 steps each, after 200 in which the start is forgotten. 5 %: the scatter of a scatter
    estimated from 40 000 values that depend on their neighbours.
    """
    damping, count, chains = 0.707, 600, 100
    scheme, z = INTEGRATORS[integrator], ratio * largest_stable_ratio(integrator, 0.707)
    noise = np.random.default_rng(7).normal(size=(count, scheme.stages, chains))
    x, pushes = np.zeros((2, chains)), np.empty((count, chains))
    for k in range(count):
        if scheme.semi_implicit:
            push = -2 * damping * z * x[1] - z**2 * (x[0] + noise[k, 0])
            pushes[k] = push
            rate = x[1] + push
            x = np.array([x[0] + rate, rate])
            continue
        slopes = []
        for row, wrong in zip(scheme.a, noise[k], strict=True):
            e, r = x + sum((a * s for a, s in zip(row, slopes, strict=False)), np.zeros((2, chains)))
            slopes.append(np.array([r, -2 * damping * z * r - z**2 * (e + wrong)]))
        pushes[k] = slopes[0][1]
        x = x + sum(b * s for b, s in zip(scheme.b, slopes, strict=True))
    assert rounding_gain(integrator, damping, z) == pytest.approx(pushes[200:].std(), rel=0.05)


def test_rounding_gain_has_no_bound_at_the_limit():
    """It grows like z² for small z, and without bound towards the limit."""
    limit = largest_stable_ratio("semi_implicit_euler", 0.707)
    small = [rounding_gain("semi_implicit_euler", 0.707, z) for z in (1e-3, 2e-3)]
    assert small[1] / small[0] == pytest.approx(4.0, rel=5e-3)
    near = [rounding_gain("semi_implicit_euler", 0.707, (1 - gap) * limit) for gap in (1e-2, 1e-4)]
    assert near[1] == pytest.approx(10.0 * near[0], rel=0.05)
    assert rounding_gain("semi_implicit_euler", 0.707, limit * 1.001) == np.inf


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("kind", ["baumgarte", "both"])
def test_auto_is_resolved_and_kept(integrator, kind):
    """`time_constant = "auto"` survives the file, and becomes gains and a number that can be looked at."""
    changes = {"stabiliser.kind": kind, "stabiliser.time_constant": "auto", "time.integrator": integrator}
    scenario = cl.load_scenario("wam_slide", changes)
    text = scenario.to_toml()
    assert 'time_constant = "auto"' in text
    assert parse_scenario(text) == scenario
    problem = cl.prepare(scenario)
    constant = STEP / recommended_ratio(integrator, 0.707)
    assert problem.time_constant == pytest.approx(constant, rel=1e-12)
    assert problem.stabiliser == pytest.approx(baumgarte_gains(0.707, constant), rel=1e-12)


def test_time_constant_of_a_problem_is_the_one_given():
    """A T given in seconds is the problem's, however long; without the stabiliser there is none."""
    for constant in (0.002, 1e300):
        scenario = cl.load_scenario("wam_slide", {"stabiliser.time_constant": constant})
        assert cl.prepare(scenario).time_constant == constant
    for kind in ("none", "projection"):
        assert cl.prepare(cl.load_scenario("wam_slide", {"stabiliser.kind": kind})).time_constant is None


ROLLING = {
    "ball": {"radius": 0.1},
    "disc": {"half_axes": [[0.1, 0, 0], [0, 0, 0.1]]},
    "point that resists pivoting": {"at": [0, 0, -0.1], "pivoting": 0.01},
    "point": {"at": [0, 0, -0.1]},
}


def on_the_floor(kind, integrator, ratio, **more):
    """Return the scenario of a body on the floor, with h/T = ratio, or without T if that is None."""
    body = {"name": "b", "shape": "ball", "radius": 0.1, "mass": 1.0, "position": [0, 0, 0.1]} | more
    contact = {"name": "c", "link": "b", "friction": 1.0} | ROLLING[kind]
    section = {"kind": "baumgarte"} | ({} if ratio is None else {"time_constant": STEP / ratio})
    time = {"duration": 200 * STEP, "step": STEP, "integrator": integrator}
    scenario = {"robot": {"model": "none"}, "body": [body], "contact": [contact], "stabiliser": section, "time": time}
    return cl.Scenario.model_validate(scenario)


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("kind", ROLLING)
def test_what_rolls_has_a_limit_of_its_own(kind, integrator):
    """Rows on velocity alone are u' = −s_v u: the real axis of each scheme, 2 of Euler's and 2.7853 of rk4, over 2ζ."""
    own = {"rk4": 2.78529356, "explicit_euler": 2.0, "semi_implicit_euler": 2.0}[integrator] / (2 * 0.707)
    limit = largest_stable_ratio(integrator, 0.707)
    if kind != "point":
        assert largest_stable_ratio(integrator, 0.707, rolls=True) == pytest.approx(min(own, limit), rel=1e-8)
        limit = min(own, limit)
    cl.prepare(on_the_floor(kind, integrator, 0.999 * limit))
    with pytest.raises(cl.ScenarioError, match=r"stabiliser\.time_constant.*unstable") as caught:
        cl.prepare(on_the_floor(kind, integrator, 1.001 * limit))
    assert ("of what rolls" in str(caught.value)) == (kind != "point")


def test_just_outside_that_limit_a_ball_that_rolls_shakes_apart():
    """The velocity of its contact, of rounding at first, grows by the factor of rk4 at each step, and dies inside."""
    slips = []
    for share in (0.9, 1.1):
        ratio = share * largest_stable_ratio("rk4", 0.707, rolls=True)
        moves = {"velocity": [0.3, 0, 0], "spin": [0, 3, 0]}
        problem = cl.prepare(on_the_floor("ball", "rk4", 1.0, **moves))
        problem = dataclasses.replace(problem, stabiliser=np.array(baumgarte_gains(0.707, STEP / ratio)))
        rows = run_loop(problem)[0]
        slips.append(np.abs(recorded(rows, problem.robot.n, "link_slips", 1))[-1].max())
    assert slips[0] < 1e-14
    assert slips[1] > 1e-8


def test_the_time_constant_follows_the_step():
    """Left out it is the step, whatever that is; of an integrator that chooses its steps that of the paper."""
    for step in (2e-4, 1e-3, 5e-3, 0.02):
        scenario = on_the_floor("ball", "rk4", None)
        time = scenario.time.model_copy(update={"step": step, "duration": 2 * step})
        assert cl.prepare(scenario.model_copy(update={"time": time})).time_constant == pytest.approx(step, rel=1e-12)
    assert cl.prepare(on_the_floor("ball", "dop853", None)).time_constant == pytest.approx(1e-3, rel=1e-12)


@pytest.mark.parametrize("integrator", SCHEMES)
def test_auto_without_damping_is_refused(integrator):
    """At ζ = 0 nothing makes the error die out: one line says so, and what to change."""
    changes = {"stabiliser.time_constant": "auto", "stabiliser.damping_ratio": 0, "time.integrator": integrator}
    with pytest.raises(
        cl.ScenarioError, match=r'stabiliser\.time_constant = "auto".*stabiliser\.damping_ratio'
    ) as caught:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert "\n" not in str(caught.value)
    assert integrator in str(caught.value)


@pytest.mark.parametrize("value", ["fast", "", "AUTO", True, [], {}])
def test_what_is_no_time_constant_is_refused_on_the_command_line(value, command_line):
    """Anything but a number or "auto" is one line that says what would be right, and exit status 2."""
    words = {"": '""', True: "true"}.get(value, str(value)) if not isinstance(value, list | dict) else str(value)
    line = command_line("wam_slide", "--stabiliser.time_constant", words, "--no-figures").refusal()
    assert line.startswith("wam_slide: stabiliser.time_constant = ")
    assert 'must be a number of seconds, or "auto"' in line


def test_auto_works_on_the_command_line(command_line, short, tmp_path):
    """--stabiliser.time_constant auto needs no quotes, and the run file keeps it."""
    assert command_line("wam_slide", "--stabiliser.time_constant", "auto", *short, "--out", "r").status == 0
    assert cl.load_run(tmp_path / "r" / "run.nc").scenario.stabiliser.time_constant == "auto"
