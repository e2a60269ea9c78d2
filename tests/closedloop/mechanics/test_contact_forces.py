"""Forces of contacts whose modes are known: the equations they solve, the shortest of those that do, and their rank."""

import numpy as np
import pytest
from contact_mobility import mobility, write_own_mobilities
from scipy.linalg import null_space

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK
from closedloop.mechanics.closure.solve import OK, PAINLEVE, SINGULAR
from closedloop.mechanics.contacts.given_modes import (
    find_inside,
    keep_in_cones,
    kinds_of_modes,
    solve_modes,
    stopping_impulses,
)
from closedloop.mechanics.contacts.joint_space import (
    ALONG,
    GIVEN,
    HOLDS,
    IN_CONE,
    OWNED,
    PUSHES,
    STICKS,
    JointSpace,
    find_exactly,
    find_least,
    respond,
)
from closedloop.mechanics.contacts.memory import CONE, DOUBLE, LINE, OFF, RAY, make_contact_memory
from closedloop.mechanics.contacts.mobility import force_size

K = 4


def contacts(rng, n, kinds=(CONE, RAY, LINE, OFF)):
    """The links and memory of contacts of these kinds of n joints, with everything that forces depend on drawn."""
    memory = make_contact_memory(n, K)
    c = memory.contacts
    c.X[:] = rng.normal(size=c.X.shape)
    c.problem.form[:], c.mu[:], c.problem.along[:] = kinds, 0.4, 0.2 * rng.normal(size=(K, 2))
    c.a[:], c.b[:], c.viscous[:] = rng.normal(size=(3, 3 * K))
    c.load[:] = rng.normal(size=n)
    write_own_mobilities(c)
    return memory


def rows_of(c):
    """The rows (p, 3 K) that active contacts have, and what their forces span (3 K, p)."""
    one = np.eye(3 * K)
    rows, span = [], []
    for i in range(K):
        if c.problem.form[i] == CONE:
            rows += list(one[3 * i : 3 * i + 3])
            span += list(one[3 * i : 3 * i + 3])
        elif c.problem.form[i] != OFF:
            rows.append(one[3 * i])
            span.append(one[3 * i] - c.problem.along[i] @ one[3 * i + 1 : 3 * i + 3])
    return np.array(rows), np.array(span).T


@pytest.mark.parametrize("seed", range(3))
def test_modes_are_kept_by_the_forces(seed):
    """No acceleration along the rows of the contacts, or what the stabiliser asks for; friction as the modes say."""
    links, c = contacts(np.random.default_rng(seed), 3 * K)
    assert interpreted(solve_modes)(links, c) == OK
    rows, span = rows_of(c)
    np.testing.assert_allclose(rows @ (c.a + mobility(c) @ c.rigid), 0.0, atol=1e-9)
    np.testing.assert_allclose(rows @ (c.a + mobility(c) @ c.F - c.b), 0.0, atol=1e-9)
    for force in (c.rigid, c.F):
        given = force + c.viscous
        np.testing.assert_allclose(given - span @ np.linalg.lstsq(span, given)[0], 0.0, atol=1e-9)
    size = max(abs(c.b[r]) + np.abs(c.X[r]) @ np.abs(c.load) for r in rows.argmax(axis=1))
    assert c.problem.rounding == pytest.approx(1e-10 * max(np.abs(c.rigid).max(), size / np.diag(mobility(c)).max()))


def test_contacts_without_modes_have_viscous_friction_alone():
    """No unknowns: no force but −`viscous`."""
    links, c = contacts(np.random.default_rng(4), 6, (OFF,) * K)
    assert interpreted(solve_modes)(links, c) == OK
    np.testing.assert_array_equal(c.F, -c.viscous)
    np.testing.assert_array_equal(c.rigid, -c.viscous)
    assert c.problem.rounding == 0.0


def test_forces_that_are_not_unique_are_the_shortest():
    """More rows than joints: the equations hold where they agree, and no others in these spaces are shorter."""
    rng = np.random.default_rng(5)
    links, c = contacts(rng, 4, (CONE, RAY, CONE, OFF))
    c.viscous[:], c.b[:] = 0.0, c.X @ rng.normal(size=4)
    c.a[:] = c.X @ rng.normal(size=4)
    assert interpreted(solve_modes)(links, c, False) == OK
    rows, span = rows_of(c)
    np.testing.assert_allclose(rows @ (c.a + mobility(c) @ c.rigid), 0.0, atol=1e-8)
    np.testing.assert_allclose(rows @ (c.a + mobility(c) @ c.F - c.b), 0.0, atol=1e-8)
    free = span @ null_space(c.X.T @ span)
    np.testing.assert_allclose(free.T @ c.rigid, 0.0, atol=1e-8)
    c.a[0] += 1.0
    c.X[:] = c.X @ np.diag([1.0, 1, 0, 0])
    write_own_mobilities(c)
    assert interpreted(solve_modes)(links, c) == SINGULAR


def test_a_contact_that_pressing_pulls_in_is_told():
    """Painlevé: W of the normal less that of friction is not positive."""
    links, c = contacts(np.random.default_rng(6), 6, (RAY, OFF, OFF, OFF))
    c.X[:] = 0.0
    c.X[0, 0], c.X[1, :2] = 1.0, [2.0, 1.0]
    write_own_mobilities(c)
    for along, status in ((0.49, OK), (0.51, PAINLEVE), (-3.0, OK)):
        c.problem.along[0] = along, 0.0
        assert interpreted(solve_modes)(links, c) == status
    c.X[2, :2], c.problem.along[0] = [2.0, 1.0], (0.0, 0.51)
    write_own_mobilities(c)
    assert interpreted(solve_modes)(links, c) == PAINLEVE


def take_shortest(links, c, force):
    """Replace a force by the shortest inside the cones with the same sum; return whether there is one."""
    span = rows_of(c)[1]
    c.given.rank, c.given.whole, c.given.slides = c.X.shape[1], 1.0, 0.0
    c.given.z[0] = np.linalg.pinv(c.X.T @ span @ np.linalg.pinv(span) @ c.X) @ (c.X.T @ (force + c.viscous))
    return interpreted(find_inside)(links, c, 0, force) == 0.0


@pytest.mark.parametrize("kinds", [(CONE, CONE, CONE, CONE), (CONE, RAY, OFF, CONE)])
def test_shortest_forces_with_the_same_sum(kinds):
    """F·(G − F) >= 0 for all other G in the cones with the same sum: none is nearer to zero."""
    found = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        links, c = contacts(rng, 5, kinds)
        c.problem.along[1] = 0.0  # the share of a sliding contact is weighed by its normal force alone
        span = rows_of(c)[1]
        free = null_space(c.X.T @ span)
        start = np.zeros(3 * K)
        start[::3] = rng.uniform(0.2, 2.0, size=K) * (np.array(kinds) != OFF)
        start[10:12] = 0.3 * start[9], -0.2 * start[9]
        force = start - c.viscous
        if not take_shortest(links, c, force):
            continue
        found += 1
        F = force + c.viscous
        np.testing.assert_allclose(c.X.T @ F, c.X.T @ start, atol=1e-9)
        near = np.array([span @ (free @ rng.normal(size=free.shape[1])) for _ in range(300)])
        near *= (10.0 ** rng.uniform(-3, 0.5, size=300) / np.linalg.norm(near, axis=1))[:, None]
        others = np.concatenate([start + near, F + near, [start]])
        assert in_cones(c, F[None], 1e-9)[0]
        others = others[in_cones(c, others, 0.0)]
        assert np.min((others - F) @ F) > -1e-9
    assert found >= 7


def in_cones(c, forces, tolerance):
    """Which of several forces (N, 3 K) are inside the cones."""
    f = forces[:, ::3]
    rub = np.hypot(forces[:, 1::3], forces[:, 2::3])
    return np.all((f >= -tolerance) & (rub <= c.mu * f + tolerance), axis=1)


@pytest.mark.parametrize("normal", [PUSHES, HOLDS, GIVEN, OWNED])
@pytest.mark.parametrize("tangent", [IN_CONE, ALONG, STICKS])
@pytest.mark.parametrize("associated", [0.0, 1.0])
def test_slopes_are_the_derivatives_of_the_response(normal, tangent, associated):
    """Of each kind of contact, inside its cone, beside it and behind it, by central differences of the speed."""
    s, rho, h = JointSpace(np.zeros(JointSpace.count(1, 2)), 1, 2), 1.7, 1e-6
    s.normal[:], s.tangent[:], s.mu[:], s.ahead[:] = [PUSHES, normal], [IN_CONE, tangent], 0.4, [0.2, -0.1]
    s.associated = associated
    for seed in range(6):
        rng = np.random.default_rng(seed)
        s.u[:], s.P[:], s.falls[1] = rng.normal(size=6), rng.normal(size=6), seed % 2
        s.given[1], owner = (0.0, 1.3) if normal == OWNED else (rng.normal(), 0.0)
        s.trial[0] = owner
        interpreted(respond)(s, 1, rho, s.trial)
        slope, along, u = -rho * s.slope[1], s.along[1].copy(), s.u[3:].copy()
        if normal == PUSHES:  # the cone's is that by u + μ|u_t| n
            slope[:, 1:] += np.outer(slope[:, 0], along)
        for j in range(3):
            ends = []
            for step in (h, -h):
                s.u[3:] = u + step * (np.arange(3) == j)
                interpreted(respond)(s, 1, rho, s.trial)
                ends.append(s.trial[3:].copy())
            np.testing.assert_allclose(slope[:, j], (ends[0] - ends[1]) / (2 * h), atol=1e-8)
        if normal == OWNED:
            s.u[3:], ends = u, []
            for step in (h, -h):
                s.trial[0] = owner + step
                interpreted(respond)(s, 1, rho, s.trial)
                ends.append(s.trial[4:].copy())
            np.testing.assert_allclose(along, (ends[0] - ends[1]) / (2 * h), atol=1e-8)


def test_what_no_forces_in_the_cones_give_is_said():
    """One contact that cannot pull."""
    links, c = contacts(np.random.default_rng(8), 6, (RAY, OFF, OFF, OFF))
    c.viscous[:], force = 0.0, np.zeros(3 * K)
    force[0], force[1:3] = -1.0, c.problem.along[0]
    assert not take_shortest(links, c, force)
    assert force[0] == pytest.approx(0.0, abs=1e-9)  # the nearest


def cones(rng, a, n, X):
    """The problem of a contacts in cones of μ = 0.5, with these rows."""
    s = JointSpace(np.zeros(JointSpace.count(n, a)), n, a)
    s.normal[:], s.tangent[:], s.mu[:], s.end[:] = PUSHES, IN_CONE, 0.5, n
    s.X[:] = X
    s.mobility[:] = np.max(np.sum(X.reshape(a, 3, n) ** 2, axis=2), axis=1)
    s.largest = s.mobility.max()
    return s


@pytest.mark.parametrize("seed", range(6))
def test_forces_that_no_cones_reach_are_the_nearest(seed):
    """With off = Xᵀ P − w the least of |off|² over the cones: X off is in the dual cones, and P across it."""
    rng = np.random.default_rng(seed)
    a, n = 3, 7
    s = cones(rng, a, n, rng.normal(size=(3 * a, n)))
    s.wanted[:] = -s.X.T @ np.tile([1.0, 0.1, 0.2], a) + 0.1 * rng.normal(size=n)  # some pull
    off = interpreted(find_least)(s, a, n)
    left = s.X.T @ s.P - s.wanted
    assert off == pytest.approx(np.linalg.norm(left) / np.sqrt(s.largest), rel=1e-9)
    P, u = s.P.reshape(a, 3), (s.X @ left).reshape(a, 3)
    assert np.min(0.5 * P[:, 0] - np.hypot(P[:, 1], P[:, 2])) > -1e-9
    assert np.min(u[:, 0] - 0.5 * np.hypot(u[:, 1], u[:, 2])) > -1e-8
    np.testing.assert_allclose(np.sum(P * u), 0.0, atol=1e-8)


def test_rows_that_nearly_depend_on_others_take_no_forces_without_bound():
    """A motion that hardly any joint makes would take 1e6 times the forces: they are found but for that motion."""
    rng = np.random.default_rng(3)
    a, n, little, left = 2, 6, 1e-7, 1e-7
    U, V = (np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(2))
    s = cones(rng, a, n, U @ np.diag([1.0, 0.9, 0.8, 0.7, 0.6, little]) @ V.T)
    P = np.array([3.0, 0.2, -0.3, 2.0, 0.1, 0.4])  # inside the cones
    s.q[:] = -s.X @ s.X.T @ P + left * U[:, 5]
    s.asked = np.abs(s.q).max()
    assert interpreted(find_exactly)(s, a, n)
    assert np.abs(s.P).max() < 10.0
    assert np.abs(s.u).max() < 2.0 * left


def test_impulses_take_away_what_is_left_of_motion():
    """After them no velocity along the rows; a, b and viscous are as before; contradicting rows have none."""
    links, c = contacts(np.random.default_rng(9), 3 * K)
    c.before[:] = np.random.default_rng(10).normal(size=3 * K)
    a, viscous = c.a.copy(), c.viscous.copy()
    interpreted(stopping_impulses)(links, c)
    rows, _ = rows_of(c)
    np.testing.assert_allclose(rows @ (c.before + mobility(c) @ c.F), 0.0, atol=1e-9)
    assert np.abs(c.F).max() > 0.1
    np.testing.assert_array_equal(c.a, a)
    np.testing.assert_array_equal(c.viscous, viscous)
    c.X[:, 1:] = 0.0
    write_own_mobilities(c)
    interpreted(stopping_impulses)(links, c)
    np.testing.assert_array_equal(c.F, 0.0)


def test_kinds_and_directions_follow_from_the_modes():
    """Friction against the slip; where it has none, or has turned round, against the direction it began in."""
    links, c = contacts(np.random.default_rng(11), 6, (OFF, OFF, OFF, OFF))
    c.friction.pulls[:], c.direction[:, 0], c.direction[:, 1] = [0.0, 0.0, 0.0, 1.0], 0.6, 0.8
    for slip, direction in (
        ([3.0, 0.0], [1, 0]),
        ([-3.0, 0.0], [0.6, 0.8]),
        ([1e-10, 0], [0.6, 0.8]),
        ([0, 2], [0, 1]),
    ):
        c.u[4:6] = c.u[10:12] = slip
        c.mode[:] = [STUCK, PRESSED, FREE, STUCK]
        interpreted(kinds_of_modes)(links, c)
        np.testing.assert_array_equal(c.problem.form, [CONE, RAY, OFF, DOUBLE])
        np.testing.assert_allclose(c.problem.along[1], c.mu[1] * np.array(direction))
        c.mode[3] = PRESSED
        interpreted(kinds_of_modes)(links, c)
        assert c.problem.form[3] == LINE
        np.testing.assert_array_equal(c.problem.along[3], c.mu[3] / c.mu[1] * c.problem.along[1])


def test_size_of_forces_is_the_largest_of_those_asked_about():
    """Infinite if one is no number."""
    F = np.array([1e-3, -2e-3, 5e-4])
    assert interpreted(force_size)(F) == 2e-3
    F[1] = np.nan
    assert interpreted(force_size)(F) == np.inf


def test_the_stabiliser_leaves_no_cone():
    """Its part is lessened by one factor, the largest with which every force presses within its cone."""
    rng, lessened = np.random.default_rng(13), 0
    _, c = contacts(rng, 6, (CONE, RAY, LINE, CONE))
    for _ in range(100):
        part = rng.normal(size=3 * K)
        c.rigid[:], f = rng.normal(size=3 * K), rng.uniform(0.5, 1.5, size=K)
        c.rigid[::3] = f
        for i in range(K):
            rub = rng.normal(size=2)
            c.rigid[3 * i + 1 : 3 * i + 3] = rng.uniform() * c.mu[i] * f[i] * rub / np.linalg.norm(rub)
        c.F[:] = c.rigid + part
        interpreted(keep_in_cones)(c, K)
        share = (c.F[0] - c.rigid[0]) / part[0]
        np.testing.assert_allclose(c.F, c.rigid + share * part, atol=1e-12)

        def inside(share, tolerance, part=part):
            force = (c.rigid + share * part).reshape(K, 3)
            rub = np.hypot(force[:, 1], force[:, 2]) - c.mu * force[:, 0]
            return np.min(force[[0, 1, 3], 0]) >= -tolerance and np.max(rub[[0, 3]]) <= tolerance

        assert inside(share, 1e-12)
        assert share == pytest.approx(1.0) or not inside(min(1.0, share * (1 + 1e-6) + 1e-9), 0.0)
        lessened += share < 1.0
    assert lessened > 20
