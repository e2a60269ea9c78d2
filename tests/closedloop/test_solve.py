"""Eq. 24 solved rightly: against Pinocchio, against LAPACK, and against the equation itself."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import closedloop as cl
from closedloop.solve import (
    NOT_POSITIVE_DEFINITE,
    OK,
    SINGULAR,
    SINGULAR_MOBILITY,
    bordered_matrix,
    condition,
    eliminate,
    residual,
)

EPS = np.finfo(float).eps
# Both solutions carry rounding times the condition of Eq. 24. Away from singular poses (`WELL` below) that is
# under 1e5 for these arms: 1e-10 leaves a factor of ten.
AGREEMENT = 1e-10
patient = settings(deadline=None)  # the first example of all compiles
# Smallest share of the normal's mobility that counts as away from a singular pose.
WELL = 1e-3


class Eliminated:
    """The outcome of `eliminate`, with its scratch."""

    def __init__(self, H, tau, C, A, b, J, b_stabiliser=None):
        m, n = A.shape
        self.problem = tuple(np.ascontiguousarray(x, dtype=float) for x in (H, tau, C, A, b))
        self.L, self.X, self.S = np.zeros((n, n)), np.zeros((m, n)), np.zeros((m, m))
        self.y, self.qdd = np.zeros(n), np.zeros(n)
        self.f, self.f_stabiliser = np.zeros(m), np.zeros(m)
        share = np.zeros(m) if b_stabiliser is None else b_stabiliser
        self.status, self.mobility = eliminate(
            *self.problem, share, np.ascontiguousarray(J), self.L, self.X, self.S, self.y, self.qdd,
            self.f, self.f_stabiliser,
        )  # fmt: skip

    def residuals(self):
        """Return the relative residuals of the two block rows."""
        return residual(*self.problem, self.y, self.X, self.qdd, self.f)

    def condition(self):
        """Return the 1-norm condition number of Eq. 24."""
        H, _, _, A, _ = self.problem
        return condition(H, A, self.L, self.X, self.S, np.zeros(len(H)), np.zeros(len(A)))


def mobility_share(terms, A):
    """Return A H⁻¹Aᵀ over the trace of Jᵣ H⁻¹Jᵣᵀ."""
    inverse = np.linalg.inv(terms.mass_matrix)
    return (A @ inverse @ A) / np.trace(terms.jacobian @ inverse @ terms.jacobian.T)


def relative(ours, theirs):
    """Return the largest difference over the largest entry of the other's."""
    return np.max(np.abs(np.asarray(ours) - theirs)) / np.max(np.abs(theirs))


@pytest.mark.parametrize("name", ["planar2", "wam4", "panda"])
def test_solve_closure_equals_pinocchio(name, robot, random_states):
    """q̈ and f are those of Pinocchio's own forward dynamics with a 1 x n Jacobian, in random states."""
    arm = robot(name)
    model = arm.model.pinocchio_model()
    data = model.createData()
    compared = 0
    for s in random_states(arm, 300, 1):
        terms = arm.terms(s.q, s.v)
        A = s.normal @ terms.jacobian
        if mobility_share(terms, A) < WELL:
            continue
        b = -(s.normal @ terms.drift)
        qdd, f = cl.solve_closure(terms.mass_matrix, s.torque - terms.bias, A, b)
        theirs = pin.forwardDynamics(model, data, s.q, s.v, s.torque, A[None], np.array([-b]), 0.0)
        assert relative(qdd, theirs) < AGREEMENT
        assert f == pytest.approx(data.lambda_c[0], rel=AGREEMENT)
        compared += 1
    assert compared > 200


@pytest.mark.parametrize("stabiliser", ["none", "baumgarte"])
@pytest.mark.parametrize("name", ["planar2", "wam4", "panda"])
def test_simulated_row_equals_pinocchio(name, stabiliser, robot, random_states):
    """The acceleration and force that a run records are Pinocchio's, stabiliser included, in random states."""
    arm = robot(name)
    model = arm.model.pinocchio_model()
    data = model.createData()
    compared = 0
    for s in random_states(arm, 60, 2):
        terms = arm.terms(s.q, s.v)
        A = s.normal @ terms.jacobian
        if mobility_share(terms, A) < WELL:
            continue
        off = 1e-4  # m, so that both terms of the stabiliser act
        scenario = cl.load_scenario(
            f"{'wam' if name == 'wam4' else name}_slide",
            {
                "start.q": s.q.tolist(),
                "start.v": s.v.tolist(),
                "surface.normal": s.normal.tolist(),
                "surface.offset": float(s.normal @ terms.position) - off,
                "reference.kind": "hold",
                "stabiliser.kind": stabiliser,
                "time.duration": 0.001,
            },
        )
        run = cl.simulate(scenario, model=arm.model, law=lambda t, q, v, terms, Q=s.torque: Q)
        drift = s.normal @ terms.drift
        if stabiliser == "baumgarte":
            drift += 1414.0 * (A @ s.v) + 1e6 * off
        theirs = pin.forwardDynamics(model, data, s.q, s.v, s.torque, A[None], np.array([drift]), 0.0)
        assert relative(run.acceleration[0], theirs) < AGREEMENT
        assert run.contact_force[0] == pytest.approx(data.lambda_c[0], rel=AGREEMENT)
        compared += 1
    assert compared > 40


def test_several_rows_equal_pinocchio(robot, random_states):
    """A tip held in two and in three directions at once gets Pinocchio's multipliers, in order and sign."""
    arm = robot("panda")
    model = arm.model.pinocchio_model()
    data = model.createData()
    for m in (2, 3):
        for s in random_states(arm, 40, m):
            terms = arm.terms(s.q, s.v)
            rows = np.linalg.qr(np.column_stack([s.normal, np.eye(3)[:, :2]]))[0].T[:m]
            A, b = rows @ terms.jacobian, -(rows @ terms.drift)
            if np.linalg.cond(bordered_matrix(terms.mass_matrix, A)) > 1e5:
                continue
            qdd, f = cl.solve_closure(terms.mass_matrix, s.torque - terms.bias, A, b)
            theirs = pin.forwardDynamics(model, data, s.q, s.v, s.torque, A, -b, 0.0)
            assert f.shape == (m,)
            assert relative(qdd, theirs) < AGREEMENT
            assert relative(f, data.lambda_c) < AGREEMENT


@st.composite
def problems(draw):
    """Draw H with a chosen condition number, closure rows that are combinations of a tip Jacobian's, and the rest."""
    n = draw(st.integers(2, 8))
    m = draw(st.integers(1, min(3, n - 1)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spread = draw(st.floats(0.0, 10.0))
    scale = 10.0 ** draw(st.floats(-3.0, 3.0))
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    H = scale * (turn * np.logspace(-spread, 0.0, n)) @ turn.T
    J = rng.normal(size=(3, n))
    rows = np.linalg.qr(rng.normal(size=(3, 3)))[0][:m]
    return 0.5 * (H + H.T), 10 * rng.normal(size=n), rng.normal(size=n), rows @ J, rng.normal(size=m), J


@patient
@given(problems())
def test_elimination_solves_the_equation(problem):
    """The compiled elimination meets both block rows of Eq. 24 to rounding, however ill-conditioned H is.

    Backward stability: the residual relative to what was summed does not know the condition of H. n <= 8 additions
    in each of three nested sums give some hundred roundings: 1e-12, which is also what a run reports as held.
    """
    H, tau, C, A, b, J = problem
    done = Eliminated(H, tau, C, A, b, J)
    assert done.status == OK
    assert max(done.residuals()) < 1e-12
    right = np.concatenate([tau - C, b])
    solution = np.concatenate([done.qdd, -done.f])
    matrix = bordered_matrix(H, A)
    # The same, independent of `residual`, against the normwise size of what is summed.
    parts = np.abs(matrix[: len(tau)]) @ np.abs(solution) + np.abs(done.y) @ np.abs(H) + np.abs(right[: len(tau)])
    assert np.max(np.abs(matrix @ solution - right)[: len(tau)]) < 1e-12 * np.max(parts)


@patient
@given(problems())
def test_elimination_equals_lapack(problem):
    """The compiled elimination and `solve_closure` agree to rounding times the conditions of the problem.

    Forward error: elimination goes through H⁻¹ and S⁻¹, so rounding is multiplied by cond(H), by the condition of the
    Schur complement, and by how far H⁻¹(Q - C) exceeds q̈; LAPACK's by cond(K).
    """
    H, tau, C, A, b, J = problem
    done = Eliminated(H, tau, C, A, b, J)
    qdd, f = cl.solve_closure(H, tau - C, A, b)
    S = A @ np.linalg.solve(H, A.T)
    amplified = np.linalg.cond(bordered_matrix(H, A)) + np.linalg.cond(H) * np.linalg.cond(S)
    tolerance = 100 * EPS * amplified
    assert np.max(np.abs(done.f - f)) <= tolerance * (
        np.max(np.abs(f)) + np.max(np.abs(np.linalg.solve(S, A @ done.y)))
    )
    assert np.max(np.abs(done.qdd - qdd)) <= tolerance * (np.max(np.abs(qdd)) + np.max(np.abs(done.y)))


@patient
@given(problems())
def test_only_the_upper_triangle_is_read(problem):
    """Pinocchio leaves the lower triangle of H unfilled; what is there changes nothing, to the last bit."""
    H, tau, C, A, b, J = problem
    whole, upper = (
        Eliminated(H, tau, C, A, b, J),
        Eliminated(np.triu(H) - 7 * np.tril(np.ones_like(H), -1), tau, C, A, b, J),
    )
    assert np.array_equal(whole.qdd, upper.qdd)
    assert np.array_equal(whole.f, upper.f)
    assert whole.residuals() == upper.residuals()
    assert whole.condition() == upper.condition()


@patient
@given(problems())
def test_stabilisers_share_is_a_difference_of_forces(problem):
    """f_stabiliser is exactly what the force loses when the stabiliser's part of b is taken away."""
    H, tau, C, A, b, J = problem
    share = 0.3 * b[::-1]
    with_it = Eliminated(H, tau, C, A, b, J, share)
    without = Eliminated(H, tau, C, A, b - share, J)
    S = A @ np.linalg.solve(H, A.T)
    size = np.max(np.abs(with_it.f)) + np.max(np.abs(without.f))
    tolerance = 1e4 * EPS * np.linalg.cond(H) * np.linalg.cond(S)
    assert np.max(np.abs(with_it.f - without.f - with_it.f_stabiliser)) <= tolerance * size


@patient
@given(problems())
def test_reported_condition_is_the_condition(problem):
    """The condition number a run records is ‖K‖₁‖K⁻¹‖₁ of the matrix of Eq. 24."""
    H, tau, C, A, b, J = problem
    matrix = bordered_matrix(H, A)
    theirs = np.linalg.cond(matrix, 1)
    done = Eliminated(H, tau, C, A, b, J)
    assert done.condition() == pytest.approx(theirs, rel=1e-6 + 100 * EPS * theirs * np.linalg.cond(H))


def test_mobility_is_the_share_of_the_normal(robot, random_states):
    """The recorded mobility is A H⁻¹Aᵀ over the trace of Jᵣ H⁻¹Jᵣᵀ."""
    arm = robot("panda")
    for s in random_states(arm, 20, 3):
        terms = arm.terms(s.q, s.v)
        A = s.normal @ terms.jacobian
        done = Eliminated(terms.mass_matrix, s.torque, terms.bias, A[None], np.zeros(1), terms.jacobian)
        assert done.mobility == pytest.approx(mobility_share(terms, A), rel=1e-9)


def test_elimination_names_what_is_wrong():
    """A row of zeros and a doubled row are SINGULAR; an indefinite or NaN mass matrix is not positive definite."""
    H, J = np.diag([1.0, 2.0, 3.0]), np.eye(3)
    tau = C = np.ones(3)
    row = np.array([[1.0, 2.0, 3.0]])
    assert Eliminated(H, tau, C, row, np.zeros(1), J).status == OK
    assert Eliminated(H, tau, C, 0 * row, np.zeros(1), J).status == SINGULAR
    assert Eliminated(H, tau, C, 0 * row, np.zeros(1), 0 * J).status == SINGULAR
    assert Eliminated(H, tau, C, np.vstack([row, row / 3]), np.zeros(2), J).status == SINGULAR
    assert Eliminated(np.diag([1.0, 0.0, 3.0]), tau, C, row, np.zeros(1), J).status == NOT_POSITIVE_DEFINITE
    assert Eliminated(np.diag([1.0, -1.0, 3.0]), tau, C, row, np.zeros(1), J).status == NOT_POSITIVE_DEFINITE
    assert Eliminated(np.diag([1.0, np.nan, 3.0]), tau, C, row, np.zeros(1), J).status == NOT_POSITIVE_DEFINITE
    assert Eliminated(H, tau, C, np.nan * row, np.zeros(1), J).status == SINGULAR


@pytest.mark.parametrize(("factor", "status"), [(0.5, SINGULAR), (2.0, OK)])
def test_singular_begins_at_the_threshold(factor, status):
    """A mobility share below SINGULAR_MOBILITY is singular, above it is not."""
    share = factor * SINGULAR_MOBILITY
    J = np.diag([1.0, 1.0, np.sqrt(2 * share)])  # with H = 1: trace 2, the third direction's mobility 2·share
    done = Eliminated(np.eye(3), np.ones(3), np.zeros(3), J[2:], np.zeros(1), J)
    assert done.status == status


def test_force_is_a_float_for_one_row_and_an_array_for_more(robot):
    """A row (n,) gives a float; the same row as (1, n) gives an array with the same force, bit for bit."""
    terms = robot("wam4").terms([0.1, 1.0, 0.2, 1.5], np.zeros(4))
    A = terms.jacobian[2]
    qdd, f = cl.solve_closure(terms.mass_matrix, np.ones(4), A, 0.5)
    same, forces = cl.solve_closure(terms.mass_matrix, np.ones(4), A[None], [0.5])
    assert isinstance(f, float)
    assert forces.shape == (1,)
    assert forces[0] == f
    assert np.array_equal(qdd, same)


@pytest.mark.parametrize(
    "rows",
    [[[0.0] * 4], [[1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]], [[1.0, 2.0, 3.0, 4.0], [2.0, 4.0, 6.0, 8.0]]],
    ids=["zero", "twice the same", "twice as long"],
)
def test_solve_closure_raises_where_there_is_no_solution(rows, robot):
    """A closure without a solution raises; it never returns a force of 1e15 N.

    The mass matrix is a real one: with round numbers LAPACK meets an exact zero and raises by luck.
    """
    H = robot("wam4").terms([0.1, 0.2, 0.3, 0.4], np.zeros(4)).mass_matrix
    with pytest.raises(np.linalg.LinAlgError):
        cl.solve_closure(H, np.ones(4), rows, np.linspace(0.0, 0.1, len(rows)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"H": np.eye(3)}, "(3, 3)"),
        ({"A": np.ones(5)}, "(5,)"),
        ({"b": np.ones(2)}, "(2,)"),
        ({"H": np.full((4, 4), np.nan)}, "finite"),
        ({"rhs": [1.0, 2.0, np.inf, 0.0]}, "finite"),
        ({"A": [1.0, np.nan, 0.0, 0.0]}, "finite"),
        ({"b": np.nan}, "finite"),
    ],
)
def test_solve_closure_refuses_bad_input(change, words):
    """Wrong shapes and entries that are not finite are refused with the shape or the reason."""
    arguments = {"H": np.eye(4), "rhs": np.ones(4), "A": np.ones(4), "b": 0.0} | change
    with pytest.raises(ValueError, match=r"Eq\. 24") as caught:
        cl.solve_closure(**arguments)
    assert words in str(caught.value)
