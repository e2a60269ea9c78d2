"""Bodies that nothing drives: seeds of `passive.py`."""

import passive
import pytest
from budget import budget


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "duration"),
    [(8200266, 0.18), (8201992, 0.5), (40290071, 0.5), *budget([], [(8300016, 0.25), (8300020, 0.5)])],
)
def test_the_adaptive_integrator_goes_on_where_a_slip_begins(seed, duration):
    """Rims and feet that stick let go, some at the edge of their cones for a moment only, some beside soft contacts.

    In 40290071 a resistance to rolling is at its limit beside one that holds the same rotation.
    """
    scenario = passive.draw(seed)
    scenario["time"]["duration"] = duration
    _, wrong = passive.examine(scenario)
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize("seed", [9910889, 9911594])
def test_a_step_of_impulses_goes_on_where_no_motion_is_smooth(seed):
    """A box slips on a soft corner as it tilts, a can rocks down onto its end: dop853 had stopped there."""
    _, wrong = passive.examine(passive.draw(seed))
    assert not wrong
