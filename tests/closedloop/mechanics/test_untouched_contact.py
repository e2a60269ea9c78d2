"""An untouched contact changes nothing: a run with one more `[[contact]]`, 50 m away, is the run without it."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.columns.record import COLUMNS
from robot_models import load

# What the far contact may be, beside friction and restitution.
PROPERTIES = {
    "plain": {"friction": 0.7},
    "lugre": {"friction_law": {"kind": "lugre", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-2, "stiffness": 1e4,
                               "damping": 30.0}},
    "edge": {"surface": {"kind": "plane", "edge_radius": 0.1}, "rest_speed": 0.5},
    "soft": {"compliance": {"kind": "kelvin_voigt", "stiffness": 1e4},
             "motion": {"kind": "conveyor", "velocity": [1, 0, 0]}},
}  # fmt: skip


def with_far_contact(scenario, properties):
    """Return a scenario with one more contact, of the tip's frame, 50 m below it, with properties of its own."""
    link = scenario.robot.tip or load(scenario.robot.model).tip
    far = {"link": link, "name": "far away", "through": [0, 0, -50.0], "restitution": 0.9, **PROPERTIES[properties]}
    return scenario.replace({"contact": [*(each.model_dump() for each in scenario.contact or ()), far]})


def assert_same(alone, beside):
    """Every column that is recorded is the same to the bit, and so are the events; the contact stays open."""
    for column in COLUMNS:
        one, other = (np.asarray(getattr(run, column)) for run in (alone, beside))
        if one.ndim == 2 and other.shape[1:] != one.shape[1:]:  # of the contacts, the far one's last
            other = other[:, : one.shape[1]]
        assert np.array_equal(one, other, equal_nan=True), column
    assert alone.stopped == beside.stopped
    if beside.scenario.contact:
        assert not np.any(beside.link_modes[:, -1])
        assert np.all(beside.link_gaps[:, -1] > 40.0)


@pytest.mark.parametrize(
    ("name", "changes", "properties"),
    [
        ("wam_bounce", {"impact.law": "poisson", "impact.restitution": 0.6, "time.duration": 0.9}, "plain"),
        ("wam_slide", {"time.duration": 0.02}, "soft"),
        ("wam_slide", {"time.duration": 0.02, "time.integrator": "dop853"}, "plain"),
        ("joint_friction", {"time.duration": 0.02}, "lugre"),
        ("wam_stick_slip", {"time.duration": 0.02}, "edge"),
        ("wam_sphere", {"stabiliser.kind": "projection", "time.duration": 0.02}, "edge"),
        ("five_bar", {"time.duration": 0.02}, "lugre"),
        ("push_block", {"time.duration": 0.02}, "soft"),
    ],
)
def test_untouched_contact_changes_nothing(name, changes, properties):
    """Whatever the far contact is: beside impacts, loops, contacts that are closed, and with every integrator."""
    scenario = cl.load_scenario(name, changes)
    assert_same(cl.simulate(scenario), cl.simulate(with_far_contact(scenario, properties)))


@pytest.mark.parametrize("name", ["wam_slide", "wam_bounce", "wam_stick_slip"])
def test_stops_that_no_joint_reaches_change_nothing(name):
    """A run with stops is the run without them, to the bit."""
    ends = {"time.duration": 0.9 if name == "wam_bounce" else 0.1}
    assert_same(*(cl.simulate(cl.load_scenario(name, {"robot.stops": stops, **ends})) for stops in (False, True)))
