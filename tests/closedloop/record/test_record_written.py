"""Every number of a row is written in that row: what the memory held before is in no column."""

import numpy as np
import pytest
import tomli_w

import closedloop as cl
from closedloop.scenario.load import parse_scenario
from closedloop.simulation.engines.adaptive_parts import Memory
from closedloop.simulation.loop_calls import Stepper

ROWS = 6
DRIVES = {"drives.torque_limit": 80.0}
ENCODER = {"encoder.quantisation": 1e-5}
ELASTIC = {"transmission.stiffness": 5e4}
STATES = {"law.force_integral": 0.1, "compensation.kind": "adaptive"}
FRICTION = {"friction.kind": "coulomb", "friction.coefficient": 0.3}
KNEE = {"name": "knee", "link": "link3", "against": "world", "through": [0.0, 0.0, -2.0]}
RESISTANCES = [{}, {"rolling": 0.001}, {"pivoting": 0.002}, {"rolling": 0.001, "pivoting": 0.002}]
SOFT = {"compliance": {"kind": "kelvin_voigt", "stiffness": 1e4, "damping": 10.0}}


def arm(time, *changes):
    """Return wam_slide with these changes."""
    return cl.load_scenario("wam_slide", {key: value for each in (time, *changes) for key, value in each.items()})


def balls(time, more):
    """Return four balls that roll on floors, each with another of `RESISTANCES`."""
    body = {"shape": "ball", "radius": 0.05, "mass": 1.0, "velocity": [1.0, 0.0, 0.0], "spin": [0.0, 20.0, 3.0]}
    contact = {"at": "collision", "friction": 0.5} | more
    bodies = [body | {"name": f"b{i}", "position": [0.3 * i, 0.0, 0.05]} for i in range(len(RESISTANCES))]
    floors = [contact | {"name": f"c{i}", "link": f"b{i}"} | resists for i, resists in enumerate(RESISTANCES)]
    return parse_scenario(
        tomli_w.dumps({"robot": {"model": "none"}, "body": bodies, "contact": floors}), overrides=time
    )


SCENARIOS = {
    "paper": (arm,),
    "drives": (arm, DRIVES),
    "encoder": (arm, ENCODER),
    "elastic": (arm, ELASTIC),
    "states": (arm, STATES),
    "all of an arm": (arm, DRIVES, ENCODER, ELASTIC, STATES, FRICTION),
    "contact": (arm, FRICTION, {"contact": [KNEE]}),
    "resistance": (arm, DRIVES, STATES, {"contact": [KNEE | {"rolling": 0.001}]}),
    "balls": (balls, {}),
    "soft balls": (balls, SOFT),
}


@pytest.fixture
def poisoned(monkeypatch):
    """Fill the memory of all rows with NaN before a run."""
    real = np.empty

    def filled(*arguments, **more):
        found = real(*arguments, **more)
        if found.dtype.kind == "f":
            found.fill(np.nan)
        return found

    monkeypatch.setattr(np, "empty", filled)
    for owner in (Memory, Stepper):
        begin = owner.__init__

        def begun(self, *arguments, begin=begin):
            begin(self, *arguments)
            self.rows.fill(np.nan)

        monkeypatch.setattr(owner, "__init__", begun)


WAYS = ["rk4", "semi_implicit_euler", "compiled", "step by step", "dop853"]
CASES = [
    (name, way)
    for name in SCENARIOS
    for way in WAYS
    if way != "dop853" or not {"encoder", "all of an arm", "soft balls"} & {name}
]


@pytest.mark.parametrize(("name", "way"), CASES)
def test_every_number_of_every_row_is_written(poisoned, name, way):
    """Rows that were NaN have none left."""
    make, *changes = SCENARIOS[name]
    integrator = way if way in ("semi_implicit_euler", "dop853") else "rk4"
    time = {"time.step": 0.001, "time.duration": 0.001 * (ROWS - 1), "time.integrator": integrator}
    scenario = make(time, *changes)
    if way == "step by step":
        stepwise = cl.Simulator(scenario)
        while not stepwise.done:
            stepwise.step()
        run = stepwise.run()
    else:
        run = cl.simulate(scenario, engine="compiled" if way == "compiled" else "pinocchio", progress=False)
    assert len(run) == ROWS
    for column, values in run.columns.items():
        if values.dtype.kind == "f":
            assert np.isfinite(values).all(), column
