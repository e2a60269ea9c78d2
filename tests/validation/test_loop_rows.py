"""The harness on mechanisms with loops: its cases, what agrees, and what it catches."""

import numpy as np
import pytest

from validation.loops.cases import MECHANISMS, TOUCHES, LoopFault, draw_case, oracle_of
from validation.loops.compare import FAULTS, LOOPS, Fault, compare_on_loops, plant_on_loops
from validation.report import Report
from validation.suite import faults_section


def test_every_type_of_loop_joint_is_among_the_mechanisms():
    """And the cases of one touch in every way."""
    types = {joint.type for name in MECHANISMS for joint in oracle_of(name).loops}
    assert types == {"point", "hinge", "slider", "cylinder", "universal", "planar", "weld", "distance", "gear"}
    assert tuple(draw_case("plate", 0, index).touch for index in range(3)) == TOUCHES


@pytest.mark.parametrize("name", ["bricard", "cardan", "distance", "gears", "plate", "cut_coupler"])
def test_drift_by_hand_is_the_rate_of_the_rows_by_hand(name):
    """Ȧ q̇ of a closed state, by differences along the motion that keeps it closed."""
    case, oracle = draw_case(name, 0, 0), oracle_of(name)
    h, rows = 1e-5, oracle.all_rows(case.q, case.v)
    before, after = (oracle.all_rows(case.q + s * h * case.v, case.v) for s in (-1.0, 1.0))
    for at, one, other in zip(rows, before, after, strict=True):
        slope = (other.A - one.A) @ case.v / (2.0 * h)
        np.testing.assert_allclose(at.drift, slope, atol=1e-7 * (1.0 + np.abs(at.drift).max()))


@pytest.mark.parametrize("name", ["four_bar", "bennett", "gears", "plate"])
def test_the_loop_agrees_with_the_equations_by_hand(name):
    """Both engines and the peers: all within tolerance, and nothing is left unsaid."""
    section = compare_on_loops(3, names=[name])
    decided = {check.of: check.passed for check in section.checks if check.passed is not None}
    assert all(decided.values()), [check for check in section.checks if check.passed is False]
    assert set(decided) >= set(LOOPS)
    assert all(check.note for check in section.checks)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_in_loops_is_caught(fault):
    """Far out of tolerance, in the oracle and in both engines."""
    catches = plant_on_loops(faults=[fault])
    assert [catch.engine for catch in catches] == ["oracle", *LOOPS]
    for catch in catches:
        assert catch.caught, catch
        assert catch.margin > 1e3, catch


def test_a_fault_in_loops_that_changes_nothing_is_unseen():
    """And fails the report."""
    catches = plant_on_loops(faults=[Fault("none at all", "plate", lambda oracle: oracle, LoopFault())])
    assert not any(catch.caught for catch in catches)
    assert not Report(sections=[faults_section("mechanisms", catches)]).passed
