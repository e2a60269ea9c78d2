"""An untouched contact changes nothing: a run with one more `[[contact]]`, 50 m away, is the run without it."""

import itertools

import numpy as np
import pytest
from budget import budget

import closedloop as cl
from closedloop.record.columns.record import COLUMNS
from robot_models import load

# To the end of what happens in each, s, where that is not 0.1 s; less where a step takes longest.
ENDS = {"wam_bounce": 0.9, "wam_liftoff": 0.4, "wam_touchdown": 0.4, "planar2_drop": 0.4, "wam_edge": 0.6,
        "panda_polish": 0.03, "panda_scan": 0.03}  # fmt: skip
# With a contact `dop853` looks for events, and closes the loops of a mechanism once more before its last row: a
# velocity that is nothing but rounding, 1e-30 rad/s, is then another of that size.
CLOSED_AGAIN = 1e-24
LAWS = ("newton", "poisson", "stronge")
SCHEMES = ("semi_implicit_euler", "rk4", "dop853")


# What the far contact may be, beside friction and restitution.
PROPERTIES = {
    "plain": {"friction": 0.7},
    "lugre": {"friction_law": {"kind": "lugre", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-2, "stiffness": 1e4,
                               "damping": 30.0}},
    "edge": {"surface": {"kind": "plane", "edge_radius": 0.1}, "rest_speed": 0.5},
    "soft": {"compliance": {"kind": "kelvin_voigt", "stiffness": 1e4},
             "motion": {"kind": "conveyor", "velocity": [1, 0, 0]}},
}  # fmt: skip


def far_contact(scenario, properties="plain"):
    """Return the section of a contact of the tip's frame that is 50 m below it, with properties of its own."""
    model = load(scenario.robot.model)
    tip = scenario.robot.tip or model.tip
    own = PROPERTIES[properties]
    return {"link": tip, "name": "far away", "through": [0, 0, -50.0], "restitution": 0.9, **own}


def both(name, changes, properties="plain"):
    """Return the run of a scenario without and with the far contact, or the refusal of it."""
    scenario = cl.load_scenario(name, changes)
    here = [each.model_dump() for each in scenario.contact or ()]
    runs = []
    for more in ([], [far_contact(scenario, properties)]):
        given = {"contact": [*here, *more]} if here or more else {}
        try:
            runs.append(cl.simulate(cl.load_scenario(name, {**changes, **given}), progress=False))
        except cl.ScenarioError as refusal:
            runs.append(str(refusal))
    return runs


def assert_same(alone, beside):
    """Every column that is recorded is the same to the bit, and so are the events; the contact stays open."""
    if isinstance(alone, str):
        assert beside == alone
        return
    assert not isinstance(beside, str), beside
    for column in COLUMNS:
        one, other = (np.asarray(getattr(run, column)) for run in (alone, beside))
        if one.ndim == 2 and other.shape[1:] != one.shape[1:]:  # of the contacts, the far one's last
            other = other[:, : one.shape[1]]
        if alone.model.loops and alone.scenario.time.integrator == "dop853":
            np.testing.assert_allclose(other, one, rtol=0.0, atol=CLOSED_AGAIN, err_msg=column)
        else:
            assert np.array_equal(one, other, equal_nan=True), column
    assert alone.stopped == beside.stopped
    if beside.scenario.contact:
        assert not np.any(beside.link_modes[:, -1])
        assert np.all(beside.link_gaps[:, -1] > 40.0)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("wam_bounce", {"impact.law": "poisson", "impact.restitution": 0.6, "time.duration": 0.9}),
        ("wam_slide", {"time.duration": 0.02}),
        ("joint_friction", {"time.duration": 0.02}),
        ("wam_stick_slip", {"time.duration": 0.02}),
    ],
)
def test_untouched_contact_changes_nothing(name, changes):
    """A selection of what `test_untouched_contact_changes_nothing_anywhere` runs."""
    assert_same(*both(name, changes))


@pytest.mark.parametrize("name", ["wam_slide", "wam_bounce", "wam_stick_slip"])
def test_stops_that_no_joint_reaches_change_nothing(name):
    """A run with stops is the run without them, to the bit."""
    ends = {"time.duration": ENDS.get(name, 0.1)}
    assert_same(*(cl.simulate(cl.load_scenario(name, {"robot.stops": stops, **ends})) for stops in (False, True)))


@pytest.mark.slow
@pytest.mark.parametrize("properties", PROPERTIES)
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("wam_edge", {"time.duration": 0.6}),
        ("wam_hybrid_friction", {"time.duration": 0.1}),
        ("panda_wipe", {"time.duration": 0.05}),
        ("wam_sphere", {"stabiliser.kind": "projection", "time.duration": 0.05}),
        ("joint_friction", {"time.duration": 0.1}),
    ],
)
def test_untouched_contact_of_any_kind_changes_nothing(name, changes, properties):
    """Whatever the far contact's law of friction, surface and compliance."""
    assert_same(*both(name, changes, properties))


@pytest.mark.slow
@pytest.mark.parametrize("name", cl.shipped_scenarios())
def test_untouched_contact_changes_nothing_anywhere(name):
    """Every shipped scenario with every integrator, with friction or without, and where it may bounce a restitution.

    Friction and laws of restitution in turn; with the full budget each with each.
    """
    scenario, place = cl.load_scenario(name), cl.shipped_scenarios().index(name)
    laws = LAWS if scenario.surface.contact == "unilateral" else LAWS[:1]
    frictions = ({}, {"friction.kind": "coulomb", "friction.coefficient": 0.3})
    compared = 0
    for k, scheme in enumerate(SCHEMES, place):
        pairs = budget([(frictions[k % 2], laws[k % len(laws)])], list(itertools.product(frictions, laws)))
        compared += sum(compare(name, law, scheme, friction) for friction, law in pairs)
    assert compared > 0, "nothing was compared"


def compare(name, law, scheme, friction):
    """Compare one scenario with the far contact and without; return whether it could be run."""
    changes = {"impact.law": law, "time.integrator": scheme, "time.duration": ENDS.get(name, 0.1), **friction}
    alone, beside = both(name, changes)
    assert_same(alone, beside)
    return not isinstance(alone, str)


@pytest.mark.parametrize(
    ("name", "law", "restitution", "friction"),
    [
        ("planar2_drop", "poisson", 0.5, 0.4),
        pytest.param("wam_bounce", "newton", 0.6, 0.3, marks=pytest.mark.slow),
        pytest.param("wam_bounce", "stronge", 0.6, 0.3, marks=pytest.mark.slow),
    ],
)
def test_contact_of_a_link_strikes_as_the_tip_does(name, law, restitution, friction):
    """A point of the tip's frame on the tip's plane bounces, with friction, as the tip does: by `impact.law`.

    An impact is applied on either side of an instant known to 1e-14 s, and the small ones at the end follow from that.
    """
    changes = {"impact.law": law, "time.duration": 0.6, "time.integrator": "rk4"}
    rubs = {"impact.restitution": restitution, "friction.kind": "coulomb", "friction.coefficient": friction}
    tip = cl.simulate(cl.load_scenario(name, changes | rubs), progress=False)
    through = tip.position[0] - tip.closure_error[0] * tip.surface_normal[0]
    contact = far_contact(tip.scenario) | {
        "normal": tip.surface_normal[0].tolist(), "through": through.tolist(),
        "friction": friction, "restitution": restitution,
    }  # fmt: skip
    link = cl.simulate(cl.load_scenario(name, changes | {"surface.gap": 50.0, "contact": [contact]}), progress=False)
    assert np.sum(tip.event_kind == 1) >= 2
    assert link.event_kind.tolist() == tip.event_kind.tolist()
    assert np.all(link.event_contact == 1)
    for column in ("event_time", "event_rate_after", "event_compression", "event_decompression", "event_restitution"):
        np.testing.assert_allclose(getattr(link, column), getattr(tip, column), rtol=1e-7, atol=5e-8, err_msg=column)
    np.testing.assert_allclose(link.v, tip.v, atol=1e-7)
