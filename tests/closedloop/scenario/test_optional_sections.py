"""A scenario without [surface], [reference] or [law]: bodies under gravity and what touches them, and no torque."""

import itertools
import json
import tomllib

import numpy as np
import pinocchio as pin
import pytest
import tomli_w
from budget import budget, others

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.record.columns.record import SURFACE_COLUMNS
from closedloop.record.report.measures import MEASURES
from closedloop.scenario.load import parse_scenario, scenario_text

FALLS = '[robot]\nmodel = "wam4"\n[time]\nduration = 0.05\n'
OPTIONAL = ("surface", "reference", "law")


def without(name, sections, duration=0.02):
    """Return the shipped scenario without some sections, as its file would be read."""
    data = tomllib.loads(scenario_text(name)[0])
    for section in (*sections, *(["belief"] if "surface" in sections else [])):  # a belief in another surface
        data.pop(section, None)
    data["time"]["duration"] = duration
    return parse_scenario(tomli_w.dumps(data), name)


@pytest.fixture(scope="module")
def fall():
    """Return the run of an arm of which nothing is said but its name."""
    return cl.simulate(parse_scenario(FALLS, "falls"), progress=False)


def test_arm_without_law_falls_as_pinocchio_says(fall):
    """Without law and surface q̈ is that of forward dynamics with Q = 0, in every row; energy is kept."""
    model = fall.model.pinocchio_model()
    data = model.createData()
    expected = [pin.aba(model, data, q, v, np.zeros(model.nv)) for q, v in zip(fall.q, fall.v, strict=True)]
    assert np.max(np.abs(expected)) > 1.0
    np.testing.assert_allclose(fall.acceleration, expected, rtol=1e-10, atol=1e-10)
    assert not np.any(fall.torque)
    energy = fall.kinetic_energy + fall.potential_energy
    np.testing.assert_allclose(energy, energy[0], atol=1e-9)


def test_report_says_nothing_of_a_contact_that_there_is_not(fall, tmp_path):
    """No value, column, row of the report or panel is about a surface; the attributes answer that nothing acts."""
    summary = fall.summary()
    assert summary["verdict"]["good"]
    assert summary["control_verdict"]["good"]
    for name in ("final_contact_force", "max_abs_closure_error", "deepest_penetration", "rms_path_error"):
        assert name in MEASURES
        assert summary[name] is None
    assert summary["max_tip_speed"] > 0.0
    assert not {*SURFACE_COLUMNS} & {*fall.specs, *fall.to_xarray().data_vars}
    for name in SURFACE_COLUMNS:
        assert np.any(getattr(fall, name)) == (name == "surface_normal")
    again = cl.load_run(fall.save(tmp_path / "run.nc"))
    assert json.dumps(again.summary()) == json.dumps(summary)
    assert np.array_equal(again.contact_force, np.zeros(len(fall)))
    titles = [axes.get_title() or axes.get_title(loc="left") for axes in fall.plot().axes]
    assert titles == ["Path, seen from above"]


def test_scenario_without_sections_is_written_and_read_again():
    """`to_toml` gives the same scenario back."""
    scenario = parse_scenario(FALLS, "falls")
    assert parse_scenario(scenario.to_toml(), "falls") == scenario
    assert not scenario.has_surface
    assert not scenario.has_law


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
def test_engines_agree_without_sections(engine, fall):
    """Both engines give one fall."""
    other = cl.simulate(fall.scenario, progress=False, engine=engine)
    np.testing.assert_allclose(other.q, fall.q, atol=1e-12)


def test_law_presses_with_no_force_unless_asked():
    """Without a surface the default of 10 N does not act; a force that is given acts against `surface.normal`."""
    law = {"law.kind": "paper", "law.kp": [0.0] * 4, "law.kd": [0.0] * 4}
    still = cl.simulate(parse_scenario(FALLS, "falls", overrides=law), progress=False)
    np.testing.assert_allclose(still.v, 0.0, atol=1e-12)  # gravity is compensated, and nothing presses
    pushed = cl.simulate(parse_scenario(FALLS, "falls", overrides={**law, "law.force": 3.0}), progress=False)
    terms = cl.Robot(pushed.model).terms(pushed.q[0], pushed.v[0])
    np.testing.assert_allclose(pushed.torque[0] - terms.bias, -3.0 * terms.jacobian[2], atol=1e-12)
    assert [problem["name"] for problem in pushed.summary()["control_verdict"]["problems"]] == ["no_contact"]


def test_simulator_and_batch_go_without_sections():
    """The stepped simulator has an infinite gap; a table's values of the contact are null."""
    scenario = parse_scenario(FALLS, "falls")
    state = cl.Simulator(scenario).reset()
    assert state.gap == np.inf
    assert state.f == 0.0
    table = cl.simulate_batch(scenario, {"time.step": [0.001, 0.002]}, keep=["e", "q"])
    assert table["verdict"].to_pylist() == ["good", "good"]
    assert table["max_abs_closure_error"].null_count == 2
    assert np.all(np.isfinite(table["max_tip_speed"].to_numpy()))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"surface.kind": "none", "surface.contact": "bilateral"}, "surface.contact"),
        ({"law.kind": "none", "law.force": 5.0}, "law.force"),
    ],
)
def test_what_says_nothing_is_refused(changes, said):
    """A key that needs what there is not names itself."""
    with pytest.raises(ScenarioError, match=said):
        parse_scenario(FALLS, "falls", overrides=changes)


# Of those whose robot is a file beside them the text alone does not say where that is.
OF_SHIPPED_ROBOTS = [
    name
    for name in cl.shipped_scenarios()
    if name != "panda_polish" and not cl.load_scenario(name).robot.model.endswith(".xml")
]


@pytest.mark.parametrize("name", others(OF_SHIPPED_ROBOTS))
def test_every_shipped_scenario_runs_without_sections(name):
    """Each of the three sections may be left out, alone and with the others; with the full budget in pairs, too."""
    for gone in (one for k in budget((1, 3), (1, 2, 3)) for one in itertools.combinations(OPTIONAL, k)):
        run = cl.simulate(without(name, gone), progress=False)
        assert run.stopped is None
        if "law" in gone and run.scenario.compensation.kind == "none":
            assert not np.any(run.torque)
        assert run.summary()["verdict"] is not None
