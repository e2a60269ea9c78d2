"""Bristles of a fast slip decay within a step of rk4: the step takes the decay exactly, at the order of the scheme."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import closedloop as cl
from closedloop.mechanics.integrators import Integrator
from closedloop.mechanics.integrators.rk4 import RK4
from closedloop.scenario.load import parse_scenario

LAWS = {
    "dahl": 'kind = "dahl", coefficient = 0.3, stiffness = 1e4',
    "lugre": 'kind = "lugre", kinetic = 0.3, static = 0.4, stribeck_speed = 0.05, stiffness = 1e4, damping = 5.0, '
    "damping_speed = 0.05",
}
BOX = """
[robot]
model = "none"
[[body]]
name = "box"
shape = "box"
edges = [0.2, 0.15, 0.1]
mass = 1.0
position = [0, 0, 0.05]
velocity = [{speed}, 0, 0]
spin = [0, 0, {spin}]
[[contact]]
name = "foot"
link = "box"
at = [[-0.1, -0.075, -0.05], [0.1, -0.075, -0.05], [-0.1, 0.075, -0.05], [0.1, 0.075, -0.05]]
friction_law = {{ {law} }}
[stabiliser]
time_constant = 0.01
[time]
duration = {duration}
step = {step}
integrator = "{integrator}"
"""


def slid(law, step, speed=0.8, spin=3.0, duration=0.4, integrator="rk4"):
    """Return the run of a box that slides on four feet."""
    given = {"law": LAWS[law], "step": step, "speed": speed, "spin": spin, "duration": duration}
    return cl.simulate(parse_scenario(BOX.format(integrator=integrator, **given)), progress=False)


@pytest.mark.parametrize("integrator", ["rk4", "explicit_euler"])
@pytest.mark.parametrize("law", list(LAWS))
def test_a_box_whose_bristles_decay_far_faster_than_a_step_comes_to_rest(law, integrator):
    """At 0.8 m/s a h is 27, where an explicit step bears 2.8: no energy is gained but what bent bristles give back."""
    long, short = (slid(law, step, integrator=integrator) for step in (1e-3, 2.5e-4))
    energy = long.kinetic_energy + long.potential_energy
    held = 0.4**2 / 1e4 * 9.81  # μ²/(2 σ_0) per newton of load, and as much again
    assert np.max(np.diff(energy)) < held
    assert len(long.event_time) == 0
    assert np.max(np.abs(long.q[-1] - short.q[-1])) < (5e-4 if integrator == "rk4" else 5e-3)


def reference(law, speed, duration):
    """Return place and velocity of a block on a floor with a law's bristles, by an implicit scheme, from code apart."""
    static, v_s, damping = (0.3, 1.0, 0.0) if law == "dahl" else (0.4, 0.05, 5.0)

    def motion(t, y):
        v, z = y[1], y[2]
        dz = v - 1e4 * abs(v) / (0.3 + (static - 0.3) * np.exp(-((v / v_s) ** 2))) * z
        return [v, -9.81 * (1e4 * z + damping * np.exp(-(min(abs(v) / 0.05, 30.0) ** 2)) * dz), dz]

    return solve_ivp(motion, (0.0, duration), [0.0, speed, 0.0], "Radau", rtol=1e-11, atol=1e-15).y[:2, -1]


@pytest.mark.parametrize("law", list(LAWS))
def test_the_order_is_that_of_the_scheme_for_all_states_together(law):
    """Where a step resolves the bristles, halves of it have a sixteenth of the error, until slip ends."""
    place, velocity = reference(law, 0.05, 0.004)
    errors = []
    for step in (5e-4, 2.5e-4, 1.25e-4):
        run = slid(law, step, speed=0.05, spin=0.0, duration=0.004)
        errors.append(abs(run.v[-1, 0] - velocity))
        assert abs(run.q[-1, 0] - place) < 1e-7
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.max(np.abs(orders - 4.0)) < 0.2, (errors, orders)


def test_first_exponentials_of_rk4_meet_the_conditions_of_order_four():
    """Row sums of the first are halves of the step at the end, with the nodes' moments that commute to third order."""
    first, whole = RK4.first_tableau()[-1], RK4.tableau()[-1]
    nodes = np.array(RK4.nodes)
    assert first.sum() == pytest.approx(0.5)
    assert (whole - first) == pytest.approx(first[::-1])  # the scheme is symmetric in time
    # [∫∫ a(t) g(s)] of Magnus' expansion: first · 1 × late · c − late · 1 × first · c = 1/6
    late = whole - first
    assert late @ nodes * first.sum() - first @ nodes * late.sum() == pytest.approx(1.0 / 6.0)


def test_first_must_have_the_rows_of_the_scheme():
    """A table of another size is refused."""
    with pytest.raises(ValueError, match="Wrong: first must have a row for each of a"):
        type("Wrong", (Integrator,), {"order": 1, "a": ((),), "b": (1.0,), "first": ((),), "source": "none"})


@pytest.mark.parametrize(("law", "key"), [("dahl", "stiffness"), ("lugre", "damping")])
def test_feet_on_bristles_too_stiff_for_the_step_are_bad_alone_and_in_a_batch(law, key):
    """Swings and decays before slip are judged of links' contacts too; the step that is named is good."""
    # By hand: of a straight slip ω² = σ_0 g, and σ_1 g is the rate of a decay; of a turn Σ r²/4 over I/m times as much.
    text = LAWS[law].replace("stiffness = 1e4", "stiffness = 1e6").replace("damping = 5.0", "damping = 6e3")
    text = text.replace("damping_speed = 0.05", "damping_speed = 1e-3")
    given = {"law": text, "speed": 0.05, "spin": 0.0, "duration": 0.02, "integrator": "rk4"}
    scenario = parse_scenario(BOX.format(step=1e-3, **given))
    problems = cl.simulate(scenario, progress=False).summary()["verdict"]["problems"]
    (problem,) = [found for found in problems if found["name"] == "resolution"]
    assert problem["text"].startswith(f"contact.foot.friction_law.{key}: rk4 with time.step = 0.001 s gets a ")
    rate = float(problem["text"].split(" of ")[1].split()[0])
    turned = (0.1**2 + 0.075**2) / ((0.2**2 + 0.15**2) / 12)
    by_hand = [(1e6 * 9.81 * x) ** 0.5 if law == "dahl" else 6e3 * 9.81 * x for x in (1.0, turned)]
    assert min(abs(rate / x - 1.0) for x in by_hand) < 0.05, (rate, by_hand)
    (row,) = cl.simulate_batch(scenario, {"time.duration": [0.02]}).to_pylist()
    assert "resolution" in row["verdict"]
    short = 0.02 / np.ceil(0.02 / float(problem["text"].split()[-2]))
    finer = cl.simulate(parse_scenario(BOX.format(step=short, **given)), progress=False)
    assert "resolution" not in [found["name"] for found in finer.summary()["verdict"]["problems"]]


def test_lugre_whose_damping_jams_a_fast_slip_is_told_what_to_lower():
    """At 0.8 m/s a damping of 30 s/m is a coefficient of friction of 24: the message names it."""
    text = BOX.format(
        law='kind = "lugre", kinetic = 0.3, static = 0.4, stribeck_speed = 0.01, stiffness = 1e4, damping = 30.0',
        step=1e-3, speed=0.8, spin=3.0, duration=0.1, integrator="rk4",
    )  # fmt: skip
    with pytest.raises(
        cl.PainleveError, match=r"contact\.foot\.friction_law: .* lower damping, or give damping_speed = 0\.09"
    ):
        cl.simulate(parse_scenario(text), progress=False)
