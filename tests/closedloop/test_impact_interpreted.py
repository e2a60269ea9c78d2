"""An impact beside stops of joints calls the loops by address, which is a number that compiled code cannot call."""

import pytest

import closedloop as cl
from closedloop.loop.events.phases import IMPACT_LAW_WANTED
from closedloop.simulation import loop_calls
from closedloop.simulation.prepare import prepare


@pytest.mark.parametrize("interpreting", [True, False])
def test_impact_has_the_form_of_the_loop_it_is_of(interpreting, monkeypatch):
    """With stops a loop that is interpreted has its impacts interpreted, though their compiled form is at hand."""
    problem = prepare(cl.load_scenario("planar2_drop", {"robot.stops": True, "time.duration": 0.01}))
    loop, called = problem.loop(), []
    monkeypatch.setattr(loop_calls, "collide", lambda address: called.append("compiled"))
    monkeypatch.setattr(loop_calls, "interpreted", lambda kernel: lambda address: called.append("interpreted"))
    answers = loop_calls.Answers(problem, loop, True, lambda: interpreting)
    loop.w.impact.before[0] = -1.0
    answers.give(IMPACT_LAW_WANTED)
    assert called == ["interpreted" if interpreting else "compiled"]
