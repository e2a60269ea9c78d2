"""Heaps of time stepping: seeds of `heaps.py`."""

import heaps
import pytest


def test_edges_that_begin_to_cross_deep_inside_do_not_throw_boxes():
    """Two edges that had been clear of each other cross 26 mm deep as boxes turn: another contact is nearer."""
    run, wrong = heaps.examine(heaps.draw(5023, duration=0.3))
    assert run.time[-1] == pytest.approx(0.3)
    assert not wrong.keys() & {"stopped", "energy", "sunk"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(6), 5023])
def test_heaps_do_not_stop_or_gain_energy(seed):
    """Boxes, balls and cylinders that fall on each other: every run ends, and none gains energy."""
    _, wrong = heaps.examine(heaps.draw(seed))
    assert not wrong.keys() & {"stopped", "energy"}
