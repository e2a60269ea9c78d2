"""Every quantity of every engine, compared at the same states: the heart of the harness.

The reference computes each state once (`Truth`), every engine is asked for what it covers, and the worst error of each
quantity is kept with the state that gave it. What an engine does not cover, or an engine that is not installed, is a
cell of its own and never counts as agreement. An engine's contact force counts only after its probe has shown that its
constraint acts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import robot_models
from validation.engines import Engine, Missing, Refused, available, probe
from validation.engines.interface import METHODS, CannotBuild, NotCovered
from validation.oracle.spatial import Array
from validation.states import State, draw_state
from validation.tolerances import SOLVES, TERMS, amplification

# The rows of the report, and the method that each comes from.
QUANTITIES: dict[str, str] = {
    "H": "mass_matrix",
    "C": "bias",
    "gravity": "gravity_term",
    "r": "position",
    "J": "jacobian",
    "drift": "drift",
    "b_s": "stabilised",
    "free q̈": "free_acceleration",
    "q̈": "constrained",
    "f": "constrained",
    "v⁺": "impulse",
    "impulse": "impulse",
}
SOLVED = ("free q̈", "q̈", "f", "v⁺", "impulse")
PROBED = ("constrained", "impulse")

# s_v and s_p of the paper, 1/s and 1/s².
STABILISER = (1414.0, 1e6)

# Fifty digits take 20 ms a state, a multibody system's start-up 4 ms, Newton-Euler passes in Python 10 to 100 ms: such
# an engine is asked at the first so many states only, and the report says at how many.
MOST_STATES = {"symbolic": 50, "exudyn": 50, "robotics toolbox": 20}


@dataclass(frozen=True)
class Cell:
    """One quantity of one engine over all states.

    Attributes
    ----------
    robot, quantity, engine : str
        What was compared.
    status : str
        "agrees", "disagrees", "not covered", "not installed" or "not usable".
    reason : str
        Why, where there is no number.
    absolute, relative : float
        Worst errors; inf if a number is missing or not finite.
    tolerance : float
        The bound at the state that comes closest to it.
    margin : float
        Worst error over its bound; at most 1 for "agrees".
    state : int or None
        The state that gave it.
    states : int
        How many were compared.
    """

    robot: str
    quantity: str
    engine: str
    status: str
    reason: str = ""
    absolute: float = np.nan
    relative: float = np.nan
    tolerance: float = np.nan
    margin: float = np.nan
    state: int | None = None
    states: int = 0


@dataclass(frozen=True)
class Truth:
    """What the reference engine says of one state, and the scale and bound for each quantity."""

    values: dict[str, Array]
    scales: dict[str, float]
    bounds: dict[str, float]


@dataclass
class Comparison:
    """All cells of one robot.

    Attributes
    ----------
    robot, tip, reference : str
        Robot, tip and the engine that the others are compared with.
    seed, states : int
        What was drawn.
    cells : list of Cell
        By engine, then quantity.
    probes : dict of str to str
        Engine -> what its probe found.
    """

    robot: str
    tip: str
    reference: str
    seed: int
    states: int
    cells: list[Cell] = field(default_factory=list)
    probes: dict[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether something was compared and nothing is out of tolerance."""
        compared = [cell for cell in self.cells if cell.status in ("agrees", "disagrees")]
        return bool(compared) and all(cell.status == "agrees" for cell in compared)

    @property
    def worst(self) -> Cell | None:
        """The cell that uses the largest part of its tolerance; None if nothing was compared."""
        compared = [cell for cell in self.cells if cell.status in ("agrees", "disagrees")]
        return max(compared, key=lambda cell: cell.margin, default=None)


def compare(
    robot: Any,
    tip: str | None = None,
    *,
    states: int = 1000,
    seed: int = 0,
    only: int | None = None,
    engines: Sequence[type[Engine]] = (),
    built: Iterable[Engine | Missing | Refused] | None = None,
    judge: str = "oracle",
    label: str | None = None,
) -> Comparison:
    """Compare all engines on one robot.

    Parameters
    ----------
    robot : str or RobotModel
        A name or path for `robot_models.load`, or a model.
    tip : str, optional
        Frame to compare at; the robot's own default if left out.
    states, seed : int
        How many states are drawn, and from which seed.
    only : int, optional
        Compare at this one state of the seed instead.
    engines : sequence of Engine classes
        More engines to judge, beside those that the package knows.
    built : iterable of Engine, Missing or Refused, optional
        Engines already made for this robot, in place of all others.
    judge : str
        Name of the engine that the others are compared with; if it cannot represent the robot, the first that covers
        every quantity.
    label : str, optional
        What to call the robot in the report.

    Raises
    ------
    ModelError
        If the robot cannot be loaded or has no such tip.
    """
    model: Any = robot_models.load(robot) if isinstance(robot, str) else robot
    name = tip_of(model, tip)
    found = list(built) if built is not None else [*available(model, name), *build_all(engines, model, name)]
    ready = [engine for engine in found if isinstance(engine, Engine)]
    reference = _reference(ready, judge)
    states = 1 if only is not None else min(states, MOST_STATES.get(reference.name, states))
    result = Comparison(label or model.name, name, reference.name, seed, states)
    chosen = [only] if only is not None else list(range(states))
    drawn = [draw_state(model, reference, seed, index) for index in chosen]
    truths = _truths(reference, drawn)
    for engine in found:
        if isinstance(engine, Engine):
            if engine is not reference:
                most = MOST_STATES.get(engine.name)
                result.cells += _judge(result, engine, drawn[:most], truths[:most])
        else:
            result.cells += missing_cells(result.robot, engine)
    return result


def missing_cells(robot: str, engine: Missing | Refused) -> list[Cell]:
    """Return the cells of an engine that is not installed or cannot represent the robot, with the reason."""
    status = "not installed" if isinstance(engine, Missing) else "not usable"
    reason = engine.install if isinstance(engine, Missing) else engine.reason
    return [Cell(robot, quantity, engine.name, status, reason) for quantity in QUANTITIES]


def tip_of(model: Any, tip: str | None) -> str:
    """Return the frame to compare at: `tip`, or the robot's own.

    Raises
    ------
    ModelError
        If the robot has no such frame, or no default.
    """
    name = tip or model.tip
    if name is None:
        raise robot_models.ModelError(f"{model.name} has no default tip: name one of {', '.join(model.frames)}")
    return str(model.require_frame(name)) if hasattr(model, "require_frame") else str(name)


def build_all(classes: Sequence[type[Engine]], model: Any, tip: str) -> list[Engine | Refused]:
    """Make the user's engines; one that cannot represent the robot says so in the report."""
    made: list[Engine | Refused] = []
    for kind in classes:
        try:
            made.append(kind(model, tip))
        except CannotBuild as error:
            made.append(Refused(kind.name, str(error)))
    return made


def _reference(engines: list[Engine], judge: str) -> Engine:
    """Return the engine that the others are compared with: the judge, else the first that covers every quantity."""
    complete = [engine for engine in engines if engine.covers == frozenset(METHODS)]
    for engine in complete:
        if engine.name == judge:
            return engine
    if complete:
        return complete[0]
    raise robot_models.ModelError("no engine covers every quantity of this robot, so there is nothing to compare with")


def _ask(engine: Engine, method: str, s: State, b: float, offset: float) -> Any:
    match method:
        case "mass_matrix" | "gravity_term" | "position" | "jacobian":
            return getattr(engine, method)(s.q)
        case "bias" | "drift":
            return getattr(engine, method)(s.q, s.v)
        case "stabilised":
            return engine.stabilised(s.q, s.v, s.normal, offset, np.array(STABILISER))
        case "free_acceleration":
            return engine.free_acceleration(s.q, s.v, s.torque)
        case "constrained":
            return engine.constrained(s.q, s.v, s.torque, s.normal, b)
        case _:
            return engine.impulse(s.q, s.v, s.normal, s.restitution)


def evaluate(engine: Engine, method: str, s: State, b: float, offset: float) -> dict[str, Array]:
    """Return the quantities that one call of an engine's method gives, by name.

    `b` is the right-hand side of Eq. 24 and `offset` the plane's d, both from the reference, so that an engine's error
    in one quantity does not count again in another.
    """
    answer = _ask(engine, method, s, b, offset)
    names = [name for name, of in QUANTITIES.items() if of == method]
    parts = answer if len(names) > 1 else (answer,)
    return {name: np.atleast_1d(np.asarray(part, dtype=np.float64)) for name, part in zip(names, parts, strict=True)}


def closure_right_side(engine: Engine, s: State) -> float:
    """Return b of Eq. 24 at a state: −nᵀJ̇ᵣq̇ and what the state asks for beyond it, m/s²."""
    return s.b - float(s.normal @ engine.drift(s.q, s.v))


def plane_offset(engine: Engine, s: State) -> float:
    """Return the d of the plane that leaves the state's closure error at its q, m."""
    return float(s.normal @ engine.position(s.q)) - s.error


def _truths(reference: Engine, states: list[State]) -> list[Truth]:
    """Ask the reference for everything, and state the scales: what each error is relative to."""
    values = []
    for s in states:
        found: dict[str, Array] = {}
        b, offset = closure_right_side(reference, s), plane_offset(reference, s)
        for method in METHODS:
            found |= evaluate(reference, method, s, b, offset)
        values.append(found)
    largest = {name: max(_size(v[name]) for v in values) for name in QUANTITIES}
    truths = []
    for s, v in zip(states, values, strict=True):
        A = s.normal @ v["J"]
        grown = amplification(v["H"], v["J"], A)
        scales = {name: largest[name] for name in QUANTITIES if name not in SOLVED}
        s_v, s_p = STABILISER
        # e = n·r − d carries the rounding of r, so a hundredth of r counts beside e: 45 ε of r at the tolerance.
        error = abs(s.error) + 0.01 * _size(v["r"])
        scales["b_s"] = _size(v["drift"]) + s_v * float(np.abs(A) @ np.abs(s.v)) + s_p * error
        # q̈ is summed from H⁻¹(Q − C) and H⁻¹Aᵀf, f from what the closure asks for and what the free arm does, v⁺ and
        # the impulse likewise: rounding is relative to the parts, which may cancel.
        X = np.linalg.solve(v["H"], A)
        mass = 1.0 / float(A @ X)
        free = v["free q̈"]
        torque = _size(s.torque) + _size(v["C"])
        scales["free q̈"] = max(_size(free), torque / _size(v["H"]))
        scales["f"] = mass * (abs(_right_side(s, v)) + float(np.abs(A) @ np.abs(free)))
        scales["q̈"] = max(scales["free q̈"], _size(X) * scales["f"])
        scales["impulse"] = mass * float(np.abs(A) @ np.abs(s.v)) * (1.0 + s.restitution)
        scales["v⁺"] = max(_size(s.v), _size(X) * scales["impulse"])
        bounds = {name: TERMS.value for name in QUANTITIES if name not in SOLVED}
        bounds |= {name: max(TERMS.value, SOLVES.value * grown) for name in SOLVED}
        truths.append(Truth(v, scales, bounds))
    return truths


def _right_side(s: State, values: dict[str, Array]) -> float:
    """Return b of Eq. 24 from the drift in `values`."""
    return s.b - float(s.normal @ values["drift"])


def _size(x: Array) -> float:
    return float(np.max(np.abs(x), initial=0.0))


def _judge(result: Comparison, engine: Engine, states: list[State], truths: list[Truth]) -> list[Cell]:
    """Return the cells of one engine, after its probe."""
    cells = []
    acts = True
    if engine.covers & set(PROBED):
        outcome = probe(engine)
        acts = outcome.passed
        result.probes[engine.name] = str(outcome)
    for method in METHODS:
        names = [name for name, of in QUANTITIES.items() if of == method]
        if method not in engine.covers:
            cells += [Cell(result.robot, name, engine.name, "not covered", engine.cannot[method]) for name in names]
        elif method in PROBED and not acts:
            reason = f"the probe failed: {result.probes[engine.name]}"
            cells += [
                Cell(result.robot, name, engine.name, "disagrees", reason, np.inf, np.inf, 0.0, np.inf)
                for name in names
            ]
        else:
            cells += _worst(result, engine, method, names, states, truths)
    return cells


def _worst(
    result: Comparison, engine: Engine, method: str, names: list[str], states: list[State], truths: list[Truth]
) -> list[Cell]:
    worst: dict[str, Cell] = {}
    for s, truth in zip(states, truths, strict=True):
        reason = ""
        try:
            values = truth.values
            answer = evaluate(engine, method, s, _right_side(s, values), float(s.normal @ values["r"]) - s.error)
        except NotCovered as error:
            return [Cell(result.robot, name, engine.name, "not covered", str(error)) for name in names]
        except np.linalg.LinAlgError as error:
            answer, reason = {}, f"state {s.index}: {error}"
        for name in names:
            absolute = _difference(answer.get(name), truth.values[name])
            scale, bound = truth.scales[name], truth.bounds[name]
            relative = absolute / scale if scale > 0.0 else (0.0 if absolute == 0.0 else np.inf)
            bound = max(bound, engine_bound(engine, name))
            margin = relative / bound
            if name not in worst or margin > worst[name].margin:
                status = "agrees" if margin <= 1.0 else "disagrees"
                worst[name] = Cell(
                    result.robot, name, engine.name, status, reason, absolute, relative, bound, margin, s.index
                )
    return [
        Cell(**{**worst[name].__dict__, "states": len(states)}) if name in worst else
        Cell(result.robot, name, engine.name, "disagrees", "no state was compared", np.inf, np.inf, 0.0, np.inf)
        for name in names
    ]  # fmt: skip


def _difference(x: Array | None, y: Array) -> float:
    """Return the largest difference; inf for what is missing, of another shape or not finite."""
    if x is None or x.shape != y.shape or not np.all(np.isfinite(x)):
        return np.inf
    return _size(x - y)


def engine_bound(engine: Engine, quantity: str) -> float:
    """Return what the engine's own file says of its accuracy in a quantity; 0 if it claims rounding."""
    own = engine.tolerances.get(QUANTITIES[quantity])
    return own.value if own else 0.0
