"""Derivatives of shipped scenarios by dual numbers, beside differences of whole runs; see `gradients.py`."""

import pytest
from budget import budget
from gradients import VALUES, look

NAMES = ["wam_slide", "planar2_drop", "soft_table", "four_bar", "wam_touchdown"]


@pytest.mark.slow
@pytest.mark.parametrize("name", budget(NAMES, [*NAMES, "push_block"]))  # whose kernels take minutes to compile
def test_derivatives_of_a_shipped_scenario(name):
    """They agree to 1e-6, or to what the differences say of themselves; those that are zero are left to differences."""
    # After 0.4 s the slip of the pushed block turns by a right angle within a step.
    count, worst, which = look(name, keys=2, values=VALUES[:1], duration=0.45 if name == "push_block" else 0.3)
    assert count["disagree"] == 0, f"{worst} {which}"
    assert count["to 1e-6"] + count["to the error"] > 0.25 * count["derivatives"] > 0
