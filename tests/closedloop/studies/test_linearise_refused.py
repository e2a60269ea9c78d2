"""Where a run has no linear loop, and why: events, stops, contacts without modes, wrong names."""

import pytest
from linear_loops import mass_on_a_spring

import closedloop as cl
from closedloop.simulation.engines.loops import PINOCCHIO
from closedloop.simulation.loop_calls import Stepper
from closedloop.simulation.prepare import prepare
from closedloop.studies.analysis.here import contacts_of


@pytest.mark.parametrize(
    ("name", "changes", "at", "why"),
    [
        ("wam_touchdown", {}, 0.01, "the tip is in flight at t = 0.01 s"),
        ("wam_slide", {}, 9.0, "at = 9 s: must be within the run, 0 to time.duration = 8 s"),
        ("wam_slide", {}, -1.0, "at = -1 s: must be within the run"),
        ("cube_toss", {}, 0.1, "no \\[surface\\], and no contact of a link is closed at t = 0.1 s: without a contact"),
        ("push_block", {"contact.foot 2.rolling": 1e-3}, 0.1, "contact 'foot 2' resists rolling or pivoting, which is"),
        ("push_block", {"contact.foot 2.friction": 0.0, "contact.foot 2.friction_law": {
            "kind": "dahl", "coefficient": 0.4, "stiffness": 1e4}}, 0.1,
         "contact 'foot 2' is closed, whose friction has a memory"),
        ("hidden_bump", {"compensation.kind": "normal", "time.duration": 0.2}, 0.1, "'normal' reads forces along"),
        ("wam_slide", {"drives.torque_limit": 1.0}, 1.0, "the drive of joint J[1-4] is at its limit at t = 1 s"),
    ],
)  # fmt: skip
def test_where_there_is_no_linear_loop(name, changes, at, why):
    """It is said in one line."""
    with pytest.raises(cl.ClosedLoopError, match=why) as caught:
        cl.linearise(cl.load_scenario(name, changes), at=at)
    assert "\n" not in str(caught.value)


def test_at_an_impact_and_beyond_the_end_of_a_run():
    """The instant of an event is refused, with the event's name; so is one that the run does not come to."""
    scenario = cl.load_scenario("wam_touchdown")
    event = cl.simulate(scenario, progress=False).events[0]
    with pytest.raises(cl.SimulationError, match=f"within a step of an event \\({event.kind} at"):
        cl.linearise(scenario, at=event.time)
    stops = cl.load_scenario("wam_slide", {"law.kd": [-60.0, -60.0, -30.0, -20.0]})
    with pytest.raises(cl.SimulationError, match="the run stops before t = 7 s"):
        cl.linearise(stops, at=7.0)


def test_at_a_stop_that_holds_a_joint():
    """A joint at its stop is refused by its name; before it comes there it is not."""
    scenario = mass_on_a_spring(
        robot__stops=True, start__q=[9.99, 0.0, 0.0], start__v=[0.5, 0.0, 0.0], law__kp=[0.0] * 3, law__kd=[0.0] * 3
    )
    with pytest.raises(
        cl.SimulationError, match=r"^linearise: at t = 0\.09 s joint X is at its stop, which is not lin"
    ):
        cl.linearise(scenario, at=0.09)
    assert len(cl.linearise(scenario, at=0.01).states) > 0


def test_at_a_stop_beside_a_closed_contact_and_beside_an_event():
    """A stop that is held is refused where links touch, too; within a step of its impact the impact is named."""
    held = {"robot__stops": True, "start__q": [9.99, 0.0, 0.0], "law__kp": [0.0] * 3, "law__kd": [0.0] * 3}
    cube = {"name": "cube", "shape": "box", "edges": [0.1, 0.1, 0.1], "mass": 1.0, "position": [2.0, 2.0, 0.05]}
    foot = {"link": "cube", "at": [[x, y, -0.05] for x in (-0.05, 0.05) for y in (-0.05, 0.05)], "friction": 0.5}
    beside = {"body": [cube], "contact": [foot], "time__integrator": "rk4", "start__v": [0.5] + [0.0] * 8}
    scenario = mass_on_a_spring(**held | beside)
    with pytest.raises(
        cl.SimulationError, match=r"^linearise: at t = 0\.09 s joint X is at its stop, which is not lin"
    ):
        cl.linearise(scenario, at=0.09)
    impact = next(event for event in cl.simulate(scenario, progress=False).events if event.time > 0.0)
    with pytest.raises(cl.SimulationError, match=rf"within a step of an event \({impact.kind} at"):
        cl.linearise(scenario, at=impact.time)


def test_contacts_without_modes():
    """Where the forces of contacts are those of a time step there is no linear loop, and it is said."""
    problem = prepare(cl.load_scenario("push_block"))
    stepper = Stepper(problem, PINOCCHIO)
    stepper.let(None)
    stepper.to_row()
    assert contacts_of(problem, stepper.loop, 0.1)
    stepper.loop.w.kept["contacts"].links.undecided = 1
    with pytest.raises(cl.SimulationError, match=r"^linearise: at t = 0\.1 s no modes of the contacts are found"):
        contacts_of(problem, stepper.loop, 0.1)


def test_a_contact_that_binds_the_tip_once_more():
    """Of a tip that a contact of its link holds in the same plane f is not unique: it is refused in one line."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.2})
    z = cl.simulate(scenario, progress=False).position[0, 2]
    again = [{"link": "tip", "at": [0.0, 0.0, 0.0], "through": [0.0, 0.0, float(z)]}]
    twice = cl.load_scenario("wam_slide", {"time.duration": 0.2, "contact": again})
    with pytest.raises(
        cl.SimulationError, match=r"^linearise: the tip's contact binds what other contacts or loops bind"
    ):
        cl.linearise(twice, at=0.1)
