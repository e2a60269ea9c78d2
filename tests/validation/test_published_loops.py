"""Published mechanisms with loops: as printed, and what of them is noticed."""

import numpy as np
import pytest

from validation.anchors.problem import read
from validation.loops import andrews
from validation.loops.andrews import (
    ANDREWS_START,
    apart,
    bricard_of_rods,
    compare_with_published,
    falling,
    lean,
    lean_of_a_pendulum,
)


def test_the_squeezer_starts_as_printed():
    """Accelerations and forces in the loops, at rest, to rounding."""
    truth, found = andrews.printed()[0], andrews.squeezed(1e-6, 2e-6)[0]
    for name, bound in ANDREWS_START.items():
        assert apart(getattr(found, name), getattr(truth, name)) < bound


@pytest.mark.parametrize("key", ["mom", "rr", "d", "da", "ra"])
def test_figures_of_the_squeezer_matter(key):
    """A part in a million of any is seen at the start already."""
    data = read("andrews")
    rate, _ = andrews._solved(data | {key: data[key] * (1.0 + 1e-6)}, np.array(data["start"]), np.zeros(7))
    assert apart(rate, np.array(data["start_acceleration"])) > 100.0 * ANDREWS_START["acceleration"]


@pytest.mark.slow
def test_published_mechanisms_move_as_printed():
    """All of the quick section: to the bounds that it argues for."""
    section = compare_with_published(quick=True)
    assert [check for check in section.checks if not check.passed] == []
    assert len(section.checks) >= 10


def test_windows_that_lie_flat_go_on_as_one():
    """Three of them pass flat, where three rows are lost at once, and equal the pendulum that they are."""
    run = falling(3, 0.8, 0.01)
    leans = lean(run)
    assert leans[-1, 0] > np.pi / 2
    assert run.loops.rank.max() == 6
    np.testing.assert_allclose(leans, lean_of_a_pendulum(3, np.asarray(run.time))[:, None] * np.ones(4), atol=1e-6)


def test_bricard_of_rods_moves_where_counting_says_that_it_cannot():
    """Five rows of five joints: four of them independent, and it falls with its energy."""
    run = bricard_of_rods(0.2, 0.01)
    assert set(run.loops.rank) == {4}
    assert run.kinetic_energy[-1] > 0.1
    energy = run.kinetic_energy + run.potential_energy
    assert np.ptp(energy) < 1e-8 * run.kinetic_energy[-1]
