"""Contacts that are open cost their gaps, those that all stick equations of the joints: both are what the rows say."""

import numpy as np
import pytest
from contact_mobility import write_whole_mobility

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.solve import OK, SINGULAR
from closedloop.mechanics.contacts.given_modes import list_unknowns, solve_modes
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, OFF, RAY, make_contact_memory
from closedloop.mechanics.contacts.sticking import all_stick, shortest_sticking
from closedloop.mechanics.loops.memory import make_loop_memory
from closedloop.mechanics.loops.rows import locate_rows

K, N = 5, 6


def sticking(rng, X, off=0.0, kinds=(CONE,) * K):
    """The memory of K contacts with rows X (3 K, N), whose accelerations the joints can have, or are off by `off`."""
    c = make_contact_memory(X.shape[1], K).contacts
    c.X[:], c.drift[:] = X, 1.0
    write_whole_mobility(c)
    c.problem.form[:], c.mu[:] = kinds, 1e6
    c.a[:], c.b[:] = X @ rng.normal(size=X.shape[1]), 0.1 * X @ rng.normal(size=X.shape[1])
    c.a[:] += off * rng.normal(size=3 * K)
    return c


def block_rows(rng):
    """Rows of two bodies, one on the other: the first two contacts with the ground, the others between the bodies."""
    X = rng.normal(size=(3 * K, 2 * N))
    X[:6, N:] = 0.0
    return X


@pytest.mark.parametrize("seed", range(4))
def test_forces_of_contacts_that_stick_are_the_shortest(seed):
    """Those of the pseudo-inverse, in both sides; of one body, and of bodies on each other."""
    rng = np.random.default_rng(seed)
    for X in (rng.normal(size=(3 * K, N)), block_rows(rng)):
        c = sticking(rng, X)
        p = interpreted(list_unknowns)(c, K, float(np.max(np.diag(c.W))))
        assert p == 3 * K
        assert interpreted(all_stick)(c, K, p)
        assert interpreted(shortest_sticking)(c, p) > 0.0
        for side, wanted in enumerate((-c.a, c.b - c.a)):
            shortest = np.linalg.pinv(X @ X.T, rcond=1e-9) @ wanted
            np.testing.assert_allclose(c.scratch.solution[side, :p], shortest, atol=1e-10 * np.max(np.abs(shortest)))


def test_forces_are_the_same_where_joints_are_moved_less_than_all():
    """Rows that no combination of which moves one joint are solved row by row, as before, and to the same forces."""
    rng = np.random.default_rng(7)
    X = rng.normal(size=(3 * K, N - 1)) @ rng.normal(size=(N - 1, N))
    c = sticking(rng, X, kinds=(DOUBLE,) * K)  # which may pull, so that any forces will do
    assert interpreted(shortest_sticking)(c, interpreted(list_unknowns)(c, K, 10.0)) < 0.0
    assert interpreted(solve_modes)(c, K) == OK
    shortest = np.linalg.pinv(X @ X.T, rcond=1e-9) @ -c.a
    np.testing.assert_allclose(c.rigid, shortest, atol=1e-9 * np.max(np.abs(shortest)))


def test_rows_that_contradict_each_other_are_told():
    """Of a size that is no rounding: no forces."""
    rng = np.random.default_rng(3)
    c = sticking(rng, rng.normal(size=(3 * K, N)), off=10.0)
    assert interpreted(shortest_sticking)(c, interpreted(list_unknowns)(c, K, 10.0)) < 0.0
    assert interpreted(solve_modes)(c, K) == SINGULAR


def test_what_slides_or_has_a_row_of_its_own_is_not_solved_so():
    """A contact that slides, a soft one, and what stands for the friction of a joint."""
    rng = np.random.default_rng(4)
    X = rng.normal(size=(3 * K, N))
    c = sticking(rng, X, kinds=(RAY, CONE, CONE, CONE, OFF))
    assert not interpreted(all_stick)(c, K, interpreted(list_unknowns)(c, K, 10.0))
    c = sticking(rng, X)
    c.soft[2] = 1.0
    assert not interpreted(all_stick)(c, K, 3 * K)
    c = sticking(rng, X)
    c.W[3, 3] *= 1.1
    assert not interpreted(all_stick)(c, K, interpreted(list_unknowns)(c, K, 10.0))
    c = sticking(rng, X, kinds=(CONE, CONE, OFF, OFF, OFF))
    assert not interpreted(all_stick)(c, K, interpreted(list_unknowns)(c, K, 10.0))


def test_gap_and_rate_of_an_open_contact_are_those_of_its_rows():
    """Of points on bodies that move, against the ground and against each other, in any posture."""
    problem = cl.prepare(cl.load_scenario("tower"))
    rng = np.random.default_rng(5)
    whole, open_ones = (make_loop_memory(problem.robot.tree, problem.placed.bound) for _ in range(2))
    open_ones.rows.clear[:] = -np.inf
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
