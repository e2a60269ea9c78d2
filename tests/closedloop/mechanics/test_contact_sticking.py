"""Contacts that are open cost their gaps, those in known modes equations of the joints: both are what the rows say."""

import numpy as np
import pytest
from contact_mobility import write_own_mobilities

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.solve import OK, SINGULAR
from closedloop.mechanics.contacts.given_modes import solve_modes
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, RAY, make_contact_memory
from closedloop.mechanics.loops.memory import make_loop_memory
from closedloop.mechanics.loops.rows import locate_rows

K, N = 5, 6


def sticking(rng, X, off=0.0, kinds=(CONE,) * K):
    """The memory of K contacts with rows X (3 K, N), whose accelerations the joints can have, or are off by `off`."""
    links, c = make_contact_memory(X.shape[1], K)
    c.X[:], c.drift[:] = X, 1.0
    write_own_mobilities(c)
    c.problem.form[:], c.mu[:] = kinds, 1e6
    c.a[:], c.b[:] = X @ rng.normal(size=X.shape[1]), 0.1 * X @ rng.normal(size=X.shape[1])
    c.a[:] += off * rng.normal(size=3 * K)
    return links, c


def block_rows(rng):
    """Rows of two bodies, one on the other: the first two contacts with the ground, the others between the bodies."""
    X = rng.normal(size=(3 * K, 2 * N))
    X[:6, N:] = 0.0
    return X


@pytest.mark.parametrize("seed", range(4))
def test_forces_of_contacts_that_stick_are_the_shortest(seed):
    """Those of the pseudo-inverse, in both sides; of one body, of bodies on each other, and of rows of a lower rank."""
    rng = np.random.default_rng(seed)
    few = rng.normal(size=(3 * K, N - 1)) @ rng.normal(size=(N - 1, N))
    for X in (rng.normal(size=(3 * K, N)), block_rows(rng), few):
        links, c = sticking(rng, X, kinds=(DOUBLE,) * K)  # which may pull, so that any forces will do
        assert interpreted(solve_modes)(links, c) == OK
        for found, wanted in ((c.rigid, -c.a), (c.F, c.b - c.a)):
            shortest = np.linalg.pinv(X @ X.T, rcond=1e-9) @ wanted
            np.testing.assert_allclose(found, shortest, atol=1e-10 * np.max(np.abs(shortest)))


@pytest.mark.parametrize("seed", range(4))
def test_forces_of_contacts_of_which_one_slides_are_the_shortest(seed):
    """More rows than joints, and friction that goes with a normal force: those of the pseudo-inverse of Xᵀ of both."""
    rng = np.random.default_rng(seed)
    links, c = sticking(rng, rng.normal(size=(3 * K, N)), kinds=(RAY, *(DOUBLE,) * (K - 1)))
    c.problem.along[0] = 0.2, -0.1
    acts = np.delete(np.eye(3 * K), [1, 2], axis=1)
    acts[1:3, 0] = -0.2, 0.1
    assert interpreted(solve_modes)(links, c, False) == OK
    equations = np.delete(c.X, [1, 2], axis=0) @ c.X.T @ acts
    sizes = np.linalg.norm(acts, axis=0)
    x = np.linalg.pinv(equations / sizes, rcond=1e-9) @ np.delete(-c.a, [1, 2]) / sizes
    np.testing.assert_allclose(c.rigid, acts @ x, atol=1e-9 * np.max(np.abs(x)))


def test_rows_that_contradict_each_other_are_told():
    """Of a size that is no rounding: no forces."""
    rng = np.random.default_rng(3)
    links, c = sticking(rng, rng.normal(size=(3 * K, N)), off=10.0)
    assert interpreted(solve_modes)(links, c) == SINGULAR


def test_the_normal_force_of_a_soft_contact_is_what_it_is_known_to_be():
    """Others hold what that leaves, and its friction goes with it."""
    rng = np.random.default_rng(4)
    links, c = sticking(rng, rng.normal(size=(3 * K, 3 * K)), kinds=(RAY, CONE, CONE, DOUBLE, DOUBLE))
    c.soft[0], c.problem.known[0], c.problem.along[0] = 1.0, 2.0, (0.3, 0.1)
    assert interpreted(solve_modes)(links, c, False) == OK
    np.testing.assert_allclose(c.rigid[:3], [2.0, -0.6, -0.2], atol=1e-12)
    acts = c.rigid.copy()
    acts[0] = 0.0  # its part is in a
    np.testing.assert_allclose((c.a + c.X @ (c.X.T @ acts))[3:], 0.0, atol=1e-10)


@pytest.mark.parametrize("limits", [{"clear": -1e9}, {"beyond": 0.0}], ids=["above", "apart"])
def test_gap_and_rate_of_an_open_contact_are_those_of_its_rows(limits):
    """Of points on bodies that move, against the ground and against each other, in any posture."""
    problem = cl.prepare(cl.load_scenario("tower"))
    rng = np.random.default_rng(5)
    whole, open_ones = (make_loop_memory(problem.robot.tree, problem.placed.rows.bound) for _ in range(2))
    for name, value in limits.items():
        getattr(open_ones.rows, name)[:] = value
    open_ones.rows.G[:] = 7.0
    for _ in range(3):
        for memory in (whole, open_ones):
            memory.rows.q[:] = problem.q + 0.1 * rng.normal(size=problem.q.size)
            memory.rows.v[:] = rng.normal(size=problem.v.size)
        open_ones.rows.q[:], open_ones.rows.v[:] = whole.rows.q, whole.rows.v
        for memory in (whole, open_ones):
            interpreted(locate_rows)(memory.links, memory.rows)
        np.testing.assert_array_equal(open_ones.rows.error, whole.rows.error)
        np.testing.assert_allclose(open_ones.rows.rate, whole.rows.rate, atol=1e-13)
        assert np.all(open_ones.rows.G == 7.0)
