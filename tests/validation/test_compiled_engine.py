"""The compiled engine in the harness: its runs are those on Pinocchio, and a fault in its arrays shows."""

import numpy as np
import pytest
from budget import others

import closedloop as cl
import robot_models
from closedloop.mechanics.robot.tree import tree_of
from closedloop.simulation.engines.scenario_numbers import asks_for_more, is_no_papers_law
from validation.engines import CannotBuild, available
from validation.engines.loop import Compiled
from validation.engines.slides import compare_runs, faulty_tree, record, shipped, twin
from validation.plant import TREE_FAULTS

# Free, pressed and let go; an impact; a slide: one of each, in a second or less.
SHORT = [
    (
        "wam_slide",
        {"reference.direction": [0.6, 0.8, 0.0], "reference.speed": 0.1, "reference.stop": 1.0, "time.duration": 1.2},
    ),
    ("planar2_drop", {}),
    ("wam_liftoff", {}),
]
# Every joint of the WAM moves in it, and at 0.1 m/s fast enough that every constant counts.
ALL_MOVE = SHORT[0]


@pytest.mark.parametrize(("name", "overrides"), SHORT, ids=[name for name, _ in SHORT])
def test_runs_are_those_on_pinocchio(name, overrides):
    """Rows and instants of events are apart by no more than what rounding becomes."""
    checks = list(compare_runs(name, overrides))
    assert all(check.passed for check in checks), checks


@pytest.mark.parametrize("name", others(shipped()))
def test_every_shipped_scenario_is_the_same_in_both_engines(name):
    """Likewise each scenario that is shipped, friction, other laws and all; the first compiles for a minute."""
    checks = list(compare_runs(name))
    assert all(check.passed for check in checks), checks


def test_shipped_scenarios_have_the_law_in_the_loop_and_at_its_address():
    """The scenarios above exercise the paper's law on a smooth surface, and everything else."""
    scenarios = {name: cl.load_scenario(name) for name in shipped()}
    more = {name: is_no_papers_law(s.law) or asks_for_more(s) for name, s in scenarios.items()}
    assert set(more.values()) == {True, False}


@pytest.mark.parametrize("fault", TREE_FAULTS.values(), ids=TREE_FAULTS)
def test_fault_in_the_arrays_shows_in_a_run(fault):
    """A constant a millionth off puts the run out of tolerance by far; sound again, it is within."""
    with faulty_tree(fault):
        assert any(check.error > 5.0 for check in compare_runs(*ALL_MOVE))
    problem = cl.prepare(cl.load_scenario(*ALL_MOVE))
    tree = tree_of(problem.robot.model, problem.robot.tip)
    faulty = fault(tree)
    assert any(not np.array_equal(a, b) for a, b in zip(tree, faulty, strict=True))


def test_twins_part_as_rounding_does():
    """A twin is beside the run by rounding: neither the same nor visibly another."""
    problem = cl.prepare(cl.load_scenario("wam_slide", {"time.duration": 0.2}))
    run, other = record(problem, "pinocchio"), record(twin(problem, 0), "pinocchio")
    apart = np.max(np.abs(run.rows[:, :4] - other.rows[:, :4]))
    assert 0.0 < apart < 1e-12


def test_row_of_a_state_is_the_loops_own(monkeypatch):
    """q̈ and f are what the compiled loop recorded: without it, the engine has none."""
    engine = Compiled(robot_models.load("wam4"), "tip")
    x = np.full(4, 0.3)
    assert np.isfinite(engine.constrained(x, x, x, np.array([0.0, 0.0, 1.0]), 0.5)[1])

    def nothing(*arguments):
        raise RuntimeError("asked")

    monkeypatch.setattr("validation.engines.loop.run_compiled", nothing)
    with pytest.raises(RuntimeError, match="asked"):
        engine.constrained(x, x, x, np.array([0.0, 0.0, 1.0]), 0.5)


def test_joint_that_the_engine_does_not_cover_is_a_line(monkeypatch):
    """A robot that the compiled engine cannot represent stands in the report with the reason."""

    def refuse(model, tip):
        raise robot_models.ModelError("joint 'wrist' is of Pinocchio's kind Spherical")

    monkeypatch.setattr("validation.engines.loop.tree_of", refuse)
    (made,) = available(robot_models.load("wam4"), "tip", [Compiled])
    assert "wrist" in str(made)
    with pytest.raises(CannotBuild, match="Spherical"):
        Compiled(robot_models.load("wam4"), "tip")
