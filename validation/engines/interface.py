"""What every engine looks like from outside, and what stands in its place when it is not there.

An engine is made from a robot and the name of its tip. All arrays are in the column order of
`robot.joint_names`, SI units, base axes; f is the force of the surface *on the robot*, positive along +n [N].
What an engine cannot do it says, method by method and with the reason: `covers` and `cannot` together list
every method of `METHODS`, so nothing can be left out in silence.

A description without everything that engines read differently and that is no part of the mechanism.

Proof that an engine's constraint acts, before any of its numbers counts.

Engines accept constraints that they then ignore: Drake on a continuous plant, MuJoCo with the row disabled,
Exudyn where its start-up gave up. A probe asks two questions whose answers are known beforehand.

How far two correct engines may be apart, and why.

A tolerance is a named quantity with its argument: which error dominates, and how large it can grow. Every relative
error is a difference over a scale that is stated with it.

The worst of the errors of many cases, and where it was found.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from types import MappingProxyType
from typing import ClassVar, NoReturn, TypeVar
from xml.etree import ElementTree

import numpy as np

from robot_models.coordinates import PLACES, RATES, balls
from validation.oracle.spatial import Array
from validation.oracle.tree import RobotModel

EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Tolerance:
    """A bound on a relative error, and the argument for it."""

    name: str
    value: float
    argument: str


TERMS = Tolerance(
    "terms",
    1e-12,
    "sums of some hundred products a joint over at most a dozen joints round to 1000 ε = 2e-13; relative to the "
    "largest value of the quantity over the robot's states",
)

SOLVES = Tolerance(
    "solves",
    64 * EPS,
    "H and A carry a few ten ε of rounding, which Eq. 24 amplifies by its condition number and by how small a part of "
    "the tip's Jacobian A is; relative to what q̈ and f are summed from",
)
"""Per unit of `amplification`: 1.4e-14; at an ordinary pose the product is 1e-12 to 1e-11."""


def amplification(H: Array, J: Array, A: Array) -> float:
    """Return by how much Eq. 24 can magnify a relative error of its entries.

    The matrix is scaled first so that every joint and the closure count alike (D H D has ones on its diagonal and
    |A D| = 1), which takes the units out. What the scaling of A hides, that rounding in A is relative to all of Jᵣ and
    not to the part along n, comes back as (|Jᵣ D| / |A D|)².

    H, J, A: (n, n), (3, n), (n,), mass matrix, tip Jacobian and closure row
    """
    D = 1.0 / np.sqrt(np.diag(H))
    size = float(np.linalg.norm(A * D))
    return condition(H, A[None]) * (float(np.linalg.norm(J * D)) / size) ** 2 if size > 0.0 else np.inf


def condition(H: Array, A: Array) -> float:
    """Return by how much Eq. 24 with the rows A (m, n) can magnify a relative error of its entries, joints to scale."""
    D = 1.0 / np.sqrt(np.diag(H))
    rows = A * D
    size = float(np.linalg.norm(rows))
    if size == 0.0:
        return np.inf
    K = np.block([[H * np.outer(D, D), rows.T / size], [rows / size, np.zeros((len(A), len(A)))]])
    return float(np.linalg.cond(K))


C = TypeVar("C")
T = TypeVar("T")


def size(x: Array) -> float:
    """Return the largest magnitude in x; inf where something in it is not finite."""
    return float(np.max(np.abs(x))) if np.all(np.isfinite(x)) else math.inf


def worst_of(
    cases: Iterable[C], truth: Callable[[C], T], errors: Callable[[C, T], Mapping[str, float]]
) -> tuple[float, str]:
    """Return the worst error over cases, and which quantity of which case it is.

    truth: case -> what the oracle says
    errors: case, truth -> error of each quantity, by its name. What has no solution is off by inf.
    """
    worst, where = -1.0, "nothing was compared"
    for case in cases:
        true = truth(case)
        try:
            found = errors(case, true)
        except np.linalg.LinAlgError as error:
            return math.inf, f"{case}: {error}"
        name = max(found, key=lambda key: found[key])
        if found[name] > worst:
            worst, where = found[name], f"{name}, {case}"
    return (worst, where) if worst >= 0.0 else (math.inf, where)


METHODS = (
    "mass_matrix", "bias", "gravity_term", "position", "jacobian", "drift", "free_acceleration", "stabilised",
    "constrained", "impulse",
)  # fmt: skip
"""The quantities that engines are compared in, each a method of that name."""

Robot = RobotModel
"""What an engine reads of a robot: format, text, joint_names, armature, tip, locked, gravity."""


class CannotBuild(ValueError):
    """The engine is installed but cannot represent this robot; the text says what stands in the way."""


class NotCovered(NotImplementedError):
    """The engine does not offer this quantity; the text is the reason that its class gives."""


class Engine:
    """The methods of an engine; a subclass overrides those that it covers and gives a reason for the others.

    Parameters
    ----------
    robot : a `robot_models.RobotModel`, or anything with the fields that `Robot` lists
    tip : link, body or site whose origin touches the surface

    Attributes
    ----------
    name : what tables call it
    package : the module that must be importable; None for what comes with this project
    install : the command that installs it; empty where nothing is to be installed
    balls : the first velocity of each joint that turns freely
    covers : names out of `METHODS` that it computes
    cannot : method → why not, for all others
    turns_freely : whether it is given joints that turn freely; q has rotation vectors, see `robot_models.coordinates`
    tolerances : method → its own bound, with the argument, where it is further from rounding than the harness asks
    """

    name: ClassVar[str]
    package: ClassVar[str | None] = None
    install: ClassVar[str] = ""
    covers: ClassVar[frozenset[str]]
    cannot: ClassVar[Mapping[str, str]] = MappingProxyType({})
    tolerances: ClassVar[Mapping[str, Tolerance]] = MappingProxyType({})
    turns_freely: ClassVar[bool] = False

    def __init__(self, robot: Robot, tip: str) -> None:
        self.n = len(robot.joint_names)
        self.balls = tuple(_balls(robot))

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if set(cls.cannot) | cls.covers != set(METHODS) or set(cls.cannot) & cls.covers:
            raise TypeError(f"{cls.__name__}: covers and cannot must share out {METHODS} between them")
        for method in cls.covers:
            if getattr(cls, method) is getattr(Engine, method):
                raise TypeError(f"{cls.__name__} says that it covers {method} but does not define it")

    def mass_matrix(self, q: Array) -> Array:
        """Return H (n, n), armature included."""
        self._refuse("mass_matrix")

    def bias(self, q: Array, v: Array) -> Array:
        """Return C (n,): Coriolis, centrifugal and gravity."""
        self._refuse("bias")

    def gravity_term(self, q: Array) -> Array:
        """Return the gravity part of C (n,)."""
        self._refuse("gravity_term")

    def position(self, q: Array) -> Array:
        """Return the tip r (3,), base frame [m]."""
        self._refuse("position")

    def jacobian(self, q: Array) -> Array:
        """Return Jᵣ (3, n), base axes."""
        self._refuse("jacobian")

    def drift(self, q: Array, v: Array) -> Array:
        """Return J̇ᵣq̇ (3,), base axes [m/s²]."""
        self._refuse("drift")

    def free_acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Return q̈ (n,) of the arm that touches nothing."""
        self._refuse("free_acceleration")

    def stabilised(self, q: Array, v: Array, normal: Array, offset: float, gains: Array) -> float:
        """Return b_s of Eq. 23 [m/s²]: −nᵀJ̇ᵣq̇ − s_v ė − s_p e with e = n·r − d and gains (s_v, s_p)."""
        self._refuse("stabilised")

    def constrained(self, q: Array, v: Array, torque: Array, normal: Array, b: float) -> tuple[Array, float]:
        """Return q̈ (n,) and f [N] of Eq. 24 with A = nᵀJᵣ: H q̈ + C = Q + Aᵀ f and A q̈ = b.

        Parameters
        ----------
        normal : (3,) unit n, base frame
        b : right-hand side of the closure [m/s²]; −nᵀJ̇ᵣq̇ keeps the tip in its plane
        """
        self._refuse("constrained")

    def impulse(self, q: Array, v: Array, normal: Array, restitution: float) -> tuple[Array, float]:
        """Return q̇⁺ (n,) and p [N s] of an impact: H (q̇⁺ − q̇) = Aᵀ p and A q̇⁺ = −ε A q̇."""
        self._refuse("impulse")

    def _refuse(self, method: str) -> NoReturn:
        raise NotCovered(f"{self.name} does not compute {method}: {self.cannot[method]}")


@dataclass(frozen=True)
class Missing:
    """An engine that is not installed: `install` is the command that would change that."""

    name: str
    install: str

    def __str__(self) -> str:
        return f"{self.name}: not installed ({self.install})"


@dataclass(frozen=True)
class Refused:
    """An engine that is installed but cannot be used here, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name}: cannot be used here ({self.reason})"


def installed(engine: type[Engine]) -> bool:
    """Tell whether the engine's package is there, without importing it.

    A package that is there and breaks on import is a fault of its own and will show as one.
    """
    return engine.package is None or find_spec(engine.package) is not None


def columns_of(names: Mapping[str, int], robot: Robot, engine: str) -> Array:
    """Return, for each joint of the robot, its column in the engine: the one map between the two orders.

    `names` are the engine's moving joints and their columns. Raises `CannotBuild` if it has not exactly these joints.
    """
    names = dict(names)
    for first, joint in zip(_balls(robot), _ball_names(robot), strict=True):
        if (at := names.pop(joint, None)) is not None:
            places = [joint + end for end in PLACES]
            if set(places) <= set(robot.joint_names) and not set(places) & set(names):  # a free joint in one piece
                names |= {name: at + k for k, name in enumerate(places)}
                at += len(places)
            names |= {robot.joint_names[first + k]: at + k for k in range(3)}
    if set(names) != set(robot.joint_names) or sorted(names.values()) != list(range(len(names))):
        raise CannotBuild(
            f"{engine} made joints {sorted(names)} out of {sorted(robot.joint_names)}: one column each is needed"
        )
    return np.array([names[joint] for joint in robot.joint_names], dtype=int)


def _balls(robot: Robot) -> list[int]:
    """Return the first velocity of each ball joint, of which a robot that is no `RobotModel` has none."""
    return balls(getattr(robot, "joint_types", ()))


def _ball_names(robot: Robot) -> list[str]:
    return [robot.joint_names[j].removesuffix(RATES[0]) for j in _balls(robot)]


def refuse_balls(robot: Robot, engine: str) -> None:
    """Refuse joints that turn freely, for an engine whose adapter has none: raise `CannotBuild`."""
    if names := _ball_names(robot):
        raise CannotBuild(f"joint {names[0]!r} turns freely: {engine} is given joints of one variable here")


_LEFT_OUT = {
    "link": ("visual", "collision"),  # meshes may be absent; MuJoCo and Drake would look for them
    "joint": ("dynamics", "mimic", "safety_controller", "calibration"),  # damping, friction, ties: not in Eq. 8
}
_KEPT = ("link", "joint")


def bare_urdf(text: str) -> str:
    """Return the links with their inertias and the joints with their placements, and nothing else.

    ``mimic`` goes because a joint that has a column moves on its own, ``dynamics`` because drive friction is
    no part of H and C: MuJoCo and Drake would both put it into q̈.
    """
    root = ElementTree.fromstring(text.encode())
    if root.tag != "robot":
        raise CannotBuild(f"the description is a <{root.tag}>, not a URDF <robot>")
    for element in list(root):
        if element.tag not in _KEPT:
            root.remove(element)
            continue
        for child in list(element):
            if child.tag in _LEFT_OUT[element.tag]:
                element.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


def bare_mjcf(text: str) -> tuple[str, dict[str, tuple[str, Array]]]:
    """Return the bodies and what their inertias follow from, and each site's body and place in it (3,) [m]."""
    root, sites = ElementTree.fromstring(text.encode()), {}
    for element in list(root):
        if element.tag not in ("compiler", "default", "asset", "worldbody"):
            root.remove(element)
    for compiler in root.iter("compiler"):  # Drake asks for an inertia of each body; MuJoCo and we know frames
        compiler.attrib.pop("inertiafromgeom", None)
    for joint in root.iter("joint"):
        for key in ("damping", "frictionloss", "stiffness"):  # no part of H and C
            joint.attrib.pop(key, None)
    for body in root.iter("body"):
        for site in body.findall("site"):
            place = np.array([float(value) for value in site.get("pos", "0 0 0").split()])
            sites[site.get("name", "")] = (body.get("name", ""), place)
            body.remove(site)
        for geom in body.findall("geom") if body.find("inertial") is not None else []:
            body.remove(geom)
    root.set("model", root.get("model", "robot"))  # Drake asks for a name
    return ElementTree.tostring(root, encoding="unicode"), sites


def root_link(text: str) -> str:
    """Return the link that is no joint's child."""
    root = ElementTree.fromstring(text.encode())
    children = {child.get("link") for child in root.iterfind("joint/child")}
    (name,) = [link.get("name", "") for link in root.iterfind("link") if link.get("name") not in children]
    return name


def masses(text: str) -> dict[str, float]:
    """Return the mass of each link as the text gives it [kg]."""
    root = ElementTree.fromstring(text.encode())
    found = ((link.get("name", ""), link.find("inertial/mass")) for link in root.iterfind("link"))
    return {name: 0.0 if mass is None else float(mass.get("value", "nan")) for name, mass in found}


PUSH = 50.0
"""The force with which the arm is pressed against the surface [N]."""

TOLERANCE = 1e-8
"""Relative error at which the probe's answers count as right. A constraint that is off is wrong by 1, one that is
soft by its softness (1e-4 at MuJoCo's hardest); rounding times a mass matrix of condition 1e6 stays below."""


@dataclass(frozen=True)
class ProbeResult:
    """What the probe found; relative errors, infinite where the engine gave no number.

    force : of f, where PUSH is right
    closure : of A q̈ = b, against |b| and what the free arm would do
    motion : of H q̈ + C = Q + Aᵀ f, against its largest part
    escape : how far from b the *free* arm's A q̈ is, on the scale of `closure`: what a constraint that is off shows
    """

    engine: str
    force: float
    closure: float
    motion: float
    escape: float

    @property
    def passed(self) -> bool:
        """Tell whether the constraint acts, and whether the probe could have seen it if it did not."""
        right = max(self.force, self.closure, self.motion) <= TOLERANCE
        return bool(right and self.escape > 1e3 * TOLERANCE)

    def __str__(self) -> str:
        verdict = "acts" if self.passed else "DOES NOT ACT"
        return (
            f"{self.engine}: the constraint {verdict} (errors: f {self.force:.1e}, closure {self.closure:.1e}, "
            f"motion {self.motion:.1e}; the free arm would miss the closure by {self.escape:.1e})"
        )


def probe(engine: Engine, *, seed: int = 0) -> ProbeResult:
    """Press the arm against a surface, at rest and then in motion, and look whether the surface answers.

    First Q = C − Aᵀ·PUSH and b = 0: the answer is q̈ = 0 and f = PUSH, whatever the robot. Then the same push
    on top of a random torque, in motion and with b ≠ 0: the answer must satisfy both rows of Eq. 24. The normal
    is the direction in which the tip moves most easily, so the pose cannot be singular for it.

    engine: one that covers `constrained`
    """
    rng = np.random.default_rng(seed)
    q, v, torque, b = rng.uniform(-1, 1, engine.n), rng.normal(size=engine.n), rng.normal(size=engine.n), rng.normal()
    J = engine.jacobian(q)
    normal: Array = np.linalg.svd(J)[0][:, 0]
    A = normal @ J
    still = np.zeros(engine.n)
    _, f = engine.constrained(q, still, engine.gravity_term(q) - A * PUSH, normal, 0.0)
    force = _number(abs(f - PUSH) / PUSH)

    Q = torque + engine.bias(q, v) - A * PUSH
    a, f = engine.constrained(q, v, Q, normal, float(b))
    free = engine.free_acceleration(q, v, Q)
    size = abs(float(b)) + float(np.abs(A) @ np.abs(free))
    H = engine.mass_matrix(q)
    parts = [H @ a, engine.bias(q, v) - Q, -A * f]
    motion = np.abs(sum(parts)).max() / max(np.abs(part).max() for part in parts)
    return ProbeResult(
        engine=engine.name, force=force, closure=_number(abs(float(A @ a) - float(b)) / size),
        motion=_number(float(motion)), escape=_number(abs(float(A @ free) - float(b)) / size),
    )  # fmt: skip


def _number(x: float) -> float:
    """Return x, or infinity for what is no number, so that a missing answer cannot pass."""
    return float(x) if np.isfinite(x) else float("inf")
