"""Every quantity of every engine, compared at the same states: the heart of the harness.

The reference computes each state once (`Truth`), every engine is asked for what it covers, and the worst error of each
quantity is kept with the state that gave it. What an engine does not cover, or an engine that is not installed, is a
cell of its own and never counts as agreement. An engine's contact force counts only after its probe has shown that its
constraint acts.

The cells of a comparison: one quantity of one engine over all states, and all of one robot.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import robot_models
from validation.engines import Engine, Missing, Refused, available, probe
from validation.engines.interface import METHODS, CannotBuild, NotCovered
from validation.oracle.spatial import Array
from validation.states import PROBED, QUANTITIES, State, Truth, draw_state, evaluate, right_side, size_of, truths_of


@dataclass(frozen=True)
class Cell:
    """One quantity of one engine over all states.

    robot, quantity, engine: what was compared
    status: "agrees", "disagrees", "not covered", "not installed" or "not usable"
    reason: why, where there is no number
    absolute, relative: worst errors; inf if a number is missing or not finite
    tolerance: the bound at the state that comes closest to it
    margin: worst error over its bound; at most 1 for "agrees"
    state: the state that gave it
    states: how many were compared
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


@dataclass
class Comparison:
    """All cells of one robot.

    robot, tip, reference: robot, tip and the engine that the others are compared with
    seed, states: what was drawn
    cells: by engine, then quantity
    probes: engine -> what its probe found
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


# Fifty digits take 20 ms a state, a multibody system's start-up 4 ms, Newton-Euler passes in Python 10 to 100 ms: such
# an engine is asked at the first so many states only, and the report says at how many.
MOST_STATES = {"symbolic": 50, "exudyn": 50, "robotics toolbox": 20}


def compare(
    robot: Any, tip: str | None = None, *, states: int | Sequence[int] = 1000, seed: int = 0,
    engines: Sequence[type[Engine]] = (), built: Iterable[Engine | Missing | Refused] | None = None,
    judge: str = "oracle", label: str | None = None,
) -> Comparison:  # fmt: skip
    """Compare all engines on one robot.

    robot: a name or path for `robot_models.load`, or a model
    tip: frame to compare at; the robot's own default if left out
    states: how many states are drawn, or which of the seed's
    seed: from which they are drawn
    engines: more engines to judge, beside those that the package knows
    built: engines already made for this robot, in place of all others
    judge: name of the engine that the others are compared with; if it cannot represent the robot, the first that covers
        every quantity
    label: what to call the robot in the report
    Raises `ModelError` if the robot cannot be loaded, has no such tip, or no joint moves the tip.
    """
    model: Any = robot_models.load(robot) if isinstance(robot, str) else robot
    name = tip_of(model, tip)
    found = list(built) if built is not None else [*available(model, name), *build_all(engines, model, name)]
    ready = [engine for engine in found if isinstance(engine, Engine)]
    reference = _reference(ready, judge)
    chosen = range(min(states, MOST_STATES.get(reference.name, states))) if isinstance(states, int) else states
    result = Comparison(label or model.name, name, reference.name, seed, len(chosen))
    drawn = [draw_state(model, reference, seed, index) for index in chosen]
    try:
        truths = truths_of(reference, drawn)
    except np.linalg.LinAlgError:
        message = f"{model.name}: the frame {name!r} cannot move along the normals drawn: name another tip"
        raise robot_models.ModelError(message) from None
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

    Raises `ModelError` if the robot has no such frame, or no default.
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
            answer = evaluate(engine, method, s, right_side(s, values), float(s.normal @ values["r"]) - s.error)
        except NotCovered as error:
            return [Cell(result.robot, name, engine.name, "not covered", str(error)) for name in names]
        except np.linalg.LinAlgError as error:
            answer, reason = {}, f"state {s.index}: {error}"
        for name in names:
            absolute = _difference(answer.get(name), truth.values[name])
            scale, bound = truth.scales[name], truth.bounds[name]
            relative = absolute / scale if scale > 0.0 else (0.0 if absolute == 0.0 else np.inf)
            own = engine.tolerances.get(QUANTITIES[name])  # what the engine's own file says of its accuracy
            bound = max(bound, own.value if own else 0.0)
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
    return size_of(x - y)
