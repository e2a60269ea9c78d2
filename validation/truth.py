"""What the reference says of a state: every quantity, its scale, and how far another engine may be from it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from validation.engines import Engine
from validation.engines.interface import METHODS
from validation.oracle.spatial import Array
from validation.states import State
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


@dataclass(frozen=True)
class Truth:
    """What the reference engine says of one state, and the scale and bound for each quantity."""

    values: dict[str, Array]
    scales: dict[str, float]
    bounds: dict[str, float]


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


def truths_of(reference: Engine, states: list[State]) -> list[Truth]:
    """Ask the reference for everything, and state the scales: what each error is relative to."""
    values = []
    for s in states:
        found: dict[str, Array] = {}
        b = right_side(s, {"drift": reference.drift(s.q, s.v)})
        offset = float(s.normal @ reference.position(s.q)) - s.error  # d of the plane that the tip is off by e
        for method in METHODS:
            found |= evaluate(reference, method, s, b, offset)
        values.append(found)
    largest = {name: max(size_of(v[name]) for v in values) for name in QUANTITIES}
    truths = []
    for s, v in zip(states, values, strict=True):
        A = s.normal @ v["J"]
        grown = amplification(v["H"], v["J"], A)
        scales = {name: largest[name] for name in QUANTITIES if name not in SOLVED}
        s_v, s_p = STABILISER
        # e = n·r − d carries the rounding of r, so a hundredth of r counts beside e: 45 ε of r at the tolerance.
        error = abs(s.error) + 0.01 * size_of(v["r"])
        scales["b_s"] = size_of(v["drift"]) + s_v * float(np.abs(A) @ np.abs(s.v)) + s_p * error
        # q̈ is summed from H⁻¹(Q − C) and H⁻¹Aᵀf, f from what the closure asks for and what the free arm does, v⁺ and
        # the impulse likewise: rounding is relative to the parts, which may cancel.
        X = np.linalg.solve(v["H"], A)
        mass = 1.0 / float(A @ X)
        free = v["free q̈"]
        torque = size_of(s.torque) + size_of(v["C"])
        scales["free q̈"] = max(size_of(free), torque / size_of(v["H"]))
        scales["f"] = mass * (abs(right_side(s, v)) + float(np.abs(A) @ np.abs(free)))
        scales["q̈"] = max(scales["free q̈"], size_of(X) * scales["f"])
        scales["impulse"] = mass * float(np.abs(A) @ np.abs(s.v)) * (1.0 + s.restitution)
        scales["v⁺"] = max(size_of(s.v), size_of(X) * scales["impulse"])
        bounds = {name: TERMS.value for name in QUANTITIES if name not in SOLVED}
        bounds |= {name: max(TERMS.value, SOLVES.value * grown) for name in SOLVED}
        truths.append(Truth(v, scales, bounds))
    return truths


def right_side(s: State, values: dict[str, Array]) -> float:
    """Return b of Eq. 24 from the drift in `values`: −nᵀJ̇ᵣq̇ and what the state asks for beyond it, m/s²."""
    return s.b - float(s.normal @ values["drift"])


def size_of(x: Array) -> float:
    """Return the largest magnitude of an array, 0 of an empty one."""
    return float(np.max(np.abs(x), initial=0.0))
