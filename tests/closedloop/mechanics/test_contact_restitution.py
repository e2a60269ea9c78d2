"""Each contact of a link has its own law of restitution, a user's too, where it strikes alone."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.mechanics.impact.single import Restitution


class Viscous(Restitution):
    """The faster, the less it rebounds."""

    ratio_of = "velocities"

    @staticmethod
    def coefficient(restitution, speed):
        """Return ε, which falls with the speed."""
        return restitution / (1.0 + speed)


class Endless(Restitution):
    """No coefficient at all."""

    @staticmethod
    def coefficient(restitution, speed):
        """Return more than one."""
        return 1.5


CHANGES = {"time.duration": 0.45, "time.integrator": "rk4", "impact.restitution": 0.0}


def drop(law, given="newton", **more):
    """Return the scenario of an arm whose tip drops on a plane that is a contact, with the law `given` in [impact]."""
    first = cl.load_scenario("planar2_drop")
    place = cl.Robot(cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.001}), progress=False).model)
    start = place.terms(np.array(first.start.q), np.zeros(place.n)).position
    contact = {"link": "tip", "through": [0.0, 0.0, float(start[2]) - 0.05], "friction": 0.4, "restitution": 0.5}
    given = {"surface": {"kind": "none"}, "impact.law": given, "contact": [contact]}
    return cl.load_scenario("planar2_drop", {**CHANGES, **given, "contact.0.restitution_law": law, **more})


@pytest.mark.parametrize("law", ["poisson", "stronge", "newton"])
def test_law_of_a_contact_is_that_of_impact(law):
    """Its own law and the same as `impact.law` give one motion, to the bit, and another law another one."""
    own, usual = (cl.simulate(scenario, progress=False) for scenario in (drop(law, "newton"), drop("impact", law)))
    assert np.sum(own.event_kind == 1) >= 2
    assert np.array_equal(own.q, usual.q)
    other = cl.simulate(drop("impact", "newton" if law != "newton" else "poisson"), progress=False)
    assert not np.array_equal(own.q, other.q)


def test_law_of_ones_own():
    """A user's coefficient is asked at the speed of each impact."""
    run = cl.simulate(drop(Viscous), progress=False)
    first = int(np.flatnonzero(run.event_kind == 1)[0])
    before, after = run.event_rate_before[first], run.event_rate_after[first]
    assert -after / before == pytest.approx(0.5 / (1.0 - before), rel=1e-12)
    assert any(name.endswith(":Viscous") for name in run.member_digests)


def test_what_is_wrong_with_a_law_is_said():
    """A name that there is not, and a coefficient that none may be, with the key."""
    with pytest.raises(cl.ScenarioError, match=r"contact.*restitution_law.*'impact', 'newton'"):
        drop("bouncy")
    with pytest.raises(cl.LawError, match=r"contact\.0\.restitution_law = .*Endless: its coefficient"):
        cl.simulate(drop(Endless), progress=False)
    with pytest.raises(cl.ScenarioError, match="has no class 'Bouncy'"):
        drop(f"{__name__}:Bouncy")
