"""A block that rocks on two feet rests when independent code says (`planar_block`), at any friction and restitution."""

import numpy as np
import pytest
from boxes import simulate
from planar_block import Block

ANGLE = 0.05
QUICK = {(1.0, 0.05, 0.3), (2.0, 3.0, 0.0)}
# Those whose reference takes a few seconds at most.
CASES = [
    *((1.0, mu, e) for mu, e in ((0.05, 0.3), (0.3, 0.0), (0.7, 0.5), (3.0, 0.3), (0.3, 0.9))),
    *((2.0, mu, e) for mu, e in ((0.05, 0.0), (0.7, 0.5), (3.0, 0.0))),
    (4.0, 0.05, 0.5),
]


def rock(tmp_path, aspect, mu, e):
    """Return the run of the block, its strikes, and those of the reference with the instant of rest."""
    half = np.array([0.1, 0.1, 0.1 * aspect])
    height = half[0] * np.sin(ANGLE) + half[2] * np.cos(ANGLE)
    start = ([0.0, height, -ANGLE], [0.0, 0.0, 0.0])
    rest, strikes = Block(half[0], half[2], mu, e).comes_to_rest(*start)
    feet = [(x, 0.0, -half[2]) for x in (half[0], -half[0])]
    duration = round(1.1 * rest + 0.05, 3)
    # A foot that strikes alone rebounds by Newton's law, as there: by Stronge's, the usual one, less where slip turns.
    run = simulate(tmp_path, half, feet, start, mu, e, **{"time.duration": duration, "impact.law": "newton"})
    return run, [event.time for event in run.events if event.kind in ("impact", "touchdown")], strikes, rest


@pytest.mark.parametrize(
    ("aspect", "mu", "e"), [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES]
)
def test_a_rocking_block_rests_at_the_instant_of_a_planar_reference(tmp_path, aspect, mu, e):
    """The first strikes to a microsecond, the instant of rest to a thousandth, on the floor to a nanometre."""
    run, struck, strikes, rest = rock(tmp_path, aspect, mu, e)
    first = min(4, len(strikes))
    np.testing.assert_allclose(struck[:first], strikes[:first], atol=1e-6)
    assert struck[-1] == pytest.approx(rest, rel=1e-3)
    assert np.max(np.abs(run.v[-1])) < 1e-8
    assert np.min(run.link_gaps) > -1e-9


@pytest.mark.slow
@pytest.mark.parametrize(("aspect", "mu"), [(2.0, 0.3), (4.0, 0.05)])
def test_a_block_that_bounces_from_foot_to_foot_strikes_as_a_planar_reference(tmp_path, aspect, mu):
    """Ten strikes to a microsecond; then a rounding has grown, by 1.8 from strike to strike, and rest is another."""
    run, struck, strikes, rest = rock(tmp_path, aspect, mu, 0.9)
    np.testing.assert_allclose(struck[:10], strikes[:10], atol=1e-6)
    assert struck[-1] == pytest.approx(rest, rel=0.05)
    assert np.max(np.abs(run.v[-1])) < 1e-8
    assert np.min(run.link_gaps) > -1e-9


def test_what_rest_takes_is_what_the_block_would_have_rocked_on_with(tmp_path):
    """Housner: r = 1 − 3/2 sin² α of the speed is left when it changes feet, r² of the energy, which rest takes."""
    half, lift = np.array([0.05, 0.1, 0.2]), 1e-4
    turn = lift / (2.0 * half[0])
    start = [0.0, half[0] * np.sin(turn) + half[2] * np.cos(turn), -turn], [0.0, 0.0, 0.0]
    feet = [(x, 0.0, -half[2]) for x in (half[0], -half[0])]
    run = simulate(tmp_path, half, feet, start, 3.0, 0.0, **{"time.duration": 0.05, "impact.rest_speed": 1.0})
    struck = run.event_energy_lost > 1e-12
    rested, lost = run.event_energy_rested[struck].sum(), run.event_energy_lost[struck].sum()
    ratio = 1.0 - 1.5 * half[0] ** 2 / (half[0] ** 2 + half[2] ** 2)
    assert rested / lost == pytest.approx(ratio**2, rel=1e-6)
    assert run.summary()["energy_taken_at_rest"] == pytest.approx(rested, rel=1e-12)
    assert np.max(np.abs(run.v[-1])) < 1e-9  # the stabiliser still takes back what the impact left of the gap
