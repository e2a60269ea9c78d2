"""Eq. 24 solved rightly: against Pinocchio, against LAPACK, and against the equation itself."""

from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import closedloop as cl
from closedloop.jit.interpreted import interpreted
from closedloop.jit.kernel import entry_kernel
from closedloop.mechanics.closure.conditioning import (
    add_to_batch,
    batch_rows,
    condition_number,
    condition_numbers_of_batch,
)
from closedloop.mechanics.closure.contact_force import (
    accelerate,
    factorise,
    free_acceleration,
    pressed_force,
    stuck_force,
)
from closedloop.mechanics.closure.solve import (
    NOT_POSITIVE_DEFINITE,
    OK,
    PAINLEVE,
    SINGULAR,
    SINGULAR_MOBILITY,
    bordered_matrix,
    closure_residual,
    motion_residual,
)
from closedloop.mechanics.surface.placed import contact_frame

EPS = np.finfo(float).eps
# Both solutions carry rounding times the condition of Eq. 24. Away from singular poses (`WELL` below) that is
# under 1e5 for these arms: 1e-10 leaves a factor of ten.
AGREEMENT = 1e-10
patient = settings(deadline=None)  # the first example of all compiles
# Smallest share of the normal's mobility that counts as away from a singular pose.
WELL = 1e-3


@entry_kernel
def _solve(H, tau, C, A, drift, asked, m, c, w, L, X, S, y, a, F, qdd, share, ends):
    """Solve Eq. 24 as a step does."""
    status = factorise(H, A, L, X, S, 0.0, ends)
    if status != OK:
        return status
    free_acceleration(L, X, drift, tau, C, y, a, ends)
    if m == 1:
        status, share[0] = pressed_force(S, a, asked[0], c, w, F)
    else:
        status = stuck_force(S, a, asked, F, share)
    if status == OK:
        accelerate(L, X, y, F, qdd, ends)
    return status


class Solved:
    """What the kernels of a step make of Eq. 24 for a tip that is pressed (m = 1) or stuck (m = 3)."""

    def __init__(self, H, tau, C, A, b, share=None, m=1, c=(0.0, 0.0), w=(0.0, 0.0), ends=None):
        n = A.shape[1]
        self.ends = np.full(n, n) if ends is None else ends
        self.H, self.tau, self.C, self.A = (np.ascontiguousarray(x, dtype=float) for x in (H, tau, C, A))
        self.b, self.m = np.array(b, dtype=float), m
        self.L, self.X, self.S = np.zeros((n, n)), np.zeros((3, n)), np.zeros((3, 3))
        self.y, self.a, self.F, self.qdd, self.share = (np.zeros(k) for k in (n, 3, 3, n, 3))
        asked = np.zeros(3) if share is None else np.array(share, dtype=float)
        # b is b_s: what the closure asks of A q̈; the kernels take it as the drift and the stabiliser's part.
        self.status = interpreted(_solve)(
            self.H, self.tau, self.C, self.A, asked - self.b, asked, m, np.array(c), np.array(w),
            self.L, self.X, self.S, self.y, self.a, self.F, self.qdd, self.share, self.ends,
        )  # fmt: skip

    def residuals(self):
        """Return the relative residuals of the two block rows."""
        found = SimpleNamespace(
            A=self.A, S=self.S, drift_c=np.zeros(3), b=self.b, a=self.a, F=self.F
        )  # fmt: skip
        motion = interpreted(motion_residual)(self.H, self.tau, self.C, self.qdd, found, self.ends)
        return motion, interpreted(closure_residual)(self.qdd, found, (0, self.m))

    def condition(self):
        """Return the 1-norm condition number of Eq. 24 with its normal row; keep that of H."""
        n, last = len(self.tau), 3  # lanes of a batch are alike: four of them do, interpreted
        batch, work = np.zeros((batch_rows(n), last + 1)), np.full(n * n + 4 * n, np.nan)
        given = self.H, self.A[0], self.L, self.X[0], self.S[0, 0]
        for lane, pressed in ((0, False), (last, True)):
            interpreted(add_to_batch)(*given, pressed, batch, lane)
        with np.errstate(all="ignore"):  # of the lanes that are empty
            interpreted(condition_numbers_of_batch)(batch, n, last + 1)
        self.condition_free = batch[-1, 0]
        self.long = [interpreted(condition_number)(*given, pressed, work, self.ends) for pressed in (False, True)]
        return batch[-1, last]


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


@pytest.mark.parametrize("count", [8, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("stabiliser", ["none", "baumgarte"])
@pytest.mark.parametrize("name", ["planar2", "wam4", "panda"])
def test_simulated_row_equals_pinocchio(name, stabiliser, count, robot, random_states):
    """The acceleration and force that a run records are Pinocchio's, stabiliser included, in random states."""
    arm = robot(name)
    model = arm.model.pinocchio_model()
    data = model.createData()
    compared = 0
    for s in random_states(arm, count, 2):
        terms = arm.terms(s.q, s.v)
        A = s.normal @ terms.jacobian
        if mobility_share(terms, A) < WELL:
            continue
        off, rate = 1e-4, 5e-5  # m, m/s, so that both terms of the stabiliser act
        v = s.v + A * ((rate - A @ s.v) / (A @ A))
        terms = arm.terms(s.q, v)
        scenario = cl.load_scenario(
            f"{'wam' if name == 'wam4' else name}_slide",
            {
                "start.q": s.q.tolist(),
                "start.v": v.tolist(),
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
            drift += 1414.0 * (A @ v) + 1e6 * off
        theirs = pin.forwardDynamics(model, data, s.q, v, s.torque, A[None], np.array([drift]), 0.0)
        assert relative(run.acceleration[0], theirs) < AGREEMENT
        assert run.contact_force[0] == pytest.approx(data.lambda_c[0], rel=AGREEMENT)
        compared += 1
    assert compared > 0.6 * count


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
    """Draw H with a chosen condition number, a tip Jacobian in a turned frame, and the rest; m = 1 pressed, 3 stuck."""
    n = draw(st.integers(3, 8))
    m = draw(st.sampled_from([1, 3]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spread = draw(st.floats(0.0, 10.0))
    scale = 10.0 ** draw(st.floats(-3.0, 3.0))
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    H = scale * (turn * np.logspace(-spread, 0.0, n)) @ turn.T
    A = np.linalg.qr(rng.normal(size=(3, 3)))[0] @ rng.normal(size=(3, n))
    return 0.5 * (H + H.T), 10 * rng.normal(size=n), rng.normal(size=n), A, rng.normal(size=3), m


def well_posed(H, A, m):
    """Whether no pivot of the Schur complement is near what counts as immobile."""
    S = A[:m] @ np.linalg.solve(H, A[:m].T)
    return np.linalg.cond(S) < 1e7


@pytest.mark.slow
@patient
@given(problems())
def test_elimination_solves_the_equation(problem):
    """The compiled elimination meets both block rows of Eq. 24 to rounding, however ill-conditioned H is.

    Backward stability: the residual relative to what was summed does not know the condition of H. n <= 8 additions
    in each of three nested sums give some hundred roundings: 1e-12, which is also what a run reports as held.
    """
    H, tau, C, A, b, m = problem
    assume(well_posed(H, A, m))
    done = Solved(H, tau, C, A, b, m=m)
    assert done.status == OK
    y = np.linalg.solve(H, tau - C)
    right = np.concatenate([tau - C, b[:m]])
    solution = np.concatenate([done.qdd, -done.F[:m]])
    matrix = bordered_matrix(H, A[:m])
    n = len(tau)
    # Independent of the residuals, against the normwise size of what is summed.
    parts = np.abs(matrix[:n]) @ np.abs(solution) + np.abs(y) @ np.abs(H) + np.abs(right[:n])
    assert np.max(np.abs(matrix @ solution - right)[:n]) < 1e-12 * np.max(parts)


@patient
@given(problems())
def test_elimination_equals_lapack(problem):
    """The compiled elimination and `solve_closure` agree to rounding times the conditions of the problem.

    Forward error: elimination goes through H⁻¹ and S⁻¹, so rounding is multiplied by cond(H), by the condition of the
    Schur complement, and by how far H⁻¹(Q - C) exceeds q̈; LAPACK's by cond(K).
    """
    H, tau, C, A, b, m = problem
    assume(well_posed(H, A, m))
    done = Solved(H, tau, C, A, b, m=m)
    qdd, f = cl.solve_closure(H, tau - C, A[:m], b[:m])
    y = np.linalg.solve(H, tau - C)
    S = A[:m] @ np.linalg.solve(H, A[:m].T)
    amplified = np.linalg.cond(bordered_matrix(H, A[:m])) + np.linalg.cond(H) * np.linalg.cond(S)
    tolerance = 100 * EPS * amplified
    assert np.max(np.abs(done.F[:m] - f)) <= tolerance * (
        np.max(np.abs(f)) + np.max(np.abs(np.linalg.solve(S, A[:m] @ y)))
    )
    assert np.max(np.abs(done.qdd - qdd)) <= tolerance * (np.max(np.abs(qdd)) + np.max(np.abs(y)))
    assert not np.any(done.F[m:])


@patient
@given(problems(), st.floats(0.0, 1.5), st.floats(0.0, 6.3), st.floats(0.0, 5.0))
def test_friction_is_solved_with_the_force_not_after_it(problem, mu, heading, load):
    """With F_t = -c f - w the bordered matrix has n - c in its column: LAPACK finds the same q̈ and f in one solve."""
    H, tau, C, A, b, _ = problem
    assume(well_posed(H, A, 3))
    t = np.array([np.cos(heading), np.sin(heading)])
    c, w = mu * t, load * t
    done = Solved(H, tau, C, A, b, c=c, w=w)
    S = A @ np.linalg.solve(H, A.T)
    mobility = S[0, 0] - S[0, 1:] @ c
    assume(mobility > 1e-6 * np.trace(S))
    matrix = np.block([[H, (A[0] - c @ A[1:])[:, None]], [A[:1], np.zeros((1, 1))]])
    solution = np.linalg.solve(matrix, np.concatenate([tau - C - A[1:].T @ w, b[:1]]))
    amplified = np.linalg.cond(matrix) + np.linalg.cond(H) * np.trace(S) / mobility
    tolerance = 1000 * EPS * amplified
    y = np.linalg.solve(H, tau - C - A[1:].T @ w)
    size = np.abs(solution[-1]) + np.max(np.abs(A @ y)) / mobility
    assert abs(done.F[0] + solution[-1]) <= tolerance * size
    assert done.F[1:] == pytest.approx(-c * done.F[0] - w, abs=1e-12 * (1 + abs(done.F[0])))


@patient
@given(problems(), st.floats(1e-3, 5.0))
def test_painleve_is_told_where_friction_takes_the_normal_mobility(problem, beyond):
    """Friction that turns the normal acceleration of a push inwards, A₀H⁻¹(A₀ - c A_t)ᵀ < 0, has no rigid answer."""
    H, tau, C, A, b, _ = problem
    assume(well_posed(H, A, 3))
    S = A @ np.linalg.solve(H, A.T)
    across = S[0, 1:]
    assume(np.hypot(*across) > 1e-6 * np.trace(S))
    enough = S[0, 0] * across / (across @ across)
    assert Solved(H, tau, C, A, b, c=(1.0 + beyond) * enough).status == PAINLEVE
    assert Solved(H, tau, C, A, b, c=enough / (1.0 + beyond)).status == OK


@patient
@given(problems())
def test_only_the_upper_triangle_is_read(problem):
    """Pinocchio leaves the lower triangle of H unfilled; what is there changes nothing, to the last bit."""
    H, tau, C, A, b, m = problem
    whole, upper = (
        Solved(H, tau, C, A, b, m=m),
        Solved(np.triu(H) - 7 * np.tril(np.ones_like(H), -1), tau, C, A, b, m=m),
    )
    assert np.array_equal(whole.qdd, upper.qdd)
    assert np.array_equal(whole.F, upper.F)
    assert whole.residuals() == upper.residuals()
    assert whole.condition() == upper.condition()


@patient
@given(problems())
def test_stabilisers_share_is_a_difference_of_forces(problem):
    """The stabiliser's share is exactly what the force loses when its part of b is taken away."""
    H, tau, C, A, b, m = problem
    assume(well_posed(H, A, m))
    share = 0.3 * b[::-1]
    with_it = Solved(H, tau, C, A, b, share, m)
    without = Solved(H, tau, C, A, b - share, m=m)
    S = A[:m] @ np.linalg.solve(H, A[:m].T)
    size = np.max(np.abs(with_it.F)) + np.max(np.abs(without.F))
    tolerance = 1e4 * EPS * np.linalg.cond(H) * np.linalg.cond(S)
    assert np.max(np.abs(with_it.F - without.F - with_it.share)[:m]) <= tolerance * size


@patient
@given(problems())
def test_reported_condition_is_the_condition(problem):
    """The condition number a run records is ‖K‖₁‖K⁻¹‖₁ of the matrix of Eq. 24; of H while the tip is free."""
    H, tau, C, A, b, _ = problem
    matrix = bordered_matrix(H, A[0])
    theirs = np.linalg.cond(matrix, 1)
    done = Solved(H, tau, C, A, b)
    assert done.condition() == pytest.approx(theirs, rel=1e-6 + 100 * EPS * theirs * np.linalg.cond(H))
    assert done.long == pytest.approx([done.condition_free, done.condition()], rel=1e-6 + 100 * EPS * theirs**2)
    assert done.condition_free == pytest.approx(np.linalg.cond(H, 1), rel=1e-6 + 100 * EPS * np.linalg.cond(H))


def test_mobility_is_the_share_of_the_normal(robot, random_states):
    """The recorded mobility is A H⁻¹Aᵀ over the trace of Jᵣ H⁻¹Jᵣᵀ."""
    arm = robot("panda")
    for s in random_states(arm, 20, 3):
        terms = arm.terms(s.q, s.v)
        frame = contact_frame(s.normal)
        done = Solved(terms.mass_matrix, s.torque, terms.bias, frame @ terms.jacobian, np.zeros(3))
        assert done.S[0, 0] / np.trace(done.S) == pytest.approx(
            mobility_share(terms, s.normal @ terms.jacobian), rel=1e-9
        )


def test_a_tangent_in_which_the_arm_cannot_move_carries_no_force(robot, random_states):
    """A planar arm's tip cannot move sideways: held fast it feels a force in its plane and none across."""
    arm = robot("planar2")
    for s in random_states(arm, 20, 4):
        terms = arm.terms(s.q, s.v)
        plane = terms.jacobian[[0, 2]]
        if abs(np.linalg.det(plane)) < 0.05:
            continue
        for turn in (0.0, 0.7, np.pi / 2):
            c, d = np.cos(turn), np.sin(turn)
            A = np.array([[0, 0, 1], [c, d, 0], [-d, c, 0]]) @ terms.jacobian
            done = Solved(terms.mass_matrix, s.torque, terms.bias, A, np.zeros(3), m=3)
            assert done.status == OK
            assert np.max(np.abs(A @ done.qdd)) < 1e-9
            qdd, f = cl.solve_closure(terms.mass_matrix, s.torque - terms.bias, plane, np.zeros(2))
            assert done.qdd == pytest.approx(qdd, abs=1e-9)
            assert done.F[0] == pytest.approx(f[1], rel=1e-9)
            assert done.F[1] * c - done.F[2] * d == pytest.approx(f[0], rel=1e-7, abs=1e-9)


def test_elimination_names_what_is_wrong():
    """A normal of zeros is SINGULAR; an indefinite or NaN mass matrix is not positive definite."""
    H, A = np.diag([1.0, 2.0, 3.0]), np.eye(3)
    tau = C = np.ones(3)
    zeros = np.zeros(3)
    for m in (1, 3):
        assert Solved(H, tau, C, A, zeros, m=m).status == OK
        assert Solved(H, tau, C, np.diag([0.0, 1.0, 1.0]), zeros, m=m).status == SINGULAR
        assert Solved(H, tau, C, 0 * A, zeros, m=m).status == SINGULAR
        assert Solved(H, tau, C, np.nan * A, zeros, m=m).status == SINGULAR
    assert Solved(np.diag([1.0, 0.0, 3.0]), tau, C, A, zeros).status == NOT_POSITIVE_DEFINITE
    assert Solved(np.diag([1.0, -1.0, 3.0]), tau, C, A, zeros).status == NOT_POSITIVE_DEFINITE
    assert Solved(np.diag([1.0, np.nan, 3.0]), tau, C, A, zeros).status == NOT_POSITIVE_DEFINITE
    for least, status in ((1e-14, NOT_POSITIVE_DEFINITE), (1e-12, OK)):  # two joints that move one point mass
        together = np.array([[1.0, 2.0, 0.0], [2.0, 4.0 * (1.0 + least), 0.0], [0.0, 0.0, 3.0]])
        assert Solved(together, tau, C, A, zeros).status == status
    skew = np.array([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert Solved(np.eye(3), tau, C, skew, zeros, c=(0.6, 0.0)).status == PAINLEVE
    assert Solved(np.eye(3), tau, C, skew, zeros, c=(0.4, 0.0)).status == OK


@pytest.mark.parametrize(("factor", "status"), [(0.5, SINGULAR), (2.0, OK)])
def test_singular_begins_at_the_threshold(factor, status):
    """A mobility share below SINGULAR_MOBILITY is singular, above it is not."""
    share = factor * SINGULAR_MOBILITY
    A = np.diag([np.sqrt(2 * share), 1.0, 1.0])  # with H = 1: trace 2, the normal's mobility 2·share
    done = Solved(np.eye(3), np.ones(3), np.zeros(3), A, np.zeros(3))
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
