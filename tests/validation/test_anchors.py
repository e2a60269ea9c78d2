# ruff: noqa: D102, D103 - the methods bear the names of those of validation.oracle.Oracle; helpers are a line each.
"""The reference problems: two engines that share no code pass them, a flaw in robot or engine does not."""

import re
from dataclasses import replace
from functools import cache
from importlib.resources import files

import numpy as np
import pytest
from budget import every
from pinocchio_reference import PinocchioEngine

from validation.anchors import Case, ReferenceProblem, grade, grade_all, reference_problems
from validation.anchors.problem import Robot, read
from validation.anchors.quantities import QUANTITIES
from validation.engines.hand_written import HandWritten
from validation.engines.interface import CannotBuild
from validation.oracle import Oracle

PROBLEMS = {problem.name: problem for problem in reference_problems()}
JSON = sorted(path.name for path in files("validation.anchors").iterdir() if path.name.endswith(".json"))


class Pinocchio(PinocchioEngine):
    """Pinocchio, whose Jacobian of a single joint comes without its second axis."""

    def jacobian(self, q):
        import pinocchio as pin

        J = pin.computeFrameJacobian(self.model, self.data, self._q(q), self.frame, pin.LOCAL_WORLD_ALIGNED)
        return np.reshape(J, (6, self.model.nv))[:3, self.columns]


ENGINES = {"oracle": Oracle.from_model, "pinocchio": Pinocchio}


@cache
def grades(engine, name):
    return grade(ENGINES[engine], PROBLEMS[name])


def altered(problem, **changes):
    """Return the problem with a robot whose text, armature or gravity is another."""
    model = problem.model
    names = ("name", "text", "joint_names", "armature", "tip", "gravity", "format", "locked")
    return replace(problem, model=Robot(**{name: getattr(model, name) for name in names} | changes))


@pytest.mark.parametrize(
    ("name", "engine"),
    [*((name, "oracle") for name in PROBLEMS), *every(3, [(name, "pinocchio") for name in PROBLEMS])],
)
def test_passes_every_case(engine, name):
    """Both engines have every quantity, and each is within its tolerance."""
    results = grades(engine, name)
    assert len(results) == len(PROBLEMS[name].cases) > 0
    assert [result for result in results if not (result.covered and result.passed and result.ratio <= 1.0)] == []


def test_counts():
    """Nothing is green because nothing ran; every quantity is asked for somewhere."""
    results = [result for name in PROBLEMS for result in grades("oracle", name)]
    assert len(PROBLEMS) == 19
    assert len(results) == 103
    assert {result.quantity for result in results} == set(QUANTITIES)


def all_passed(problem):
    """Whether the oracle of this robot passes every case; motions come last, and the first failure ends it."""
    moved = ("free_positions", "swing_period", "impact_times")
    cases = sorted(problem.cases, key=lambda case: case.quantity in moved)
    return all(result.passed for case in cases for result in grade(Oracle.from_model, replace(problem, cases=(case,))))


@pytest.mark.parametrize("flaw", ["mass", pytest.param("gravity", marks=pytest.mark.slow)])
def test_flawed_robots_fail(flaw):
    """One per cent more mass everywhere, or a thousandth more gravity, is seen wherever it changes the motion."""
    unseen = set()
    for name, problem in PROBLEMS.items():
        text = re.sub(
            r'<mass value="([^"]+)"', lambda found: f'<mass value="{1.01 * float(found[1])!r}"', problem.model.text
        )
        changes = {"mass": {"text": text}, "gravity": {"gravity": problem.model.gravity * 1.001}}
        if all_passed(altered(problem, **changes[flaw])):
            unseen.add(name)
    blind = {
        # Free fall does not depend on the mass; without gravity, or with the mobility alone, gravity is not asked for.
        "mass": {name for name in PROBLEMS if name.startswith("bouncing ball")},
        "gravity": {name for name, problem in PROBLEMS.items() if not np.any(problem.model.gravity)} | {"Painlevé rod"},
    }
    assert unseen == blind[flaw]
    assert len(PROBLEMS) > 2 * len(unseen)


class Sloppy(Oracle):
    """An engine with an error of one part in a million in its velocity terms, none elsewhere."""

    def bias(self, q, v):
        still = super().gravity_term(q)
        return still + 1.000001 * (super().bias(q, v) - still)


def test_velocity_terms_are_graded():
    """A Coriolis term that is off by 1e-6 is seen by the closed form in motion, not by a state at rest."""
    failed = {result.case for result in grade(Sloppy.from_model, PROBLEMS["planar arm"]) if not result.passed}
    assert failed >= {"bias, state 2", "bias, state 3"}
    assert {name for name in failed if "contact force in motion" in name}
    assert [name for name in failed if "state 1" in name or "at rest" in name] == []


@pytest.mark.parametrize("file", JSON)
def test_every_file_names_its_source(file):
    """Every published value names its source."""
    published = read(file.removesuffix(".json"))
    assert len(published["source"]) > 60
    assert len(published["convention"]) > 20


def test_every_file_is_used():
    """By the problem that has its source, or by the mechanisms with loops, see `validation.loops.andrews`."""
    mechanisms = {"andrews.json", "n_four_bar.json"}
    assert set(JSON) > mechanisms
    sources = {read(file.removesuffix(".json"))["source"] for file in set(JSON) - mechanisms}
    assert sources == {p.source for p in PROBLEMS.values()}


def test_every_tolerance_has_its_argument():
    """An argument is a sentence, and says what dominates the error."""
    cases = [case for problem in PROBLEMS.values() for case in problem.cases]
    assert cases
    assert [case.name for case in cases if len(case.argument.split()) < 8] == []


def case(**changes):
    given = {"q": np.zeros(1)}
    fields = {
        "name": "c",
        "quantity": "position",
        "inputs": given,
        "expected": np.zeros(3),
        "tolerance": np.array(1e-9),
    }
    return Case(**fields | {"argument": "because"} | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"argument": " "}, "needs its argument"),
        ({"tolerance": np.array(0.0)}, "finite and positive"),
        ({"tolerance": np.array(np.inf)}, "finite and positive"),
        ({"expected": np.zeros(0)}, "no entries"),
        ({"expected": np.array([0.0, np.nan, 0.0])}, "not finite"),
        ({"quantity": "colour"}, "is not one of"),
    ],
)
def test_refuses_a_case_that_says_nothing(changes, message):
    """A case that every engine would pass, or none, is no case."""
    with pytest.raises(ValueError, match=message):
        case(**changes)


def test_refuses_a_problem_without_source_or_cases():
    """Both are what makes it a reference."""
    model = PROBLEMS["physical pendulum"].model
    with pytest.raises(ValueError, match="source"):
        ReferenceProblem("p", "", model, "tip", (case(),))
    with pytest.raises(ValueError, match="needs cases"):
        ReferenceProblem("p", "somebody", model, "tip", ())
    with pytest.raises(ValueError, match="name of its own"):
        ReferenceProblem("p", "somebody", model, "tip", (case(), case()))


def test_expected_cannot_be_changed():
    """The values are shared by all who grade."""
    one = case()
    with pytest.raises(ValueError, match="read-only"):
        one.expected[0] = 1.0
    with pytest.raises(TypeError):
        one.inputs["q"] = np.ones(1)


class Nothing:
    """An engine that offers nothing."""

    def __init__(self, model, tip):
        pass


def test_what_an_engine_lacks_is_not_passed():
    """An engine without methods covers nothing and passes nothing."""
    results = grade_all(Nothing, PROBLEMS.values())
    assert len(results) == 103
    assert not any(result.covered or result.passed for result in results)
    assert all(result.error == np.inf and "has no method" in result.reason for result in results)


class OnlyPlaces(Nothing):
    """An engine that knows where its tip is, and says NaN."""

    def position(self, q):
        return np.full(3, np.nan)


class WrongShape(Nothing):
    """An engine that returns the position as a column."""

    def position(self, q):
        return np.zeros((3, 1))


class Singular(Nothing):
    """An engine that gives up."""

    def position(self, q):
        raise np.linalg.LinAlgError("singular")


@pytest.mark.parametrize(
    ("engine", "reason"), [(OnlyPlaces, "not finite"), (WrongShape, "shape"), (Singular, "LinAlgError: singular")]
)
def test_an_unusable_answer_fails(engine, reason):
    """It counts as covered, with an infinite error."""
    results = [r for r in grade(engine, PROBLEMS["planar arm"]) if r.quantity == "position"]
    assert len(results) == 3
    for result in results:
        assert result.covered
        assert not result.passed
        assert result.error == np.inf
        assert reason in result.reason


@pytest.mark.parametrize("refusal", [NotImplementedError, CannotBuild])
def test_an_engine_that_refuses_the_robot_covers_nothing(refusal):
    """Its reason is in every grade."""

    def refusing(model, tip):
        raise refusal("no slides here")

    results = grade(refusing, PROBLEMS["inclined plane"])
    assert {result.reason for result in results} == {"no slides here"}
    assert not any(result.covered or result.passed for result in results)


@pytest.mark.slow
def test_an_engine_class_of_the_harness_can_be_graded():
    """Its names for q̈ are understood, and what it refuses by name falls back on its own terms."""
    results = grade_all(HandWritten, PROBLEMS.values())
    assert [result.quantity for result in results if not result.covered] == ["coriolis_matrix"]
    assert [result for result in results if result.covered and not result.passed] == []


class Bare:
    """The four terms of Eq. 24 and nothing else."""

    def __init__(self, model, tip):
        oracle = Oracle.from_model(model, tip)
        self.mass_matrix, self.bias, self.position = oracle.mass_matrix, oracle.bias, oracle.position
        self.jacobian, self.drift = oracle.jacobian, oracle.drift


@pytest.mark.slow
def test_the_terms_of_the_equation_are_enough():
    """H, C, r, J and the drift answer for everything but the Coriolis matrix, of which C holds only the product."""
    results = grade_all(Bare, PROBLEMS.values())
    assert {result.quantity for result in results if not result.covered} == {"coriolis_matrix"}
    assert [result for result in results if result.covered and not result.passed] == []
