"""The harness on curved, moving, rubbing and soft surfaces: its cases, what agrees, and what it catches."""

import numpy as np
import pytest

import robot_models
from validation.report import Report
from validation.suite import faults_section
from validation.surfaces.answers import (
    FAULTS,
    LOOPS,
    STIFFNESSES,
    SurfaceFault,
    ask_loop,
    ask_oracle,
    compare_on_surfaces,
    errors,
    plant_on_surfaces,
    soft_contact_section,
)
from validation.surfaces.cases import MATERIALS, SHAPES, SMOOTH, displacement_of, draw_case


def drawn(count, seed=0):
    """Return the first cases of a seed on the Panda."""
    model = robot_models.load("panda")
    return [draw_case("panda", model, model.tip, seed, index) for index in range(count)]


def test_cases_are_of_every_shape_and_material():
    """Thirty of them pair every shape with every material, with every motion, and some carry a tool."""
    cases = drawn(30)
    assert {(case.shape, case.material) for case in cases} == {(s, m) for s in SHAPES for m in MATERIALS}
    assert len({case.moving.kind for case in cases}) == 5
    assert 0 < sum(bool(case.tool) for case in cases) < 30
    assert str(drawn(4)[3]) == str(cases[3])
    for case in cases:
        assert abs(ask_oracle(case)[0].error) < 0.01  # near the surface


def test_the_velocity_of_a_surface_is_the_rate_of_its_displacement():
    """Of the oracle: a point carried along has the velocity and acceleration that v₀ and a₀ give it."""
    moving = drawn(5)[4].moving
    point = np.array([0.3, -0.2, 0.4])

    def at(t):
        moved = displacement_of(moving, t)
        return moved.rotation @ (point - moved.centre) + moved.centre + moved.shift[0]

    h, t = 1e-4, 0.1
    moved, x = displacement_of(moving, t), at(t)
    omega, v0, turning, a0 = *np.split(moved.velocity(), 2), *np.split(moved.acceleration(), 2)
    velocity = v0 + np.cross(omega, x)
    assert np.allclose((at(t + h) - at(t - h)) / (2 * h), velocity, rtol=0, atol=1e-7)
    acceleration = a0 + np.cross(turning, x) + np.cross(omega, velocity)
    assert np.allclose((at(t + h) - 2 * at(t) + at(t - h)) / h**2, acceleration, rtol=0, atol=1e-6)


def test_the_loop_agrees_with_the_equations_by_hand():
    """Both engines, arms and trees, and the peers that take a row: all within tolerance, and nothing is left unsaid."""
    section = compare_on_surfaces(3, 1)
    decided = {(check.name, check.of): check.passed for check in section.checks if check.passed is not None}
    assert all(decided.values()), [check for check in section.checks if check.passed is False]
    assert {of for _, of in decided} >= {*LOOPS, "mujoco", "exudyn"}
    assert all(check.note for check in section.checks)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_on_surfaces_is_caught(fault):
    """Far out of tolerance, in the oracle and in both engines."""
    catches = plant_on_surfaces(faults=[fault])
    assert [catch.engine for catch in catches] == ["oracle", *LOOPS]
    for catch in catches:
        assert catch.caught, catch
        assert catch.margin > 1e5, catch


def test_a_fault_on_surfaces_that_changes_nothing_is_unseen():
    """And fails the report."""
    none = SurfaceFault("none at all", 4, SMOOTH, lambda contact, case: contact, lambda problem, case: problem)
    catches = plant_on_surfaces(faults=[none])
    assert not any(catch.caught for catch in catches)
    assert not Report(sections=[faults_section("panda", catches)]).passed


def test_an_answer_of_no_number_is_infinitely_wrong():
    """NaN in q̈ does not pass."""
    case = drawn(1)[0]
    truth, scales, _ = ask_oracle(case)
    answer = ask_loop(case, "pinocchio")
    answer.acceleration[0] = np.nan
    assert errors(answer, truth, scales)["q̈"] == np.inf


def test_mujocos_soft_contact_is_a_spring_but_for_its_impedance():
    """At every stiffness, to rounding."""
    section = soft_contact_section(states=2)
    assert len(section.checks) == len(STIFFNESSES)
    assert all(check.passed for check in section.checks), section.checks
