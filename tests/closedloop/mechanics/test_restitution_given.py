"""What an impact gave of the restitution asked for: Newton's law is cut where it would create energy, and says so."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report import notes

# Slip that friction reverses: Newton's law asks for more rebound than the energy of the impact allows.
START = {
    "surface.gap": 0.0,
    "start.q": [0.21, -0.95],
    "start.v": [-0.7, -2.36],
    "friction.kind": "coulomb",
    "friction.coefficient": 0.8,
    "impact.restitution": 0.9,
    "time.duration": 0.01,
}


def first_impact(law):
    """Return the run of such a start, and its impact at t = 0."""
    run = cl.simulate(cl.load_scenario("planar2_drop", START | {"impact.law": law}))
    assert run.events[0].kind == "impact"
    assert run.event_time[0] == 0.0
    return run, run.events[0]


def test_newtons_cut_is_recorded_and_said():
    """Of 0.9 asked Newton's law gives 0.72, without a gain of energy: in the event, and in a line of the report."""
    run, event = first_impact("newton")
    assert event.restitution == pytest.approx(-event.rate_after / event.rate_before, rel=1e-12)
    assert event.restitution == pytest.approx(0.7243, abs=1e-4)
    assert abs(event.energy_lost) < 1e-12
    line = "impact.restitution = 0.9: 1 of 1 impacts gave less, at least 0.724"
    assert [note for note in notes(run) if note.startswith(line)]


@pytest.mark.parametrize("law", ["poisson", "stronge"])
def test_other_laws_give_what_is_asked(law):
    """The same impact under the other laws takes energy, gives 0.9 in their own sense, and there is nothing to say."""
    run, event = first_impact(law)
    assert event.restitution == 0.9
    assert event.energy_lost > 1e-3
    assert not [note for note in notes(run) if "impact.restitution" in note]


def test_what_is_no_bounce_has_no_restitution():
    """A touchdown gives none."""
    run = cl.simulate(cl.load_scenario("planar2_drop", START | {"impact.restitution": 0.0}))
    assert run.events[0].kind == "touchdown"
    assert not np.any(run.event_restitution)
