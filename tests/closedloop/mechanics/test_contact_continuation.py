"""The path from a problem whose solution is known: its derivatives, what holds all along it, and where it ends."""

import numpy as np
import pytest
from random_contacts import faults, filled

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.complementarity import LAST_ROUNDS, STARTS, solve_from_here
from closedloop.mechanics.contacts.continuation import END, follow_path, start_path, turn_tangent, write_path
from closedloop.mechanics.contacts.memory import CONE, LINE, OFF, RAY, make_contact_memory

# Of each kind one, and a cone without friction.
KINDS = (CONE, RAY, CONE, OFF, LINE)


def mixed(seed):
    """A memory of contacts of all kinds with a mobility of full rank, and their number."""
    rng, k = np.random.default_rng(seed), len(KINDS)
    c = make_contact_memory(3 * k, k).contacts
    c.X[:] = rng.normal(size=c.X.shape)
    c.W[:], c.problem.q[:] = c.X @ c.X.T, rng.normal(size=3 * k)
    c.problem.form[:], c.mu[:], c.problem.along[:] = KINDS, [0.5, 0.3, 0.0, 0.4, 0.2], 0.2 * rng.normal(size=(k, 2))
    return c, k


def on_path(c, k, x, log_tau, tau0):
    """What is written at a point of the path: residuals, forces, u, z + residual; and the derivatives."""
    interpreted(write_path)(c, k, x, log_tau, tau0)
    m = 3 * k
    return (
        c.scratch.residuals.copy(),
        c.scratch.trial.copy(),
        c.problem.after.copy(),
        c.scratch.system[:m, : m + 1].copy(),
    )


@pytest.mark.parametrize("log_tau", [0.0, -1.5, 0.7])
def test_derivatives_are_those_of_the_residuals(log_tau):
    """By all x / τ0 and by log τ, in each kind of contact, by central differences."""
    c, k = mixed(1)
    tau0 = interpreted(start_path)(c, k, 2.0)
    x, h = tau0 * np.random.default_rng(2).normal(size=3 * k), 1e-6
    derivatives = on_path(c, k, x, log_tau, tau0)[3]
    for j in range(3 * k + 1):
        step = h * tau0 * (np.arange(3 * k) == j)
        share = h if j == 3 * k else 0.0
        ahead, behind = (on_path(c, k, x + s * step, log_tau + s * share, tau0)[0] for s in (1.0, -1.0))
        found = (ahead - behind) / (2 * h)
        np.testing.assert_allclose(derivatives[:, j], found, atol=1e-7 * (1 + np.abs(derivatives).max()))


@pytest.mark.parametrize("apart", STARTS)
def test_every_path_begins_on_itself_and_leads_to_smaller_tau(apart):
    """y is τ0 / `apart` there, z is `apart` times τ0; τ0 is of the size of q; the tangent is a unit vector."""
    c, k = mixed(3)
    m, tau0 = 3 * k, interpreted(start_path)(c, k, apart)
    assert tau0 == pytest.approx(np.max(np.repeat(c.path.scale, 3) * np.abs(c.problem.q)))
    widest = np.diag(c.W).reshape(k, 3).max(axis=1)
    np.testing.assert_allclose(c.path.scale, 1.0 / widest)
    residuals, F, u, derivatives = on_path(c, k, c.path.point[:m], 0.0, tau0)
    assert np.max(np.abs(residuals)) < 1e-14
    assert F[0] * c.mu[0] == F[6] == pytest.approx(tau0 / apart)
    np.testing.assert_allclose(u, c.problem.q + c.W @ F, atol=1e-12)
    interpreted(turn_tangent)(c, m)
    assert np.linalg.norm(c.path.tangent) == pytest.approx(1.0)
    assert c.path.tangent[m] < 0.0
    np.testing.assert_allclose(derivatives @ c.path.tangent, 0.0, atol=1e-10 * np.abs(derivatives).max())


def test_pairs_of_force_and_gap_have_the_product_that_tau_says():
    """y ∘ z = τ² e and both inside the cone, where y is (μ f, F_t) and z = ρ (u_n/μ + |u_t|, u_t) + what is left."""
    c, k = mixed(4)
    tau0 = interpreted(start_path)(c, k, 1.0)
    c.path.start[:] = 0.0
    rng = np.random.default_rng(5)
    for log_tau in (0.0, -2.0, -8.0):
        tau, x = tau0 * np.exp(log_tau), tau0 * rng.normal(size=3 * k)
        left, F, u, _ = on_path(c, k, x, log_tau, tau0)
        left *= tau0
        rho, mu = c.path.scale[0], c.mu[0]
        y = F[:3] * [mu, 1, 1]
        slip = np.sqrt(u[1] ** 2 + u[2] ** 2 + (tau / rho) ** 2)
        z = rho * np.array([u[0] / mu + slip, u[1], u[2]]) - left[:3]
        product = [y @ z, y[0] * z[1] + z[0] * y[1], y[0] * z[2] + z[0] * y[2]]
        np.testing.assert_allclose(product, [tau**2, 0, 0], atol=1e-12 * tau0**2)
        np.testing.assert_allclose(y - z, x[:3], atol=1e-12 * tau0)
        assert min(y[0] - np.hypot(y[1], y[2]), z[0] - np.hypot(z[1], z[2])) > 0.0
        for i in (1, 2):  # a contact that slides, and a smooth one: f and ρ u_n + τ
            f, z = F[3 * i], c.path.scale[i] * u[3 * i] + tau - left[3 * i]
            assert f * z == pytest.approx(tau**2, abs=1e-12 * tau0**2)
            assert f - z == pytest.approx(x[3 * i], abs=1e-12 * tau0)
            assert min(f, z) > 0.0
        for i in (1, 4):
            np.testing.assert_allclose(F[3 * i + 1 : 3 * i + 3], -c.problem.along[i] * F[3 * i])
            np.testing.assert_array_equal(left[3 * i + 1 : 3 * i + 3], x[3 * i + 1 : 3 * i + 3])
        np.testing.assert_array_equal(F[7:12], 0.0)
        assert F[12] == x[12]
        assert left[12] == pytest.approx(c.path.scale[4] * u[12])
        np.testing.assert_allclose(left[9:12], x[9:12])


@pytest.mark.parametrize("apart", STARTS[::2])
def test_every_path_ends_at_the_solution(apart):
    """Contacts of all kinds: complementarity and cone to τ there, and to rounding by the quick method from there."""
    c, k = mixed(6)
    assert interpreted(follow_path)(c, k, apart)
    assert c.path.point[3 * k] <= np.log(END)
    for limit in (1e-5, 1e-11):
        F, u = c.F.reshape(k, 3), (c.problem.q + c.W @ c.F).reshape(k, 3)
        force, speed = np.abs(F).max(), np.abs(c.problem.q).max()
        slip = np.hypot(u[0, 1], u[0, 2])
        assert max(np.hypot(*F[0, 1:]) - c.mu[0] * F[0, 0], -F[0, 0]) < limit * force
        assert abs(F[0] @ u[0] + c.mu[0] * slip * F[0, 0]) < limit * force * speed
        assert abs(F[:, 0] @ u[:, 0] - F[0, 0] * u[0, 0]) < limit * force * speed * k
        assert np.min(u[:3, 0]) > -limit * speed
        assert np.min(F[:3, 0]) > -limit * force
        assert abs(u[4, 0]) < limit * speed
        np.testing.assert_array_equal(F[3], 0.0)
        assert interpreted(solve_from_here)(c, k, 0, LAST_ROUNDS)


def test_paths_of_bodies_end_where_forces_are_not_unique():
    """Several contacts of bodies in space, and in the plane."""
    for seed, planar in ((1, False), (11, True)):
        memory, _ = filled(np.random.default_rng(seed), planar=planar)
        c, k = memory.contacts, int(memory.links.k)
        assert interpreted(follow_path)(c, k, 2.0)
        assert faults(c, k) < 1e-5


def test_a_problem_without_solution_is_given_up():
    """Two smooth walls opposite each other that both are to let go: forces grow beyond all bounds; or no number."""
    c = make_contact_memory(1, 2).contacts
    c.X[:] = np.array([[1.0, 0, 0, -1.0, 0, 0]]).T
    c.W[:], c.problem.form[:] = c.X @ c.X.T, CONE
    c.problem.q[:] = [-1.5, 0, 0, 1.0, 0, 0]
    assert not interpreted(follow_path)(c, 2, 2.0)
    c.problem.q[3] = 2.0
    assert interpreted(follow_path)(c, 2, 2.0)
    np.testing.assert_allclose(c.problem.q + c.W @ c.F, [0, 0, 0, 0.5, 0, 0], atol=1e-6)
    c.problem.q[0] = np.nan
    assert not interpreted(follow_path)(c, 2, 2.0)
