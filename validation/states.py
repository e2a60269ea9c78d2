"""The states that engines are compared at: drawn by seed, inside the joint limits, and on purpose near singular poses.

State k of a seed is the same however many are drawn, so that a single one can be looked at again.

What the reference says of a state: every quantity, its scale, and how far another engine may be from it.

Seeded random robots: any topology, every joint type, possible bodies; as a tree and as URDF text.

The tree is built from the drawn numbers and not from the text, so that reading the text can be tested against
it. The text has 17 significant digits, from which every engine recovers the same doubles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from validation.engines import Engine
from validation.engines.interface import METHODS, SOLVES, TERMS, amplification
from validation.oracle.spatial import Array, rotation_from_rpy
from validation.oracle.tree import MOVING, Joint, Link, Tree, build_tree

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
    "H": "mass_matrix", "C": "bias", "gravity": "gravity_term", "r": "position", "J": "jacobian", "drift": "drift",
    "b_s": "stabilised", "free q̈": "free_acceleration", "q̈": "constrained", "f": "constrained", "v⁺": "impulse",
    "impulse": "impulse",
}  # fmt: skip
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


@dataclass(frozen=True)
class RandomRobot:
    """A random robot, with the fields of a loaded one and the tree that its numbers make.

    joint_names, joint_types (n,) in column order; armature (n,); gravity (3,) [m/s²]; home, position_lower,
    position_upper (n,) [rad] or [m]; tip : a fixed massless link at the end of a branch
    """

    name: str
    text: str
    tree: Tree
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    armature: Array
    gravity: Array
    tip: str
    home: Array
    position_lower: Array
    position_upper: Array
    format: str = "urdf"
    locked: Mapping[str, float] = field(default_factory=dict)


def random_robot(
    seed: int, *, joints: int | None = None, branching: bool = True, kinds: Sequence[str] = MOVING,
    drive_inertia: bool = True, gravity: Array | None = None,
) -> RandomRobot:  # fmt: skip
    """Return the random robot of a seed.

    seed: the same seed is the same robot
    joints: number of moving joints; 2 to 12 at random by default
    branching: let links carry several others; else the robot is one chain, with the tip at its end
    gravity: (3,) base frame [m/s²]; 9.81 in a random direction by default
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 13)) if joints is None else joints
    draft = _Draft(rng)
    bodies = [draft.add_link("base", massive=bool(rng.integers(2)))]
    names: list[str] = []
    types: list[str] = []
    for i in range(n):
        # A new link hangs on any earlier one, on the newest twice as often: branches, but long ones too.
        above = str(rng.choice(bodies)) if branching and rng.random() < 0.5 else bodies[-1]
        types.append(str(rng.choice(kinds)))
        # Letters in random order, as engines that sort joints by name must not get away with it.
        names.append(f"{'zyxwvutsrqponmlkjihgfedcba'[rng.integers(26)]}{i}")
        bodies.append(draft.add_link(f"link{i}", massive=True))
        draft.add_joint(names[-1], types[-1], above, bodies[-1])
        if rng.random() < 0.3:
            extra = draft.add_link(f"attached{i}", massive=rng.random() < 0.7)
            draft.add_joint(f"weld{i}", "fixed", bodies[-1], extra)
            if rng.random() < 0.5:  # let the branch go on from the attached link
                bodies[-1] = extra
    draft.add_link("tip", massive=False)
    draft.add_joint("tip_mount", "fixed", bodies[-1], "tip")
    armature = 10.0 ** rng.uniform(-3.0, 0.0, n) if drive_inertia else np.zeros(n)
    fall = 9.81 * _direction(rng) if gravity is None else np.asarray(gravity, dtype=float)
    tree = build_tree(draft.links, draft.joints, joint_names=names, armature=armature, gravity=fall)
    reach = np.where(np.array(types) == "prismatic", 0.5, np.pi)
    return RandomRobot(
        name=f"random{seed}", text=draft.text(f"random{seed}"), tree=tree, joint_names=tuple(names),
        joint_types=tuple(types), armature=armature, gravity=fall, tip="tip", home=np.zeros(n), position_lower=-reach,
        position_upper=reach,
    )  # fmt: skip


def random_state(robot: RandomRobot, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return q within the robot's limits and rates of order one, both (n,)."""
    return rng.uniform(robot.position_lower, robot.position_upper), rng.normal(size=len(robot.joint_names))


def random_body(rng: np.random.Generator) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of mass (3,) [m] and tensor (3, 3) [kg m²] of a cloud of mass points.

    A tensor summed over points satisfies the triangle inequality of its principal moments, as one drawn entry
    by entry need not.
    """
    points = rng.uniform(-0.2, 0.2, (8, 3)) * rng.uniform(0.2, 1.0, 3) + rng.uniform(-0.3, 0.3, 3)
    masses = rng.uniform(0.05, 0.5, 8)
    mass = float(np.sum(masses))
    centre = masses @ points / mass
    arms = points - centre
    tensor = np.sum(masses * np.sum(arms**2, axis=1)) * np.eye(3) - (arms.T * masses) @ arms
    return mass, centre, (tensor + tensor.T) / 2


class _Draft:
    """Links and joints as they are drawn, each in numbers and in text."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self._link_texts: list[str] = []
        self._joint_texts: list[str] = []

    def add_link(self, name: str, *, massive: bool) -> str:
        """Draw a link; its inertial frame is turned by a random rpy."""
        if not massive:
            self.links.append(Link(name))
            self._link_texts.append(f'  <link name="{name}"/>')
            return name
        mass, centre, tensor = random_body(self.rng)
        rpy = self.rng.uniform(-np.pi, np.pi, 3)
        turned = rotation_from_rpy(rpy)
        self.links.append(Link(name, mass, centre, turned @ tensor @ turned.T))
        entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        inertia = " ".join(f'{key}="{tensor[at]:.17g}"' for key, at in entries.items())
        self._link_texts.append(
            f'  <link name="{name}">\n    <inertial>\n'
            f'      <origin xyz="{_text(centre)}" rpy="{_text(rpy)}"/>\n'
            f'      <mass value="{mass:.17g}"/>\n      <inertia {inertia}/>\n    </inertial>\n  </link>'
        )
        return name

    def add_joint(self, name: str, kind: str, parent: str, child: str) -> None:
        """Draw a joint; now and then one along a coordinate axis, as engines treat those apart."""
        xyz = self.rng.uniform(-0.4, 0.4, 3)
        rpy = np.zeros(3) if self.rng.random() < 0.2 else self.rng.uniform(-np.pi, np.pi, 3)
        axis = _direction(self.rng)
        if self.rng.random() < 0.3:
            axis = np.eye(3)[self.rng.integers(3)] * self.rng.choice([-1.0, 1.0])
        self.joints.append(Joint(name, kind, parent, child, rotation_from_rpy(rpy), xyz, axis))
        lines = [
            f'  <joint name="{name}" type="{kind}">',
            f'    <parent link="{parent}"/>\n    <child link="{child}"/>',
            f'    <origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>',
        ]
        if kind != "fixed":
            lines.append(f'    <axis xyz="{_text(axis)}"/>')
        if kind in ("revolute", "prismatic"):
            lines.append('    <limit lower="-10" upper="10" effort="1000" velocity="100"/>')
        self._joint_texts.append("\n".join([*lines, "  </joint>"]))

    def text(self, name: str) -> str:
        """Return the URDF, joints in an order of its own: the order in a file means nothing."""
        order = np.random.default_rng(len(self.joints)).permutation(len(self.joints))
        parts = self._link_texts + [self._joint_texts[i] for i in order]
        return "\n".join([f'<?xml version="1.0"?>\n<robot name="{name}">', *parts, "</robot>\n"])


def _direction(rng: np.random.Generator) -> Array:
    """Return a random unit vector (3,)."""
    draw = rng.normal(size=3)
    return np.asarray(draw / np.linalg.norm(draw))


def _text(numbers: Array) -> str:
    """Return the numbers in 17 significant digits, enough to read the same doubles back."""
    return " ".join(f"{number:.17g}" for number in numbers)
