"""Bodies that no joint connects: each is solved by itself, and all numbers are those of the whole."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from test_solve import Solved

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.loop.step.record_row import kinetic_energy
from closedloop.mechanics.contacts.memory import make_contact_memory
from closedloop.mechanics.contacts.mobility import added, own_mobilities, write_motion
from closedloop.mechanics.robot.tree import group_ends

SIZES = (2, 6, 1, 12)
ENDS = np.repeat(np.cumsum(SIZES), SIZES)


def apart(rng):
    """H of four groups of joints, a torque, C, and rows of a tip that the second of them moves."""
    roots = [rng.normal(size=(n, n)) for n in SIZES]
    H = block_diag(*(root @ root.T + np.eye(len(root)) for root in roots))
    A = np.zeros((3, len(H)))
    A[:, 2:8] = rng.normal(size=(3, 6))
    return H, rng.normal(size=len(H)), rng.normal(size=len(H)), A


@pytest.mark.parametrize("m", [1, 3])
def test_eq_24_of_bodies_apart_is_that_of_the_whole(m):
    """To the last bit: what is left out is zeros."""
    rng = np.random.default_rng(m)
    H, tau, C, A = apart(rng)
    b = rng.normal(size=3)
    whole, groups = (Solved(H, tau, C, A, b, m=m, ends=ends) for ends in (None, ENDS))
    for name in ("L", "X", "S", "y", "a", "F", "qdd"):
        np.testing.assert_array_equal(getattr(groups, name), getattr(whole, name))
    assert groups.residuals() == whole.residuals()
    whole.condition(), groups.condition()
    np.testing.assert_allclose(groups.long, whole.long, rtol=1e-13)
    v = rng.normal(size=len(H))
    assert interpreted(kinetic_energy)(H, v, ENDS) == pytest.approx(v @ H @ v / 2, rel=1e-14)


@pytest.mark.parametrize(
    ("parents", "ends"),
    [
        ([-1, 0, 1, -1, 3, -1], [3, 3, 3, 5, 5, 6]),
        ([-1, 0, 0, 1], [4, 4, 4, 4]),
        ([-1, -1, 0, 1, -1], [4, 4, 4, 4, 5]),  # two trees whose joints alternate are one group
    ],
)
def test_groups_are_consecutive_joints(parents, ends):
    """No joint of a group has a parent outside it, whatever the order of the joints."""
    np.testing.assert_array_equal(group_ends(np.array(parents)), ends)


def test_mobility_of_contacts_is_taken_over_the_joints_that_both_move():
    """The blocks of X Xᵀ, and what forces move: rows of a contact are zero but for its groups of joints."""
    rng, k, n = np.random.default_rng(2), 5, 21
    c = make_contact_memory(n, k).contacts
    for i, (first, end) in enumerate(((0, 21), (0, 2), (2, 9), (8, 21), (2, 8))):
        c.moves.first[i], c.moves.end[i] = first, end
        c.X[3 * i : 3 * i + 3, first:end] = rng.normal(size=(3, end - first))
    c.near[1] = 0.0
    c.X[3:6] = 0.0
    interpreted(own_mobilities)(c, k)
    W = c.X @ c.X.T
    for i in range(k):
        np.testing.assert_allclose(c.S[i], W[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], atol=1e-14)
    F = rng.normal(size=3 * k)
    interpreted(write_motion)(c, k, F)
    np.testing.assert_allclose([interpreted(added)(c, r) for r in range(3 * k)], W @ F, atol=1e-13)


def test_contacts_of_a_tower_are_of_two_boxes():
    """The lowest box moves its contacts with the floor alone, another box and the one below those between them."""
    contacts = cl.prepare(cl.load_scenario("tower")).loop().w.kept["contacts"].contacts
    spans = {(int(a), int(b)) for a, b in zip(contacts.moves.first[1:], contacts.moves.end[1:], strict=True)}
    assert spans == {(0, 6), (0, 12), (6, 18), (12, 24), (18, 30)}
    assert not np.any(contacts.moves.first[0])
