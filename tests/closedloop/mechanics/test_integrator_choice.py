"""The integrator that a scenario gets if it names none, and what it is worth at impacts."""

import numpy as np
import pytest
from budget import budget

import closedloop as cl
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS
from closedloop.record.report import notes
from closedloop.scenario.load import parse_scenario, shipped_scenarios
from closedloop.scenario.messages import explain_key

DAHL = '[friction]\nkind = "dahl"\ncoefficient = 0.2\nstiffness = 1e4'
WITH_IMPACTS = ("wam_bounce", "planar2_drop", "wam_touchdown", "panda_touchdown", "wam_edge", "wam_liftoff")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[surface]\nkind = "plane"', "semi_implicit_euler"),
        ("", "rk4"),  # nothing holds the tip
        ('[surface]\ncontact = "unilateral"', "rk4"),
        ('[surface]\ncontact = "unilateral"\n[time]\nintegrator = "auto"', "rk4"),
        ('[surface]\ncontact = "unilateral"\n[time]\nintegrator = "explicit_euler"', "explicit_euler"),
        (f'[surface]\ncontact = "unilateral"\n{DAHL}', "semi_implicit_euler"),
    ],
)
def test_a_scenario_without_an_integrator_gets_one_that_fits(text, expected):
    """The paper's where contact is held, rk4 where there may be impacts; what is chosen is what the scenario says."""
    scenario = parse_scenario(f"{text}\n[law]\nkp = 1\nkd = 1")
    assert scenario.time.integrator == expected
    assert parse_scenario(scenario.to_toml()) == scenario
    assert f'integrator = "{expected}"' in scenario.to_toml()


def test_help_says_the_orders():
    """The order of every integrator is in its help, and "auto" with its rule."""
    line = " ".join(explain_key("time.integrator").split())
    for name, scheme in (*INTEGRATORS.items(), *ADAPTIVE.items()):
        assert f"{name} (order {scheme.order}" in line
    assert "auto: rk4 where surface.contact is unilateral" in line


def test_shipped_scenarios_that_may_leave_run_with_rk4():
    """All of them, and no other is unilateral."""
    loaded = [cl.load_scenario(name) for name in shipped_scenarios()]
    unilateral = {scenario.name for scenario in loaded if scenario.surface.contact == "unilateral"}
    without = {"gripper_gear", "gripper_block", "cube_toss", "ball_on_turntable", "tower", "push_block", "hand_turns",
               "hand_rolls", "quadruped"}  # a surface  # fmt: skip
    pressing = {"panda_scan", "panda_polish", "fr3_press", "four_bar", "two_arms_bar", "hidden_bump"}
    assert unilateral == {*WITH_IMPACTS, *pressing, *without}
    assert {cl.load_scenario(name).time.integrator for name in unilateral} == {"rk4"}


# wam_bounce, planar2_drop: 1.3e-9 and 4e-11 s were measured; the touchdowns under PD gains, 1.7e-7 and 4.7e-7 s.
BOUNDS = {"wam_bounce": 1e-8, "planar2_drop": 1e-9}


@pytest.mark.slow
@pytest.mark.parametrize("name", WITH_IMPACTS)
def test_as_shipped_all_events_are_there(name, shipped_run):
    """Every event of dop853 at 1e-12 is there, at its instant, to a microsecond or better.

    dop853 goes on for 0.05 s after the last event, with the full budget to the end.
    """
    run = shipped_run(name)
    ends = budget(min(round(run.event_time[-1] + 0.05, 3), run.scenario.time.duration), run.scenario.time.duration)
    truth = cl.simulate(cl.load_scenario(name, {"time.integrator": "dop853", "time.duration": ends}))
    assert np.array_equal(run.event_kind, truth.event_kind)
    assert np.max(np.abs(run.event_time - truth.event_time)) < BOUNDS.get(name, 1e-6)
    if name == "wam_bounce":
        assert len(run.events) == 23


def test_the_report_says_what_order_one_is_worth(shipped_run):
    """With semi-implicit Euler a run with impacts carries a note; with rk4 none."""
    short = {"time.duration": 0.3}
    first = cl.simulate(cl.load_scenario("planar2_drop", short | {"time.integrator": "semi_implicit_euler"}))
    fourth = cl.simulate(cl.load_scenario("planar2_drop", short))
    assert len(first.events) == len(fourth.events) == 1
    assert [note for note in notes(first) if "is of order 1" in note]
    assert not [note for note in notes(fourth) if "order" in note]
