"""What a reference problem is, and what a grade is.

Any engine held against the reference problems. Robots written as URDF from published parameters, in the fields that an
engine reads.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from validation.anchors.quantities import QUANTITIES, Asked, EngineFactory
from validation.engines.interface import CannotBuild
from validation.oracle.spatial import Array
from validation.oracle.tree import RobotModel


@dataclass(frozen=True, eq=False)
class Case:
    """One value, or array of values, that an engine must give.

    name: what the value is, in words
    quantity: key of `QUANTITIES`, which says how an engine is asked for it
    inputs: arguments of that quantity; SI units and radians, arrays read-only
    expected: what the source gives
    tolerance: largest accepted |error| of each entry, in the unit of `expected`; broadcast to its shape
    argument: why the tolerance is this large and not larger
    """

    name: str
    quantity: str
    inputs: Mapping[str, Array]
    expected: Array
    tolerance: Array
    argument: str

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise ValueError(f"case {self.name!r}: {self.quantity!r} is not one of {', '.join(sorted(QUANTITIES))}")
        expected = _frozen(self.expected)
        tolerance = _frozen(np.broadcast_to(np.asarray(self.tolerance, dtype=float), expected.shape))
        if expected.size == 0 or not np.all(np.isfinite(expected)):
            raise ValueError(f"case {self.name!r}: expected has no entries, or entries that are not finite")
        if not (np.all(np.isfinite(tolerance)) and np.all(tolerance > 0.0)):
            raise ValueError(f"case {self.name!r}: every tolerance must be finite and positive")
        if not self.argument.strip():
            raise ValueError(f"case {self.name!r}: a tolerance needs its argument")
        object.__setattr__(self, "expected", expected)
        object.__setattr__(self, "tolerance", tolerance)
        inputs = {name: _frozen(value) for name, value in self.inputs.items()}
        object.__setattr__(self, "inputs", MappingProxyType(inputs))


@dataclass(frozen=True, eq=False)
class ReferenceProblem:
    """A robot and what is known about it from elsewhere.

    name: short and unique
    source: citation of the values, or of the closed form
    model: the robot, in URDF, with the fields that an engine reads
    tip: link whose origin is the tip
    cases: at least one
    """

    name: str
    source: str
    model: RobotModel
    tip: str
    cases: tuple[Case, ...]

    def __post_init__(self) -> None:
        names = [case.name for case in self.cases]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"problem {self.name!r}: it needs cases, each with a name of its own")
        if not self.source.strip():
            raise ValueError(f"problem {self.name!r}: a reference needs its source")


@dataclass(frozen=True)
class Grade:
    """How an engine did in one case.

    problem, case, quantity: which case
    error: |error| of the entry with the largest ratio to its tolerance; inf if there is no answer
    tolerance: of that entry
    passed: answered, and every entry within its tolerance
    covered: the engine has the methods that the quantity needs
    reason: why it was not covered, or gave no usable answer; else empty
    """

    problem: str
    case: str
    quantity: str
    error: float
    tolerance: float
    passed: bool
    covered: bool
    reason: str = field(default="")

    @property
    def ratio(self) -> float:
        """Error over tolerance, at most 1 for a pass."""
        return self.error / self.tolerance


def _frozen(value: ArrayLike) -> Array:
    out = np.array(value, dtype=float)
    out.setflags(write=False)
    return out


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


LIMIT = 100.0
"""Wide enough that no case comes near it [rad] or [m]; URDF wants a number."""


@dataclass(frozen=True, eq=False)
class Robot:
    """What an engine reads of a robot; the same names as `robot_models.RobotModel`."""

    name: str
    text: str
    joint_names: tuple[str, ...]
    armature: Array
    tip: str
    gravity: Array
    format: str = "urdf"
    locked: Mapping[str, float] = field(default_factory=dict)


def read(name: str) -> dict[str, Any]:
    """Return the data of a reference, ``name``.json beside this file."""
    text = files("validation.anchors").joinpath(f"{name}.json").read_text(encoding="utf-8")
    return json.loads(text)


def robot(
    name: str, parts: Sequence[str], joint_names: Sequence[str], tip: str, *,
    gravity: Sequence[float] = (0.0, 0.0, -9.81), armature: Sequence[float] | Array | None = None,
) -> Robot:  # fmt: skip
    """Join links and joints to a robot; `joint_names` are the moving ones in column order."""
    text = f'<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"
    drives = np.zeros(len(joint_names)) if armature is None else np.array(armature, dtype=float)
    return Robot(name, text, tuple(joint_names), drives, tip, np.array(gravity, dtype=float))


def link(name: str, mass: float = 0.0, centre: Sequence[float] | None = None, moments: Sequence[float] = ()) -> str:
    """Return a link; `centre` (3,) of mass [m]; `moments` (3,) Ixx, Iyy, Izz about it along the link's axes [kg m²]."""
    if not mass:
        return f'<link name="{name}"/>'
    ixx, iyy, izz = (repr(float(value)) for value in moments)
    return (
        f'<link name="{name}"><inertial><origin xyz="{_vector(centre or (0.0, 0.0, 0.0))}"/>'
        f'<mass value="{float(mass)!r}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(
    name: str, kind: str, parent: str, child: str, *, xyz: Sequence[float] = (0.0, 0.0, 0.0),
    rpy: Sequence[float] = (0.0, 0.0, 0.0), axis: Sequence[float] = (0.0, 0.0, 1.0),
) -> str:  # fmt: skip
    """Return a joint of `kind` "revolute", "prismatic" or "fixed"; the child's frame sits at `xyz` [m], `rpy` [rad]."""
    moving = "" if kind == "fixed" else f'<axis xyz="{_vector(axis)}"/>{_LIMITS}'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_vector(xyz)}" rpy="{_vector(rpy)}"/>{moving}</joint>'
    )


def with_triad(tip: str) -> list[str]:
    """Return the links one metre off along the axes of `tip` that `quantities.rotation` looks at, and their joints."""
    parts = []
    for axis, unit in zip("xyz", np.eye(3), strict=True):
        parts += [link(f"{tip}_{axis}"), joint(f"{tip}_to_{axis}", "fixed", tip, f"{tip}_{axis}", xyz=unit.tolist())]
    return parts


_LIMITS = f'<limit lower="{-LIMIT}" upper="{LIMIT}" velocity="{LIMIT}" effort="1000.0"/>'


def _vector(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
