"""Impacts in a plane against Routh's construction: two straight pieces and a quadratic each, written out here anew."""

import math

import numpy as np
import pytest

from closedloop.mechanics.impact import two_phase_impact

# Rounding times the condition of the two pieces' algebra; mobilities are drawn with determinants above 0.05.
AGREEMENT = 1e-11


def routh(a, b, c, un, ut, eps, law, mu):
    """Return the impulses of both phases as (P_n, P_t) pairs, and what happened.

    a, b, c are S_nn, S_nt, S_tt. A piece is (its length in P_n, du_n/dP_n, du_t/dP_n, dP_t/dP_n).
    """
    pieces, slope = [], 0.0
    if ut != 0.0:
        s = math.copysign(1.0, ut)
        rate = b * s - mu * c  # of |u_t|
        length = abs(ut) / -rate if rate < 0.0 else math.inf
        pieces.append((length, a - mu * b * s, s * rate, -mu * s))
    if not pieces or pieces[0][0] < math.inf:
        if abs(b) <= mu * c:
            slope = -b / c
            pieces.append((math.inf, a + b * slope, 0.0, slope))
            last = "stick"
        else:
            s = math.copysign(1.0, b)
            pieces.append((math.inf, a - mu * abs(b), s * (abs(b) - mu * c), -mu * s))
            last = "reversal" if ut * s < 0.0 else "slip"
    else:
        last = "slip"
    phases = [[0.0, 0.0], [0.0, 0.0]]
    phase, work, energy, start = 0, 0.0, 0.0, un
    jam = cut = False
    for length, n, t, f in pieces:
        if phase == 0:
            x = -un / n if n > 0.0 else math.inf
            jam |= n < 0.0
            step = min(x, length)
            work += un * step + 0.5 * n * step**2
            energy += (un + f * ut) * step + 0.5 * (n + f * t) * step**2
            phases[0][0] += step
            phases[0][1] += f * step
            un, ut, length = un + n * step, ut + t * step, length - step
            if x <= step:
                phase, un = 1, 0.0
        if phase == 1 and length > 0.0 and eps > 0.0:
            # What is still missing, by the law; then by the energy
            if law == "poisson":
                x = eps * phases[0][0] - phases[1][0]
            elif law == "newton":
                x = (-eps * start - un) / n if n > 0.0 else math.inf
            else:
                done = 0.0 if phases[1][0] == 0.0 else done  # noqa: F821 - work of decompression so far
                x = root(0.5 * n, un, done + eps**2 * work)
            limit = root(0.5 * (n + f * t), un + f * ut, energy) if law == "newton" else math.inf
            if limit < min(x, length) * (1.0 - 1e-12):
                x, cut = limit, True
            step = min(x, length)
            done = (0.0 if phases[1][0] == 0.0 else done) + un * step + 0.5 * n * step**2
            energy += (un + f * ut) * step + 0.5 * (n + f * t) * step**2
            phases[1][0] += step
            phases[1][1] += f * step
            un, ut = un + n * step, ut + t * step
            if x <= step:
                break
    return phases, last, jam, cut


def root(q, h, e):
    """Return the positive x with q x² + h x + e = 0, e < 0; inf if there is none."""
    square = h * h - 4.0 * q * e
    if square < 0.0 or (q <= 0.0 and h <= 0.0):
        return math.inf
    return -2.0 * e / (h + math.sqrt(square)) if h > 0.0 else (-h + math.sqrt(square)) / (2.0 * q)


def planar(a, b, c):
    """Return S of a planar arm: the second tangent has no mobility."""
    return np.array([[a, b, 0.0], [b, c, 0.0], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("law", ["newton", "poisson", "stronge"])
def test_random_planar_impacts_are_rouths(law):
    """Slip, stick, reversal, jam and the cut, each met often; impulses of both phases and what happened."""
    rng = np.random.default_rng(8)
    met = dict.fromkeys(["slip", "stick", "reversal", "jam", "cut"], 0)
    for _ in range(500):
        a, c = rng.uniform(0.5, 3.0, 2)
        b = rng.uniform(-1.0, 1.0) * math.sqrt(a * c - 0.05)
        un, ut = -rng.uniform(0.1, 2.0), rng.choice([0.0, rng.normal()], p=[0.1, 0.9])
        eps, mu = rng.uniform(), rng.choice([0.2, 0.6, 1.5, 4.0])
        expected, last, jam, cut = routh(a, b, c, un, ut, eps, law, mu)
        hit = two_phase_impact(planar(a, b, c), [un, ut, 0.0], eps, law, mu)
        size = AGREEMENT * np.max(np.abs(expected))
        np.testing.assert_allclose(hit.compression, [*expected[0], 0.0], rtol=0.0, atol=size)
        np.testing.assert_allclose(hit.decompression, [*expected[1], 0.0], rtol=0.0, atol=size)
        assert ("jam" in hit.modes, "cut" in hit.modes) == (jam, cut)
        if last in ("stick", "reversal") and "slip" not in hit.modes[:1]:
            assert ut == 0.0
        if last in hit.modes:
            met[last] += 1
        met["jam"] += jam
        met["cut"] += cut
    wanted = set(met) if law == "newton" else set(met) - {"cut"}
    assert all(met[name] >= 7 for name in wanted), met
    assert law == "newton" or met["cut"] == 0


def test_slip_that_stops_and_sticks_by_hand():
    """The rod at 45 degrees with μ = 0.8, u = (−1, 0.35): S_nn = S_tt = 2.5, S_nt = −1.5.

    Slip: du_t/dp = −1.5 − 2 = −3.5, stops at p = 0.1 with u_n = −1 + 0.1·(2.5 + 1.2) = −0.63. It sticks, for 0.6 < 0.8:
    du_n/dp = 2.5 − 0.6·1.5 = 1.6, dP_t/dp = 0.6. Poisson with ε = 0.5.
    """
    hit = two_phase_impact(planar(2.5, -1.5, 2.5), [-1.0, 0.35, 0.0], 0.5, "poisson", 0.8)
    x = 0.63 / 1.6
    np.testing.assert_allclose(hit.compression, [0.1 + x, -0.08 + 0.6 * x, 0.0], rtol=1e-14)
    d = 0.5 * (0.1 + x)
    np.testing.assert_allclose(hit.decompression, [d, 0.6 * d, 0.0], rtol=1e-14)
    np.testing.assert_allclose(hit.after, [1.6 * d, 0.0, 0.0], rtol=1e-14, atol=1e-15)
    assert hit.modes == ("slip", "stick")


def test_a_jam_by_hand():
    """Friction drives the tip in: S_nt = 1.5, μ = 2, u = (−1, 0.7): du_n/dp = 2.5 − 3 = −0.5 while it slides.

    du_t/dp = 1.5 − 5 = −3.5: slip stops at p = 0.2 with u_n = −1.1, deeper than at first; then it sticks,
    du_n/dp = 1.6. Compression ends at p = 0.2 + 1.1/1.6 = 0.8875.
    """
    hit = two_phase_impact(planar(2.5, 1.5, 2.5), [-1.0, 0.7, 0.0], 0.5, "stronge", 2.0)
    assert hit.modes == ("slip", "stick", "jam")
    np.testing.assert_allclose(hit.compression, [0.8875, -0.4 - 0.6 * 0.6875, 0.0], rtol=1e-14)
    work = -1.05 * 0.2 - 0.5 * 1.1 * 0.6875
    assert hit.after[0] == pytest.approx(math.sqrt(2.0 * 1.6 * 0.25 * -work), rel=1e-14)


def test_slip_may_stop_in_decompression():
    """u = (−1, 1.2), S_nn = S_tt = 2, S_nt = 0, μ = 0.5, ε = 1: slip stops at p = 1.2, of 0.5 + 0.5 only: not at all.

    With u_t = 0.8 it stops at p = 0.8, in decompression, and sticks: dP_t is 0 from there on.
    """
    S = planar(2.0, 0.0, 2.0)
    slides = two_phase_impact(S, [-1.0, 1.2, 0.0], 1.0, "newton", 0.5)
    assert slides.modes == ("slip",)
    np.testing.assert_allclose(slides.after, [1.0, 0.2, 0.0], rtol=1e-14)
    stops = two_phase_impact(S, [-1.0, 0.8, 0.0], 1.0, "newton", 0.5)
    assert stops.modes == ("slip", "stick")
    np.testing.assert_allclose(stops.compression, [0.5, -0.25, 0.0], rtol=1e-14)
    np.testing.assert_allclose(stops.decompression, [0.5, -0.15, 0.0], rtol=1e-14)


def test_rounding_in_the_immobile_direction_changes_nothing():
    """A planar arm's S in rotated axes has entries of 1e-17 where it should have zeros; so has u."""
    rng = np.random.default_rng(2)
    for mu in (0.2, 0.7, 3.0):
        for ut in (0.0, 0.3, -0.4):
            S, u = planar(2.5, -1.5, 2.5), np.array([-1.0, ut, 0.0])
            noise = 3e-17 * rng.normal(size=(3, 3))
            clean = two_phase_impact(S, u, 0.5, "poisson", mu)
            noisy = two_phase_impact(S + noise + noise.T, u + 3e-17 * rng.normal(size=3), 0.5, "poisson", mu)
            np.testing.assert_allclose(noisy.impulse, clean.impulse, rtol=0.0, atol=1e-14)
            assert noisy.modes == clean.modes
