"""The states that engines are compared at: drawn by seed, inside the joint limits, and on purpose near singular poses.

State k of a seed is the same however many are drawn, so that a single one can be looked at again.

What the reference says of a state: every quantity, its scale, and how far another engine may be from it.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from validation.engines import Engine
from validation.engines.interface import METHODS
from validation.oracle.spatial import Array
from validation.tolerances import SOLVES, TERMS, amplification

# Every so many states the normal is the direction in which the pose lets the tip move least.
SINGULAR_EVERY = 5
# Such a pose is the worst of so many draws; a direction that the tip cannot move in at all is passed over.
CANDIDATES = 20
SMALLEST_SHARE = 1e-3


class Limited(Protocol):
    """What drawing states needs of a robot."""

    joint_names: tuple[str, ...]
    position_lower: Array
    position_upper: Array


class Kinematics(Protocol):
    """What finding near-singular poses needs of an engine."""

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n)."""
        ...


@dataclass(frozen=True)
class State:
    """A state and what acts in it.

    q, v, torque: (n,), joint positions, velocities and torques
    normal: (3,), unit normal of the surface, base frame
    b: what the closure asks of A q̈ beyond −nᵀJ̇ᵣq̇, m/s²
    error: closure error e that the plane leaves at q, m; the plane's offset follows from it
    restitution: of an impact, in [0, 1]
    singular: whether it was looked for near a singular pose
    """

    index: int
    q: Array
    v: Array
    torque: Array
    normal: Array
    b: float
    error: float
    restitution: float
    singular: bool


def draw_state(robot: Limited, kinematics: Kinematics, seed: int, index: int) -> State:
    """Draw state number `index` of `seed`.

    Positions are uniform within the limits (within ±π or ±1 m where there are none), velocities and torques normal with
    deviation 1 rad/s and 20 N m, normals uniform on the sphere.
    """
    rng = np.random.default_rng([seed, index])
    lower = np.where(np.isfinite(robot.position_lower), robot.position_lower, -np.pi)
    upper = np.where(np.isfinite(robot.position_upper), robot.position_upper, np.pi)
    n = len(robot.joint_names)
    singular = index % SINGULAR_EVERY == SINGULAR_EVERY - 1
    normal = rng.normal(size=3)
    q = rng.uniform(lower, upper)
    if singular:
        share = np.inf
        for candidate in rng.uniform(lower, upper, size=(CANDIDATES, n)):
            U, s, _ = np.linalg.svd(np.asarray(kinematics.jacobian(candidate)))
            movable = np.flatnonzero(s > SMALLEST_SHARE * s[0])
            if movable.size and s[movable[-1]] / s[0] < share:
                q, normal, share = candidate, U[:, movable[-1]], s[movable[-1]] / s[0]
    else:
        # A planar arm's tip cannot leave its plane: lean the normal into what the tip can do.
        U, s, _ = np.linalg.svd(np.asarray(kinematics.jacobian(q)))
        reach = U[:, : s.size] @ (np.where(s > SMALLEST_SHARE * s[0], 1.0, 0.0) * (U[:, : s.size].T @ normal))
        normal = reach if np.linalg.norm(reach) > 1e-3 else U[:, 0]
    return State(
        index=index,
        q=q,
        v=rng.normal(size=n),
        torque=rng.normal(scale=20.0, size=n),
        normal=normal / np.linalg.norm(normal),
        b=float(rng.normal()),
        # A centimetre: of a smaller error, e = n·r − d would keep fewer digits than the comparison looks at.
        error=0.01 * float(rng.normal()),
        restitution=float(rng.uniform()),
        singular=singular,
    )


def draw_states(robot: Limited, kinematics: Kinematics, seed: int, count: int) -> list[State]:
    """Draw the first `count` states of `seed`."""
    return [draw_state(robot, kinematics, seed, index) for index in range(count)]


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
