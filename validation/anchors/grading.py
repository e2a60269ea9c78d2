"""Any engine held against the reference problems."""

from collections.abc import Iterable

import numpy as np

from validation.anchors.asked import Asked, EngineFactory
from validation.anchors.problem import Case, Grade, ReferenceProblem
from validation.anchors.quantities import QUANTITIES
from validation.engines.interface import CannotBuild
from validation.oracle.spatial import Array


def grade(engine_factory: EngineFactory, problem: ReferenceProblem) -> list[Grade]:
    """Ask an engine for every case of a problem.

    engine_factory: (model, tip) → an object with as many methods of `validation.oracle.Oracle` as it offers, or a
        `validation.engines.Engine` class
    Returns one grade a case, in their order. A quantity that the engine has no method for, and a robot that it cannot
    build (`NotImplementedError`, `CannotBuild`), are not covered; neither they, nor NaN, nor a division by zero inside
    the engine can pass.
    """
    try:
        asked = Asked(engine_factory, problem.model, problem.tip)
    except (NotImplementedError, CannotBuild) as refusal:
        return [_none(problem, case, covered=False, reason=str(refusal)) for case in problem.cases]
    return [_grade_case(asked, problem, case) for case in problem.cases]


def grade_all(engine_factory: EngineFactory, problems: Iterable[ReferenceProblem]) -> list[Grade]:
    """Return the grades of several problems in one list."""
    return [result for problem in problems for result in grade(engine_factory, problem)]


def _grade_case(asked: Asked, problem: ReferenceProblem, case: Case) -> Grade:
    try:
        answer = np.asarray(QUANTITIES[case.quantity](asked, **case.inputs), dtype=float)
    except NotImplementedError as missing:
        return _none(problem, case, covered=False, reason=str(missing))
    except (ArithmeticError, np.linalg.LinAlgError) as failure:
        return _none(problem, case, covered=True, reason=f"{type(failure).__name__}: {failure}")
    if answer.shape != case.expected.shape:
        reason = f"its answer has shape {answer.shape}, not {case.expected.shape}"
        return _none(problem, case, covered=True, reason=reason)
    error, tolerance = _worst(np.abs(answer - case.expected), case.tolerance)
    reason = "" if np.isfinite(error) else "its answer is not finite"
    return Grade(problem.name, case.name, case.quantity, error, tolerance, error <= tolerance, True, reason)


def _worst(error: Array, tolerance: Array) -> tuple[float, float]:
    """Return error and tolerance of the entry with the largest ratio of the two; NaN counts as inf."""
    error = np.where(np.isnan(error), np.inf, error)
    at = np.unravel_index(int(np.argmax(error / tolerance)), error.shape)
    return float(error[at]), float(tolerance[at])


def _none(problem: ReferenceProblem, case: Case, *, covered: bool, reason: str) -> Grade:
    tolerance = float(np.max(case.tolerance))
    return Grade(problem.name, case.name, case.quantity, np.inf, tolerance, False, covered, reason)
