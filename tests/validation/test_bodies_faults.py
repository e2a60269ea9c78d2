"""Free bodies and what rolls obey laws written by hand, and every fault planted in a term of theirs is caught."""

import pytest

from validation.bodies import FAULTS, TOLERANCE, Fault, errors, rows_with


def test_sound_runs_obey_the_laws():
    """Euler's equations, the quaternion's rate, momentum, free fall, rolling and pivoting."""
    found = errors(rows_with(Fault("none")))
    assert max(found.values()) < TOLERANCE, found


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_planted_fault_is_caught(fault):
    """By ten tolerances at least, but where it is a part in a thousand."""
    assert max(errors(rows_with(fault)).values()) > 5 * TOLERANCE
