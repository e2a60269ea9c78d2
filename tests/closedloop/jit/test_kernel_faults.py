"""Signs and sides inside a step that whole runs hardly show: each of these tests fails if the one it names is wrong."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg

import closedloop as cl
from closedloop.jit.kernel import plain
from closedloop.loop.step.entries import reference_row
from closedloop.loop.step.tip_friction import turn_with_slip


def test_the_reference_between_two_instants_is_the_cubic_through_both():
    """Positions and rates that are a cubic's at the table's instants are that cubic's between them."""
    n, spacing = 2, 0.1
    rng = np.random.default_rng(0)
    cubic = rng.normal(size=(4, n + 3))  # of q_des, then of p_des
    at = np.arange(4) * spacing

    def position(t):
        return sum(cubic[k] * t**k for k in range(4))

    def rate(t):
        return sum(k * cubic[k] * t ** (k - 1) for k in range(1, 4))

    table = rng.normal(size=(4, 2 * n + 10))
    for i, t in enumerate(at):
        table[i, 0:n], table[i, 2 * n : 2 * n + 3] = position(t)[:n], position(t)[n:]
        table[i, n : 2 * n], table[i, 2 * n + 3 : 2 * n + 6] = rate(t)[:n], rate(t)[n:]
    row = np.empty(2 * n + 10)
    for t in (0.013, 0.05, 0.121, 0.1999, 0.27):
        plain(reference_row)(t, spacing, table, n, row)
        np.testing.assert_allclose(np.r_[row[0:n], row[2 * n : 2 * n + 3]], position(t), atol=1e-14)
        i = int(t / spacing)
        s = t / spacing - i
        others = [*range(n, 2 * n), *range(2 * n + 3, 2 * n + 10)]
        np.testing.assert_allclose(row[others], ((1 - s) * table[i] + s * table[i + 1])[others], atol=1e-14)


@pytest.mark.parametrize("pushes", [1.0, -1.0])
def test_slow_friction_points_against_the_slip_at_the_end_of_the_step(pushes):
    """u⁺ + h μ|f| S_t d = u + h (a_t + S_tn f − S_t w), d = u⁺/|u⁺|, where the surface pushes and where it pulls."""
    rng, level, h, turned, stopped = np.random.default_rng(1), 0.3, 1e-3, 0, 0
    for _ in range(200):
        root = rng.normal(size=(3, 3))
        S, angle = root @ root.T, rng.uniform(0.0, 2.0 * math.pi)
        f = pushes * rng.uniform(1.0, 20.0)
        u = np.r_[0.0, 10.0 ** rng.uniform(-5, -2) * np.array([math.cos(angle), math.sin(angle)])]
        a, w = rng.normal(size=3) * rng.choice([0.1, 30.0]), rng.normal(size=2)
        ahead = u[1:] / np.linalg.norm(u[1:])
        c = math.copysign(level, f) * ahead
        tip = SimpleNamespace(u=u, a=a, S=S, F=np.array([f, 0.0, 0.0]))
        state = SimpleNamespace(viscous=w, c=c.copy(), direction=ahead)
        if not plain(turn_with_slip)(SimpleNamespace(tip=tip, friction=state), h):
            np.testing.assert_array_equal(state.c, c)
            continue
        assert np.linalg.norm(state.c) == pytest.approx(level, rel=1e-12)
        d = math.copysign(1.0, f) * state.c / level
        free = u[1:] + h * (a[1:] + S[1:, 0] * f - S[1:, 1:] @ w)
        needed = np.linalg.solve(S[1:, 1:], free) / h  # of friction, to stop the tip within the step
        if np.linalg.norm(needed) < level * abs(f):
            # Friction of its full size, so that what is left of the velocity is opposite to the present one: S⁻¹u and
            # the force that would stop the tip span the direction.
            p, q = np.linalg.solve(S[1:, 1:], u[1:]), needed - np.linalg.solve(S[1:, 1:], u[1:]) / h
            rate = np.linalg.lstsq(np.column_stack([p, -level * abs(f) * d]), -q, rcond=None)[0]
            np.testing.assert_allclose(rate[0] * p + q, level * abs(f) * d, rtol=1e-9, atol=1e-9)
            assert rate[0] > 0.0
            stopped += 1
            continue
        after = free - h * level * abs(f) * S[1:, 1:] @ d
        assert d @ after > 0.0
        assert d[0] * after[1] - d[1] * after[0] == pytest.approx(0.0, abs=1e-10 * np.linalg.norm(free))
        turned += 1
    assert turned > 20
    assert stopped > 5


def test_a_stuck_tip_is_put_back_on_its_anchor_by_projection(robot):
    """The arm swings about a tip that friction holds: the tip stays at the point, not on the plane alone."""
    still = cl.load_scenario("wam_slide")
    q = np.array(still.start.q)
    swing = scipy.linalg.null_space(robot("wam4", "tip").terms(q, 0.0 * q).jacobian)[:, 0]
    values = {
        "start.v": (1.0 * swing).tolist(), "friction.kind": "coulomb", "friction.coefficient": 5.0,
        "stabiliser.kind": "projection", "law.kp": 0.0, "law.kd": 0.0, "time.duration": 0.2, "reference.kind": "hold",
    }  # fmt: skip
    run = cl.simulate(cl.load_scenario("wam_slide", values))
    assert np.all(run.mode == 2)
    assert np.max(np.abs(run.q - q)) > 0.1
    assert np.max(np.abs(run.position - run.position[0])) < 1e-12
    assert np.max(np.linalg.norm(run.friction_force, axis=1)) > 0.1


def test_what_an_event_at_the_start_takes_is_gone_from_row_0():
    """A row holds the state after the events of its instant; the energy supplied counts from row 0."""
    values = {"surface.gap": 0.0, "start.v": [-0.5, -0.5], "time.duration": 0.01, "stabiliser.kind": "none"}
    scenario = cl.load_scenario("planar2_drop", values)
    run = cl.simulate(scenario)
    lost = float(np.sum(run.event_energy_lost[run.event_time == 0.0]))
    assert lost > 0.05
    problem = cl.prepare(scenario)
    v = np.array(scenario.start.v)
    H = problem.robot.terms(scenario.start.q, v).mass_matrix
    assert run.kinetic_energy[0] == pytest.approx(0.5 * v @ H @ v - lost, rel=1e-12)
    assert run.energy_supplied[0] == 0.0


def test_a_touchdown_is_taken_before_the_tip_is_inside():
    """At each impact the tip is on the surface or a hair above it: what it falls in the time of the bracket."""
    scenario = cl.load_scenario("wam_bounce", {"time.duration": 0.6})
    run = cl.simulate(scenario)
    normal = np.asarray(scenario.surface.normal, dtype=float)
    offset = float(normal @ run.position[0] - run.closure_error[0])
    gaps = [float(normal @ event.position) - offset for event in run.events if event.kind in ("impact", "touchdown")]
    assert len(gaps) >= 3
    assert min(gaps) > -1e-16
    assert max(gaps) < 1e-11
