"""Bodies that nothing drives: seeds of `passive.py`."""

import passive
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8300016, 8200266, 8201992, 8300020, 40290071])
def test_the_adaptive_integrator_goes_on_where_a_slip_begins(seed):
    """Rims and feet that stick let go, some at the edge of their cones for a moment only, some beside soft contacts.

    In 40290071 a resistance to rolling is at its limit beside one that holds the same rotation.
    """
    _, wrong = passive.examine(passive.draw(seed))
    assert not wrong
