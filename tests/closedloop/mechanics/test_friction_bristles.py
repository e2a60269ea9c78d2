"""Bristles: exact steps, loops, and small motions before slip."""

import math

import numpy as np
import pytest
from budget import every
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from test_friction_examples import EXAMPLES, PUBLISHED, angles, contact, patient, pointing, some_states

import closedloop as cl
from closedloop.mechanics.friction.bristle import bristle
from closedloop.mechanics.friction.law import surface_parameters
from closedloop.mechanics.friction.laws.dahl import SurfaceDahl


def small_motion(law, mass, load=1.0):
    """Return ω, rad/s, and ζ of a mass, kg, before slip under a normal force, N."""
    stiffness, damping = bristle(law, surface_parameters(law), load)
    omega = math.sqrt(stiffness / mass)
    return omega, damping / (2.0 * mass * omega)


@pytest.mark.parametrize(
    ("name", "speed"), every(3, [(name, speed) for name in ("dahl", "lugre") for speed in (1e-6, 3e-4, 2e-3, 0.1)])
)
def test_exponential_step_is_the_solution(name, speed):
    """At constant slip a step is the solution of the rates, here by Radau at 1e-11, in two dimensions."""
    law = contact(EXAMPLES[name])
    u, z = pointing(speed, 0.3), some_states(law, 0.8, 2.5).copy()
    duration = 2.0 * float(np.linalg.norm(z)) / speed

    def motion(t, state):
        law.states[:] = state
        return law.rates(u)

    wanted = solve_ivp(motion, (0.0, duration), z, method="Radau", rtol=1e-11, atol=1e-20).y[:, -1]
    law.states[:] = z
    law.advance(u, duration)
    assert law.states == pytest.approx(wanted, rel=1e-9, abs=1e-9 * np.linalg.norm(wanted))


@pytest.mark.parametrize("name", ["dahl", "lugre"])
@given(speed=st.floats(0.0, 100.0), angle=angles, share=st.floats(0.0, 1.0), h=st.floats(0.0, 1e12))
@patient
def test_bristles_stay_within_their_bound(name, speed, angle, share, h):
    """However long the step and however fast the slip, the deflection stays within its bound."""
    law = contact(EXAMPLES[name])
    bound = law.stick_limit / law.par.stiffness
    some_states(law, share, angle)
    law.advance(pointing(speed, 0.0), h)
    assert np.linalg.norm(law.states) <= bound * (1.0 + 1e-14)


@pytest.mark.parametrize("name", ["dahl", "lugre", "seven_parameter"])
@given(speed=st.floats(0.0, 1.0), share=st.floats(0.0, 1.0), h=st.floats(0.0, 0.1), split=st.floats(0.0, 1.0))
@patient
def test_two_steps_are_one(name, speed, share, h, split):
    """A step in two parts ends where the whole one does: the step is exact, whatever its length."""
    once, twice = contact(EXAMPLES[name]), contact(EXAMPLES[name])
    for law in (once, twice):
        some_states(law, share, 1.0)
    u = pointing(speed, 4.0)
    once.advance(u, h, stuck=True)
    twice.advance(u, split * h, stuck=True)
    twice.advance(u, h - split * h, stuck=True)
    assert twice.states == pytest.approx(once.states, rel=1e-12, abs=1e-17)


@pytest.mark.parametrize("amplitude", [0.3, 1.0, 5.0])
def test_loop_of_dahl(amplitude):
    """A cycle of dahl has the force F_C tanh(σ_0 x_0/F_C) at its ends and the area 4 F_C (x_0 − F_end/σ_0)."""
    law = contact(SurfaceDahl(coefficient=0.3, stiffness=3e4), d=1)
    x0 = amplitude * 0.3 / 3e4
    halves = 40 if amplitude < 1.0 else 10  # half cycles of 500 steps, until the first is forgotten
    x = x0 * np.sin(np.linspace(0.0, (halves + 0.5) * math.pi, 500 * halves + 251))
    force = np.zeros(x.size)
    for i in range(1, x.size):
        law.advance(np.array([(x[i] - x[i - 1]) / 1e-3]), 1e-3)
        force[i] = law.slide(np.zeros(1))[0][0]
    end = 0.3 * math.tanh(3e4 * x0 / 0.3)
    assert force[-1] == pytest.approx(end, rel=1e-5)  # closed to e^(−2 σ_0 x_0/F_C) a half cycle
    assert force[-1 - 500] == pytest.approx(-end, rel=1e-5)
    if amplitude >= 1.0:
        area = np.trapezoid(force[-1001:], x[-1001:])
        assert area == pytest.approx(4.0 * 0.3 * (x0 - end / 3e4), rel=1e-4)  # rule of 500 chords


def test_loop_of_dahl_does_not_depend_on_speed():
    """Dahl's friction follows the path, not the time: the same path a thousand times slower gives the same force."""
    ends = []
    for h in (1e-3, 1.0):
        law = contact(EXAMPLES["dahl"])
        for leg in (pointing(4e-6, 0.0), pointing(9e-6, 2.0), pointing(3e-6, 4.0)):
            law.advance(leg / h, h)
        ends.append(law.states)
    assert ends[0] == pytest.approx(ends[1], rel=1e-12)


@pytest.mark.parametrize("name", ["dahl", "lugre"])
@pytest.mark.parametrize(("mass", "load"), [(1.0, 1.0), (3.0, 12.0)])
def test_small_motions_are_a_spring_and_a_damper(name, mass, load):
    """The eigenvalues of a mass held by bristles are those of ω and ζ."""
    law = contact(EXAMPLES[name], d=1)

    def motion(state):
        law.states[:] = state[1:]
        c, w = law.slide(state[:1])
        return np.array([(-load * c[0] - w[0]) / mass, law.rates(state[:1])[0]])

    tiny = 1e-10  # a is proportional to |u|, so differences have an error of this relative to |u|/z_max
    jacobian = np.column_stack([(motion(e * tiny) - motion(-e * tiny)) / (2.0 * tiny) for e in np.eye(2)])
    omega, zeta = small_motion(EXAMPLES[name], mass, load)
    found = np.linalg.eigvals(jacobian)
    wanted = omega * np.roots([1.0, 2.0 * zeta, 1.0])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(wanted), rel=1e-6)


def test_published_small_signal_figures():
    """σ_0 = 1e5 N/m, σ_1 = √1e5, σ_2 = 0.4 and 1 kg give ω = 316.2 rad/s and ζ = 0.5006 (closed form)."""
    assert small_motion(PUBLISHED, 1.0) == pytest.approx((316.2278, 0.500632), rel=1e-6)


@pytest.mark.parametrize(("share", "grows"), [(0.99, False), (1.01, True)])
@pytest.mark.parametrize("name", ["dahl", "lugre"])
def test_largest_step_before_slip(name, share, grows):
    """Semi-implicit Euler with the exponential step holds a mass on its bristles just below the limit, not above."""
    law = contact(EXAMPLES[name], d=1)
    omega, zeta = small_motion(EXAMPLES[name], 2.0, 5.0)
    h = share * 2.0 * (math.sqrt(1.0 + zeta * zeta) - zeta) / omega  # the root of ω²h² + 4ζωh = 4
    u = np.array([1e-13])
    peak = 0.0
    for _ in range(1200):
        c, w = law.slide(u)
        u += h / 2.0 * (-5.0 * c - w)
        law.advance(u, h)
        peak = max(peak, abs(float(u[0])))
    assert (peak > 1e3 * 1e-13) is grows  # what grows does so until the bristles yield, 1e9 times as far


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_bristles_of_tip_and_joints_are_advanced_with_the_step(integrator):
    """A mass that is pressed on and slides is soon braked by μ f, and by all of the friction in its slide."""
    run = cl.simulate(cl.load_scenario("wam_slide", {
        "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0] * 3, "start.v": [0.3, 0.0, 0.0],
        "reference": {"kind": "hold"}, "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": 20.0},
        "friction": {"kind": "dahl", "coefficient": 0.3, "stiffness": 1e3},
        "joint_friction": {"kind": "dahl", "kinetic": 0.5, "stiffness": 2e3},
        "time.integrator": integrator, "time.step": 1e-3, "time.duration": 0.02,
    }))  # fmt: skip
    assert run.friction_force[-1, 0] == pytest.approx(-6.0, rel=1e-2)
    assert run.joint_friction[-1, 0] == pytest.approx(-0.5, rel=1e-2)
