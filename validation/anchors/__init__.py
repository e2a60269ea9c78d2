"""Published reference problems: published values or closed forms, to grade any engine with.

    from validation.anchors import grade, reference_problems
    for problem in reference_problems():
        for result in grade(MyEngine, problem):   # MyEngine(model, tip): methods as validation.oracle.Oracle
            print(result)

Each problem names its source, each case the argument for its tolerance; the values lie in the JSON files beside this
one. Read `problem` first, then `quantities`, which says how an engine is asked.
"""

from functools import lru_cache

from validation.anchors.problem import Case, Grade, ReferenceProblem, grade, grade_all
from validation.anchors.quantities import QUANTITIES, Asked, EngineFactory

__all__ = [
    "QUANTITIES", "Asked", "Case", "EngineFactory", "Grade", "ReferenceProblem", "grade", "grade_all",
    "reference_problems",
]  # fmt: skip


@lru_cache(maxsize=1)
def reference_problems() -> tuple[ReferenceProblem, ...]:
    """Return all reference problems, those with printed values first."""
    from validation.anchors import closed_forms, iiwa, puma560

    return (*puma560.problems(), *iiwa.problems(), *closed_forms.problems())
