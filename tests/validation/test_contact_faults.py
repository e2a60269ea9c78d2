"""What the harness catches in the impact of several contacts."""

import pytest

from validation.contacts import FAULTS, TOLERANCE, Fault, ask, cases, errors, plant_on_contacts
from validation.report import Report
from validation.suite import faults_section


def test_impacts_obey_the_laws_of_contact():
    """To rounding: opening, cone, complementarity, friction against the slip, motion."""
    for memory in cases(3):
        assert max(errors(memory, ask(memory)).values()) < 1e-2 * TOLERANCE


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_in_contacts_is_caught(fault):
    """Far out of tolerance."""
    (catch,) = plant_on_contacts(faults=[fault])
    assert catch.caught, catch
    assert catch.margin > 1e3, catch


def test_a_fault_in_contacts_that_changes_nothing_is_unseen():
    """And fails the report."""
    catches = plant_on_contacts(faults=[Fault("none at all")])
    assert not any(catch.caught for catch in catches)
    assert not Report(sections=[faults_section("several contacts", catches)]).passed
