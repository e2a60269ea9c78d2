"""What a run of free bodies says of itself, and what is asked about it."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.record.report.tables import report_rows
from closedloop.scenario.load import parse_scenario
from closedloop.studies.gradient.differences import Keys

BOX = """
[robot]
model = "none"
[[body]]
name = "box"
shape = "box"
edges = [0.2, 0.2, 0.08]
mass = 1.3
[[contact]]
name = "foot"
link = "box"
at = [[-0.1, -0.1, -0.04], [-0.1, 0.1, -0.04], [0.1, -0.1, -0.04], [0.1, 0.1, -0.04]]
[time]
duration = 0.5
step = 0.001
integrator = "rk4"
"""


def test_friction_of_contacts_takes_the_energy_of_a_slide():
    """A box with 1 m/s comes to rest: friction takes ½ m v², and the error of the energy stands beside what it had."""
    scenario = parse_scenario(
        BOX, overrides={"body.box.velocity": [1, 0, 0], "body.box.position": [0, 0, 0.04], "contact.*.friction": 0.3}
    )
    run = cl.simulate(scenario)
    assert np.max(np.abs(run.v[-1])) < 1e-12
    assert run.summary()["energy_lost_to_friction"] == pytest.approx(0.65, rel=1e-5)
    table = cl.simulate_batch(scenario, {"body.box.mass": [1.3, 2.6]})  # sums its rows in another way
    np.testing.assert_allclose(table["energy_lost_to_friction"].to_pylist(), [0.65, 1.3], rtol=1e-5)
    rows = {row[0]: row[1:] for row in report_rows(run)}
    assert rows["energy unaccounted for"][2] == "of 1.3 J exchanged"
    assert rows["energy lost to friction"][0] == "0.65"
    assert rows["energy grows by"] == (f"{run.summary()['energy_gained']:.2g}", "J", "of 1.3 J; nothing drives it")
    belt = {"contact.*.motion": {"kind": "conveyor", "velocity": [0.1, 0.0, 0.0]}, "body.box.position": [0, 0, 0.04]}
    moved = cl.simulate(parse_scenario(BOX, overrides=belt | {"time.duration": 0.01}))
    assert "energy grows by" not in {row[0] for row in report_rows(moved)}


def test_a_derivative_may_be_with_respect_to_a_key_of_a_table():
    """Keys of bodies and contacts are named as overrides name them; of several tables they have to agree."""
    scenario = parse_scenario(BOX, overrides={"contact.*.friction": 0.3, "contact.foot 1.restitution": 0.5})
    keys = Keys(scenario, ["body.box.mass", "body.0.position", "contact.foot.friction"])
    assert {name: value.tolist() for name, value in keys.values.items()} == {
        "body.box.mass": 1.3, "body.0.position": [0.0, 0.0, 0.0], "contact.foot.friction": 0.3,
    }  # fmt: skip
    changed = keys.scenario_at({keys.directions[-1]: 0.1})
    assert [each.friction for each in changed.contact] == [pytest.approx(0.4)] * 4
    with pytest.raises(cl.ScenarioError, match=r"contact\.\*\.restitution: these have different values"):
        Keys(scenario, ["contact.*.restitution"])
    with pytest.raises(cl.ScenarioError, match="there is no contact 'hand'"):
        Keys(scenario, ["contact.hand.friction"])


def test_bodies_alone_have_no_force_loop():
    """The refusal says that there is no surface, not that a tip which there is not is in flight."""
    scenario = parse_scenario(BOX, overrides={"body.box.position": [0.0, 0.0, 1.0], "time.duration": 0.1})
    with pytest.raises(cl.ScenarioError, match=r"linearise: the scenario has no \[surface\]"):
        cl.linearise(scenario)
