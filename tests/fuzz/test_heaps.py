"""Heaps of time stepping: seeds of `heaps.py`."""

import heaps
import numpy as np
import pytest
from free_bodies import matrices

from closedloop.record.report import report_rows
from closedloop.record.report.summary import contact_faults


def test_edges_that_begin_to_cross_deep_inside_do_not_throw_boxes():
    """Two edges that had been clear of each other cross 26 mm deep as boxes turn: another contact is nearer."""
    run, wrong = heaps.examine(heaps.draw(5023, duration=0.3))
    assert run.time[-1] == pytest.approx(0.3)
    assert not wrong.keys() & {"stopped", "energy", "sunk"}


def test_the_report_says_how_deep_bodies_that_press_are_in_each_other():
    """1.7 mm with a step of 5 ms, less with a shorter one: the verdict of such a run is good."""
    scenario = heaps.draw(120000059, duration=0.25)
    run, _ = heaps.examine(scenario)
    ball, box = scenario["body"][0], scenario["body"][2]
    centre = np.einsum("kji,kj->ki", matrices(run.q[:, 17:21]), run.q[:, :3] - run.q[:, 14:17])
    apart = np.maximum(np.abs(centre) - 0.5 * np.array(box["edges"]), 0.0)
    depth = np.max(ball["radius"] - np.linalg.norm(apart, axis=1))
    assert depth == pytest.approx(1.7578e-3, abs=1e-7)
    found, i = contact_faults(run), 11
    assert (found.names[i], np.argmax(found.depth)) == ("contact 5", i)
    assert found.depth[i] == pytest.approx(depth, rel=1e-9)
    assert ("contacts: depth in a rigid surface", "0.002", "m", "contact 5") in report_rows(run)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "integrator"),
    [(seed, "time_stepping") for seed in (*range(6), 5023)]
    + [(seed, each) for seed in (*range(3), 99518) for each in ("semi_implicit_euler", "rk4")],
)
def test_heaps_do_not_stop_or_gain_energy(seed, integrator):
    """Boxes, balls and cylinders that fall on each other: every run ends, and none gains energy.

    In 99518 two edges crossed 20 mm deep in a step of impulses between events, and were pushed apart.
    """
    _, wrong = heaps.examine(heaps.draw(seed, integrator=integrator))
    assert not wrong.keys() & {"stopped", "energy"}
