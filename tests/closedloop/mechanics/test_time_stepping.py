"""Time stepping: closed forms of first order, rest to rounding, no energy from nowhere, and what it refuses."""

import numpy as np
import passive_scenes as scenes
import pytest
from random_contacts import random_bodies

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import entry_kernel
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.joint_space import IN_CONE, PUSHES, solve_step
from closedloop.mechanics.contacts.memory import contacts_at, make_contact_memory
from closedloop.mechanics.contacts.stepping import begin_step
from closedloop.mechanics.limits import NEAR, SLIGHT
from closedloop.mechanics.surface.placed import PlacedSurface
from validation.speed.scenes import scenario_of

G = 9.81
VISCOUS = {"friction.kind": "coulomb_viscous", "friction.coefficient": 0.3, "friction.viscous": 1.0}


@entry_kernel
def solve_at(address):
    """Solve the problem in joint space of a memory of contacts, of which all take part."""
    links, c = contacts_at(address)
    return 1 if solve_step(c.stepping, links.k, links.n) else 0


def test_impulses_keep_cones_and_complementarity():
    """Impulses are in their cones, nothing parts that presses, and friction is against the slip that is left."""
    found, worst = 0, 0.0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        X, v = random_bodies(rng, seed % 3 == 0)
        k, n = len(X) // 3, X.shape[1]
        memory = make_contact_memory(n, k)
        s, mu = memory.contacts.stepping, rng.choice([0.0, 0.2, 0.5, 1.0], size=k)
        s.normal[:], s.tangent[:], s.mu[:], s.first[:], s.end[:], s.X[:], s.q[:] = PUSHES, IN_CONE, mu, 0, n, X, X @ v
        s.mobility[:], s.asked = np.max(np.sum(X * X, axis=1).reshape(k, 3), axis=1), np.max(np.abs(X @ v))
        if not solve_at(memory.address):
            continue
        found += 1
        P, u = s.P.reshape(k, 3), (s.q + X @ X.T @ s.P).reshape(k, 3)
        size, speed = np.max(np.abs(P)) + 1e-300, np.max(np.abs(s.q))
        assert np.all(np.hypot(P[:, 1], P[:, 2]) <= mu * P[:, 0] + 1e-13 * size)
        slip = np.hypot(u[:, 1], u[:, 2])
        work = np.abs(np.sum(P * u, axis=1) + mu * slip * P[:, 0]) / (size * speed)
        worst = max(worst, np.max(-u[:, 0]) / speed, np.max(work))
    assert found >= 295
    assert worst < 2.0 * NEAR  # the residual, in impulses, is at most NEAR


def one_step(X, v, e, mu=0.0, gap=0.0, load=0.0, h=1e-3):
    """Return L q̇ (n,), normal impulses (k,) and what is put back (n,) in a step from L q̇ = v of rows X (3 k, n)."""
    k, n = len(X) // 3, X.shape[1]
    links, c = make_contact_memory(n, k)
    c.X[:], c.u[:], c.mu[:], c.restitution[:], c.inside[:], c.located[::3] = X, X @ v, mu, e, 1.0, gap
    assert interpreted(begin_step)(links, c, load + np.zeros(n), h, 1e-6)[0] == OK
    return v + h * (load + X.T @ c.F), h * c.F[::3], c.step.shift


def test_rebounds_of_a_step_add_no_energy():
    """All are lessened by one factor where Newton's law would add some, or has no impulses: else they are whole."""
    gains, shares = [], []
    for seed in (0, 1, 2, 3, 4, 5, 6, 7, 8, 23, 30, 35):
        rng = np.random.default_rng(seed)
        X, v = random_bodies(rng, seed % 3 == 0)
        mu, e = rng.choice([0.0, 0.5, 1.0], size=len(X) // 3), rng.choice([0.0, 0.9], size=len(X) // 3)
        after, P, _ = one_step(X, v, e, mu)
        gains.append(after @ after / (v @ v) - 1.0)
        before, parting = (X @ v)[::3], (X @ after)[::3]
        rebounds = (P > 0.0) & (e > 0.0) & (before < 0.0)
        shares.append(np.max(-parting[rebounds] / (0.9 * before[rebounds]), initial=0.0))
    assert np.max(gains) < 1e-9
    assert np.sum(np.abs(np.array(shares) - 1.0) < 1e-3) >= 5
    assert np.any((np.array(shares) > 0.1) & (np.array(shares) < 0.9))


def test_one_contact_in_a_step_rebounds_stays_or_is_put_back():
    """By closed forms: e = 1 keeps its speed, what only now turns round does not rebound, a tenth of a depth goes."""
    X = np.eye(3)
    assert one_step(X, np.array([-0.37, 0.1, 0.0]), 1.0)[0][0] == pytest.approx(0.37, rel=SLIGHT)
    turns = one_step(X, np.array([0.1, 0.0, 0.0]), 1.0, load=np.array([-600.0, 0.0, 0.0]))[0]
    assert turns[0] == pytest.approx(0.0, abs=1e-7)
    after, _, shift = one_step(X, np.array([0.0, 0.1, 0.0]), 0.5, gap=-1e-5)
    np.testing.assert_allclose(after, [0.0, 0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(shift, [1e-6, 0.0, 0.0], rtol=1e-3, atol=1e-12)
    assert one_step(X, np.array([-0.5, 0.0, 0.0]), 0.0, gap=2e-4)[0][0] == pytest.approx(-0.2, rel=1e-6)
    # Two opposite contacts cannot both part: what is deep has no impulses.
    both = np.concatenate([X, np.diag([-1.0, 1.0, 1.0])])
    after, P, _ = one_step(both, np.array([0.0, 0.1, 0.0]), 0.0, gap=np.array([-2e-5, -1e-5]))
    np.testing.assert_allclose([after[0], *P], 0.0, atol=1e-9)


@pytest.mark.parametrize(("mu", "angle"), [(0.3, 0.2), (0.3, 0.5), (0.0, 0.4)])
def test_a_box_on_an_incline(mu, angle):
    """A box sticks below the angle of friction, and beyond it slides by g (sin θ − μ cos θ)."""
    run = scenes.run([scenes.box(edges=(0.2, 0.1, 0.1), position=scenes.above(angle, 0.05), tilt=angle)], mu, angle)
    gain = max(G * (np.sin(angle) - mu * np.cos(angle)), 0.0)
    speed = np.linalg.norm(run.v[:, :3], axis=1)
    assert speed[-1] == pytest.approx(gain * run.time[-1], rel=SLIGHT, abs=1e-9)  # of what each step asks
    assert np.sum(run.link_forces[-1]) == pytest.approx(G * np.cos(angle), rel=1e-5)


def test_a_ball_that_slips_rolls_at_five_sevenths():
    """A ball that is put down slipping rolls at 5/7 of its speed, and never faster."""
    ball = {"name": "b", "shape": "ball", "radius": 0.05, "mass": 1.0, "position": [0, 0, 0.05], "velocity": [1, 0, 0]}
    run = scenes.run([ball], 0.2, duration=0.5)
    assert run.v[-1, 0] == pytest.approx(5.0 / 7.0, rel=1e-7)
    assert np.min(run.v[:, 0]) > 5.0 / 7.0 - 1e-7


def test_errors_are_of_first_order():
    """A thrown cube lands where rk4 with located events has it, but for an error that halves with the step."""
    exact = scenes.run([scenes.thrown()], 0.5, duration=0.3, step=1e-4, integrator="rk4")
    errors = []
    for step in (2e-3, 1e-3, 5e-4, 2.5e-4):
        run = scenes.run([scenes.thrown()], 0.5, duration=0.3, step=step)
        errors.append(np.linalg.norm(run.v[-1] - exact.v[-1]) + np.linalg.norm(run.q[-1, :3] - exact.q[-1, :3]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert 0.6 < np.mean(orders) < 1.6
    assert errors[-1] < 0.1


def test_dropped_bodies_come_to_rest_without_gaining_energy():
    """Boxes dropped into a corner of walls lose energy in every step, come to rest, and do not sink in."""
    run = cl.simulate(scenario_of("bin_4"), engine="compiled", progress=False)
    energy = run.kinetic_energy + run.potential_energy
    assert np.max(np.diff(energy)) < 1e-7 * energy[0]
    assert run.kinetic_energy[-1] < 1e-15
    assert np.min(run.link_gaps[-1]) > -1e-8
    assert run.summary()["verdict"]["good"]


def test_a_restitution_of_one_loses_what_the_scheme_loses():
    """A ball with e = 1 never rises above its last height, and loses no more than the scheme does in flight."""
    ball = {"name": "b", "shape": "ball", "radius": 0.05, "mass": 1.0, "position": [0, 0, 0.15]}
    for step in (1e-3, 5e-4):
        run = scenes.run([ball], 0.0, duration=1.0, step=step, restitution=1.0)
        energy = run.kinetic_energy + run.potential_energy
        assert np.max(np.diff(energy)) < 1e-12
        assert energy[0] - energy[-1] < 2.0 * G * G * step * run.time[-1]


def test_a_soft_floor_of_any_stiffness():
    """A box rests on its soft corners m g/(4 k) deep, also where k h² is many times its mass."""
    for stiffness in (1e4, 1e8):
        soft = {"kind": "kelvin_voigt", "stiffness": stiffness, "damping": 10.0}
        run = scenes.run([scenes.box(position=(0, 0, 0.0501))], 0.5, compliance=soft)
        assert -np.min(run.link_gaps[-1]) == pytest.approx(G / (4.0 * stiffness), rel=1e-6)
        assert np.sum(run.link_forces[-1]) == pytest.approx(G, rel=1e-6)


@pytest.mark.parametrize("name", ["quadruped", "gripper_block", "two_arms_bar", "push_block", "hand_turns"])
def test_shipped_scenarios_end_as_with_located_events(name):
    """Hands, a quadruped and a pushed block end where rk4 has them, and press alike."""
    exact = cl.simulate(cl.load_scenario(name), engine="compiled")
    run = cl.simulate(cl.load_scenario(name, {"time.integrator": "time_stepping"}), engine="compiled")
    assert np.max(np.abs(run.q[-1] - exact.q[-1])) < 3e-2
    assert np.sum(run.link_forces[-1]) == pytest.approx(np.sum(exact.link_forces[-1]), rel=2e-3)


def test_both_engines_and_a_batch_are_equal():
    """Pinocchio's engine has the same run to rounding, and a batch the same to the bit."""
    scenario = cl.load_scenario("cube_toss", {"time.integrator": "time_stepping", "time.duration": 0.4})
    run = cl.simulate(scenario, engine="compiled")
    assert np.max(np.abs(cl.simulate(scenario, engine="pinocchio").q - run.q)) < 1e-8
    table = cl.simulate_batch(scenario, {"time.step": [1e-3, 1e-3]})
    assert table["max_kinetic_energy"].to_pylist() == [np.max(run.kinetic_energy)] * 2
    assert table["energy_gained"].to_pylist() == [run.summary()["energy_gained"]] * 2


@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("wam_slide", {}, "has no [[contact]]"),
        ("quadruped", {"stabiliser.kind": "projection"}, "keeps contacts on their surfaces itself"),
        (
            "push_block",
            {"friction.kind": "coulomb_viscous", "friction.coefficient": 0.3, "friction.viscous": 1.0},
            "solves for Coulomb's friction alone",
        ),
    ],
)
def test_what_it_cannot_do_is_refused(name, changes, says):
    """One line says what is no part of the problem of impulses, and what to use."""
    with pytest.raises(cl.ScenarioError, match=says.replace("[", r"\[")) as error:
        cl.simulate(cl.load_scenario(name, {**changes, "time.integrator": "time_stepping"}))
    assert "\n" not in str(error.value)
    assert "rk4" in str(error.value)


def test_linear_loops_are_refused():
    """Impulses have no linear loop: one line says so, and what has."""
    with pytest.raises(cl.ScenarioError, match=r"finds impulses, .* use 'semi_implicit_euler' or 'rk4'"):
        cl.linearise(cl.load_scenario("quadruped", {"time.integrator": "time_stepping"}))


def test_corners_beside_a_body_of_the_same_width_do_not_clamp_it():
    """Dominoes fall as they do in half the step: corners that slide along the sides of the next are not pressed.

    Whatever presses them on both sides alike keeps the conditions of contact: a continuum of solutions, of which one
    has a reason. With others this row comes to rest leaning.
    """
    ends = []
    for step in (1e-3, 5e-4):
        scenario = scenario_of("dominoes").replace({"time.duration": 0.45, "time.step": step})
        run = cl.simulate(scenario, engine="compiled")
        ends.append(run.kinetic_energy[-1] + run.potential_energy[-1])
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)  # as errors of first order are
    assert ends[0] < 0.98  # J; leaning they have 0.9818


def test_pairs_that_are_far_apart_are_left_out_without_a_trace(monkeypatch):
    """Dominoes move to the bit as when each corner and edge of all pairs is looked at.

    With an integrator that has events: with time stepping boxes have no corners and edges of their own.
    """
    scenario = scenario_of("dominoes", "semi_implicit_euler").replace({"time.duration": 0.19})
    some = cl.simulate(scenario, engine="compiled")
    monkeypatch.setattr(PlacedSurface, "extent", np.inf)
    monkeypatch.setattr("closedloop.simulation.engines.bind_contacts.reach_of_edges", lambda edge: np.inf)
    every = cl.simulate(scenario, engine="compiled")
    assert np.any(some.link_forces > 0.0)
    np.testing.assert_array_equal(some.q, every.q)
    np.testing.assert_array_equal(some.link_forces, every.link_forces)
    np.testing.assert_allclose(some.link_gaps, every.link_gaps, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(some.link_slips, every.link_slips, rtol=0.0, atol=1e-13)
