"""The tree's kernels as kernels: what they write, what they keep, compiled or not, cached or not."""

import numpy as np
import pytest
from tree_cases import FIELDS, Own, random_model

from closedloop.mechanics.robot.tree import energies_of_rows, potential_energies, tree_terms
from closedloop.mechanics.robot.tree.energy import ROWS_AT_ONCE


@pytest.mark.slow
def test_below_the_diagonal_nothing_is_written(robot):
    """The caller may keep what it likes in the lower triangle of H."""
    arm = robot("wam4")
    own, H = Own(arm.model, arm.tip), np.full((4, 4), 7.0)
    tree_terms(own.tree, np.ones(4), np.ones(4), own.work, H, np.zeros(4), (np.zeros((3, 4)), np.zeros(3), np.zeros(3)))
    assert np.all(H[np.tril_indices(4, -1)] == 7.0)
    assert np.all(H[np.triu_indices(4)] != 7.0)


def test_nothing_is_remembered():
    """Terms are those of the state alone: the same to the last bit after another state, and in other scratch."""
    model, tip, rng = random_model(3, joints=7)
    own, other = Own(model, tip), Own(model, tip)
    q, v = rng.uniform(-3.0, 3.0, 7), rng.normal(size=7)
    first = own.terms(q, v)
    own.terms(rng.uniform(-3.0, 3.0, 7), rng.normal(size=7))
    for again in (own.terms(q, v), other.terms(q, v)):
        assert all(np.array_equal(getattr(first, field), getattr(again, field)) for field in FIELDS)


def test_kinematics_alone_are_those_of_the_terms():
    """`tree_kinematics` writes what `tree_terms` writes."""
    for seed in range(3):
        model, tip, rng = random_model(seed)
        own = Own(model, tip)
        q, v = rng.uniform(-3.0, 3.0, model.n), rng.normal(size=model.n)
        terms, (J, r, drift) = own.terms(q, v), own.kinematics(q, v)
        assert np.array_equal(J, terms.jacobian)
        assert np.array_equal(r, terms.position)
        assert np.array_equal(drift, terms.drift)


def test_energies_of_many_rows_are_the_same_interpreted_and_compiled():
    """A process changes from one to the other after its first runs; its columns must not say which it was."""
    for seed in range(3):
        model, tip, rng = random_model(seed)
        own, q = Own(model, tip), rng.uniform(-3.0, 3.0, (ROWS_AT_ONCE + 3, model.n))
        compiled = np.empty(q.shape[0])
        potential_energies(own.tree, q, own.work, compiled)
        assert np.array_equal(energies_of_rows(own.tree, q), compiled)
        assert np.ptp(compiled) > 0.0
