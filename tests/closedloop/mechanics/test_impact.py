"""The impact against closed forms, Pinocchio, and what must hold of every impact; bad input is refused in one line."""

import math

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from closedloop.base.errors import ScenarioError
from closedloop.mechanics.impact import Impact, two_phase_impact

LAWS = ["newton", "poisson", "stronge"]
# Relative error of a single impact: rounding times the condition of S, which is below 1e3 where this is used.
EXACT = 1e-12
patient = settings(deadline=None, max_examples=150)


def scale(S, P):
    """Return the largest energy that S and the impulse P can make of rounding: |P|ᵀ|S||P|, J."""
    return np.abs(P) @ np.abs(S) @ np.abs(P)


def draw(rng, rank=4):
    """Return a random mobility, 1/kg, a velocity that a tip with it can have, approaching, and the joints' part."""
    B = rng.normal(size=(3, rank))
    v = rng.normal(size=rank)
    if B[0] @ v > 0.0:
        v = -v
    return B @ B.T, B @ v, v


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("restitution", [0.0, 0.3, 1.0])
def test_without_friction_all_laws_are_newtons(law, restitution):
    """P_n = (1 + ε) m_eff |u_n| in the shares 1 : ε, and (1 − ε²)/2 m_eff u_n² is lost; the tip is pushed aside too."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        S, u, _ = draw(rng)
        hit = two_phase_impact(S, u, restitution, law)
        mass = 1.0 / S[0, 0]
        np.testing.assert_allclose(hit.compression, [-mass * u[0], 0.0, 0.0], rtol=EXACT)
        np.testing.assert_allclose(hit.decompression, restitution * hit.compression, rtol=EXACT)
        np.testing.assert_allclose(hit.after[0], -restitution * u[0], rtol=EXACT, atol=EXACT * abs(u[0]))
        np.testing.assert_allclose(hit.after[1:] - u[1:], S[1:, 0] * hit.impulse[0], rtol=1e-10)
        lost = 0.5 * (1.0 - restitution**2) * mass * u[0] ** 2
        assert hit.energy_lost == pytest.approx(lost, rel=EXACT, abs=EXACT * mass * u[0] ** 2)
        assert hit.modes == ()


@pytest.mark.parametrize("name", ["wam4", "panda"])
@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_velocity_and_impulse_are_pinocchios(name, restitution, robot, random_states):
    """Without friction: q̇⁺ and P_n of pinocchio.impulseDynamics with the row nᵀJᵣ."""
    arm = robot(name)
    model = arm.model.pinocchio_model()
    data = model.createData()
    compared = 0
    for s in random_states(arm, 60, 5):
        terms = arm.terms(s.q, s.v)
        H = terms.mass_matrix
        A = frame(s.normal) @ terms.jacobian
        v = s.v if A[0] @ s.v < 0.0 else -s.v
        hit = two_phase_impact(mobility(H, A), A @ v, restitution)
        theirs = pin.impulseDynamics(model, data, s.q, v, A[:1], restitution, 0.0)
        ours = v + np.linalg.solve(H, A.T @ hit.impulse)
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-10 * np.max(np.abs(theirs)))
        assert hit.impulse[0] == pytest.approx(data.impulse_c[0], rel=1e-10)
        compared += 1
    assert compared == 60


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["planar2", "wam4", "panda"])
def test_energy_lost_is_that_of_the_joints(name, law, robot, random_states):
    """With friction, ½ q̇ᵀH q̇ falls by `energy_lost`, and A q̇ after the impact is `after`; in a plane and in
    space.
    """
    arm = robot(name)
    for s in random_states(arm, 20, 6):
        normal = s.normal if name != "planar2" else in_plane(arm, s)
        terms = arm.terms(s.q, s.v)
        H = terms.mass_matrix
        A = frame(normal) @ terms.jacobian
        v = s.v if A[0] @ s.v < 0.0 else -s.v
        hit = two_phase_impact(mobility(H, A), A @ v, 0.5, law, 0.3)
        after = v + np.linalg.solve(H, A.T @ hit.impulse)
        np.testing.assert_allclose(A @ after, hit.after, rtol=0.0, atol=1e-10 * np.max(np.abs(A @ v)))
        before = 0.5 * v @ H @ v
        assert before - 0.5 * after @ H @ after == pytest.approx(hit.energy_lost, abs=1e-10 * before)
        assert hit.energy_lost > 0.0


def frame(normal):
    """Return the rows n, t1, t2, right-handed."""
    t1 = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    t1 /= np.linalg.norm(t1)
    return np.array([normal, t1, np.cross(normal, t1)])


def mobility(H, A):
    """Return A H⁻¹Aᵀ, symmetric to the last bit."""
    X = np.linalg.solve(np.linalg.cholesky(H), A.T)
    return X.T @ X


def in_plane(arm, s):
    """Return a unit normal in the plane in which a planar arm moves: 0.6, 0.8 in its principal directions there."""
    rows = np.linalg.svd(arm.terms(s.q, s.v).jacobian.T)[2]
    return 0.6 * rows[0] + 0.8 * rows[1]


@pytest.mark.parametrize("law", LAWS)
def test_a_homogeneous_sphere_slides_or_rolls(law):
    """A sphere that meets the floor obliquely: S = diag(1, 7/2, 7/2)/m, slip stops where μ (1 + ε) |u_n| 7/2 = |u_t|.

    The direction of slip stays. Tip means the sphere's lowest point; 1/m + r²/(2/5 m r²) = 7/(2 m) along the floor.
    """
    mass, eps, mu, un = 2.0, 0.5, 0.3, -1.0
    S = np.diag([1.0, 3.5, 3.5]) / mass
    direction = np.array([0.6, -0.8])
    threshold = 3.5 * mu * (1.0 + eps) * -un
    for slip in (0.99 * threshold, 1.01 * threshold):
        hit = two_phase_impact(S, [un, *(slip * direction)], eps, law, mu)
        friction = min(mu * (1.0 + eps) * mass * -un, slip * mass / 3.5)
        np.testing.assert_allclose(hit.impulse[1:], -friction * direction, rtol=EXACT)
        assert hit.impulse[0] == pytest.approx((1.0 + eps) * mass, rel=EXACT)
        assert hit.modes == (("slip", "stick") if slip < threshold else ("slip",))


def test_a_tip_at_rest_along_the_plane_sticks_or_slips_at_the_cone():
    """Both sides of the threshold μ = |S_nt|/S_tt = 0.6 of a rod at 45 degrees, S_tt = 2.5, S_nt = −1.5."""
    S = rod(-1.5)
    held = two_phase_impact(S, [-1.0, 0.0, 0.0], 0.5, "poisson", 0.61)
    assert held.modes == ("stick",)
    np.testing.assert_allclose(held.after[1:], 0.0, atol=1e-15)
    np.testing.assert_allclose(held.impulse[1], 0.6 * held.impulse[0], rtol=EXACT)
    slides = two_phase_impact(S, [-1.0, 0.0, 0.0], 0.5, "poisson", 0.59)
    assert slides.modes == ("slip",)
    np.testing.assert_allclose(slides.impulse[1], 0.59 * slides.impulse[0], rtol=EXACT)
    assert slides.after[1] < 0.0


def rod(coupling):
    """Return the mobility of the end of a rod of 1 kg at 45 degrees: (1 + 3 cos²)/m, (1 + 3 sin²)/m, ±3 sin cos/m."""
    return np.array([[2.5, coupling, 0.0], [coupling, 2.5, 0.0], [0.0, 0.0, 0.0]])


def test_the_three_laws_differ_where_slip_reverses():
    """A rod with μ = 0.4 and u = (−1, 0.5): each law by hand.

    Slip, du_t/dp = −1.5 − 0.4·2.5 = −2.5, stops at p = 0.2, where u_n = −1 + 0.2 (2.5 + 0.4·1.5) = −0.38. It reverses,
    for 1.5/2.5 > 0.4, with du_n/dp = 2.5 − 0.4·1.5 = 1.9: compression ends at p = 0.4 with P_t = −0.08 + 0.08 = 0. Its
    work is −(1 + 0.38)/2·0.2 − 0.38/2·0.2 = −0.176. So u_n⁺ is ε, ε·0.4·1.9, ε √(2·0.176·1.9).
    """
    rebound = {}
    for law in LAWS:
        hit = two_phase_impact(rod(-1.5), [-1.0, 0.5, 0.0], 0.5, law, 0.4)
        np.testing.assert_allclose(hit.compression, [0.4, 0.0, 0.0], rtol=EXACT, atol=1e-15)
        assert hit.modes == ("slip", "reversal")
        rebound[law] = hit.after[0]
    assert rebound["newton"] == pytest.approx(0.5, rel=EXACT)
    assert rebound["poisson"] == pytest.approx(0.38, rel=EXACT)
    assert rebound["stronge"] == pytest.approx(0.5 * math.sqrt(0.6688), rel=EXACT)


def test_newtons_law_is_cut_where_it_would_create_energy():
    """The same rod with ε = 1. Since slip stopped, E = −0.158 − 0.38 x + 0.85 x²: zero at x = (0.38 + √0.6816)/1.7.

    Newton's u_n⁺ = 1 would need x = 0.2 + 1/1.9 = 0.726, by when 0.0144 J would have come from nowhere.
    """
    x = (0.38 + math.sqrt(0.6816)) / 1.7
    hit = two_phase_impact(rod(-1.5), [-1.0, 0.5, 0.0], 1.0, "newton", 0.4)
    assert hit.modes == ("slip", "reversal", "cut")
    assert hit.impulse[0] == pytest.approx(0.2 + x, rel=EXACT)
    assert hit.after[0] == pytest.approx(-0.38 + 1.9 * x, rel=EXACT)
    assert hit.energy_lost == pytest.approx(0.0, abs=1e-15)
    uncut = two_phase_impact(rod(-1.5), [-1.0, 0.5, 0.0], 0.9, "newton", 0.4)
    assert "cut" not in uncut.modes
    assert uncut.after[0] == pytest.approx(0.9, rel=EXACT)


def test_restitution_zero_ends_with_compression():
    """ε = 0: no decompression, exactly, and the tip does not leave."""
    rng = np.random.default_rng(4)
    for law in LAWS:
        for _ in range(20):
            S, u, _ = draw(rng)
            hit = two_phase_impact(S, u, 0.0, law, 0.5)
            assert not hit.decompression.any()
            assert 0.0 <= hit.after[0] < 1e-14 * np.linalg.norm(u)


def test_nothing_happens_without_approach():
    """u_n = 0: zero impulse, whatever slip."""
    hit = two_phase_impact(rod(1.5), [0.0, 3.0, 0.0], 1.0, "stronge", 5.0)
    assert not hit.impulse.any()
    np.testing.assert_array_equal(hit.after, [0.0, 3.0, 0.0])
    assert hit.energy_lost == 0.0


@pytest.mark.parametrize("law", LAWS)
def test_a_wedged_tip_does_not_rebound(law):
    """A one-joint arm, S = g gᵀ: friction above g_n/|g_t| holds the tip, below it the tip leaves."""
    g = np.array([0.6, 0.48, -0.64])  # |g_t| = 0.8: the threshold is μ = 0.75
    held = two_phase_impact(np.outer(g, g), -2.0 * g, 0.5, law, 0.76)
    assert "wedge" in held.modes
    np.testing.assert_allclose(held.after, 0.0, atol=1e-15)
    # While it approaches, friction helps the normal impulse: u_n = −1.2 + p 0.6 (0.6 + 0.8 μ)
    assert held.compression[0] == pytest.approx(1.2 / (0.6 * (0.6 + 0.8 * 0.76)), rel=EXACT)
    leaves = two_phase_impact(np.outer(g, g), -2.0 * g, 0.5, law, 0.74)
    assert "wedge" not in leaves.modes
    assert leaves.after[0] > 1e-3


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([2, 3, 4]),
    st.floats(0.0, 1.0),
    st.floats(0.0, 4.0, allow_subnormal=False),
)
@patient
def test_every_impact_obeys_its_laws(seed, rank, restitution, friction):
    """The cone in both phases, no approach afterwards, no energy from nowhere, the ratio of the law."""
    rng = np.random.default_rng(seed)
    S, u, v = draw(rng, rank)
    energy = 0.5 * v @ v
    for law in LAWS:
        hit = two_phase_impact(S, u, restitution, law, friction)
        for phase in (hit.compression, hit.decompression):
            assert phase[0] >= 0.0
            assert np.hypot(*phase[1:]) <= friction * phase[0] * (1.0 + 1e-12) + 1e-300
        assert hit.after[0] >= 0.0
        rounding = 1e-14 * scale(S, hit.impulse) + 1e-12 * energy
        np.testing.assert_allclose(hit.after, u + S @ hit.impulse, rtol=0.0, atol=1e-11 * np.sqrt(np.trace(S) * energy))
        assert hit.energy_lost >= -rounding
        if law == "poisson":
            expected = restitution * hit.compression[0]
            assert hit.decompression[0] == pytest.approx(expected, rel=1e-11, abs=1e-13 * hit.compression[0])
        if law == "newton" and "wedge" not in hit.modes:
            reached = hit.after[0] - -restitution * u[0]
            room = 1e-13 * np.abs(S[0]) @ np.abs(hit.impulse) + EXACT * abs(u[0])
            assert reached <= room
            assert "cut" in hit.modes or reached >= -room


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"restitution": -0.1}, "restitution = -0.1: must be from 0 to 1"),
        ({"restitution": 1.5}, "restitution = 1.5: must be from 0 to 1"),
        ({"restitution": math.nan}, "restitution = nan: must be a finite number"),
        ({"friction": -1.0}, "friction = -1: must not be negative"),
        ({"friction": math.inf}, "friction = inf: must be a finite number"),
        ({"friction": "0.3"}, "friction = '0.3': must be a finite number"),
        ({"law": "hertz"}, "law = 'hertz': must be 'newton' or 'poisson' or 'stronge'"),
        ({"u": [0.1, 0.0, 0.0]}, "u[0] = 0.1 m/s: the tip moves off the surface; must not be positive"),
        ({"u": [-1.0, 0.0]}, "u has shape (2,): must be (3,)"),
        ({"u": [-1.0, math.nan, 0.0]}, "u = [-1.0, nan, 0.0]: must be finite"),
        ({"u": "fast"}, "u must be an array of numbers of shape (3,)"),
        ({"S": np.eye(2)}, "S has shape (2, 2): must be (3, 3)"),
        (
            {"S": np.diag([1.0, math.inf, 1.0])},
            "S = [[1.0, 0.0, 0.0], [0.0, inf, 0.0], [0.0, 0.0, 1.0]]: must be finite",
        ),
        ({"S": np.eye(3) + np.eye(3, k=1)}, "S is not symmetric: must be A H^-1 A^T in the order (n, t1, t2)"),
        (
            {"S": np.diag([1.0, -1.0, 1.0])},
            "S has a negative eigenvalue: must be A H^-1 A^T with a positive definite H",
        ),
        ({"S": np.diag([0.0, 1.0, 1.0])}, "S[0, 0] = 0 1/kg: the tip cannot move along the normal; must be positive"),
        (
            {"S": np.ones((3, 3)), "u": [-1.0, 1.0, 1.0], "friction": 2.0},
            "u = [-1.0, 1.0, 1.0]: no impulse ends the approach; must be a velocity that a tip with this S can have",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(change, message):
    """What, where, and what would be right."""
    good = {"S": np.eye(3), "u": [-1.0, 0.0, 0.0], "restitution": 0.5, "law": "newton", "friction": 0.1}
    assert isinstance(two_phase_impact(**good), Impact)
    with pytest.raises(ScenarioError) as caught:
        two_phase_impact(**(good | change))
    assert str(caught.value) == message


def test_the_arrays_are_read_only():
    """An impact is a record."""
    hit = two_phase_impact(np.eye(3), [-1.0, 0.0, 0.0], 0.5)
    for array in (hit.compression, hit.decompression, hit.after):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
